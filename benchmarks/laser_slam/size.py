"""Time and memory of long logs: MIT CSAIL driven several times, one run in a process of its own.

Between two drives raw odometry jumps, so that the robot is lost and found there.
"""

import dataclasses

import numpy as np

from benchmarks.gate import Metric, child
from benchmarks.laser_slam.logs import LOGS

RUN = """
import json, resource, sys, time
from benchmarks.laser_slam import logs, size
from jaxslam import laser_slam
from jaxslam._cli.recorded.memory import memory_returned
if sys.argv[2] == "warm":
    laser_slam.solve(size.repeated(1_051))
log = size.repeated(int(sys.argv[1]))
began = time.perf_counter()
with memory_returned():
    solved = laser_slam.solve(log)
told = {"seconds": time.perf_counter() - began, "stages": solved.seconds, "counts": solved.counts}
told["gigabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
print(json.dumps(told))
"""


def repeated(scans: int):
    """So many scans of CSAIL, from the first on again and again."""
    log = LOGS["csail"].read()
    rows = np.arange(scans) % len(log.time)
    turn = np.arange(scans) // len(log.time)
    raw = log.raw[rows] + 100.0 * turn[:, None] * [1, 0, 0]
    return dataclasses.replace(
        log,
        time=log.time[rows] + turn * (np.ptp(log.time) + 10.0),
        raw=raw,
        corrected=log.corrected[rows],
        odometry_known=log.odometry_known[rows],
        row=log.row[rows],
        beams=type(log.beams)(*(np.asarray(part)[rows] for part in log.beams)),
    )


def measure() -> list[Metric]:
    found = []
    for scans, start, high in ((4_791, "warm", 60.0), (20_000, "cold", np.inf)):
        told = child("-c", RUN, scans, start)
        stages = ", ".join(f"{stage} {value:.1f}" for stage, value in told["stages"].items())
        print(f"{scans:,} scans, {start}: {told['seconds']:.1f} s ({stages})")
        print(", ".join(f"{count:,} {what}" for what, count in told["counts"].items() if count))
        most = 2.0 if scans == 20_000 else np.inf
        found += [
            Metric(f"{scans:,} scans, {start}, seconds", told["seconds"], high=high),
            Metric(f"{scans:,} scans, peak memory [GB]", told["gigabytes"], high=most),
        ]
    return found
