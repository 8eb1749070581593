"""Whole runs: precision, recall, NEES and divergence against clutter and odometry noise."""

import dataclasses

import jax
import numpy as np

from jaxslam import association, motion
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.filters import EkfSlam
from jaxslam.life import Existence
from jaxslam.math.stats import chi2_quantile
from jaxslam.results.plot.style import INK, PAGE, caption, curve, panels_of, titled
from jaxslam.simulation.scenarios import cloister
from jaxslam.simulation.spurious import Spurious

RUNS = 32
REACH = 4.0
CAPACITY = 60
CLUTTER = (0.0, 0.5, 1.0, 2.0)
NOISE = (1.0, 2.0, 3.0)
"""times the scenario's σ of the odometry"""
GATE, NEW = chi2_quantile(0.99, 2), chi2_quantile(0.9999, 2)
METHODS = {
    "nearest": association.Nearest(GATE, NEW),
    "maximum_likelihood": association.MaximumLikelihood(GATE, NEW),
    "global_nearest": association.GlobalNearest(GATE, NEW),
    "joint": association.JointCompatibility(0.99, NEW, budget=500),
}
ROWS = ("precision", "recall", "false_landmarks", "nees_pose", "rmse_position")


def near(reach):
    return lambda pose, point: ((pose[:2] - point) ** 2).sum() < reach**2


def world(clutter, noise):
    plain = cloister()
    sigma = noise * np.diag([0.01, 0.02])
    return dataclasses.replace(
        plain,
        motion=motion.Increment(sigma**2),
        visible=near(REACH),
        places=12,
        spurious=Spurious(clutter=clutter, missed=0.05, reach=REACH),
    )


def measure(clutter, noise):
    """{method: {measure: value}} with the share of divergent runs; `known` believes the tags."""
    scenario = world(clutter, noise)
    parts = scenario.motion, scenario.sensor, CAPACITY
    life = Existence(near(0.8 * REACH), patience=20)
    filters = {"known": EkfSlam(*parts)}
    for name, method in METHODS.items():
        filters[name] = EkfSlam(*parts, associate=method, life=life)
    campaign = monte_carlo(scenario, filters, RUNS, jax.random.key(0))
    out = {}
    for name, summary in campaign.filters.items():
        out[name] = {row: summary.measures[row].value for row in ROWS if row in summary.measures}
        lost = summary.counts["divergent"] + summary.counts["not_finite"]
        out[name]["divergent"] = lost / RUNS
    return out


def draw(found):
    """found: {(clutter, noise): what measure returned}."""
    figure, panels = panels_of(PAGE, 4.2, 2, 3, share=(False, False))
    lines = panels[:3], panels[3:]
    series = (
        ("clutter [false measurements a scan]", [(c, 1.0) for c in CLUTTER], CLUTTER),
        ("σ of the odometry [times 1 cm, 1.1°]", [(1.0, n) for n in NOISE], NOISE),
    )
    rows = (
        ("precision", "precision"),
        ("recall", "recall"),
        ("nees_pose", "pose NEES (honest: 3)"),
    )
    for line, (label, at, x) in zip(lines, series, strict=True):
        for axes, (row, title) in zip(line, rows, strict=True):
            for i, name in enumerate(("known", *METHODS)):
                values = np.array([found[key][name].get(row, np.nan) for key in at])
                curve(axes, i, np.array(x), values, name)
            titled(axes, title)
            if row == "nees_pose":
                axes.axhline(3, color=INK, lw=0.8)
        line[1].set_xlabel(label)
    caption(figure, "")
    return figure
