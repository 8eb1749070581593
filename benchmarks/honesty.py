"""Where four filters are honest: verdicts over 20 × 20 and 10 × 12 worlds, 100 runs each.

A robot drives two laps among landmarks on both sides of its circle. The worlds differ in the noise
of the heading, in the range of the sensor, and in the number of landmarks; each filter knows them.
Each world is a campaign, and the worlds share a program. One program of a stack of worlds is timed
beside that.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from matplotlib.colors import TwoSlopeNorm

from benchmarks.gate import Metric, save
from jaxslam import Scenario, monte_carlo, motion, run, sensors, simulate
from jaxslam.catalog import FILTERS
from jaxslam.results.plot import INK, PAGE, TEXT, caption, panels_of
from jaxslam.simulation.scenarios import BetweenRanges

NAMES = {"ekf": "EKF", "fej": "FEJ", "right_invariant": "invariant EKF", "ukf": "UKF"}
MOST, FAR = 12, 1e3
KEY = jax.random.key(0)
SIGMAS = np.geomspace(0.5, 8.0, 20)
AXES = {
    "range of the sensor [m]": ("reach", np.linspace(2.0, 8.0, 20), 1),
    "number of landmarks": ("count", np.arange(1, MOST + 1), 2),
}
"""The option of `world_of`, its values, and every which of `SIGMAS`."""


def motion_of(sigma: Array | float) -> motion.Increment:
    """The odometry with σ of the heading [°] a step of half a metre."""
    turn = jnp.deg2rad(sigma)
    return motion.Increment(jnp.diag(jnp.stack([0.02 + 0 * turn, turn])) ** 2)


def world_of(sigma: float, reach: float = 8.0, count: int = MOST) -> Scenario:
    """Landmarks beyond `count` are where no sensor sees them, so that all worlds have one shape."""
    turn = 2 * np.pi * (0.618034 * np.arange(MOST) % 1)
    radius = 4.0 + np.where(np.arange(MOST) % 2 == 0, 1.5, -1.5)
    points = np.stack([radius * np.sin(turn), 4.0 - radius * np.cos(turn)], axis=1)
    points[count:] = FAR
    return Scenario(
        name="two laps",
        motion=motion.Increment(np.asarray(motion_of(sigma).noise_cov.cov)),
        sensor=sensors.RangeBearing(np.diag([0.1, np.deg2rad(2.0)]) ** 2),
        landmarks=points,
        controls=np.tile([8 * np.pi / 50, 2 * np.pi / 50], (100, 1)),
        visible=BetweenRanges(0.0, float(reach)),
        filter_options={"correction": "joint"},
    )


def campaign_of(world: Scenario, names: PyTree, runs: int) -> PyTree:
    filters = {name: FILTERS[name](world) for name in names}
    return monte_carlo(world, filters, runs, KEY, progress=False).filters


def stack_seconds(worlds: int, runs: int) -> float:
    """Of one program for a stack of worlds: poses and covariances of the EKF, no scores."""
    base = world_of(1.0)

    def one(sigma: Array, reach: Array, key: Array) -> PyTree:
        reached = BetweenRanges(0.0, reach)
        world = dataclasses.replace(base, motion=motion_of(sigma), visible=reached)
        _, log = simulate(world, key)
        estimate = run(FILTERS["ekf"](world), log, world.pose, world.pose_cov, key).estimate
        return estimate.pose, estimate.pose_cov

    every = jax.jit(jax.vmap(jax.vmap(one, (None, None, 0)), (0, 0, None)))
    sigma, keys = jnp.geomspace(0.5, 8.0, worlds), jax.random.split(KEY, runs)
    given = sigma, jnp.linspace(2.0, 8.0, worlds), keys
    jax.block_until_ready(every(*given))
    began = time.perf_counter()
    jax.block_until_ready(every(*given))
    return time.perf_counter() - began


def campaign_seconds(worlds: int, runs: int) -> float:
    """Of a campaign of the EKF for each of the same worlds, scores and verdicts included."""
    sigma, reach = np.geomspace(0.5, 8.0, worlds), np.linspace(2.0, 8.0, worlds)
    campaign_of(world_of(1.0), ["ekf"], runs)
    began = time.perf_counter()
    for each in zip(sigma, reach, strict=True):
        campaign_of(world_of(*each), ["ekf"], runs)
    return time.perf_counter() - began


def measure(quick: bool = False) -> list[Metric]:
    every, runs = (6, 20) if quick else (1, 100)
    figure, panels = panels_of(PAGE, 4.9, 2, 4, share=(False, "row"))
    metrics, began, worlds = [], time.perf_counter(), 0
    for row, (label, (option, values, apart)) in enumerate(AXES.items()):
        sigmas = SIGMAS[:: apart * every]
        values, tables = values[::every], {name: np.zeros((len(sigmas), 0)) for name in NAMES}
        honest = {name: [] for name in NAMES}
        for value in values:
            found = [campaign_of(world_of(s, **{option: value}), NAMES, runs) for s in sigmas]
            for name in NAMES:
                column = [each[name].measures["nees_pose"].value for each in found]
                tables[name] = np.column_stack([tables[name], column])
                honest[name].append([each[name].verdict == "consistent" for each in found])
        worlds += len(values) * len(sigmas)
        for column, (name, shown) in enumerate(NAMES.items()):
            mask = np.array(honest[name]).T
            share = float(mask.mean())
            print(f"{label:24} {shown:14} consistent in {share:.3f} of {mask.size} worlds")
            metrics.append(Metric(f"σ of heading by {label}, {shown}: share consistent", share))
            panel = panels[4 * row + column]
            draw(panel, tables[name], mask, values, sigmas)
            panel.set_title(shown, fontsize=TEXT)
            panel.set_xlabel(label)
        panels[4 * row].set_ylabel("σ of the heading [°/step]")
    shares = {m.name.split(": ")[0]: m.value for m in metrics}
    for label in AXES:
        gain = shares[f"σ of heading by {label}, invariant EKF"]
        gain -= shares[f"σ of heading by {label}, EKF"]
        metrics.append(Metric(f"{label}: invariant EKF less EKF", gain, low=0.0))
    seconds = time.perf_counter() - began
    metrics.append(Metric("worlds, four filters each", worlds))
    metrics.append(Metric("runs of each filter in a world", runs))
    metrics.append(Metric("time [min]", seconds / 60))
    metrics.append(Metric("time of a world [s]", seconds / worlds))
    ratio = stack_seconds(8, runs) / campaign_seconds(8, runs)
    metrics.append(Metric("eight worlds as one stack / as eight campaigns, time", ratio))
    if not quick:
        bar = figure.colorbar(panels[0].images[0], ax=panels, aspect=40, pad=0.01)
        bar.set_label("pose NEES / 3", fontsize=TEXT)
        bar.set_ticks([-2, -1, 0, 1, 2], labels=["¼", "½", "1", "2", "4"])
        bar.ax.tick_params(labelsize=TEXT)
        title = f"Honest where dotted: verdict consistent over {runs} runs a world"
        caption(figure, title, [])
        save(figure, "honesty")
    return metrics


def draw(panel: PyTree, nees: np.ndarray, honest: np.ndarray, across, up) -> None:
    """A map of the NEES over 3, with a dot where the verdict is consistent."""
    norm = TwoSlopeNorm(0.0, -2.5, 2.5)
    panel.imshow(np.log2(nees / 3), cmap="RdBu_r", norm=norm, origin="lower", aspect="auto")
    y, x = np.nonzero(honest)
    panel.plot(x, y, ".", color=INK, ms=2.0)
    panel.grid(visible=False)
    for axis, values in ((panel.xaxis, across), (panel.yaxis, up)):
        at = np.unique(np.linspace(0, len(values) - 1, 4).round().astype(int))
        axis.set_ticks(at, labels=[f"{values[i]:.2g}" for i in at])
