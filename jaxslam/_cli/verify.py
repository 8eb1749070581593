"""The command `jaxslam verify`: the Jacobians of every model, or of a user's file."""

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from jaxslam import motion, sensors, verify
from jaxslam._cli import cache
from jaxslam._cli.common import FAILED, add_out
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.laser.grids import beam_models
from jaxslam.results._files import check_writable, json_text, versions, write_files
from jaxslam.verify._findings import report_table
from jaxslam.verify._inputs import user_files
from jaxslam.verify._verifier import build


def verify_models(options: argparse.Namespace, command: str) -> int:
    """Verify Jacobians, print and write the findings; returns the exit status, 1 if any fails."""
    began = time.perf_counter()
    if options.states < 2:
        raise ValueError(f"--states: expected at least 2, got {options.states}")
    check_writable(options.out)
    verify_one = partial(verify.verify_jacobians, count=options.states, seed=options.seed)
    if options.target is None:
        models = motion.REGISTRY | sensors.REGISTRY | beam_models.REGISTRY
        reports = []
        with (
            Progress(f"{len(models)} models", "models") as progress,
            ThreadPoolExecutor(os.cpu_count()) as pool,  # compilation takes most of the time
        ):
            tasks = [
                pool.submit(lambda make: verify_one(build(make)), factory)
                for factory in models.values()
            ]
            try:
                for task in tasks:
                    reports.append(task.result())
                    progress(len(reports), len(models))
            except BaseException:  # on an interrupt, models not yet started are dropped
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        print(report_table(reports))
    else:
        reports = user_files.verify_file(options.target, verify_one)
    details = reports if options.target else [r for r in reports if not r.passed]
    print("\n".join(["", *(str(r) for r in details)]) if details else "")
    passed = all(r.passed for r in reports)
    content = {
        "command": command,
        "passed": passed,
        "reports": [r.as_dict() for r in reports],
        "seconds": round(time.perf_counter() - began, 2),
        "versions": versions(),
    }
    written = write_files(options.out, {"verify.json": json_text(content)})
    print(f"{content['seconds']:.1f} s; wrote {written[0]}")
    return 0 if passed else FAILED


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam verify`."""
    parser.add_argument(
        "target",
        metavar="FILE.py[:NAME]",
        nargs="?",
        help="a file that defines a Motion, a Sensor, a factory of one, a graphs.Factor, a "
        "grids.BeamModel, or a function f and its f_jacobian; NAME: only that one (default: every "
        "motion model, sensor and beam model of jaxslam)",
    )
    parser.add_argument(
        "--states", type=int, default=24, help="number of random states (default: 24)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the random states (default: 0)"
    )
    add_out(parser)
    cache.add_options(parser)
    parser.set_defaults(command=verify_models, dtype="float64")
