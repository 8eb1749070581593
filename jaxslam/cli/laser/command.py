"""`jaxslam run` on a laser log: which job it does, and the summary and files of each."""

import argparse
import time
from typing import Any

from jaxslam.cli.common import summary_table
from jaxslam.cli.laser import localization, mapping
from jaxslam.cli.laser.job import Job
from jaxslam.cli.laser.options import complete, read_log
from jaxslam.results.campaign_files import check_formats
from jaxslam.results.files import check_writable, json_text, versions, write_files


def run_laser(options: argparse.Namespace, command: str) -> int:
    """Do what the options ask for, print and write the results; returns the exit status."""
    began = time.perf_counter()
    if options.map is None and options.localize is None:
        raise ValueError(
            f"{options.path}: SLAM from a laser log is not there yet: --map known makes a map from "
            "the poses in the file, --localize MAP.yaml localizes the robot in a map"
        )
    options = complete(options)
    formats = check_formats("--figures", options.figures.split(","))
    log, left_out = read_log(options)
    check_writable(options.out)
    job: Job = (mapping.run if options.localize is None else localization.run)(log, options)
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
    written = write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0
