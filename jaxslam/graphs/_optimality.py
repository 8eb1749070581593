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
from jaxslam.core.types import JaxOrNumPy
from jaxslam.graphs._checks import check_graph
from jaxslam.graphs._factor import PRIOR, Chordal, Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.batch import graph_in_one_dtype, over_batch
from jaxslam.graphs._solver.linearized import (
    Data,
    Variables,
    data_of,
    variable_numbers,
    variables_of,
)
from jaxslam.graphs._solver.model import Model, model_of
from jaxslam.graphs._solver.plans import Plan, plan_for
from jaxslam.graphs._solver.search import minimize
from jaxslam.graphs._sparse.cholesky import factorize, substitute
from jaxslam.graphs._sparse.sweeps import summed
from jaxslam.math._linalg import total


@record
class _Relaxed(Factor):
    """The factor of the same measurement with chordal residuals, `Factor.chordal`."""

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


def _chordal_weights(
    form: Chordal, information: Float[JaxOrNumPy, "E R R B"]
) -> Float[Array, "E S B"]:
    """The weights τ, τ, κ, κ or τ, τ of the chordal residuals; zero for a prior."""
    near = 0.5 * (information[:, 0, 0] + information[:, 1, 1])
    if form.rows is None:
        return jnp.zeros_like(near)[:, None]
    turn = [information[:, 2, 2]] * (form.size - 2)
    return jnp.stack([near, near, *turn], axis=1)


def dual(
    chordal: Model, plan: Plan, variables: Variables, data: Data
) -> tuple[Float[Array, "M 4 4 B"], Float[Array, "N B"], Float[Array, "M 4 4 1"]]:
    """The blocks of M - diag(0, λ), with the position of the held pose removed; λ of each pose; and
    where the blocks have the diagonal of a u."""
    poses, dtype = len(variables.poses), variables.poses.dtype
    count, batch = len(plan.order), variables.poses.shape[-1]
    angle = variables.poses[:, 2]
    z = jnp.zeros((count, 4, batch), dtype)
    z = z.at[:poses, :2].set(variables.poses[:, :2] - variables.poses[:1, :2])
    z = z.at[:poses, 2:].set(jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1))
    z = z.at[poses:, :2].set(variables.points[:, :2] - variables.poses[:1, :2])
    is_pose = jnp.arange(count) < poses
    free = jnp.concatenate([data.free[:, :2], jnp.ones_like(data.free[:, :2])], axis=1)
    free = free & (
        jnp.array([True, True, False, False])[None, :, None] | is_pose[plan.order][:, None, None]
    )
    blocks, gradients = [], []
    for name, factor in chordal.factors.items():
        who, valid, k = plan.who[name], data.valid[name], len(factor.variables)
        rows, size = len(who), len(factor.errors)
        if factor.chordal is None or factor.chordal.rows is None:
            blocks.append(jnp.zeros((rows, 4, 4, batch), dtype))
            gradients.append(jnp.zeros((rows, 4, batch), dtype))
            continue
        parts = factor.chordal.rows(data.z[name])
        jacobian = jnp.stack(
            [jnp.stack([jnp.stack(row, axis=1) for row in part], axis=1) for part in parts], axis=2
        )  # (E, S, K, 4, B)
        jacobian = jnp.where(valid[:, None, None, None], jacobian, 0.0)
        weight = jnp.stack([data.information[name][:, i, i] for i in range(size)], axis=1)
        of = variable_numbers(factor, who, poses)
        near = z[of]
        r = total(jacobian[:, :, a, c] * near[:, a, None, c] for a in range(k) for c in range(4))
        gradient = total(jacobian[:, i] * (weight * r)[:, i, None, None] for i in range(size))
        gradients.append(gradient.reshape(rows * k, 4, batch))
        jacobian = jnp.where(free[plan.column[of]][:, None], jacobian, 0.0)
        product = total(
            jacobian[:, i, :, None, :, None]
            * (weight[:, i, None, None] * jacobian[:, i])[:, None, :, None, :]
            for i in range(size)
        )
        blocks.append(product.reshape(rows * k * k, 4, 4, batch))
    by_variable = summed(plan.gradient, jnp.concatenate(gradients))[plan.column]
    multipliers = (by_variable[:poses, 2:] * z[:poses, 2:]).sum(axis=1)
    every = jnp.concatenate([multipliers, jnp.zeros((count - poses, batch), dtype)])
    unit = jnp.eye(4, dtype=dtype)[None, ..., None]
    turn = unit * jnp.array([0.0, 0.0, 1.0, 1.0], dtype)[None, None, :, None]
    at = plan.on_diagonal[:, None, None, None]
    turns = jnp.where(at & is_pose[plan.order][plan.block_column][:, None, None, None], turn, 0.0)
    out = summed(plan.information, jnp.concatenate(blocks))
    out = out + jnp.where(at & ~free[plan.block_column][:, None], unit, 0.0)
    return out - turns * every[plan.order][plan.block_column][:, None, None], multipliers, turns


_FIRST_GAP = 1e-6
"""The first gap, relative to χ² + 1."""

_NEGLIGIBLE_GAP = 3e-5
"""The gap that counts as zero, relative to χ² + 1: between two of those that are tried, each ten
times the last."""

_POWERS = 100
"""iterations for the smallest eigenvalue"""


class Certificate(NamedTuple):
    """The certificate of a pose graph's optimum; leading axes by `vmap`.

    The proof is for the chordal cost with isotropic weights, Σ τ |t_j - t_i - R_i t|² + κ |R_j -
    R_i R|²/2. It proves nothing about the cost of the graph: `position` and `heading` are the
    distances of the two optima. If they are close, and the surrogate's is global, a lower minimum
    of the graph's cost would have a higher chordal cost.
    """

    certified: Bool[Array, ""]
    """the optimum of the surrogate that was found is its global one, up to `gap`"""
    gap: Float[Array, ""]
    """proved: no poses have a chordal cost below `chi2 - gap`"""
    smallest: Float[Array, ""]
    """the smallest eigenvalue of the dual matrix, about 0 where certified: the optimum itself is
    its eigenvector"""
    chi2: Float[Array, ""]
    """chordal cost at the optimum of the surrogate next to the graph"""
    graph: Graph
    """with the poses of that optimum"""
    position: Float[Array, ""]
    """[m], root mean square distance of the poses of both optima"""
    heading: Float[Array, ""]
    """[rad], the same of their headings"""


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
    caller = "graphs.certificate"
    model = model_of(caller, graph, factors)
    for name, factor in model.factors.items():
        if factor.chordal is None:
            raise ValueError(
                f"{caller}: the table {name!r} has no chordal cost: its factor is {factor.name}, "
                "and relative poses, relative positions and priors have one"
            )
    check_graph(caller, graph, model.factors)
    plan = plan_for(caller, graph, model.factors, plan)
    if is_concrete(graph):
        # NumPy, since each operation on a new shape would be a program.
        held = np.array(graph.fixed_pose)
        for name, factor in model.factors.items():
            if factor.chordal is PRIOR:
                held[
                    np.asarray(graph.tables[name].who)[np.asarray(graph.tables[name].valid), 0]
                ] = True
        if held.sum() != 1:
            raise ValueError(
                f"{caller}: expected one pose that is fixed or has a prior, got {held.sum()}; the "
                "dual is of a graph that is free but for that"
            )
    proved: Certificate = _certificate(model, graph, plan)
    return proved


def _hold(model: Model, plan: Plan, graph: Graph) -> Bool[Array, "N *B"]:
    """The poses that are fixed or have a prior."""
    held = jnp.asarray(graph.fixed_pose)
    for name, factor in model.factors.items():
        if factor.chordal is PRIOR:
            held = held.at[plan.who[name][:, 0]].max(graph.tables[name].valid)
    return held


@partial(jax.jit, inline=True)
def _certificate(model: Model, graph: Graph, plan: Plan) -> Certificate:
    return over_batch("graphs.certificate", _prove)((model, plan), graph_in_one_dtype(graph))


def _prove(model: Model, plan: Plan, graph: Graph) -> Certificate:
    """Of graphs with a last axis B."""
    poses, dtype = len(graph.poses), graph.poses.dtype
    held = _hold(model, plan, graph)
    tables = {}
    for name, factor in model.factors.items():
        table = graph.tables[name]
        assert factor.chordal is not None
        weights = _chordal_weights(factor.chordal, table.information)
        unit = jnp.eye(weights.shape[1], dtype=dtype)[None, ..., None]
        tables[name] = table._replace(information=unit * weights[:, None])
    chordal = Model({name: _Relaxed(factor) for name, factor in model.factors.items()}, {})
    surrogate = graph._replace(tables=tables, fixed_pose=held)
    tolerance = jnp.asarray(1e-13, dtype)
    found = minimize(chordal, plan, jnp.asarray(100), tolerance, surrogate)
    variables, data = variables_of(found.graph), data_of(surrogate, plan.column)
    blocks, multipliers, turns = dual(chordal, plan, variables, data)
    value = found.chi2
    bound = multipliers.sum(axis=0)
    margin = jnp.maximum(
        _FIRST_GAP * (value + 1.0) / poses,
        16 * jnp.finfo(dtype).eps * (blocks * turns).max((0, 1, 2)),
    )

    def shifted(shift: Array) -> Array:
        return blocks + shift[None, None, None] * turns

    def proof(shift: Array) -> Array:
        # A pivot with an error below a thirtieth of itself is positive.
        return factorize(plan.cholesky, shifted(shift), uncertain=1 / 32).regular.all(axis=0)

    def wider(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        shift, good, count = carry
        shift = jnp.where(good, shift, 10 * shift)
        return shift, proof(shift), count + 1

    shift, good, _ = jax.lax.while_loop(
        lambda carry: ~carry[1].all() & (carry[2] < 40),
        wider,
        (margin / 10, jnp.zeros(margin.shape, bool), jnp.zeros((), jnp.int32)),
    )
    factored = factorize(plan.cholesky, shifted(shift))
    of_turns = jnp.diagonal(turns[plan.cholesky.diagonal], axis1=1, axis2=2)
    of_turns = jnp.moveaxis(of_turns, 2, 1)

    def power(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        v, _ = carry
        w = of_turns * substitute(plan.cholesky, factored, v)
        inverse = (v * w).sum((0, 1))
        norm = jnp.sqrt((w * w).sum((0, 1)))
        return w / jnp.where(norm > 0, norm, 1.0)[None, None], 1.0 / inverse - shift

    angle = jnp.arange(len(plan.order), dtype=dtype) ** 2
    first = jnp.stack([jnp.zeros_like(angle)] * 2 + [jnp.cos(angle), jnp.sin(angle)], axis=1)
    first = jnp.broadcast_to(of_turns * first[..., None], (*first.shape, *value.shape))
    first = first / jnp.sqrt((first * first).sum((0, 1)))[None, None]
    first = jnp.broadcast_to(first, (*first.shape[:2], *shift.shape))
    smallest = jax.lax.fori_loop(0, _POWERS, power, (first, jnp.zeros_like(shift)))[1]
    gap = value - bound + poses * shift
    away = found.graph.poses - graph.poses
    turned = jnp.arctan2(jnp.sin(away[:, 2]), jnp.cos(away[:, 2]))
    return Certificate(
        certified=good & (gap <= _NEGLIGIBLE_GAP * (value + 1.0)),
        gap=jnp.where(good, gap, jnp.inf),
        smallest=smallest,
        chi2=value,
        graph=graph._replace(poses=found.graph.poses, points=found.graph.points),
        position=jnp.sqrt((away[:, :2] ** 2).sum(1).mean(axis=0)),
        heading=jnp.sqrt((turned**2).mean(axis=0)),
    )
