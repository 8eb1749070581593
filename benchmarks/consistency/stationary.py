"""A robot that stands still: which filters learn a heading that nothing tells them?"""

import jax
import numpy as np
from matplotlib.figure import Figure

from benchmarks.consistency.markdown import Section, table
from benchmarks.gate import Metric
from jaxslam.family import FILTERS
from jaxslam.monte_carlo import monte_carlo
from jaxslam.plot import COLORS
from jaxslam.protocols import Candidate
from jaxslam.scenarios import stationary

HONEST = ("ideal", "fej", "oc", "right_invariant", "robocentric", "ukf_right")


def measure(runs: int = 200, seed: int = 0) -> tuple[Section, list[Metric], Figure]:
    """Section, metrics and figure: heading NEES and learnt information of every filter."""
    scenario = stationary()
    filters: dict[str, Candidate] = {n: make(scenario, watch=True) for n, make in FILTERS.items()}
    campaign = monte_carlo(scenario, filters, runs, jax.random.key(seed))
    rows, metrics = [], []
    before = 1 / np.deg2rad(5.0) ** 2
    for name, summary in campaign.filters.items():
        nees, learnt = (summary.measures[k] for k in ("nees_heading", "rotation_information"))
        left = np.rad2deg(1 / np.sqrt(before + learnt.value))
        rows.append(
            [
                name,
                f"{left:.3f}",
                f"{nees.value:.3f} ± {(nees.high - nees.low) / 2:.2g}",
                "passes" if name in HONEST else "fails",
            ]
        )
        ratio = learnt.value / before
        if name in HONEST:
            metrics.append(Metric(f"stationary, {name}, learnt of the heading", ratio, high=1e-6))
        else:
            metrics.append(Metric(f"stationary, {name}, learnt of the heading", ratio, low=1e-3))
    header = ["filter", "heading σ it could claim [°] (5 is honest)", "heading NEES (1)", ""]
    text = (
        f"{runs} runs × {campaign.steps} steps, seed {seed}. A robot that stands still and "
        "measures one landmark has a heading σ of 5° and nothing to learn it from.\n\n"
        + table(header, rows)
        + "\n\n![Information learnt of the heading](stationary.png)"
    )
    picture = Figure(figsize=(6.5, 4.0), dpi=150, layout="constrained")
    axes = picture.subplots()
    step = np.arange(1, campaign.steps + 1)
    for i, (name, summary) in enumerate(campaign.filters.items()):
        curve = summary.curves["rotation_information"] / before
        label = name if name not in HONEST else f"{name} (none)"
        axes.plot(
            step,
            np.maximum(curve, 1e-6),
            color=COLORS[i % len(COLORS)],
            ls=("-", "--", ":")[i // len(COLORS)],
            lw=1.4,
            label=label,
        )
    axes.set(
        xlabel="step",
        ylabel="information learnt / prior's",
        yscale="log",
        ylim=(1e-5, None),
        xlim=(1, campaign.steps),
    )
    axes.grid(color="#dddddd", lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small", ncols=2)
    return Section("stationary", "A robot that does not move", text), metrics, picture
