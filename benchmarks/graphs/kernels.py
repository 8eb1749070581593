"""Robust kernels at 0 to 50 % false loop closures: error, NEES, coverage, what they keep."""

from functools import partial

import jax
import numpy as np

from benchmarks.gate import Metric, save, show
from benchmarks.graphs.worlds import measured, ring, with_false_closures
from jaxslam import graphs
from jaxslam.consistency import block_nees, pose_error
from jaxslam.graphs._graph import LOOPS
from jaxslam.math import stats
from jaxslam.results.plot import INK, PAGE, caption, curve, panels_of, titled

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

NAMES = ("none", "huber", "cauchy", "dcs", "truncated")


def measure(quick: bool = False) -> list[Metric]:
    graph, runs = (ring(), 4) if quick else (ring(200, 40), 20)
    found = compare(graph, runs)
    print(f"\n{runs} runs of {len(graph.poses)} poses: robust kernels and false closures")
    for name in NAMES:
        show(name, {f"{share:.0%} false": found[name, share] for share in SHARES})
    if not quick:
        save(figure(found), "graph_kernels")
    worst, plain = max(SHARES), found["none", 0.0]["position RMSE [m]"]
    return [
        Metric(
            f"{name}: position RMSE at {worst:.0%} false / none at 0 %",
            found[name, worst]["position RMSE [m]"] / plain,
        )
        for name in NAMES
    ]


def figure(found):
    """Error, NEES, coverage and false closures kept, against the share of false closures."""
    shown = {
        "position RMSE [m]": "log",
        "pose NEES": "log",
        "poses within 95 %": "linear",
        "false closures kept": "linear",
    }
    figure, panels = panels_of(PAGE, 4.2, 2, 2)
    share = 100 * np.array(SHARES)
    for axes, (key, scale) in zip(panels, shown.items(), strict=True):
        for i, name in enumerate(NAMES):
            curve(axes, i, share, np.array([found[name, part][key] for part in SHARES]), name)
        axes.set_yscale(scale)
        titled(axes, key)
    panels[1].axhline(3, color=INK, lw=0.8, zorder=1.5)
    panels[2].axhline(0.95, color=INK, lw=0.8, zorder=1.5)
    for axes in panels[2:]:
        axes.set_xlabel("false loop closures [%]")
    caption(figure, "Robust kernels on the loop closures; lines: honest")
    return figure


def compare(graph, runs):
    """{(kernel, share): figures of merit}, averages over the runs.

    The same closures may be false in every run; the share says how many of them are there.
    """
    drawn = [
        with_false_closures(jax.device_get(measured(graph, jax.random.key(run))), max(SHARES))
        for run in range(runs)
    ]
    first, false = drawn[0]
    plan = graphs.plan(first, marginals=True)
    many = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(graphs.starts.odometry(each) for each, _ in drawn)
    )
    found = {}
    for name in NAMES:
        kernel = {} if name == "none" else {LOOPS: graphs.KERNELS[name]()}
        solve = jax.jit(jax.vmap(partial(solved, kernel=kernel, plan=plan)))
        for share in SHARES:
            there = ~false | (np.cumsum(false) <= share / (1 - share) * (~false).sum())
            table = many.tables[LOOPS]
            table = table._replace(valid=np.broadcast_to(there, table.valid.shape))
            mixed = many._replace(tables=many.tables | {LOOPS: table})
            poses, cov, square, failed = jax.device_get(solve(mixed))
            kept = np.ones(square[LOOPS].shape, bool)
            if kernel:
                kept = np.asarray(kernel[LOOPS].weight(square[LOOPS])) > 0.5
            error = pose_error(np.asarray(graph.poses), poses)
            nees = block_nees(poses, error, error, cov)["pose"]
            kept = kept[:, there]
            found[name, share] = merits(error[:, 1:], nees, kept, false[there], failed)
    return found


def solved(graph, kernel, plan):
    """Poses, covariances and squared residuals at the optimum, and whether it was not reached."""
    solution = graphs.optimize(graph, kernel=kernel, plan=plan)
    cov = graphs.marginals(solution, plan=plan).poses
    square = graphs.squared_residuals(solution.graph)
    return solution.graph.poses, cov, square, solution.status != graphs.Ending.CONVERGED


def merits(error, nees, kept, false, failed):
    """The figures of merit of some runs against the true poses; NEES where it is defined."""
    value = nees.value[nees.regular]
    return {
        "position RMSE [m]": np.sqrt((error[..., :2] ** 2).sum(axis=-1).mean()),
        "pose NEES": value.mean(),
        "poses within 95 %": (value < stats.chi2_quantile(0.95, 3)).mean(),
        "false closures kept": kept[:, false].mean() if false.any() else np.nan,
        "true closures kept": kept[:, ~false].mean(),
        "not converged": failed.mean(),
    }
