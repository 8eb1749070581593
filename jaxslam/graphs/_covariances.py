"""Marginal covariances of poses and points, from the information matrix of a graph."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core.validation import InvalidField, instance_of, refusals_of, require
from jaxslam.graphs._checks import check_graph, label
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.batch import (
    LEAST,
    cut,
    graph_in_one_dtype,
    original_number,
    over_batch,
    padded_graph,
    padded_number,
)
from jaxslam.graphs._solver.linearized import data_of, linearize, variables_of
from jaxslam.graphs._solver.model import Model, model_of
from jaxslam.graphs._solver.plans import Plan, checked_pairs, plan_for
from jaxslam.graphs._solver.search import Solution
from jaxslam.graphs._sparse.cholesky import by, by_transposed, factorize, selected_inverse
from jaxslam.graphs._sparse.sweeps import padded_size


class Marginals(NamedTuple):
    """Covariances of a graph's variables, zero for fixed ones; leading axes by `vmap`."""

    poses: Float[Array, "N 3 3"]
    """covariance of (x, y, θ), in world coordinates like the poses"""
    points: Float[Array, "P L L"]
    pairs: Float[Array, "Q 2 2 d d"]
    """the joint covariance of each pair by its two variables, d = max(3, L); rows and columns that
    a variable does not have are zero"""
    singular: Int[Array, ""]
    """the first variable that the measurements do not determine, poses before points; then the
    covariances are not valid. -1: none"""


def marginals(
    solution: Solution,
    factors: Mapping[str, Factor] | None = None,
    *,
    pairs: ArrayLike = (),
    plan: Plan | None = None,
    room: int = 0,
) -> Marginals:
    """The covariances (Σ Jᵀ ρ' Ω J)⁻¹ of all poses and points of a graph, and of pairs of them.

    J and the weights ρ' of robust kernels are taken from the solution: a row that a kernel leaves
    out does not count. The inverse is computed where the Cholesky factor has blocks
    (`selected_inverse`), and at the pairs.

    Args:
        solution: of `optimize`. Outside of a trace its graph is checked. Of a graph as it is:
            `optimize(graph, iterations=0)`.
        factors: as in `optimize`.
        pairs: (Q, 2), two variables each, points counted on from the poses.
        plan: of `plan(graph, marginals=True, pairs=pairs)`; needed under `jit` and `vmap`. Its
            pairs stand if none are given here.
        room: as in `optimize`.
    Raises:
        ValueError: on a graph in place of a solution, on what `check_graph` refuses, on a plan
            without marginals or those pairs, and outside of a trace on a variable that the
            measurements do not determine.
    """
    hint = "; of a graph as it is: graphs.optimize(graph, iterations=0)"
    with refusals_of("graphs.marginals"):
        require("solution", solution, instance_of(Solution, hint))
        model = model_of(solution.graph, factors)
        check_graph(solution.graph, model.factors)
        wanted = checked_pairs(pairs, len(solution.graph.poses) + len(solution.graph.points))
    array = np.asarray if is_concrete(solution) else jnp.asarray  # no program for each shape
    tables = {
        name: table._replace(
            information=array(table.information) * array(solution.weights[name])[:, None, None]
        )
        for name, table in solution.graph.tables.items()
    }
    graph = solution.graph._replace(tables=tables)
    covariances: Marginals
    if plan is None and is_concrete(graph):
        padded = padded_graph(graph, room)
        rows = np.zeros((padded_size(max(len(wanted), 4 * room), LEAST), 2), int)
        rows[: len(wanted)] = padded_number(wanted, graph, padded)
        plan = plan_for(padded, model.factors, None, marginals=True, pairs=rows, room=room)
        covariances = _marginals(model, padded, plan)
        poses, points, blocks = cut(covariances[:3], (graph.poses, graph.points, wanted))
        singular = original_number(covariances.singular, graph, padded)
        covariances = Marginals(poses, points, blocks, singular)
    else:
        with refusals_of("graphs.marginals"):
            plan = plan_for(graph, model.factors, plan, marginals=True, pairs=wanted)
            covariances = _marginals(model, graph, plan)
    singular = covariances.singular
    if is_concrete(singular) and np.ndim(singular) == 0 and singular >= 0:
        reason = f"the measurements do not determine {label(graph, int(singular))}"
        raise InvalidField("", reason, owner="graphs.marginals")
    return covariances


@partial(jax.jit, inline=True)
def _marginals(model: Model, graph: Graph, plan: Plan) -> Marginals:
    return over_batch(_invert)((model, plan), graph_in_one_dtype(graph))


def _invert(model: Model, plan: Plan, graph: Graph) -> Marginals:
    """The covariances of graphs with a last axis B."""
    assert plan.inverse is not None
    data, variables = data_of(graph, plan.column), variables_of(graph)
    system = linearize(model, plan, variables, data)
    factored = factorize(plan.cholesky, system.blocks)
    blocks = selected_inverse(plan.inverse, factored)
    diagonal = blocks[plan.inverse.diagonal[plan.column]]  # by variable
    diagonal = _mask(diagonal, *[data.free[plan.column]] * 2)
    poses, size = len(graph.poses), graph.points.shape[1]
    # From increments in the frame of a pose to world coordinates: R(θ) for its position.
    width, batch = data.free.shape[1], graph.poses.shape[-1]
    unit = jnp.eye(width, dtype=graph.poses.dtype)[None, ..., None]
    units = jnp.broadcast_to(unit, (poses + len(graph.points), width, width, batch))
    cos, sin = jnp.cos(graph.poses[:, 2]), jnp.sin(graph.poses[:, 2])
    rotation = jnp.stack([jnp.stack([cos, -sin], axis=1), jnp.stack([sin, cos], axis=1)], axis=1)
    turn = units.at[:poses, :2, :2].set(rotation)
    diagonal = by_transposed(by(turn, diagonal), turn)
    first, second = plan.pairs[:, 0], plan.pairs[:, 1]
    cross = blocks[plan.inverse.pairs]
    turned = plan.inverse.turned[:, None, None, None]
    cross = jnp.where(turned, jnp.swapaxes(cross, 1, 2), cross)
    cross = _mask(cross, data.free[plan.column[first]], data.free[plan.column[second]])
    cross = by_transposed(by(turn[first], cross), turn[second])
    # (Q, 2, 2, d, d, B)
    joint = jnp.stack(
        [
            jnp.stack([diagonal[first], cross], axis=1),
            jnp.stack([jnp.swapaxes(cross, 1, 2), diagonal[second]], axis=1),
        ],
        axis=1,
    )
    regular = factored.regular
    # The first False of each graph, in the order of the columns.
    culprit = plan.order[jnp.argmin(regular, axis=0)].astype(jnp.int32)
    return Marginals(
        poses=diagonal[:poses, :3, :3],
        points=diagonal[poses:, :size, :size],
        pairs=joint,
        singular=jnp.where(regular.all(axis=0), -1, culprit).astype(jnp.int32),
    )


def _mask(
    blocks: Float[Array, "k d d B"], rows: Bool[Array, "k d B"], columns: Bool[Array, "k d B"]
) -> Float[Array, "k d d B"]:
    """The blocks, zero where a row or a column is not estimated."""
    return jnp.where(rows[:, :, None] & columns[:, None], blocks, 0.0)
