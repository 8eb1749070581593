"""FastSLAM 2.0 against the EKF, and how long it stays honest, by the number of particles.

    python -m benchmarks.fastslam [--runs 20] [--particles 10 50 100 500] [--steps 300]

One loop of `webmap`, the world of Bailey, Nieto & Nebot, "Consistency of the FastSLAM algorithm",
ICRA 2006: the same draws for every filter, known association, each filter's pose NEES (3 for an
honest one) averaged over the runs step by step. They found FastSLAM consistent at first and ever
more optimistic after, later with more particles: resampling leaves few ancestors of what happened
long ago, and the spread of their descendants is all that the filter knows of its own error.

The gates: the RMSE of 100 particles within 20 % of the EKF's; NEES after the first eighth of the
loop is below NEES of the last eighth (optimism grows); the step from which the NEES is above twice
its dof for good comes no earlier with the most particles than with the fewest. `--ring` is the same
study on an easy world, where six landmarks are in view all the time. Throughput, `--speed`: a run
of 1000 particles, 100 landmarks and 200 steps on one core, in seconds. Where it resamples at every
step, less where it never does, is all that ancestry indices instead of copied maps could save.
"""

import argparse
import os
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam import monte_carlo, motion, run, sensors, simulate
from jaxslam.filters import EkfSlam, FastSlam
from jaxslam.results.plot.style import PAGE, band, caption, curve, panels_of, png
from jaxslam.simulation.scenarios import webmap
from jaxslam.simulation.worlds import Scenario

FIGURE = Path(__file__).parent / "figures" / "fastslam_nees.png"
PARTICLES = (10, 50, 100, 500)
DOF = 3
ROWS = ("rmse_position", "rmse_heading_deg", "nees_pose", "nees_heading", "nis_per_dof")


def filters_of(world: Scenario, particles):
    """The EKF and FastSLAM by name, none with more slots than there are landmarks."""
    capacity = len(world.landmarks)
    out = {"ekf": EkfSlam(world.motion, world.sensor, capacity, **world.filter_options)}
    for count in particles:
        out[f"{count} particles"] = FastSlam(world.motion, world.sensor, capacity, count)
    return out


def settled_above(curve, limit, window):
    """The first step from which the moving average of a curve stays above limit; its length if
    it never does."""
    smooth = np.convolve(np.nan_to_num(curve), np.ones(window) / window, mode="same")
    below = np.flatnonzero(smooth <= limit)
    return 0 if below.size == 0 else int(below[-1]) + 1


def nees_study(runs, particles, world):
    """The campaign, with its table printed."""
    campaign = monte_carlo(
        world, filters_of(world, particles), runs, jax.random.key(0), workers=1, block=min(runs, 6)
    )
    table(campaign)
    return campaign


def table(campaign):
    """A line for each filter, and its NEES over eighths of the run."""
    print(f"\n{campaign.scenario}: {campaign.runs} runs × {campaign.steps} steps")
    for name, summary in campaign.filters.items():
        cells = []
        for row in ROWS:
            m = summary.measures[row]
            cells.append(f"{row} {m.value:.3g} [{m.low:.3g}, {m.high:.3g}]")
        print(f"{name:15}" + "  ".join(cells))
        eighths = np.array_split(summary.curves["nees_pose"], 8)
        print(" " * 15 + "NEES by eighths " + " ".join(f"{np.nanmean(e):.3g}" for e in eighths))
        counts = {k: v for k, v in summary.counts.items() if v}
        print(" " * 15 + str(counts))


def measure(runs=20, particles=PARTICLES, out=None, steps=None):
    """The gates, and the figure where asked for; steps: of the loop, default all."""
    campaign = nees_study(runs, particles, webmap(steps=steps, loops=1))
    steps = campaign.steps
    ekf = campaign.filters["ekf"].measures["rmse_position"].value
    metrics, onset = [], {}
    for count in particles:
        summary = campaign.filters[f"{count} particles"]
        curve = summary.curves["nees_pose"]
        onset[count] = settled_above(curve, 2 * DOF, max(steps // 16, 1))
        eighth = max(steps // 8, 1)
        growth = np.nanmean(curve[-eighth:]) / np.nanmean(curve[eighth // 4 : eighth])
        ratio = summary.measures["rmse_position"].value / ekf
        gated = count == 100
        metrics.append(
            Metric(f"{count} particles: RMSE over the EKF's", ratio, high=1.2 if gated else np.inf)
        )
        metrics.append(Metric(f"{count} particles: NEES, last over first eighth", growth, low=1.0))
        metrics.append(Metric(f"{count} particles: step of lasting optimism", onset[count]))
    few, many = min(particles), max(particles)
    late = onset[many] - onset[few]
    metrics.append(Metric(f"optimism with {many} comes later than with {few} by", late, low=0.0))
    if out is not None:
        draw(campaign, out)
    return metrics


def draw(campaign, out):
    """NEES against time, one line a filter."""
    figure, (axes,) = panels_of(PAGE, 3.0, 1)
    seconds = 0.2 * np.arange(1, campaign.steps + 1)
    for i, (name, summary) in enumerate(campaign.filters.items()):
        curve(axes, i, seconds, summary.curves["nees_pose"], name)
    ends = (campaign.filters["ekf"].curves[f"nees_pose_{end}"] for end in ("low", "high"))
    band(axes, seconds, *ends, "95 % band of an honest filter")
    axes.set_yscale("log")
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"pose NEES, mean of {campaign.runs} runs (dof 3)")
    caption(figure, f"FastSLAM 2.0 on {campaign.scenario}, {campaign.steps} scans")
    out.parent.mkdir(exist_ok=True)
    out.write_bytes(png(figure))


def ring(steps=200):
    """Four turns inside six landmarks, all in view always; noise so low that an EKF is honest."""
    around = 2 * np.pi * np.arange(6) / 6
    points = np.stack([3 * np.cos(around), 1 + 3 * np.sin(around)], axis=1)
    return Scenario(
        name="ring",
        motion=motion.Increment(np.diag([0.01, 0.01]) ** 2),
        sensor=sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2),
        landmarks=points,
        controls=np.tile([0.125, 4 * np.pi / 100], (steps, 1)),
    )


def crowd(measured=10):
    """A robot circles among 100 landmarks for 200 steps, some 10 of them in a scan."""
    points = np.random.default_rng(0).uniform(-20, 20, (100, 2))
    return Scenario(
        name="crowd",
        motion=motion.Increment(np.diag([0.01, 0.01]) ** 2),
        sensor=sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2),
        landmarks=points,
        controls=np.tile([0.3, 0.3 / 12], (200, 1)),
        pose=(0.0, -12.0, 0.0),
        visible=lambda pose, point: ((point - pose[:2]) ** 2).sum() < 7.5**2,
        places=measured,
    )


def seconds_a_run(repeats=5, batch=None, **options):
    """Of a compiled run of 1000 particles on `crowd`, the least of some; batch: of so many runs."""
    world = crowd()
    filter = FastSlam(world.motion, world.sensor, 100, 1000, **options)
    _, log = jax.jit(partial(simulate, world))(jax.random.key(1))

    def one(key):
        return run(filter, log, world.pose, world.pose_cov, key)

    def go(key):
        keys = jax.random.split(key, batch)
        return jax.lax.map(one, keys)  # a cache holds one run, not four

    compiled = jax.jit(one if batch is None else go).lower(jax.random.key(2)).compile()
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(compiled(jax.random.key(2)))
        spent.append(time.perf_counter() - began)
    return min(spent) / (batch or 1)


def speed():
    """On one core, where the system lets a process choose its cores."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    size = "1000 particles × 100 landmarks × 200 steps"
    return [
        Metric(f"{size}, one core [s]", seconds_a_run(), high=2.0),
        Metric("the same, resampled at every step", seconds_a_run(threshold=1.0)),
        Metric("the same, never resampled", seconds_a_run(threshold=0.0)),
        Metric("the same, FastSLAM 1.0", seconds_a_run(proposal="motion")),
        Metric("the same, of 100 runs batched, a run", seconds_a_run(1, 100), high=2.0),
    ]


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fastslam")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--particles", type=int, nargs="+", default=list(PARTICLES))
    parser.add_argument("--steps", type=int, help="of webmap; default one loop, 566")
    parser.add_argument("--speed", action="store_true", help="throughput alone")
    parser.add_argument("--ring", action="store_true", help="the easy world, no gates")
    parser.add_argument("--out", type=Path, default=FIGURE)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.speed:
        metrics = speed()
    elif options.ring:
        nees_study(options.runs, options.particles, ring())
        return 0
    else:
        metrics = measure(options.runs, tuple(options.particles), options.out, options.steps)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
