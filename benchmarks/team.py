"""Three robots of MRCLAM in one map, with and without their sightings of each other.

The first robot alone; three robots that know nothing of each other but the map; and three that see
each other too. Where robots 2 and 3 start is not told: each finds itself by two landmarks. Scored
by the map, brought onto the survey by the SE(2) motion that fits best; the recorded poses are not
among the files. `theirs` is NIS/dof of the sightings alone. The folder is JAXSLAM_DATA, by default
../shared/data beside the checkout.
"""

import time

import jax
import numpy as np

import jaxslam
from benchmarks.gate import Metric, show
from benchmarks.real_data import DATA
from jaxslam import datasets
from jaxslam.consistency.metrics import align_map
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam, TeamSlam
from jaxslam.filters.multi_robot.team import poses


def through(filter, data, log, robots):
    """The trace, on the host: the estimate at the end, info, (pose, cov, there) of all robots."""

    def probe(joint):
        return poses(joint, robots) if robots > 1 else (joint.pose[None], joint.cov[None, :3, :3])

    @jax.jit
    def go(log):
        start = data.pose, data.pose_cov, jax.random.key(0)
        trace = jaxslam.run(filter, log, *start, probe=probe)
        return filter.estimate(trace.final), trace.info._replace(innovation_cov=()), trace.probe

    compiled = go.lower(log).compile()
    begin = time.perf_counter()
    return jax.device_get(compiled(log)), time.perf_counter() - begin


def measure(quick: bool = False) -> list[Metric]:
    if not (DATA / "mrclam1").is_dir():
        print(f"no folder {DATA / 'mrclam1'}")
        return []
    data = datasets.mrclam_team(DATA / "mrclam1")
    log, own = data.log, data.log.scan.tag < data.capacity
    apart = log._replace(scan=log.scan._replace(valid=log.scan.valid & own))
    alone = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
    team = TeamSlam(data.robots, data.capacity, **data.filter_options)
    print(f"{data.name}: {len(log.control):,} rows, dropped {data.dropped}")
    rows, metrics = {}, []
    for name, filter, given, robots in (
        ("one alone", alone, log, 1),
        ("three, blind", team, apart, 3),
        ("three", team, log, 3),
    ):
        (final, info, (_, covs, *there)), seconds = through(filter, data, given, robots)
        fused = info.status == Status.FUSED
        met = fused & ~own
        nis = float(np.where(fused, info.nis, 0.0).sum() / info.dof.sum())
        rmse = align_map(final, data.landmarks)[1]
        spread = np.trace(covs[:, :, :2, :2], axis1=2, axis2=3) / 2
        # Of each robot over the second half, when all have long been in the map.
        sigmas = np.sqrt(spread[len(spread) // 2 :].mean(axis=0))
        rows[name] = {
            "fused": f"{fused.sum():,}",
            "sightings": f"{met.sum():,}",
            "unused": f"{(info.status == Status.UNMATCHED).sum():,}",
            "NIS/dof": nis,
            "theirs": np.where(met, info.nis, 0.0).sum() / max(2 * met.sum(), 1),
            "RMSE [m]": rmse,
            "σ [m]": ", ".join(f"{s:.4f}" for s in sigmas),
            "run [s]": f"{seconds:.1f}",
        }
        metrics.append(Metric(f"map RMSE, {name} [m]", rmse, high=0.5))
        metrics.append(Metric(f"NIS/dof, {name}", nis, low=0.7, high=1.5))
    show("robots in one map", rows)
    off = info.innovation[met]
    mean, spread = off.mean(axis=0), off.std(axis=0)
    print(f"sightings are off by {mean[0]:.3f} ± {spread[0]:.3f} m", end=", ")
    print(f"{mean[1]:.4f} ± {spread[1]:.4f} rad")
    for b in (1, 2):
        row = int(np.argmax(there[0][:, b]))
        began = data.time[row] - data.time[0]
        print(f"robot {b + 1} is in the map from row {row}, {began:.2f} s on")
    return metrics
