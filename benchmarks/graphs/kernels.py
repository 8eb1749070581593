"""Robust kernels at 0 to 50 % false loop closures: error, NEES, coverage, what they keep."""

from functools import partial

import jax
import numpy as np

from benchmarks.graphs.worlds import measured, with_false_closures
from jaxslam import graphs
from jaxslam.consistency.measures.nees import block_nees, pose_error
from jaxslam.math import stats

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

ROBUST = ("huber", "cauchy", "dcs", "truncated")


def compare(graph, names=("none", *ROBUST), runs=10):
    """{(kernel, share): figures of merit}, averages over the runs.

    The same closures may be false in every run; the share says how many of them are there.
    """
    drawn = [
        with_false_closures(jax.device_get(measured(graph, jax.random.key(run))), max(SHARES))
        for run in range(runs)
    ]
    loops, false = drawn[0].loops, drawn[0].false
    plan = graphs.plan(drawn[0].graph, marginals=True)
    many = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(graphs.starts.odometry(each.graph) for each in drawn)
    )
    found = {}
    for name in names:
        kernel = {} if name == "none" else {loops: graphs.KERNELS[name]()}
        solve = jax.jit(jax.vmap(partial(_solved, kernel=kernel, plan=plan)))
        for share in SHARES:
            there = ~false | (np.cumsum(false) <= share / (1 - share) * (~false).sum())
            table = many.tables[loops]
            table = table._replace(valid=np.broadcast_to(there, table.valid.shape))
            mixed = many._replace(tables=many.tables | {loops: table})
            poses, cov, square, failed = jax.device_get(solve(mixed))
            kept = np.ones(square[loops].shape, bool)
            if kernel:
                kept = np.asarray(kernel[loops].weight(square[loops])) > 0.5
            error = pose_error(np.asarray(graph.poses), poses)
            nees = block_nees(poses, error, error, cov)["pose"]
            kept = kept[:, there]
            found[name, share] = _merits(error[:, 1:], nees, kept, false[there], failed)
    return found


def _solved(graph, kernel, plan):
    """Poses, covariances and squared residuals at the optimum, and whether it was not reached."""
    solution = graphs.optimize(graph, kernel=kernel, plan=plan)
    cov = graphs.marginals(solution, plan=plan).poses
    square = graphs.squared_residuals(solution.graph)
    return solution.graph.poses, cov, square, solution.status != graphs.Ending.CONVERGED


def _merits(error, nees, kept, false, failed):
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
