"""`jaxslam run` on a laser log: which job it does, and the summary and files of each."""

import argparse
import time
from collections.abc import Callable

import numpy as np

from jaxslam.cli import films
from jaxslam.cli.common import SUMMARY, check_out, summary_table
from jaxslam.cli.laser.job import Job
from jaxslam.cli.laser.localization import run_localization
from jaxslam.cli.laser.mapping import run_mapping
from jaxslam.cli.laser.options import complete, read_log
from jaxslam.cli.laser.slam import run_slam
from jaxslam.datasets import LaserLog
from jaxslam.results.campaign_files import check_figure_formats
from jaxslam.results.files import json_text, versions, write_files


def run_laser(options: argparse.Namespace, command: str) -> int:
    """Do what the options ask for, print and write the results; returns the exit status."""
    began = time.perf_counter()
    options = complete(options)
    formats = check_figure_formats("--figures", options.figures.split(","))
    log, left_out = read_log(options)
    check_out(options.out, "run")
    job = _job_of(options)(log, options)
    figures = job.figures(formats)
    summary: dict[str, object] = {
        "dataset": log.name,
        "source": log.source,
        "command": command,
        "dtype": options.dtype,
        "scans": len(log.time),
        "scans left out": left_out,
        "dropped by the reader": dict(log.dropped),
        "corrections to the data": list(log.corrections),
        **_mount_told(log),
        **job.summary,
        "seconds": round(time.perf_counter() - began, 2),
    }
    print(summary_table({"": summary}))
    if job.told:
        print("\n" + job.told)
    files = job.files | figures
    files[SUMMARY] = json_text(summary | (job.more or {}) | {"versions": versions()})
    written = write_files(options.out, files, replaces=films.NAMES)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _job_of(options: argparse.Namespace) -> Callable[[LaserLog, argparse.Namespace], Job]:
    """The function that does what the options ask for."""
    if options.localize is not None:
        return run_localization
    return run_slam if options.map is None else run_mapping


def _mount_told(log: LaserLog) -> dict[str, object]:
    """The mount of the laser, where the log has one: an entry of the summary."""
    if not log.mount.any():
        return {}
    x, y, heading = log.mount
    return {"mount of the laser [m, m, deg]": [float(x), float(y), float(np.rad2deg(heading))]}
