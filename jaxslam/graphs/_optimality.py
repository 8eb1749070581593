"""A certificate of global optimality: a lower bound of the chordal cost of a pose graph.

It uses the dual matrix of that cost, whose least eigenvalue the solver of graphs computes.
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import record
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.graphs._checks import check_graph
from jaxslam.graphs._factor import PRIOR, Chordal, Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.batch import graph_in_one_dtype, over_batch
from jaxslam.graphs._solver.linearized import (
    Data,
    Variables,
    data_of,
    diagonal_of,
    dot,
    outer,
    variable_numbers,
    variables_of,
)
from jaxslam.graphs._solver.model import Model, model_of
from jaxslam.graphs._solver.plans import Plan, plan_for
from jaxslam.graphs._solver.search import minimize
from jaxslam.graphs._sparse.cholesky import factorize, substitute
from jaxslam.graphs._sparse.sweeps import sum_rows
from jaxslam.math._linalg import total


@record
class _Relaxed(Factor):
    """The factor of a factor's measurement with chordal residuals, `Factor.chordal`."""

    factor: Factor

    @property
    def variables(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.factor.variables

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.factor.measurements

    @property
    def errors(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("",) * self.chordal.size

    @property
    def chordal(self) -> Chordal:  # type: ignore[override]
        assert self.factor.chordal is not None
        return self.factor.chordal

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        return self.chordal.residual(variables, z)


def dual(
    chordal: Model, plan: Plan, variables: Variables, data: Data
) -> tuple[Float[Array, "M 4 4 B"], Float[Array, "N B"], Float[Array, "M 4 4 1"]]:
    """The dual matrix M - Λ of the chordal cost at some variables, of graphs with a last axis B.

    A pose has v = (x, y, u) with u = (cos θ, sin θ), a point v = (x, y). The chordal cost is

        vᵀ M v = Σ w (Σ_k J_k v_k)²,    M_kl = Σ J_kᵀ w J_l

    over the residuals of all rows, each of which has variables k and J_k = ∂r/∂v_k
    (`Chordal.rows`). With λ_i, the multiplier of |u_i|² = 1 at a stationary point,

        Λ_ii = diag(0, 0, λ_i, λ_i),    λ_i = u_i · (M v)_i

    Rows and columns of the position of the held pose, and of the two numbers of four that a point
    does not have, are those of the identity.

    Returns:
        The blocks of M - Λ at their places in the plan; λ; the blocks of Λ for λ = 1.
    """
    poses, dtype = len(variables.poses), variables.poses.dtype
    count, batch = len(plan.order), variables.poses.shape[-1]
    # v of poses before points; zeros for u of a point. The first pose is the origin: the cost does
    # not depend on it, and smaller numbers round less.
    pose, point = variables
    v = jnp.zeros((count, 4, batch), dtype)
    v = v.at[:poses, :2].set(pose[:, :2] - pose[:1, :2])
    v = v.at[:poses, 2:].set(jnp.stack([jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])], axis=1))
    v = v.at[poses:, :2].set(point[:, :2] - pose[:1, :2])
    is_pose = jnp.arange(count) < poses
    # Which of the four numbers of each column are free, (n, 4, B): those of a position as in the
    # graph, u of every pose, the held one included.
    free = jnp.concatenate([data.free[:, :2], jnp.ones_like(data.free[:, :2])], axis=1)
    is_position = jnp.array([True, True, False, False])
    free = free & (is_position[None, :, None] | is_pose[plan.order][:, None, None])
    blocks, gradients = [], []
    for name, factor in chordal.factors.items():
        who, valid, size_k = plan.who[name], data.valid[name], len(factor.variables)
        rows, size_s = len(who), len(factor.errors)
        if factor.chordal is None or factor.chordal.rows is None:
            blocks.append(jnp.zeros((rows, 4, 4, batch), dtype))
            gradients.append(jnp.zeros((rows, 4, batch), dtype))
            continue
        # The lists are [variable k][residual s][number of v]; together (E, S, K, 4, B).
        lists = factor.chordal.rows(data.z[name])
        jacobian = jnp.stack(
            [jnp.stack([jnp.stack(row, axis=1) for row in by_k], axis=1) for by_k in lists], axis=2
        )
        jacobian = jnp.where(valid[:, None, None, None], jacobian, 0.0)
        weight = jnp.stack([data.information[name][:, s, s] for s in range(size_s)], axis=1)
        numbers = variable_numbers(factor, who, poses)
        v_k = v[numbers]  # (E, K, 4, B)
        r = total(
            jacobian[:, :, k, c] * v_k[:, k, None, c] for k in range(size_k) for c in range(4)
        )
        # J_kᵀ w r, the share of a row in (M v)_k.
        gradient = total(jacobian[:, s] * (weight * r)[:, s, None, None] for s in range(size_s))
        gradients.append(gradient.reshape(rows * size_k, 4, batch))
        jacobian = jnp.where(free[plan.column[numbers]][:, None], jacobian, 0.0)
        product = total(
            outer(jacobian[:, s], weight[:, s, None, None] * jacobian[:, s]) for s in range(size_s)
        )
        # (E, K, K, 4, 4, B): a block for each two variables of a row.
        blocks.append(product.reshape(rows * size_k * size_k, 4, 4, batch))
    m_v = sum_rows(plan.gradient, jnp.concatenate(gradients))[plan.column]
    multipliers = (m_v[:poses, 2:] * v[:poses, 2:]).sum(axis=1)
    by_variable = jnp.concatenate([multipliers, jnp.zeros((count - poses, batch), dtype)])
    # The blocks of Λ for λ = 1: diag(0, 0, 1, 1) on the diagonal where the column is a pose.
    unit = jnp.eye(4, dtype=dtype)[None, ..., None]
    unit_of_u = unit * jnp.array([0.0, 0.0, 1.0, 1.0], dtype)[None, None, :, None]
    on_diagonal = plan.on_diagonal[:, None, None, None]
    of_pose = is_pose[plan.order][plan.block_column][:, None, None, None]
    unit_lambda = jnp.where(on_diagonal & of_pose, unit_of_u, 0.0)
    m = sum_rows(plan.information, jnp.concatenate(blocks))
    m = m + jnp.where(on_diagonal & ~free[plan.block_column][:, None], unit, 0.0)
    by_block = by_variable[plan.order][plan.block_column][:, None, None]
    return m - unit_lambda * by_block, multipliers, unit_lambda


_FIRST_GAP = 1e-6
"""The first gap that is tried, relative to χ² + 1."""

_NEGLIGIBLE_GAP = 3e-5
"""The gap that counts as zero, relative to χ² + 1: between two of those that are tried, each ten
times the last."""

_DIAGONAL_ROUNDING = 16
"""The least shift, in eps of the largest diagonal entry, for a Cholesky factor to resolve it."""

_SHIFTS = 40
"""The largest number of shifts that are tried, each ten times the last."""

_POWERS = 100
"""Iterations for the smallest eigenvalue."""

_SURROGATE_STEPS = 100
_SURROGATE_TOLERANCE = 1e-13
"""Of `minimize` on the chordal cost; the bound is tight only at a stationary point."""


class Certificate(NamedTuple):
    """The certificate of a pose graph's optimum; leading axes by `vmap`.

    The proof is for the chordal cost with isotropic weights, Σ τ |t_j - t_i - R_i t|² + κ |R_j -
    R_i R|²/2. It proves nothing about the cost of the graph: `position` and `heading` are the
    distances of the two optima. If they are close, and the surrogate's is global, a lower minimum
    of the graph's cost would have a higher chordal cost.
    """

    certified: Bool[Array, ""]
    """the optimum of the surrogate next to the graph is its global one, up to `gap`"""
    gap: Float[Array, ""]
    """proved: no poses have a chordal cost below `chi2 - gap`"""
    smallest: Float[Array, ""]
    """the smallest eigenvalue of the dual matrix, about 0 where certified: the optimum itself is
    its eigenvector"""
    chi2: Float[Array, ""]
    """chordal cost at the optimum of the surrogate next to the graph"""
    graph: Graph
    """the graph at the optimum of the surrogate"""
    position: Float[Array, ""]
    """[m], root mean square distance of the poses of both optima"""
    heading: Float[Array, ""]
    """[rad], root mean square difference of the headings of both optima"""


def certificate(
    graph: Graph, factors: Mapping[str, Factor] | None = None, *, plan: Plan | None = None
) -> Certificate:
    """Whether the optimum next to a graph is the global one, of the chordal cost (see above).

    Poses are complex numbers p = x + iy and u = exp(iθ), |u| = 1, and the chordal cost is a
    quadratic form zᴴ M z of both. At a stationary point λ_i = Re(ū_i (M z)_i), and for all other
    poses the cost is at least Σλ + N μ, where μ is the smallest eigenvalue, if negative, of
    M - diag(0, λ) after the positions are eliminated (Carlone, Calafiore, Tommolillo and Dellaert
    2016, "Planar pose graph optimization: duality, optimal solutions, and verification", T-RO
    32(3); Rosen et al. 2019, "SE-Sync", IJRR 38). μ > -η is proved by a Cholesky factor of
    M - diag(0, λ - η), with the sparsity of the information matrix.

    τ is the mean of the two position entries of an information's diagonal, κ its heading entry;
    other entries are left out. First the chordal cost is minimized from the graph's variables.

    Args:
        graph: usually that of a `Solution`. One pose is held: fixed, or by a prior, which is left
            out.
        factors: as in `optimize`; each must be a relative pose, a relative position, or a prior
            (`Factor.chordal`).
        plan: of `plan(graph)`; needed under `jit` and `vmap`.
    Raises:
        ValueError: on other factors, on more poses held than one, and on what `check_graph`
            refuses.
    """
    with refusals_of("graphs.certificate"):
        model = model_of(graph, factors)
        for name, factor in model.factors.items():
            if factor.chordal is None:
                raise InvalidField(
                    "factors",
                    f"the table {name!r} has no chordal cost: its factor is {factor.name}, "
                    "and relative poses, relative positions and priors have one",
                )
        check_graph(graph, model.factors)
        plan = plan_for(graph, model.factors, plan)
        if is_concrete(graph):
            # NumPy, since each operation on a new shape would be a program.
            held = np.array(graph.fixed_pose)
            for name, factor in model.factors.items():
                if factor.chordal is PRIOR:
                    table = graph.tables[name]
                    held[np.asarray(table.who)[np.asarray(table.valid), 0]] = True
            if held.sum() != 1:
                raise InvalidField(
                    "graph",
                    f"expected one pose that is fixed or has a prior, got {held.sum()}; the "
                    "dual is of a graph that is free but for that",
                )
        proof: Certificate = _certificate(model, graph, plan)
        return proof


@partial(jax.jit, inline=True)
def _certificate(model: Model, graph: Graph, plan: Plan) -> Certificate:
    return over_batch(_prove)((model, plan), graph_in_one_dtype(graph))


def _prove(model: Model, plan: Plan, graph: Graph) -> Certificate:
    """The certificates of graphs with a last axis B."""
    poses = len(graph.poses)
    chordal, surrogate = _chordal_problem(model, plan, graph)
    tolerance = jnp.asarray(_SURROGATE_TOLERANCE, graph.poses.dtype)
    solution = minimize(chordal, plan, jnp.asarray(_SURROGATE_STEPS), tolerance, surrogate)
    variables, data = variables_of(solution.graph), data_of(surrogate, plan.column)
    blocks, multipliers, unit_lambda = dual(chordal, plan, variables, data)
    shift, proved = _proved_shift(plan, blocks, unit_lambda, solution.chi2, poses)
    # No poses cost less than Σλ - N η, since |u|² = 1 for each of the N.
    gap = solution.chi2 - multipliers.sum(axis=0) + poses * shift
    away = solution.graph.poses - graph.poses
    turned = jnp.arctan2(jnp.sin(away[:, 2]), jnp.cos(away[:, 2]))
    return Certificate(
        certified=proved & (gap <= _NEGLIGIBLE_GAP * (solution.chi2 + 1.0)),
        gap=jnp.where(proved, gap, jnp.inf),
        smallest=_smallest_eigenvalue(plan, blocks, unit_lambda, shift),
        chi2=solution.chi2,
        graph=graph._replace(poses=solution.graph.poses, points=solution.graph.points),
        position=jnp.sqrt((away[:, :2] ** 2).sum(1).mean(axis=0)),
        heading=jnp.sqrt((turned**2).mean(axis=0)),
    )


def _chordal_problem(model: Model, plan: Plan, graph: Graph) -> tuple[Model, Graph]:
    """The model and the graph whose χ² is the chordal cost, without priors.

    A pose that a prior holds is fixed.
    """
    held = jnp.asarray(graph.fixed_pose)
    tables = {}
    for name, factor in model.factors.items():
        table = graph.tables[name]
        assert factor.chordal is not None
        if factor.chordal is PRIOR:
            held = held.at[plan.who[name][:, 0]].max(table.valid)
        # τ, τ, κ, κ or τ, τ of the chordal residuals; zero for a prior.
        tau = 0.5 * (table.information[:, 0, 0] + table.information[:, 1, 1])
        if factor.chordal.rows is None:
            weights = jnp.zeros_like(tau)[:, None]
        else:
            kappa = [table.information[:, 2, 2]] * (factor.chordal.size - 2)
            weights = jnp.stack([tau, tau, *kappa], axis=1)
        unit = jnp.eye(weights.shape[1], dtype=graph.poses.dtype)[None, ..., None]
        tables[name] = table._replace(information=unit * weights[:, None])
    chordal = Model({name: _Relaxed(factor) for name, factor in model.factors.items()}, {})
    return chordal, graph._replace(tables=tables, fixed_pose=held)


def _proved_shift(
    plan: Plan,
    blocks: Float[Array, "M 4 4 B"],
    unit_lambda: Float[Array, "M 4 4 1"],
    chi2: Float[Array, "B"],
    poses: int,
) -> tuple[Float[Array, "B"], Bool[Array, "B"]]:
    """The first η of a series by tens for which M - Λ + η has a Cholesky factor, η added to the
    diagonal of u, and whether there is such an η."""
    least = jnp.maximum(
        _FIRST_GAP * (chi2 + 1.0) / poses,
        _DIAGONAL_ROUNDING * jnp.finfo(blocks.dtype).eps * (blocks * unit_lambda).max((0, 1, 2)),
    )

    def larger(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        shift, proved, count = carry
        shift = jnp.where(proved, shift, 10 * shift)
        # A pivot with an error below a thirtieth of itself is positive.
        factored = factorize(
            plan.cholesky, _shift_diagonal(blocks, unit_lambda, shift), uncertain=1 / 32
        )
        return shift, factored.regular.all(axis=0), count + 1

    shift, proved, _ = jax.lax.while_loop(
        lambda carry: ~carry[1].all() & (carry[2] < _SHIFTS),
        larger,
        (least / 10, jnp.zeros(least.shape, bool), jnp.zeros((), jnp.int32)),
    )
    return shift, proved


def _smallest_eigenvalue(
    plan: Plan,
    blocks: Float[Array, "M 4 4 B"],
    unit_lambda: Float[Array, "M 4 4 1"],
    shift: Float[Array, "B"],
) -> Float[Array, "B"]:
    """The smallest eigenvalue μ of M - Λ with positions eliminated, by inverse iteration.

    With P the selection of u and S the Schur complement of the positions,
    (S + η)⁻¹ = P (M - Λ + η P)⁻¹ P, whose largest eigenvalue is 1/(μ + η).
    """
    factored = factorize(plan.cholesky, _shift_diagonal(blocks, unit_lambda, shift))
    of_u = diagonal_of(plan, unit_lambda)  # (n, 4, 1), the diagonal of P

    def power(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        vector, _ = carry
        image = of_u * substitute(plan.cholesky, factored, vector)
        quotient = dot(vector, image)
        norm = jnp.sqrt(dot(image, image))
        return image / jnp.where(norm > 0, norm, 1.0)[None, None], 1.0 / quotient - shift

    # The headings n² [rad] of variable n: not smooth along a path, so that the start is hardly
    # orthogonal to an eigenvector.
    angle = jnp.arange(len(plan.order), dtype=blocks.dtype) ** 2
    start = jnp.stack([jnp.zeros_like(angle)] * 2 + [jnp.cos(angle), jnp.sin(angle)], axis=1)
    start = jnp.broadcast_to(of_u * start[..., None], (*start.shape, *shift.shape))
    start = start / jnp.sqrt(dot(start, start))[None, None]
    smallest: Array = jax.lax.fori_loop(0, _POWERS, power, (start, jnp.zeros_like(shift)))[1]
    return smallest


def _shift_diagonal(
    blocks: Float[Array, "M 4 4 B"], unit_lambda: Float[Array, "M 4 4 1"], shift: Float[Array, "B"]
) -> Float[Array, "M 4 4 B"]:
    """The blocks of M - Λ + η, with η on the diagonal of u."""
    return blocks + shift[None, None, None] * unit_lambda
