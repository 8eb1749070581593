"""Recorded data through the EKF, scored against the survey.

Bonn and MRCLAM are looked for in the folder JAXSLAM_DATA, by default ../shared/data beside the
checkout, and left out where absent; Victoria Park comes with GTSAM. The map is brought onto the
survey by the SE(2) motion that fits best. Seconds are of a second run, without compilation.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, show
from jaxslam import datasets
from jaxslam.consistency.metrics import align_map
from jaxslam.core.types import Status
from jaxslam.datasets import Dataset
from jaxslam.filters import EkfSlam

DATA = Path(os.environ.get("JAXSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
GATES = {"bonn": 0.2, "mrclam robot 1": 0.5, "mrclam robot 2": 0.5, "mrclam robot 3": 0.5}
"""Map RMSE [m]."""


def readers() -> list[Callable[[], Dataset]]:
    import gtsam  # other benchmarks take DATA from here

    found = [lambda: datasets.victoria_park(gtsam.findExampleDataFile("victoria_park.txt"))]
    if (DATA / "bonn").is_dir():
        found.append(lambda: datasets.bonn(DATA / "bonn"))
    if (DATA / "mrclam1").is_dir():
        found += [lambda n=n: datasets.mrclam(DATA / "mrclam1", n) for n in (1, 2, 3)]
    return found


def measure(quick: bool = False) -> list[Metric]:
    metrics, rows = [], {}
    for reader in readers():
        begin = time.perf_counter()
        data = reader()
        read = time.perf_counter() - begin
        ekf = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)

        @jax.jit
        def go(log, data=data, ekf=ekf):
            trace = jaxslam.run(ekf, log, data.pose, data.pose_cov, jax.random.key(0))
            nis = jnp.where(trace.info.status == Status.FUSED, trace.info.nis, 0.0).sum()
            return ekf.estimate(trace.final), trace.info.status, nis / trace.info.dof.sum()

        jax.block_until_ready(go(data.log))
        begin = time.perf_counter()
        final, status, nis = jax.block_until_ready(go(data.log))
        seconds = time.perf_counter() - begin
        rmse = np.nan if data.landmarks is None else align_map(final, data.landmarks)[1]
        fused, rejected = (int((status == s).sum()) for s in (Status.FUSED, Status.REJECTED))
        rows[data.name] = {
            "T": f"{data.steps:,}",
            "N": data.capacity,
            "measured": f"{data.measurements:,}",
            "fused": f"{fused:,}",
            "rejected": f"{rejected:,}",
            "dropped": f"{sum(data.dropped.values()):,}",
            "NIS/dof": f"{nis:.3f}",
            "RMSE [m]": rmse,
            "read [s]": f"{read:.2f}",
            "run [s]": f"{seconds:.2f}",
        }
        if data.name in GATES:
            metrics.append(Metric(f"map RMSE of {data.name} [m]", rmse, high=GATES[data.name]))
        metrics.append(Metric(f"NIS/dof of {data.name}", float(nis), low=0.7, high=1.3))
    show("EKF-SLAM of recorded data", rows)
    return metrics
