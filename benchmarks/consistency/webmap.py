"""NEES against time over the loops of a car, standard and ideal EKF (Bailey et al. 2006)."""

import jax
import numpy as np

from benchmarks.consistency.markdown import Section, table
from benchmarks.gate import Metric
from jaxslam.catalog import FILTERS
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.results.plot import nees_figure
from jaxslam.results.plot.style import Figure
from jaxslam.simulation.scenarios import webmap

NAMES = ("ekf", "ideal", "right_invariant")
LOOPS = 3


def measure(runs: int = 100, seed: int = 0) -> tuple[Section, list[Metric], Figure]:
    """Section, metrics and figure."""
    scenario = webmap(loops=LOOPS)
    campaign = monte_carlo(
        scenario, {n: FILTERS[n](scenario) for n in NAMES}, runs, jax.random.key(seed)
    )
    rows, metrics = [], []
    for name, summary in campaign.filters.items():
        nees = summary.measures["nees_pose"]
        curve = summary.curves["nees_pose"]
        ends = [np.nanmean(part) for part in np.array_split(curve, LOOPS)]
        rows.append(
            [
                name,
                f"{nees.value:.2f} ± {(nees.high - nees.low) / 2:.2g}",
                summary.verdict,
                *(f"{end:.2f}" for end in ends),
            ]
        )
    header = ["filter", "pose NEES (3)", "verdict", *(f"loop {i + 1}" for i in range(LOOPS))]
    text = (
        f"{runs} runs × {campaign.steps} scans ({LOOPS} loops of 340 m), seed {seed}. "
        "The map is ours, in the style of theirs; what is reproduced is the course: the standard "
        "EKF is consistent at first and grows optimistic with the heading's uncertainty, the ideal "
        "EKF stays consistent.\n\n"
        + table(header, rows)
        + "\n\n![NEES against time](figures/webmap.png)"
    )
    ideal, ekf = (campaign.filters[n].measures["nees_pose"] for n in ("ideal", "ekf"))
    metrics.append(Metric("webmap, ideal EKF, pose NEES", ideal.value, 2.4, 3.6))
    metrics.append(Metric("webmap, EKF over ideal, pose NEES", ekf.value / ideal.value, low=1.0))
    return Section("webmap", "A car among landmarks", text), metrics, nees_figure(campaign)
