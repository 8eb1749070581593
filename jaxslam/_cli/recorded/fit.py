"""The command `jaxslam fit`: noises and systematic errors of a user's data."""

import argparse
from pathlib import Path

import numpy as np

from jaxslam._cli import cache
from jaxslam._cli.common import add_out, summary_table
from jaxslam.core._table import Row, Table, text_of
from jaxslam.datasets import Dataset, DatasetFit, fit, table
from jaxslam.datasets._landmark_logs.table_settings import FITTED, fitted_text
from jaxslam.results._files import (
    Files,
    Json,
    check_writable,
    json_number,
    json_text,
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
    if data.assumed:
        print(summary_table({"": {"defaults taken": list(data.assumed)}}), end="\n\n")
    print(_table(data, result))
    groups = [parameter.group for parameter in result.parameters]
    # fit.toml replaces the numbers of the groups that were to be fitted, held ones among them too.
    kept = np.flatnonzero([group in ("noise", *calibrated) for group in groups])
    fitted = fitted_text([result.parameters[i] for i in kept], result.cov[np.ix_(kept, kept)])
    files: Files = {
        "fit.json": json_text(
            _summary(data, result) | {"command": command, "versions": versions()}
        ),
        FITTED: fitted,
    }
    written = write_files(options.out, files)
    confounded = [
        parameter.name
        for parameter in result.parameters
        if parameter.group != "noise" and parameter.name in result.noise_fit.loose
    ]
    good = result.noise_fit.converged and result.settled and not confounded
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
    estimate = result.noise_fit
    rows = zip(
        estimate.names,
        estimate.start,
        estimate.parameters,
        estimate.error,
        estimate.robust_error,
        strict=True,
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
                "upper limit, 95 %": estimate.upper.get(name),
                "not determined, confounded with": (
                    list(estimate.loose[name]) if name in estimate.loose else None
                ),
            }
            for name, before, after, error, robust in rows
        },
        "held fixed": result.held,
        "log-likelihood": list(estimate.log_likelihood),
        "NIS / dof": list(estimate.nis_per_dof),
        "dof": estimate.dof,
        "innovation autocorrelation": json_number(result.autocorrelation[0]),
        "innovation autocorrelation, 95 % band": json_number(result.autocorrelation[1]),
        "steps": len(estimate.path) - 1,
        "converged": estimate.converged,
        "rounds of association and gate": result.rounds,
        "associations settled": result.settled,
        "defaults taken": list(data.assumed),
    }


def _table(data: Dataset, result: DatasetFit) -> str:
    """The parameters before and after with their errors, the likelihood, and notes."""
    estimate = result.noise_fit
    rows = []
    for i, name in enumerate(estimate.names):
        limit = estimate.upper.get(name)
        errors = estimate.error[i], estimate.robust_error[i]
        value = f"{estimate.parameters[i]:.4g}" if limit is None else f"< {limit:.2g}"
        shown = [f"{e:.2g}" if np.isfinite(e) and limit is None else None for e in errors]
        rows.append(Row(name, [f"{estimate.start[i]:.4g}", value, *shown]))
    before, after = estimate.log_likelihood
    rows.append(Row("log-likelihood", [f"{before:.1f}", f"{after:.1f}", "", ""]))
    before, after = estimate.nis_per_dof
    rows.append(Row("NIS / dof", [f"{before:.3f}", f"{after:.3f}", "", ""]))
    lag, band = result.autocorrelation
    if np.isfinite(lag):
        rows.append(Row("autocorrelation", ["", f"{lag:.3f}", f"(± {band:.2g})", ""]))
    parameters = Table(["", "before", "after", "std. error", "robust"], rows)
    head = f"{data.name}: {data.steps:,} rows, {result.used:,} measurements used"
    if result.left_out:
        counts = (f"{count:,} {name}" for name, count in result.left_out.items())
        head += f", others: {', '.join(counts)}"
    return "\n".join([head, text_of(parameters), "", *_notes(result)])


def _notes(result: DatasetFit) -> list[str]:
    """Sentences on convergence, parameters held and parameters that the log does not determine."""
    estimate = result.noise_fit
    steps = len(estimate.path) - 1
    notes = [
        f"converged after {steps} steps"
        if estimate.converged
        else f"NOT converged after {steps} steps: start closer, or hold a parameter (--fix)"
    ]
    if not result.settled:
        notes.append(
            f"NOT settled: after {result.rounds} rounds the noises still change what is associated "
            "or gated"
        )
    notes += [f"{name} = {value:g} was held" for name, value in result.held.items()]
    for name, limit in estimate.upper.items():
        notes.append(
            f"{name}: this log does not distinguish it from 0; above {limit:.2g} it is unlikely "
            "(95 %, the others held)"
        )
    for name, others in estimate.loose.items():
        reason = (
            f"only together with {', '.join(others)}" if others else "its error is over a factor e"
        )
        notes.append(f"{name}: the log does not determine it ({reason}); hold it by --fix")
    # If the models fit, the two kinds of errors agree.
    contradictory = [
        name
        for name, error, robust in zip(
            estimate.names, estimate.error, estimate.robust_error, strict=True
        )
        if np.isfinite(error)
        and not 0.5 <= robust / error <= 2
        and name not in (*estimate.upper, *estimate.loose)
    ]
    if contradictory:
        notes.append(
            f"{', '.join(contradictory)}: robust and standard errors differ by over a factor 2, "
            "so the models do not fit"
        )
    value, band = result.autocorrelation
    if abs(value) > max(band, 0.1):
        notes.append(
            "successive innovations of a landmark are correlated: errors last, so standard errors "
            "are too small"
        )
    if any(name.startswith(("motion ", "sensor ", "state ")) for name in estimate.names):
        notes.append(
            "NIS / dof is near 1 after any fit of all noises; test them on another log (jaxslam "
            "run)"
        )
    return notes
