"""`jaxslam verify`: the Jacobians of every model, or of the user's own file."""

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from jaxslam import motion, sensors, verify
from jaxslam.cli.asking import Progress
from jaxslam.results import report
from jaxslam.verify import user_files

FAILED = 1


def verify_models(options: argparse.Namespace, command: str) -> int:
    """Verify the Jacobians, print the findings, write them; exit status, 1 if any is wrong."""
    began = time.perf_counter()
    report.check_writable(options.out)
    ask = partial(verify.verify_jacobians, count=options.states, seed=options.seed)
    if options.target is None:
        reports = _verify_all(ask)
        print(verify.table(reports))
    else:
        reports = user_files.verify_file(options.target, ask)
    details = reports if options.target else [r for r in reports if not r.passed]
    print("\n".join(["", *(str(r) for r in details)]) if details else "")
    passed = all(r.passed for r in reports)
    content = {
        "command": command,
        "passed": passed,
        "reports": [r.as_dict() for r in reports],
        "seconds": round(time.perf_counter() - began, 2),
        "versions": report.versions(),
    }
    written = report.write_files(options.out, {"verify.json": report.json_text(content)})
    print(f"{content['seconds']:.1f} s; wrote {written[0]}")
    return 0 if passed else FAILED


def _verify_one(ask: Callable[..., verify.Report], factory: Callable[..., Any]) -> verify.Report:
    return ask(verify.build(factory))


def _verify_all(ask: Callable[..., verify.Report]) -> list[verify.Report]:
    models = motion.REGISTRY | sensors.REGISTRY
    reports = []
    with (
        Progress(f"{len(models)} models", "models") as progress,
        ThreadPoolExecutor(os.cpu_count()) as pool,  # compilation takes most of the time
    ):
        tasks = [pool.submit(_verify_one, ask, factory) for factory in models.values()]
        try:
            for task in tasks:
                reports.append(task.result())
                progress(len(reports), len(models))
        except BaseException:  # an interrupt: what has not begun need not
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return reports
