"""A robot that stands still: which filters learn a heading that nothing tells them?"""

import math

import jax
import numpy as np

from benchmarks.consistency.markdown import Section, table
from benchmarks.gate import Metric
from jaxslam.catalog import FILTERS
from jaxslam.consistency.campaign import Campaign, monte_carlo
from jaxslam.core.protocols import Candidate
from jaxslam.results.plot.style import PAGE, Figure, caption, curve, panels_of
from jaxslam.simulation.scenarios import stationary

PRIOR = math.radians(5.0)
"""σ of the heading at the start, rad."""

NOTHING = 1e-6
"""of the prior's information."""

HONEST = ("ideal", "fej", "oc", "right_invariant", "ukf_right")


def measure(runs: int = 200, seed: int = 0) -> tuple[Section, list[Metric], Figure]:
    """Section, metrics and figure: heading NEES and learnt information of every filter."""
    scenario = stationary()
    filters: dict[str, Candidate] = {n: make(scenario, watch=True) for n, make in FILTERS.items()}
    campaign = monte_carlo(scenario, filters, runs, jax.random.key(seed))
    rows, metrics = [], []
    for name, summary in campaign.filters.items():
        nees = summary.measures["nees_heading"]
        learnt = summary.measures["rotation_information"].value * PRIOR**2
        left = np.rad2deg(PRIOR / np.sqrt(1 + learnt))
        rows.append(
            [
                name,
                f"{left:.3f}",
                f"{nees.value:.3f} ± {(nees.high - nees.low) / 2:.2g}",
                "passes" if learnt < NOTHING else "fails",
            ]
        )
        gate = {"high": NOTHING} if name in HONEST else {"low": 1e-3}
        metrics.append(Metric(f"stationary, {name}, learnt of the heading / prior", learnt, **gate))
    header = ["filter", "heading σ it could claim [°] (5 is honest)", "heading NEES (1)", ""]
    text = (
        f"{runs} runs × {campaign.steps} steps, seed {seed}. A robot that stands still and "
        "measures one landmark has a heading σ of 5° and nothing to learn it from. What a filter "
        "could claim is 1/√(prior's information + what its own linearized system gains along a "
        "turn of the whole frame).\n\n"
        + table(header, rows)
        + "\n\n![Heading σ against time](figures/stationary.png)"
    )
    return Section("stationary", "A robot that does not move", text), metrics, figure(campaign)


def figure(campaign: Campaign) -> Figure:
    """The heading's σ that each filter could claim against the steps; 5° is honest."""
    picture, (axes,) = panels_of(PAGE, 3.0, 1)
    step = np.arange(1, campaign.steps + 1)
    for i, (name, summary) in enumerate(campaign.filters.items()):
        learnt = summary.curves["rotation_information"] * PRIOR**2
        curve(axes, i, step, np.rad2deg(PRIOR / np.sqrt(1 + learnt)), name)
    axes.set(xlabel="step", xlim=(0, campaign.steps), ylim=(0, 5.5))
    caption(picture, "Heading σ that each filter could claim [°]; 5 is honest")
    return picture
