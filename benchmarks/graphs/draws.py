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

from benchmarks.gate import Metric, save, show
from benchmarks.graphs.worlds import MANHATTAN, manhattan, measured, ring
from jaxslam import graphs
from jaxslam.consistency import pose_error
from jaxslam.math import stats
from jaxslam.results.plot import INK, PAGE, caption, curve, every_handle, panels_of, titled

SCALES = (1.0, 3.0, 10.0)
BLOCK = 8


def measure(quick: bool = False) -> list[Metric]:
    """40 draws; quick, or without the data, 100 of a small graph."""
    return judged(manhattan(), 40) if MANHATTAN.exists() and not quick else judged(ring(), 100)


def thousand(quick: bool = False) -> list[Metric]:
    """1,000 draws, with the figure: two hours on a slow core."""
    return judged(manhattan(), 1000, drawn=True)


def judged(graph, runs, drawn=False):
    table = graph.tables["relative_pose"]
    dof = 3 * len(table.who) - 3 * (len(graph.poses) - 1)
    name = f"{len(graph.poses)} poses"
    found = {scale: draws(graph, scale, runs) for scale in SCALES}
    rows = {scale: summary(each, dof) for scale, each in found.items()}
    what = f"{runs} draws of {name}, {len(table.who)} relative poses, {dof} degrees of freedom"
    show(what, {f"noise × {scale:g}": row for scale, row in rows.items()})
    if drawn:
        save(figure(found, dof), "graph_draws")
    first = rows[SCALES[0]]
    half = first["its 95 % interval ±"]
    fails = "certificate fails"
    return [
        Metric(f"{name}: pose NEES, noise × 1", first["pose NEES"], 3 - 2 * half, 3 + 2 * half),
        Metric(f"{name}: χ² / dof, noise × 1", first["χ² / dof"], 0.99, 1.01),
        Metric(f"{name}: RMSE / bound, noise × 1", first["RMSE / bound"], 0.8, 1.2),
        *(Metric(f"{name}: {fails}, noise × {k:g}", rows[k][fails]) for k in SCALES[1:]),
        Metric(f"{name}: not converged", first["not converged"], high=0.0),
    ]


def figure(found, dof):
    """NEES by pose and distribution of the χ² of the optimum, for each noise."""
    figure, panels = panels_of(PAGE, 2.6, 1, 3, share=(False, False))
    nees, ordered, cost = panels
    for i, (scale, each) in enumerate(found.items()):
        good = ~each.failed
        if good.sum() < 2:
            continue
        name = f"noise × {scale:g}"
        pose = np.arange(1, each.nees.shape[1] + 1)
        curve(nees, i, pose, each.nees[good].mean(axis=0), name)
        level = np.linspace(0.01, 0.99, 99)
        values = np.quantile(each.nees[good], level)
        curve(ordered, i, level, scipy.stats.chi2(3).cdf(values), name)
        ratio = np.sort(each.chi2[good]) / dof
        curve(cost, i, ratio, (np.arange(len(ratio)) + 0.5) / len(ratio), name)
    nees.axhline(3, color=INK, lw=0.8, zorder=1.5)
    nees.set_ylim(bottom=0)
    nees.set_xlabel("pose")
    titled(nees, "pose NEES (dof 3)")
    ordered.plot([0, 1], [0, 1], color=INK, lw=0.8, label="honest")
    ordered.set_xlabel("share of the poses")
    titled(ordered, "probability of their region")
    x = np.linspace(*cost.get_xlim(), 200)
    cost.plot(x, scipy.stats.chi2(dof).cdf(x * dof), color=INK, lw=0.8, label="honest")
    cost.set_xlabel("χ² of the optimum / dof")
    titled(cost, "share of the draws below")
    count = len(next(iter(found.values())).chi2)
    caption(figure, f"{count} draws of one graph", every_handle(panels))
    return figure


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


def draws(graph, scale, runs):
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
    for begin in range(0, runs, BLOCK):
        many = jax.device_get(draw(keys[np.arange(begin, begin + BLOCK) % runs]))
        found, again = solve(many), solve(from_chordal(many))
        cov, certified = jax.device_get((spread(found), prove(again.graph)))
        error = pose_error(np.asarray(graph.poses), found.graph.poses)[:, 1:]
        nees = np.einsum("rni,rni->rn", error, np.linalg.solve(cov, error[..., None])[..., 0])
        square = (error[..., :2] ** 2).sum(axis=-1)
        wrong = again.chi2 > found.chi2 * (1 + 1e-6)
        failed = found.status != graphs.Ending.CONVERGED
        rows.append(jax.device_get((found.chi2, nees, square, wrong, certified, failed)))
    chi2, nees, square, *flags = (np.concatenate(part)[:runs] for part in zip(*rows, strict=True))
    return Draws(chi2, nees, square, np.trace(bound[:, :2, :2], axis1=1, axis2=2), *flags)


def from_chordal(many):
    """The graphs at their chordal starts."""
    each = [
        graphs.starts.chordal(jax.tree.map(lambda leaf, k=k: leaf[k], many))
        for k in range(len(many.poses))
    ]
    return many._replace(poses=np.stack([np.asarray(graph.poses) for graph in each]))


def summary(found, dof):
    """The figures of merit of the draws, by name; NaN where fewer than two converged."""
    good = ~found.failed
    chi2, nees, square = (each[good] for each in (found.chi2, found.nees, found.square))
    mean = nees.mean(axis=1) if good.sum() > 1 else np.full(2, np.nan)
    half = stats.t_quantile(0.975, len(mean) - 1) * mean.std(ddof=1) / len(mean) ** 0.5
    ks = scipy.stats.kstest(chi2, scipy.stats.chi2(dof).cdf) if good.any() else None
    return {
        "pose NEES": mean.mean(),
        "its 95 % interval ±": half,
        "poses within 95 %": average(nees < stats.chi2_quantile(0.95, 3)),
        "χ² / dof": average(chi2) / dof,
        "χ²: p of Kolmogorov-Smirnov": ks.pvalue if ks else np.nan,
        "RMSE / bound": np.sqrt(average(square) / found.bound.mean()),
        "wrong minima from chordal": found.wrong.mean(),
        "certificate fails": 1 - found.certified.mean(),
        "not converged": found.failed.mean(),
    }


def average(values):
    return values.mean() if values.size else np.nan
