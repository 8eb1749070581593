"""The part of `jaxslam judge` on one recording: published covariances against a reference."""

import argparse
from collections.abc import Mapping

import numpy as np

from jaxslam._cli.common import SUMMARY, check_out, write_results
from jaxslam.consistency import RecordingScores, judge_recording
from jaxslam.consistency._intervals import Average
from jaxslam.consistency._recording import ALIGNMENTS, COMPONENTS, FRAMES
from jaxslam.core._table import csv_text
from jaxslam.core.validation import or_none, positive, require
from jaxslam.datasets import RecordedPath, recorded_path
from jaxslam.results._campaign_files import formats_of_figures
from jaxslam.results._files import Files, Json, json_number, json_text, versions

DRAWING = "errors"

OPTIONS: dict[str, tuple[str, object]] = {
    "--align": ("align", "none"),
    "--covariance-frame": ("covariance_frame", "world"),
    "--gap": ("gap", None),
}
"""Field and default of each option of a recording besides its two sources."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for a recording, without those of folder and figures."""
    group = parser.add_argument_group("a recorded robot")
    sources = (
        "BAG:/topic, BAG:parent:child (two frames of /tf), a CSV file as of jaxslam run, or a "
    )
    group.add_argument(
        "--estimate",
        metavar="SOURCE",
        help=f"poses with covariances: {sources}file of TUM",
    )
    group.add_argument("--truth", metavar="SOURCE", help="poses of the reference, as --estimate")
    group.add_argument(
        "--align",
        choices=ALIGNMENTS,
        default="none",
        help="none: both are in one frame; first: the truth is carried to the first estimate; "
        "best: by the rigid motion that fits best (default: none)",
    )
    group.add_argument(
        "--covariance-frame",
        choices=FRAMES,
        default="world",
        help="axes of x and y in the covariances; body: along and across (default: world)",
    )
    group.add_argument(
        "--gap",
        type=float,
        metavar="S",
        help="longest interval of the truth that is interpolated [s] (default: ten times its "
        "median)",
    )


def run(options: argparse.Namespace, command: str = "jaxslam judge") -> int:
    """Judge the recording, print and write its scores; returns the exit status."""
    formats = require("--figures", options.figures.split(","), formats_of_figures)
    if options.estimate is None or options.truth is None:
        missing = "--estimate" if options.estimate is None else "--truth"
        raise ValueError(f"{missing}: expected the poses of a recorded robot, got none")
    require("--gap", options.gap, or_none(positive))
    check_out(options.out, "judge")
    estimate, truth = recorded_path(options.estimate), recorded_path(options.truth)
    try:
        scores = judge_recording(
            (estimate.time, estimate.pose, estimate.cov),
            (truth.time, truth.pose),
            align=options.align,
            covariance_frame=options.covariance_frame,
            longest_gap=options.gap,
        )
    except ValueError as problem:
        raise ValueError(f"{estimate.source} by {truth.source}: {problem}") from problem
    notes = source_notes(options.align, estimate, truth)
    print("\n".join([*notes, *([""] * bool(notes)), str(scores)]))

    def draw() -> Files:
        from jaxslam.results import plot  # matplotlib is slow to load
        from jaxslam.results.plot._style import pictures

        title = f"{estimate.source} by {truth.source}: {scores.verdict}"
        return {**pictures(DRAWING, plot.recording_figure(scores, title=title), formats)}

    summary = summary_of(scores, estimate, truth) | {
        "command": command,
        "align": options.align,
        "covariance frame": options.covariance_frame,
        "notes": notes,
        "versions": versions(),
    }
    files: Files = {SUMMARY: json_text(summary), "errors.csv": errors_csv(scores)}
    return write_results(options.out, files, {DRAWING: draw})


def source_notes(align: str, estimate: RecordedPath, truth: RecordedPath) -> list[str]:
    """Notes on the two sources: rows left out, assumptions of the readers, frames that differ."""
    notes = []
    for path in (estimate, truth):
        notes += [f"{path.source}: {note}" for note in path.notes]
        notes += [f"{path.source}: {count:,} {reason}" for reason, count in path.dropped.items()]
    frames = {path.frame for path in (estimate, truth)} - {""}
    if align == "none" and len(frames) == 2:
        notes.append(
            f"the estimate is in the frame {estimate.frame!r}, the truth in {truth.frame!r}, which "
            "are taken for one: --align first or best if they are not"
        )
    return notes


def summary_of(scores: RecordingScores, estimate: RecordedPath, truth: RecordedPath) -> Json:
    """The scores as JSON: of each number its value and interval, null where it has no bound."""
    blocks = {
        name: {
            "poses": block.poses,
            "independent errors": json_number(block.independent),
            "nees": _interval(block.nees),
            "honest nees": list(block.honest),
            "coverage": {f"{level:g}": _interval(share) for level, share in block.coverage.items()},
            "honest coverage": {
                f"{level:g}": list(ends) for level, ends in block.honest_coverage.items()
            },
        }
        for name, block in scores.blocks.items()
    }
    lag = scores.lag
    return {
        "estimate": estimate.source,
        "truth": truth.source,
        "verdict": scores.verdict,
        "doubts": list(scores.doubts),
        "poses compared": len(scores.errors.time),
        "poses left out": dict(scores.dropped),
        "blocks": blocks,
        "factors of sigma": _intervals(scores.factors),
        "rmse [m, m, rad]": dict(scores.rmse),
        "mean error [m, m, rad]": _intervals(scores.mean),
        "lag [s]": None if lag is None else _interval(lag.seconds),
        "standard error of the lag [s]": None if lag is None else json_number(lag.error),
        "nees without the lag": {} if lag is None else _intervals(lag.nees),
        "verdict without the lag": None if lag is None else lag.verdict,
    }


def _interval(average: Average) -> list[float | None]:
    return [json_number(number) for number in average]


def _intervals(averages: Mapping[str, Average]) -> Json:
    return {name: _interval(average) for name, average in averages.items()}


def errors_csv(scores: RecordingScores) -> str:
    """The errors and the claimed standard deviations at each time, empty where not valid."""
    errors = scores.errors
    units = ("[m]", "[m]", "[rad]")
    header = ["t [s]"]
    header += [f"{name} {unit}" for name, unit in zip(COMPONENTS, units, strict=True)]
    header += [f"sigma {name} {unit}" for name, unit in zip(COMPONENTS, units, strict=True)]
    rows = [
        [f"{time:.17g}", *(f"{value:.9g}" if np.isfinite(value) else "" for value in values)]
        for time, values in zip(
            errors.time, np.hstack([errors.error, errors.sigma]).tolist(), strict=True
        )
    ]
    return csv_text(header, rows)
