"""The command `jaxslam fit`: noises and systematic errors of a user's data."""

import argparse
from pathlib import Path

import numpy as np

from jaxslam._cli import cache
from jaxslam._cli.common import add_out
from jaxslam.datasets import Dataset, DatasetFit, fit, table
from jaxslam.datasets._landmark_logs.table_settings import FITTED, fitted_text
from jaxslam.results._files import (
    Files,
    Json,
    check_writable,
    json_number,
    json_text,
    text_table,
    versions,
    write_files,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam fit`."""
    parser.add_argument("path", metavar="FOLDER", help="the folder of the CSV files")
    parser.add_argument(
        "--calibrate",
        metavar="GROUPS",
        default="",
        help="systematic errors to fit, too, some of: mount, scale, wheels, heading, range, axis, "
        "delay; with commas between them",
    )
    parser.add_argument(
        "--fix",
        metavar="NAMES",
        default="",
        help='parameters or groups to hold, comma-separated, as "motion v,mount y" or noise',
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="also write fit.toml into the folder, where it replaces numbers of dataset.toml",
    )
    cache.add_options(parser)
    add_out(parser)
    parser.set_defaults(command=fit_folder, dtype="float64")


def fit_folder(options: argparse.Namespace, command: str) -> int:
    """Fit the noises of a folder, print and write them; returns the exit status."""
    data = table(options.path, fitted=False)
    check_writable(options.out)
    fixed, calibrated = (
        [name.strip() for name in text.split(",") if name.strip()]
        for text in (options.fix, options.calibrate)
    )
    result = fit(data, calibrate=calibrated, fixed=fixed)
    print(_table(data, result))
    groups = [parameter.group for parameter in result.parameters]
    kept = np.flatnonzero([group in ("noise", *calibrated) for group in groups])
    fitted = fitted_text([result.parameters[i] for i in kept], result.cov[np.ix_(kept, kept)])
    files: Files = {
        "fit.json": json_text(
            _summary(data, result) | {"command": command, "versions": versions()}
        ),
        FITTED: fitted,
    }
    written = write_files(options.out, files)
    confounded = [one.name for one in result.parameters if one.group != "noise"]
    confounded = [name for name in confounded if name in result.found.loose]
    good = result.found.converged and result.settled and not confounded
    if options.write and good:
        written += write_files(Path(options.path), {FITTED: fitted})
    print("\nwrote " + ", ".join(map(str, written)))
    if options.write and not good:
        reason = f"hold {' or '.join(confounded)}" if confounded else "the fit did not converge"
        print(f"{FITTED} was not written into {options.path}: {reason}")
    elif not options.write:
        print(
            f"use --write to write {FITTED} into {options.path}, too, where it replaces numbers of "
            "dataset.toml"
        )
    return 0


def _summary(data: Dataset, result: DatasetFit) -> Json:
    """The content of `fit.json`; infinite numbers are null."""
    found = result.found
    rows = zip(
        found.names, found.start, found.parameters, found.error, found.robust_error, strict=True
    )
    return {
        "dataset": data.name,
        "measurements used": result.used,
        "measurements left out": result.left_out,
        "dropped by the reader": data.dropped,
        "parameters": {
            name: {
                "before": float(before),
                "after": float(after),
                "standard error": json_number(error),
                "robust error": json_number(robust),
                "upper limit, 95 %": found.upper.get(name),
                "not determined, confounded with": (
                    list(found.loose[name]) if name in found.loose else None
                ),
            }
            for name, before, after, error, robust in rows
        },
        "held fixed": result.held,
        "log-likelihood": list(found.log_likelihood),
        "NIS / dof": list(found.nis_per_dof),
        "dof": found.dof,
        "innovation autocorrelation": json_number(result.autocorrelation[0]),
        "innovation autocorrelation, 95 % band": json_number(result.autocorrelation[1]),
        "steps": len(found.path) - 1,
        "converged": found.converged,
        "rounds of association and gate": result.rounds,
        "associations settled": result.settled,
        "defaults taken": list(data.assumed),
    }


def _table(data: Dataset, result: DatasetFit) -> str:
    """The parameters before and after with their errors, the likelihood, and notes."""
    found = result.found
    lines = [["", "before", "after", "std. error", "robust"]]
    for i, name in enumerate(found.names):
        errors = found.error[i], found.robust_error[i]
        shown = [f"{e:.2g}" if np.isfinite(e) and name not in found.upper else "-" for e in errors]
        value = (
            f"< {found.upper[name]:.2g}" if name in found.upper else f"{found.parameters[i]:.4g}"
        )
        lines.append([name, f"{found.start[i]:.4g}", value, *shown])
    before, after = found.log_likelihood
    lines.append(["log-likelihood", f"{before:.1f}", f"{after:.1f}", "", ""])
    before, after = found.nis_per_dof
    lines.append(["NIS / dof", f"{before:.3f}", f"{after:.3f}", "", ""])
    lag, band = result.autocorrelation
    if np.isfinite(lag):
        lines.append(["autocorrelation", "", f"{lag:.3f}", f"(± {band:.2g})", ""])
    text = text_table(lines)
    out = ", ".join(f"{count:,} {name}" for name, count in result.left_out.items())
    text.insert(
        0,
        f"{data.name}: {data.steps:,} rows, {result.used:,} measurements used"
        + (f", others: {out}" if out else ""),
    )
    return "\n".join([*(line.rstrip() for line in text), "", *_notes(result)])


def _notes(result: DatasetFit) -> list[str]:
    """Sentences on convergence, parameters held and parameters that the log does not determine."""
    found = result.found
    steps = len(found.path) - 1
    notes = [
        f"converged after {steps} steps"
        if found.converged
        else f"NOT converged after {steps} steps: start closer, or hold a parameter (--fix)"
    ]
    if not result.settled:
        notes.append(
            f"NOT settled: after {result.rounds} rounds the noises still change what is associated "
            "or gated"
        )
    notes += [f"{name} = {value:g} was held" for name, value in result.held.items()]
    for name, limit in found.upper.items():
        notes.append(
            f"{name}: this log does not distinguish it from 0; above {limit:.2g} it is unlikely "
            "(95 %, the others held)"
        )
    for name, others in found.loose.items():
        reason = (
            f"only together with {', '.join(others)}" if others else "its error is over a factor e"
        )
        notes.append(f"{name}: the log does not determine it ({reason}); hold it by --fix")
    off = [
        name
        for name, one, other in zip(found.names, found.error, found.robust_error, strict=True)
        if np.isfinite(one)
        and not 0.5 <= other / one <= 2
        and name not in (*found.upper, *found.loose)
    ]
    if off:
        notes.append(
            f"{', '.join(off)}: robust and standard errors differ by over a factor 2, so the "
            "models do not fit"
        )
    value, band = result.autocorrelation
    if abs(value) > max(band, 0.1):
        notes.append(
            "successive innovations of a landmark are correlated: errors last, so standard errors "
            "are too small"
        )
    if any(name.startswith(("motion ", "sensor ")) for name in found.names):
        notes.append(
            "NIS / dof is near 1 after any fit of all noises; test them on another log (jaxslam "
            "run)"
        )
    return notes
