"""`jaxslam run` on a laser log: which job it does, and the summary and files of each."""

import argparse
import time
from types import ModuleType
from typing import Any

from jaxslam.cli import films
from jaxslam.cli.common import summary_table
from jaxslam.cli.laser import localization, mapping, slam
from jaxslam.cli.laser.job import Job
from jaxslam.cli.laser.options import complete, read_log
from jaxslam.results.campaign_files import check_formats
from jaxslam.results.files import check_writable, json_text, versions, write_files


def run_laser(options: argparse.Namespace, command: str) -> int:
    """Do what the options ask for, print and write the results; returns the exit status."""
    began = time.perf_counter()
    options = complete(options)
    formats = check_formats("--figures", options.figures.split(","))
    log, left_out = read_log(options)
    check_writable(options.out)
    job: Job = _job_of(options).run(log, options)
    figures = job.figures(formats)
    summary: dict[str, Any] = {
        "dataset": log.name,
        "source": log.source,
        "command": command,
        "dtype": options.dtype,
        "scans": len(log.time),
        "scans left out": left_out,
        "dropped by the reader": dict(log.dropped),
        "corrections to the data": list(log.corrections),
        **job.summary,
        "seconds": round(time.perf_counter() - began, 2),
    }
    print(summary_table({"": summary}))
    files = job.files | figures
    files["summary.json"] = json_text(summary | {"versions": versions()})
    written = write_files(options.out, files, replaces=films.NAMES)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _job_of(options: argparse.Namespace) -> ModuleType:
    """The module whose `run` does what the options ask for."""
    if options.localize is not None:
        return localization
    return slam if options.map is None else mapping
