"""FastSLAM 2.0 against the EKF, and how long it stays honest, by the number of particles.

One loop of `webmap`, the world of Bailey, Nieto & Nebot, "Consistency of the FastSLAM algorithm",
ICRA 2006: the same draws for every filter, known association, each filter's pose NEES (3 for an
honest one) averaged over the runs step by step. They found FastSLAM consistent at first and ever
more optimistic after, later with more particles: resampling leaves few ancestors of what happened
long ago, and the spread of their descendants is all that the filter knows of its own error.

The gates: the RMSE of 100 particles within 20 % of the EKF's; NEES after the first eighth of the
loop is below NEES of the last eighth (optimism grows); the step from which the NEES is above twice
its dof for good comes no earlier with the most particles than with the fewest.
"""

import jax
import numpy as np

from benchmarks.gate import Metric, save
from jaxslam import monte_carlo
from jaxslam.filters import EkfSlam, FastSlam
from jaxslam.results.plot import PAGE, band, caption, curve, panels_of
from jaxslam.simulation.scenarios import webmap

PARTICLES = (10, 100)
DOF = 3


def settled_above(curve, limit, window):
    """The first step from which the moving average of a curve stays above limit; its length if
    it never does."""
    smooth = np.convolve(np.nan_to_num(curve), np.ones(window) / window, mode="same")
    below = np.flatnonzero(smooth <= limit)
    return 0 if below.size == 0 else int(below[-1]) + 1


def measure(quick: bool = False) -> list[Metric]:
    """The gates; the table of the campaign, and the NEES of each filter by eighths of the run."""
    world, runs = webmap(loops=1), 4 if quick else 20
    parts = world.motion, world.sensor, len(world.landmarks)
    filters = {"ekf": EkfSlam(*parts, **world.filter_options)}
    filters |= {f"{count} particles": FastSlam(*parts, count) for count in PARTICLES}
    key = jax.random.key(0)
    campaign = monte_carlo(world, filters, runs, key, workers=1, block=min(runs, 6))
    print(campaign)
    for name, summary in campaign.filters.items():
        eighths = np.array_split(summary.curves["nees_pose"], 8)
        print(f"{name}: NEES by eighths " + " ".join(f"{np.nanmean(e):.3g}" for e in eighths))
    steps, eighth = campaign.steps, campaign.steps // 8
    ekf = campaign.filters["ekf"].measures["rmse_position"].value
    metrics, onset = [], {}
    for count in PARTICLES:
        summary = campaign.filters[f"{count} particles"]
        curve = summary.curves["nees_pose"]
        onset[count] = settled_above(curve, 2 * DOF, steps // 16)
        growth = np.nanmean(curve[-eighth:]) / np.nanmean(curve[eighth // 4 : eighth])
        ratio, high = summary.measures["rmse_position"].value / ekf, 1.2 if count == 100 else np.inf
        metrics += [
            Metric(f"{count} particles: RMSE over the EKF's", ratio, high=high),
            Metric(f"{count} particles: NEES, last over first eighth", growth, low=1.0),
            Metric(f"{count} particles: step of lasting optimism", onset[count]),
        ]
    few, many = PARTICLES
    late = onset[many] - onset[few]
    metrics.append(Metric(f"optimism with {many} comes later than with {few} by", late, low=0.0))
    if not quick:
        save(figure(campaign), "fastslam_nees")
    return metrics


def figure(campaign):
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
    return figure
