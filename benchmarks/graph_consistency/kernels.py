"""Robust kernels at 0 to 50 % false loop closures: error, NEES, coverage, what they keep."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.graph_consistency.worlds import measured, with_false_closures
from jaxslam import graphs
from jaxslam.consistency.nees import pose_error
from jaxslam.math import stats

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

ROBUST = ("huber", "cauchy", "dcs")


def robust(graph, name, loops):
    """The optimum by a kernel on the loops, from a spanning tree of the odometry; its covariances,
    and the weights of the loops."""
    start = graphs.starts.odometry(graph)
    if name == "none":
        solution, kernel = graphs.optimize(start), None
        weight = np.ones(len(graph.tables[loops].who))
    else:
        kernel = {loops: graphs.kernels.REGISTRY[name]()}
        solution = graphs.optimize(start, kernel=kernel)
        square = graphs.squared_residuals(solution.graph)[loops]
        weight = np.asarray(kernel[loops].weight(jnp.asarray(square)))
    cov = graphs.marginals(solution.graph, kernel=kernel).poses
    return solution, np.asarray(cov), weight


def compare(graph, names, shares=SHARES, runs=10):
    """{(kernel, share): figures of merit}, averages over the runs."""
    found = {}
    for share in shares:
        rows = {name: [] for name in names}
        for run in range(runs):
            drawn = jax.device_get(measured(graph, jax.random.key(run)))
            mixed, false = with_false_closures(drawn, share, run)
            loops = next(name for name in mixed.tables if name.endswith("/loops"))
            for name in names:
                solution, cov, weight = robust(mixed, name, loops)
                rows[name].append(_row(graph, solution, cov, weight, false))
        for name in names:
            keys = rows[name][0]
            found[name, share] = {key: np.nanmean([r[key] for r in rows[name]]) for key in keys}
    return found


def _row(graph, solution, cov, weight, false):
    """The figures of one optimum against the true poses."""
    error = pose_error(np.asarray(graph.poses), np.asarray(solution.graph.poses))[1:]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(cov[1:], error[..., None])[..., 0])
    kept = weight > 0.5
    return {
        "position RMSE [m]": np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()),
        "pose NEES": nees.mean(),
        "poses within 95 %": (nees < stats.chi2_quantile(0.95, 3)).mean(),
        "false closures kept": kept[false].mean() if false.any() else np.nan,
        "true closures kept": kept[~false].mean(),
        "not converged": float(solution.status != graphs.Ending.CONVERGED),
    }
