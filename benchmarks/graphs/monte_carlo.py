"""Many draws of one graph: NEES of the marginals, χ² of the optimum, RMSE over what they claim.

The "bound" is the trace of the marginals of one draw at the true poses. It approximates the
Cramér-Rao bound to first order, and draws that did not converge are left out of the RMSE, so the
ratio may lie below 1.

Where does honesty end as the noise grows, by linearization or by wrong minima? Every draw is solved
from the truth and from a chordal start. A χ² of the chordal one that is larger is a wrong minimum.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy.stats

from benchmarks.graphs.worlds import measured
from jaxslam import graphs
from jaxslam.consistency.measures.nees import pose_error
from jaxslam.math import stats

SCALES = (1.0, 3.0, 10.0)

MERITS = (
    "pose NEES",
    "its 95 % interval ±",
    "poses within 95 %",
    "χ² / dof",
    "χ²: p of Kolmogorov-Smirnov",
    "RMSE / bound",
    "wrong minima from chordal",
    "certificate fails",
    "not converged",
)


class Draws(NamedTuple):
    """What came of the draws at one noise, a row each."""

    chi2: np.ndarray
    """at the optimum from the truth"""
    nees: np.ndarray
    """(runs, N - 1) of the poses, 3 degrees of freedom"""
    square: np.ndarray
    """(runs, N - 1): squared position errors"""
    bound: np.ndarray
    """(N - 1,): their traces by the marginals of one draw"""
    wrong: np.ndarray
    """whether the chordal start ends in a larger χ²"""
    certified: np.ndarray
    """whether the chordal surrogate's optimum beside the second is proved global"""
    failed: np.ndarray
    """whether the optimization from the truth did not converge; such draws have no figures"""


def draws(graph, scale, runs, block=8):
    """The draws of a graph with `scale` times its standard deviations."""
    keys = jax.random.split(jax.random.key(round(10 * scale)), runs)
    one = jax.tree.map(np.asarray, measured(graph, keys[0], scale))
    plan = graphs.plan(one, marginals=True)
    true = graphs.optimize(one, plan=plan, iterations=0)
    bound = np.asarray(graphs.marginals(true, plan=plan).poses)[1:]
    solve = jax.jit(jax.vmap(partial(graphs.optimize, plan=plan)))
    spread = jax.jit(jax.vmap(lambda found: graphs.marginals(found, plan=plan).poses[1:]))
    prove = jax.jit(jax.vmap(lambda graph: graphs.certificate(graph, plan=plan).certified))
    draw = jax.jit(jax.vmap(partial(measured, graph, scale=scale)))
    rows = []
    for begin in range(0, runs, block):
        many = jax.device_get(draw(keys[np.arange(begin, begin + block) % runs]))
        found, again = solve(many), solve(_from_chordal(many))
        cov, certified = jax.device_get((spread(found), prove(again.graph)))
        error = pose_error(np.asarray(graph.poses), found.graph.poses)[:, 1:]
        nees = np.einsum("rni,rni->rn", error, np.linalg.solve(cov, error[..., None])[..., 0])
        square = (error[..., :2] ** 2).sum(axis=-1)
        wrong = again.chi2 > found.chi2 * (1 + 1e-6)
        failed = found.status != graphs.Ending.CONVERGED
        rows.append(jax.device_get((found.chi2, nees, square, wrong, certified, failed)))
    chi2, nees, square, *flags = (np.concatenate(part)[:runs] for part in zip(*rows, strict=True))
    return Draws(chi2, nees, square, np.trace(bound[:, :2, :2], axis1=1, axis2=2), *flags)


def _from_chordal(many):
    """The graphs at their chordal starts."""
    each = [
        graphs.starts.chordal(jax.tree.map(lambda leaf, k=k: leaf[k], many))
        for k in range(len(many.poses))
    ]
    return many._replace(poses=np.stack([np.asarray(graph.poses) for graph in each]))


def summary(found, dof):
    """The figures of merit of the draws, by name."""
    good = ~found.failed
    if good.sum() < 2:
        nothing = dict.fromkeys(MERITS[:-3], np.nan)
        return nothing | _shares(found)
    mean = found.nees[good].mean(axis=1)
    half = stats.t_quantile(0.975, max(len(mean) - 1, 1)) * mean.std(ddof=1) / len(mean) ** 0.5
    rmse = np.sqrt(found.square[good].mean() / found.bound.mean())
    p = scipy.stats.kstest(found.chi2[good], scipy.stats.chi2(dof).cdf).pvalue
    inside = (found.nees[good] < stats.chi2_quantile(0.95, 3)).mean()
    values = mean.mean(), half, inside, found.chi2[good].mean() / dof, p, rmse
    return dict(zip(MERITS[:-3], values, strict=True)) | _shares(found)


def _shares(found):
    shares = found.wrong.mean(), 1 - found.certified.mean(), found.failed.mean()
    return dict(zip(MERITS[-3:], shares, strict=True))
