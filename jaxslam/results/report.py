"""Results on paper: a campaign's table, JSON and CSV, and files that appear whole or not."""

import csv
import io
import json
import math
import os
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.consistency import (
    DOF,
    LANDMARK_DOF,
    LEVEL,
    LEVELS,
    Measure,
    Summary,
    lopsided,
    power_of,
)
from jaxslam.consistency.verdict import TESTS
from jaxslam.monte_carlo import Campaign
from jaxslam.types import Estimate

ROWS = (
    ("nees_pose", "pose NEES (x, y, θ)", f"{DOF['pose']}"),
    ("nees_own", "pose NEES, own error", f"{DOF['pose']}"),
    ("nees_position", "position NEES", f"{DOF['position']}"),
    ("nees_heading", "heading NEES", f"{DOF['heading']}"),
    ("nees_landmarks", "landmark NEES", f"{LANDMARK_DOF}"),
    ("nis_per_dof", "NIS / dof", "1"),
    ("autocorrelation", "innovation autocorr., lag 1", "0"),
    ("coverage_95_pose", "pose in 95 % ellipsoid", "0.95"),
    ("noncredibility", "noncredibility [dB]", "0"),
    ("inclination", "inclination [dB]", "0"),
    ("rmse_position", "position RMSE [m]", ""),
    ("bound_ratio_position", "  over conditional bound", "1"),
    ("rmse_heading_deg", "heading RMSE [°]", ""),
    ("bound_ratio_heading", "  over conditional bound", "1"),
    ("rmse_landmarks", "landmark RMSE [m]", ""),
    ("precision", "associations: precision", "1"),
    ("recall", "associations: recall", "1"),
    ("false_landmarks", "false landmarks", "0"),
    ("unobservable", "unobservable directions", "3"),
    ("rotation_information", "learnt of a turn [1/rad²]", "0"),
    ("log_likelihood", "log-likelihood", ""),
)
"""Measure, its name in the table, and what an honest filter shows."""

_COLUMNS = 5


def table(campaign: Campaign) -> str:
    """The campaign for a human: one column a filter, one row a measure, and the verdicts.

    Filters beyond the fifth start a further table.
    """
    names = list(campaign.filters)
    parts = [names[i : i + _COLUMNS] for i in range(0, len(names), _COLUMNS)]
    text = "\n\n".join(_columns(campaign, part) for part in parts)
    title = f"{campaign.scenario}: {campaign.runs} runs × {campaign.steps} steps, {campaign.dtype}"
    notes = [
        f"NEES is not divided by its dof, which is the honest value. ± or [ends]: {LEVEL:.0%}",
        "interval over the runs. Verdict: whether pose NEES = 3 and NIS / dof = 1 lie in intervals",
        f"that an honest filter's miss in {1 - LEVEL:.0%} of campaigns; above: optimistic, below:",
        "pessimistic, and which spoke; consistent: not rejected. divergent: final position error "
        f"over {campaign.divergence_limit:.3g} m, 5 σ of the ideal EKF.",
    ]
    notes += qualified(campaign)
    notes += not_finite(campaign)
    if campaign.dtype == "float32":
        notes.append(
            "In float32: the command's default is float64 (from Python, jax_enable_x64 first)."
        )
    if campaign.published:
        notes.append(f"published: {campaign.source}")
    return "\n".join([title, "", text, "", *notes])


def qualified(campaign: Campaign) -> list[str]:
    """A sentence on each filter that was not rejected, with what would have been noticed, and on
    each verdict that has to be qualified, which has an asterisk in the table."""
    out = []
    for name, summary in campaign.filters.items():
        power = power_of(summary.noticed)
        if power and summary.verdict in ("consistent", "incomplete", "undecided"):
            out.append(f"{name}: not rejected; {power}")
        out += [f"{name}*: {doubt}" for doubt in summary.doubts]
    return out


def not_finite(campaign: Campaign) -> list[str]:
    """A sentence on each filter that was not finite in some runs, with the numbers of those."""
    out = []
    for name, summary in campaign.filters.items():
        lost = summary.not_finite_runs
        if lost:
            shown = ", ".join(map(str, lost[:20])) + (", …" if len(lost) > 20 else "")
            out.append(
                f"{name} was not finite in {len(lost)} of {campaign.runs} runs, which its figures "
                f"leave out: {shown}"
            )
    return out


def as_json(campaign: Campaign, command: str = "", seed: int | None = None) -> str:
    """Everything but the curves, with versions, seed and command line; no NaN or infinity in it."""
    filters = {
        name: {
            "verdict": s.verdict,
            "rejected_by": s.by,
            "noticed": {key: _numbers(np.asarray(ends)) for key, ends in s.noticed.items()},
            "doubts": s.doubts,
            "measures": {key: _finite(measure._asdict()) for key, measure in s.measures.items()},
            "nis_band": s.nis_band,
            "steps_inside_band": s.inside,
            "coverage": {block: _numbers(share) for block, share in s.coverage.items()},
            "autocorrelation": _numbers(s.autocorrelation),
            "autocorrelation_band": _numbers(s.autocorrelation_band),
            "not_finite_runs": s.not_finite_runs,
            "counts": s.counts,
        }
        for name, s in campaign.filters.items()
    }
    head = {
        "scenario": campaign.scenario,
        "source": campaign.source,
        "published": campaign.published,
        "runs": campaign.runs,
        "steps": campaign.steps,
        "dtype": campaign.dtype,
        "seed": seed,
        "command": command,
        "nees_convention": "not divided by dof",
        "coverage_levels": LEVELS,
        "level": LEVEL,
        "divergence_limit_m": campaign.divergence_limit,
        "seconds": round(campaign.seconds, 3),
        "compile_seconds": round(campaign.compile_seconds, 3),
        "step_seconds": campaign.step_seconds,
        "versions": versions(),
    }
    return json_text(head | {"filters": filters})


def json_text(content: Mapping[str, Any]) -> str:
    """Indented JSON; raises ValueError on a NaN or an infinity, which JSON does not have."""
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def as_csv(campaign: Campaign) -> str:
    """The curves: one row a filter and step; an empty cell where there is no number."""
    keys = list(dict.fromkeys(key for s in _of(campaign) for key in s.curves))
    nothing = np.full(campaign.steps, np.nan)  # a filter without landmarks, say, lacks some
    rows: list[list[str]] = []
    for name, s in campaign.filters.items():
        columns = [map(_blank, s.curves.get(key, nothing).tolist()) for key in keys]
        rows += [[name, str(step + 1), *row] for step, row in enumerate(zip(*columns, strict=True))]
    return csv_text(["filter", "step", *keys], rows)


def trajectory_csv(time: np.ndarray, estimate: Estimate) -> str:
    """One row a step: time, pose and the upper triangle of its covariance (x, y, θ)."""
    header = ["time", "x", "y", "theta", "c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt"]
    rows, columns = np.triu_indices(3)
    triangle = np.asarray(estimate.pose_cov)[:, rows, columns]
    values = np.concatenate(
        [np.asarray(time)[:, None], np.asarray(estimate.pose), triangle], axis=1
    )
    # 17 digits for the time, an epoch; nine for the rest.
    return csv_text(
        header, [[f"{row[0]:.17g}", *(f"{value:.9g}" for value in row[1:])] for row in values]
    )


def map_csv(estimate: Estimate, names: Sequence[int]) -> str:
    """One row a landmark of a map at one time: the data set's name of it, position, covariance."""
    rows = []
    for i in np.flatnonzero(np.asarray(estimate.alive)):
        cov = np.asarray(estimate.point_covs[i])
        values = [*np.asarray(estimate.points[i]), cov[0, 0], cov[0, 1], cov[1, 1]]
        rows.append([str(names[int(estimate.tag[i])]), *(f"{value:.9g}" for value in values)])
    return csv_text(["landmark", "x", "y", "c_xx", "c_xy", "c_yy"], rows)


def csv_text(header: list[str], rows: list[list[str]]) -> str:
    """Comma-separated text with a header line."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def versions() -> dict[str, str]:
    """Of Python, this package and what it computes with."""
    return {"python": platform.python_version()} | {
        name: version(name) for name in ("jax", "numpy")
    }


def check_writable(folder: Path) -> None:
    """Raise OSError now, before hours of work, if files cannot be written to the folder.

    The folder is not made here; its nearest existing parent is tried. The error names the folder as
    it was given.
    """
    try:
        there = folder.absolute()
        while not there.exists():
            there = there.parent
        if not there.is_dir():
            raise NotADirectoryError(f"{there} is not a folder")
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise type(error)(f"results cannot be written to {folder}: {reason}") from error


def write_files(folder: Path, files: Mapping[str, str | Callable[[Path], Any]]) -> list[Path]:
    """Write files, each text or a function that saves to a path; they appear whole or not at all.

    All are written to a hidden folder beside the target first and moved in place only when the last
    one is complete; on any error, an interrupt too, nothing of them stays behind.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".unfinished-") as hidden:
        for name, content in files.items():
            target = Path(hidden) / name
            if callable(content):
                content(target)
            else:
                target.write_text(content, encoding="utf-8")
        for name in files:
            os.replace(Path(hidden) / name, folder / name)
    return [folder / name for name in files]


def _columns(campaign: Campaign, names: list[str]) -> str:
    summaries = [campaign.filters[name] for name in names]
    lines = [["", "honest", *names]]
    lines.append(["verdict", "consistent", *map(_verdict, summaries)])
    for key, label, honest in ROWS:
        cells = [_cell(s.measures.get(key)) for s in summaries]
        if any(cell != "-" for cell in cells):
            lines.append([label, honest, *cells])
        note = [campaign.published.get(name, {}).get(key) for name in names]
        if any(figure is not None for figure in note):
            figures = ["" if figure is None else f"{figure:.4g}" for figure in note]
            lines.append(["  published", "", *figures])
    lines.append([f"NIS / dof, {LEVEL:.0%} band", "", *(_band(s.nis_band) for s in summaries)])
    first = [s.autocorrelation_band[0] for s in summaries]
    lags = [f"± {half:.4f}" if np.isfinite(half) else "-" for half in first]
    lines.append([f"autocorrelation, {LEVEL:.0%} band", "", *lags])
    for block in DOF:
        shares = [f"{s.inside[block]:.1%}" if block in s.inside else "-" for s in summaries]
        lines.append([f"steps in {block} band", f"{LEVEL:.1%}", *shares])
    took = [campaign.step_seconds.get(name) for name in names]
    if any(took):
        cells = ["-" if one is None else f"{1e6 * one:.3g}" for one in took]
        lines.append(["time of a step [µs]", "", *cells])
    always = ("runs", "not_finite", "divergent")
    for key in dict.fromkeys(key for s in summaries for key in s.counts):
        counts = [s.counts.get(key) for s in summaries]
        if key in always or any(counts):
            shown = ("-" if count is None else f"{count:,}" for count in counts)
            lines.append([key.replace("_", " "), "", *shown])
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    text = [
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w)
            for i, (c, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    ]
    text.insert(1, "-" * len(text[0]))
    return "\n".join(text)


def _of(campaign: Campaign) -> list[Summary]:
    return list(campaign.filters.values())


def _verdict(summary: Summary) -> str:
    """The word, which tests spoke, and an asterisk where it is qualified."""
    spoke = ", ".join(
        TESTS[name].removeprefix("pose ").removesuffix(" / dof") for name in summary.by
    )
    return summary.verdict + f" ({spoke})" * bool(spoke) + "*" * bool(summary.doubts)


def _cell(measure: Measure | None) -> str:
    if measure is None:
        return "-"
    value, low, high = measure
    if not (np.isfinite(low) or np.isfinite(high)) or (low, high) == (0.0, np.inf):
        return f"{value:.4g}"
    if lopsided(measure):
        return f"{value:.4g} [{low:.3g}, {high:.3g}]".replace("inf", "∞")
    return f"{value:.4g} ± {(high - low) / 2:.2g}"


def _band(band: tuple[float, float] | None) -> str:
    return "-" if band is None else f"[{band[0]:.4f}, {band[1]:.4f}]"


def _numbers(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    return {k: float(v) if np.isfinite(v) else None for k, v in values.items()}


def _blank(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""
