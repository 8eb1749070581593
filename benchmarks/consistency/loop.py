"""The observability experiment of Huang et al. 2010 over many maps, since maps differ a lot."""

import dataclasses
import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.consistency.markdown import Section, table
from benchmarks.gate import Metric
from jaxslam.catalog import FILTERS
from jaxslam.consistency import own_error_of, score
from jaxslam.consistency.score import run_statistics
from jaxslam.core.protocols import Filter, Motion, Sensor
from jaxslam.results.plot.style import INK, PAGE, Figure, caption, curve, panels_of
from jaxslam.run import run
from jaxslam.simulation.scenarios import loop
from jaxslam.simulation.scenarios.loop import loop_landmarks
from jaxslam.simulation.worlds import simulate

_Model = TypeVar("_Model", Motion, Sensor)

NAMES = ("ekf", "ideal", "fej", "oc", "right_invariant")
MEASURES = ("nees_pose", "nees_own", "square_position", "square_heading", "unobservable")
PLACES = 9  # the fullest scan of the first 100 maps
PUBLISHED = {
    "map A, 2500 steps": {"ekf": 38.8, "ideal": 3.58, "fej": 17.5, "oc": 33.0},
    "map B, 800 steps": {"ekf": 23.8, "ideal": 3.0, "fej": 3.3, "oc": 3.5},
}


def measure(maps: int = 100, runs: int = 4, steps: int = 2500, seed: int = 0):
    """Section, metrics and figure: `runs` runs on each of `maps` maps."""
    began = time.perf_counter()
    per_map = campaign(NAMES, maps, runs, steps, seed)
    calm = campaign(("ideal",), maps, runs, steps, seed, noise=0.1)["ideal"]["nees_pose"]
    nees = {name: np.nanmean(per_map[name]["nees_pose"], axis=1) for name in NAMES}
    rows = []
    for name in NAMES:
        low, quarter, middle, rest, high = np.quantile(nees[name], [0, 0.25, 0.5, 0.75, 1])
        own = np.nanmean(per_map[name]["nees_own"])
        error = nees[name].std(ddof=1) / np.sqrt(maps)
        rows.append(
            [
                name,
                f"{middle:.2f}",
                f"{quarter:.2f} to {rest:.2f}",
                f"{low:.2f} to {high:.2f}",
                f"{nees[name].mean():.2f} ± {error:.2g}",
                f"{own:.2f}",
                f"{np.sqrt(per_map[name]['square_position'].mean()):.3f}",
                f"{np.rad2deg(np.sqrt(per_map[name]['square_heading'].mean())):.2f}",
                f"{np.nanmin(per_map[name]['unobservable']):.0f}",
            ]
        )
    header = ["filter", "median map", "quartiles", "range", "mean ± standard error", "own error"]
    header += ["position RMSE [m]", "heading RMSE [°]", "unobservable"]
    published = "; ".join(
        f"{where}: " + ", ".join(f"{name} {value:g}" for name, value in figures.items())
        for where, figures in PUBLISHED.items()
    )
    text = (
        f"{maps} maps × {runs} runs × {steps} steps, seed {seed}, "
        f"{time.perf_counter() - began:.0f} s. Pose NEES (dof 3, not divided), averaged over the "
        f"runs and steps of a map:\n\n{table(header, rows)}\n\nThe ideal filter is not quite "
        "honest here: with Jacobians at the truth, what remains is the second order of steps that "
        "turn by 2° (1 σ). At a tenth of every σ, same maps and draws, its mean is "
        f"{calm.mean():.2f} ± {calm.mean(axis=1).std(ddof=1) / np.sqrt(maps):.2g}.\n\n"
        f"The authors' own released program, 50 runs on one map each: {published}.\n\n"
        "![Pose NEES by map and filter](figures/loop.png)"
    )
    middle = {name: float(np.median(nees[name])) for name in NAMES}
    metrics = [
        Metric(
            f"loop, {name} between ideal and EKF, median map",
            middle[name],
            middle["ideal"],
            middle["ekf"],
        )
        for name in ("fej", "oc")
    ]
    own = per_map["right_invariant"]["nees_own"]
    metrics.append(
        Metric("loop, ideal at a tenth of the noise, pose NEES, mean", float(calm.mean()), 2.7, 3.3)
    )
    metrics.append(
        Metric("loop, right-invariant own NEES / dof, mean", float(np.nanmean(own)) / 3, high=1.3)
    )
    for name in NAMES:
        expected = 2 if name == "ekf" else 3
        for which, extreme in (("fewest", np.min), ("most", np.max)):
            metrics.append(
                Metric(
                    f"loop, {name}, unobservable directions, {which} of all runs",
                    float(extreme(per_map[name]["unobservable"])),
                    expected,
                    expected,
                )
            )
    return (
        Section("loop", "Observability and consistency over 100 maps", text),
        metrics,
        figure(nees),
    )


def campaign(names, maps: int, runs: int, steps: int, seed: int, noise=1.0, block: int = 40):
    """{filter: {measure: (maps, runs)}}, with so many times the published σ of every noise."""
    world = loop(steps)
    world = dataclasses.replace(
        world,
        places=PLACES,
        motion=_scaled(world.motion, noise),
        sensor=_scaled(world.sensor, noise),
    )
    landmarks = np.repeat([loop_landmarks(seed + i) for i in range(maps)], runs, axis=0)
    keys = jax.random.split(jax.random.key(seed), maps * runs)

    def one(name, landmarks, key):
        here = dataclasses.replace(world, landmarks=landmarks)
        key_world, key_filter = jax.random.split(key)
        truth, log = simulate(here, key_world)
        candidate = FILTERS[name](world, watch=True)
        filter = candidate if isinstance(candidate, Filter) else candidate(truth)
        trace = run(
            filter,
            log,
            here.pose,
            here.pose_cov,
            key_filter,
            probe=lambda state: state.monitor.information,
        )
        own = own_error_of(filter.chart, here.sensor, trace, truth)
        # Of the estimate a score looks at poses alone.
        seen = trace._replace(estimate=trace.estimate[:2])
        return seen, truth, run_statistics(trace, truth, here.sensor), own

    def averages(go, rows):
        """Each run's own averages, and how many measurements found no slot in a scan."""
        trace, truth, *found = jax.device_get(go(jnp.asarray(landmarks[rows]), keys[rows]))
        scores = score(trace, truth, *found)

        def average(total, weight):
            there = scores.finite & (weight > 0)
            return np.where(there, total / np.where(there, weight, 1), np.nan)

        return {m: average(*scores.measures[m]) for m in MEASURES}, truth.missed.sum()

    out = {}
    starts = range(0, maps * runs, block)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name in names:
            first = slice(0, block)
            go = (
                jax.jit(jax.vmap(partial(one, name))).lower(landmarks[first], keys[first]).compile()
            )
            parts = list(pool.map(lambda i, go=go: averages(go, slice(i, i + block)), starts))
            assert sum(missed.sum() for _, missed in parts) == 0, "a scan had too few places"
            out[name] = {
                m: np.concatenate([kept[m] for kept, _ in parts]).reshape(maps, runs)
                for m in MEASURES
            }
            print(f"loop, {name}, {noise:g} of the noise: {maps} maps done", flush=True)
    return out


def _scaled(model: _Model, noise: float) -> _Model:
    """The model with so many times its σ."""
    cov = model.noise_cov
    return dataclasses.replace(model, noise_cov=lambda *at: noise**2 * cov(*at))


def figure(nees: dict[str, np.ndarray]) -> Figure:
    """Cumulative distribution over maps of the average pose NEES."""
    picture, (axes,) = panels_of(PAGE, 3.0, 1)
    for i, (name, values) in enumerate(nees.items()):
        share = (np.arange(len(values)) + 0.5) / len(values)
        curve(axes, i, np.sort(values), share, name)
    axes.axvline(3.0, color=INK, lw=0.8, label="honest: 3")
    axes.set(
        xscale="log",
        xlabel="average pose NEES of a map (dof 3)",
        ylabel="share of maps",
        ylim=(0, 1),
    )
    axes.xaxis.set_major_formatter("{x:g}")
    caption(picture, "")
    return picture
