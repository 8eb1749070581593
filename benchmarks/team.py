"""Three robots of MRCLAM in one map, with and without their sightings of each other.

    python -m benchmarks.team [--out FIGURE] [--steps T]

The first robot alone; three robots that know nothing of each other but the map; and three that see
each other too. Where robots 2 and 3 start is not told: each finds itself by two landmarks. Scored
by the map, brought onto the survey by the SE(2) motion that fits best; the recorded poses are not
among the files. `theirs` is NIS/dof of the sightings alone. The folder is JAXSLAM_DATA, by default
../shared/data beside the checkout.
"""

import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, alone
from benchmarks.real_data import DATA
from jaxslam import datasets, se2
from jaxslam.consistency.metrics import align_map
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam, TeamSlam
from jaxslam.filters.multi_robot.team import poses
from jaxslam.results.plot.style import (
    HUES,
    INK,
    PAGE,
    caption,
    every_handle,
    panels_of,
    png,
    titled,
)

FIGURE = Path(__file__).parent / "figures" / "team.png"
HEADER = "run robots fused sightings unused NIS/dof theirs RMSE[m] σ1[m] σ2[m] σ3[m] run[s]"


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


def measure(steps=None, out=FIGURE):
    if not (DATA / "mrclam1").is_dir():
        print(f"no folder {DATA / 'mrclam1'}")
        return []
    data = datasets.mrclam_team(DATA / "mrclam1")
    log = jax.tree.map(lambda leaf: leaf[:steps], data.log)
    apart = log._replace(
        scan=log.scan._replace(valid=log.scan.valid & (log.scan.tag < data.capacity))
    )
    alone = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
    team = TeamSlam(data.robots, data.capacity, **data.filter_options)
    print(f"{data.name}: {len(log.control):,} rows, dropped {data.dropped}")
    print("".join(f"{name:>{20 if i == 0 else 10}}" for i, name in enumerate(HEADER.split())))
    runs, metrics = {}, []
    for name, filter, given, robots in (
        ("one alone", alone, log, 1),
        ("three, blind", team, apart, 3),
        ("three", team, log, 3),
    ):
        (final, info, probe), seconds = through(filter, data, given, robots)
        runs[name] = final, probe
        fused, status = info.status == Status.FUSED, info.status
        met = fused & (log.scan.tag >= data.capacity)
        nis = np.where(fused, info.nis, 0.0).sum() / info.dof.sum()
        theirs = np.where(met, info.nis, 0.0).sum() / max(2 * met.sum(), 1)
        rmse = align_map(final, data.landmarks)[1]
        spread = np.sqrt(np.trace(probe[1][:, :, :2, :2], axis1=2, axis2=3) / 2)
        # Of each robot over the second half, when all have long been in the map.
        sigmas = np.sqrt((spread[len(spread) // 2 :] ** 2).mean(axis=0))
        unused = (status == Status.UNMATCHED).sum()
        cells = [f"{robots}", f"{fused.sum():,}", f"{met.sum():,}", f"{unused:,}", f"{nis:.3f}"]
        cells += [f"{theirs:.3f}" if met.any() else "-", f"{rmse:.4f}"]
        cells += [*(f"{s:.4f}" for s in sigmas), *["-"] * (3 - robots)]
        print(f"{name:>20}" + "".join(f"{c:>10}" for c in (*cells, f"{seconds:.1f}")), flush=True)
        if met.any():
            off = info.innovation[met]
            print(f"{'':20} sightings are off by", end=" ")
            print(f"{off[:, 0].mean():.3f} ± {off[:, 0].std():.3f} m, ", end="")
            print(f"{off[:, 1].mean():.4f} ± {off[:, 1].std():.4f} rad")
        metrics.append(Metric(f"map RMSE, {name} [m]", rmse, high=0.5))
        metrics.append(Metric(f"NIS/dof, {name}", float(nis), low=0.7, high=1.5))
    for b in (1, 2):
        row = int(np.argmax(runs["three"][1][2][:, b]))
        print(
            f"robot {b + 1} is in the map from row {row}, {data.time[row] - data.time[0]:.2f} s on"
        )
    if out is not None:
        draw(data, runs, out)
    return metrics


def draw(data, runs, out):
    figure, (world, spread) = panels_of(PAGE, 3.4, 1, 2, share=(False, False), widths=(1, 1.5))
    final, (paths, covs, there) = runs["three"]
    onto = align_map(final, data.landmarks)[0]
    carry = jax.vmap(partial(se2.from_frame, jnp.asarray(onto)))
    colours = HUES[:3]
    for b, colour in enumerate(colours):
        path = np.asarray(carry(jnp.asarray(paths[there[:, b], b, :2][::50])))
        world.plot(*path.T, lw=0.3, color=colour)
    points = np.asarray(carry(jnp.asarray(final.points)))
    world.plot(*np.asarray(data.landmarks).T, "o", mfc="none", mec=INK, ms=7, label="survey")
    world.plot(*points.T, "+", color=INK, ms=6, label="map")
    world.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    titled(world, "paths and map")
    seconds = data.time[: len(covs)] - data.time[0]
    for name, style in (("three, blind", "--"), ("three", "-")):
        sigma = np.sqrt(np.trace(runs[name][1][1][:, :, :2, :2], axis1=2, axis2=3) / 2)
        for b, colour in enumerate(colours):
            inside = np.where(runs[name][1][2][:, b], sigma[:, b], np.nan)
            bins = len(inside) // 1000
            mean = inside[: bins * 1000].reshape(bins, 1000).mean(axis=1)
            label = f"robot {b + 1}" + (", without sightings" if style == "--" else "")
            spread.plot(seconds[: bins * 1000 : 1000], mean, style, color=colour, lw=1, label=label)
    spread.set(xlabel="time [s]", yscale="log")
    titled(spread, "σ of the position that the filter claims [m], means of 1,000 rows")
    caption(figure, "Three robots, one map", every_handle((world, spread)))
    out.parent.mkdir(exist_ok=True)
    out.write_bytes(png(figure))


if __name__ == "__main__":
    raise SystemExit(
        alone(
            "team",
            measure,
            steps={"type": int, "help": "the first rows alone"},
            out={"type": Path, "default": FIGURE},
        )
    )
