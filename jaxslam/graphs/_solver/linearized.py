"""A graph about its variables: residuals, gradient, and the blocks of the information matrix.

Arrays have a batch B as their last axis, as in `_sparse/cholesky.py`. Increments of a pose are
local, in its frame, X ∘ exp(δ) (`se2.boxplus`); increments of a point are added.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.kernels import Kernel
from jaxslam.graphs._solver.model import Model
from jaxslam.graphs._solver.plans import Plan
from jaxslam.graphs._sparse.sweeps import sum_rows
from jaxslam.math import se2
from jaxslam.math._linalg import total
from jaxslam.math.angles import sin_cos


class Variables(NamedTuple):
    """The variables that are estimated, poses and points."""

    poses: Float[Array, "N 3 B"]
    points: Float[Array, "P L B"]


class Data(NamedTuple):
    """The measurements by table, and the fixed variables; rows that are not valid are zero."""

    z: dict[str, Float[Array, "_ _ B"]]
    information: dict[str, Float[Array, "_ _ _ B"]]
    valid: dict[str, Bool[Array, "_ B"]]
    free: Bool[Array, "n d B"]
    """whether each entry of the increments is estimated, by column"""


class System(NamedTuple):
    """The normal equations of a Gauss-Newton step."""

    chi2: Float[Array, "B"]
    gradient: Float[Array, "n d B"]
    """Σ Jᵀ ρ' Ω e, by column: half the derivative of χ² by the increments"""
    blocks: Float[Array, "M d d B"]
    """Σ Jᵀ ρ' Ω J; one on the diagonal of fixed variables"""


def diagonal_of(plan: Plan, blocks: Float[Array, "M d d *B"]) -> Float[Array, "n d *B"]:
    """The diagonal of a matrix of the plan's pattern, by column."""
    diagonal = jnp.diagonal(blocks[plan.cholesky.diagonal], axis1=1, axis2=2)  # (n, B, d)
    return jnp.moveaxis(diagonal, 2, 1)


def dot(a: Float[Array, "n d B"], b: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """The inner product Σ a b over all variables."""
    return (a * b).sum(axis=(0, 1))


def outer(a: Float[Array, "E K d B"], b: Float[Array, "E K d B"]) -> Float[Array, "E K K d d B"]:
    """The products a_k b_lᵀ of each two variables k and l of a row."""
    # a: (E, K, 1, d, 1, B), b: (E, 1, K, 1, d, B)
    return a[:, :, None, :, None] * b[:, None, :, None]


def retract(variables: Variables, increments: Float[Array, "n d B"], plan: Plan) -> Variables:
    """The variables moved by increments."""
    by_variable = increments[plan.column]
    poses, size = len(variables.poses), variables.points.shape[1]
    move = jax.vmap(jax.vmap(se2.boxplus, -1, -1))
    return Variables(
        move(variables.poses, by_variable[:poses, :3]),
        variables.points + by_variable[poses:, :size],
    )


def _select(factor: Factor, who: Array, variables: Variables) -> tuple[Array, ...]:
    """The variables of the rows of a table, (E, 3, B) or (E, L, B) each."""
    return tuple(
        (variables.poses if kind == "pose" else variables.points)[who[:, k]]
        for k, kind in enumerate(factor.variables)
    )


def _over_rows(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """The function of one row of one graph, over rows (first axis) and graphs (last axis)."""
    return jax.vmap(jax.vmap(function, -1, -1))(*arguments)


def squares(information: Float[Array, "E R R B"], e: Float[Array, "E R B"]) -> Float[Array, "E B"]:
    """The squared residual s = eᵀ Ω e of each row."""
    size = e.shape[1]
    return total(e[:, i] * information[:, i, j] * e[:, j] for i in range(size) for j in range(size))


def row_costs(
    factor: Factor, kernel: Kernel | None, who: Array, variables: Variables, z: Array, info: Array
) -> tuple[Float[Array, "E R B"], Float[Array, "E B"], Float[Array, "E B"]]:
    """Residuals, squared residuals s, and costs ρ(s) of the rows of a table."""
    e = _over_rows(factor.residual, _select(factor, who, variables), z)
    s = squares(info, e)
    return e, s, s if kernel is None else kernel.cost(s)


def held_data(model: Model, who: Mapping[str, Array], at: Variables, data: Data) -> Data:
    """The data with Wᵀ Ω W as the information of factors that whiten, W at the variables `at`."""
    information = dict(data.information)
    for name, factor in model.factors.items():
        if factor.whiten is None:
            continue
        w = _over_rows(factor.whiten, _select(factor, who[name], at), data.z[name])
        information[name] = jnp.einsum("erib,ersb,esjb->eijb", w, information[name], w)
    return data._replace(information=information)


def chi2_of(
    model: Model,
    who: Mapping[str, Array],
    variables: Variables,
    data: Data,
    held: Variables | None = None,
) -> Float[Array, "B"]:
    """The cost χ² of the graph at some variables.

    held: the variables at which factors whiten, if others.
    """
    data = held_data(model, who, variables if held is None else held, data)
    parts = []
    for name, factor in model.factors.items():
        z, information, kernel = data.z[name], data.information[name], model.kernels.get(name)
        cost = row_costs(factor, kernel, who[name], variables, z, information)[2]
        parts.append(jnp.where(data.valid[name], cost, 0.0).sum(axis=0))
    return total(parts)


def row_weights(
    model: Model, who: Mapping[str, Array], variables: Variables, data: Data
) -> dict[str, Float[Array, "_ B"]]:
    """The weights ρ'(s) of the rows of each table: 1 without a kernel, 0 where not valid."""
    data = held_data(model, who, variables, data)
    weights = {}
    for name, factor in model.factors.items():
        z, info, kernel = data.z[name], data.information[name], model.kernels.get(name)
        if kernel is None:
            weight = jnp.ones_like(z, shape=data.valid[name].shape)
        else:
            weight = kernel.weight(row_costs(factor, None, who[name], variables, z, info)[1])
        weights[name] = jnp.where(data.valid[name], weight, 0.0)
    return weights


def linearize(model: Model, plan: Plan, variables: Variables, data: Data) -> System:
    """The normal equations about the variables."""
    data = held_data(model, plan.who, variables, data)
    width, poses = data.free.shape[1], len(variables.poses)
    chi2, gradients, blocks = [], [], []
    for name, factor in model.factors.items():
        e, jacobian = _jacobians(factor, plan.who[name], variables, data.z[name], width)
        info, valid = data.information[name], data.valid[name]
        s, kernel = squares(info, e), model.kernels.get(name)
        chi2.append(jnp.where(valid, s if kernel is None else kernel.cost(s), 0.0).sum(axis=0))
        weight = 1.0 if kernel is None else kernel.weight(s)
        info = info * jnp.where(valid, weight, 0.0)[:, None, None]
        free = data.free[plan.column[variable_numbers(factor, plan.who[name], poses)]]
        keep = valid[:, None, None, None] & free[:, None]  # (E, 1, K, d, B)
        jacobian = jnp.where(keep, jacobian, 0.0)
        rows, size = e.shape[0], e.shape[1]
        # ρ' Ω J, (E, R, K, d, B)
        weighted = total(info[:, :, r, None, None] * jacobian[:, r, None] for r in range(size))
        e = jnp.where(valid[:, None], e, 0.0)
        gradient = total(weighted[:, r] * e[:, r, None, None] for r in range(size))
        gradients.append(gradient.reshape(-1, *gradient.shape[2:]))
        product = total(outer(jacobian[:, r], weighted[:, r]) for r in range(size))
        blocks.append(product.reshape(rows * len(factor.variables) ** 2, *product.shape[3:]))
    return System(
        total(chi2),
        sum_rows(plan.gradient, jnp.concatenate(gradients)),
        _assemble(plan, blocks, data),
    )


def _assemble(plan: Plan, blocks: list[Array], data: Data) -> Float[Array, "M d d B"]:
    """The blocks of the matrix, from those of the rows of each table, (E K K, d, d, B)."""
    matrix = sum_rows(plan.information, jnp.concatenate(blocks))
    # Row, column and gradient of a fixed entry are zero; with a 1 its increment is zero.
    held = plan.on_diagonal[:, None, None] & ~data.free[plan.block_column]
    unit = jnp.eye(matrix.shape[1], dtype=matrix.dtype)[None, ..., None]
    return matrix + jnp.where(held[:, None], unit, 0.0)


def half_hessian(
    model: Model, plan: Plan, variables: Variables, data: Data
) -> Float[Array, "M d d B"]:
    """Half the second derivative of χ² by the increments, as `System.blocks`; information held."""
    data = held_data(model, plan.who, variables, data)
    width, poses = data.free.shape[1], len(variables.poses)
    blocks = []
    for name, factor in model.factors.items():
        kernel, count = model.kernels.get(name), len(factor.variables)

        def half_cost(steps: Array, involved: tuple[Array, ...], z: Array, info: Array) -> Array:
            moved = tuple(
                se2.boxplus(x, step[:3]) if kind == "pose" else x + step[: len(x)]
                for kind, x, step in zip(factor.variables, involved, steps, strict=True)  # noqa: B023
            )
            e = factor.residual(moved, z)  # noqa: B023
            s = e @ info @ e
            return 0.5 * (s if kernel is None else kernel.cost(s))  # noqa: B023

        values = _select(factor, plan.who[name], variables)
        still = jnp.zeros((count, width), variables.poses.dtype)
        # Over the rows, the first axis, and the graphs, the last.
        second: Array = jax.vmap(
            jax.vmap(jax.jacfwd(jax.grad(half_cost)), (None, -1, -1, -1), -1), (None, 0, 0, 0)
        )(still, values, data.z[name], data.information[name])  # (E, K, d, K, d, B)
        free = data.free[plan.column[variable_numbers(factor, plan.who[name], poses)]]
        keep = free[:, :, :, None, None] & free[:, None, None]
        keep = keep & data.valid[name][:, None, None, None, None]
        second = jnp.moveaxis(jnp.where(keep, second, 0.0), 3, 2)  # (E, K, K, d, d, B)
        blocks.append(second.reshape(-1, *second.shape[3:]))
    return _assemble(plan, blocks, data)


def variable_numbers(factor: Factor, who: Array, poses: int) -> Array:
    """The numbers of the variables of rows (E, K); points are counted on from the poses."""
    shift = np.array([[poses * (kind == "point") for kind in factor.variables]], np.int32)
    return who + shift


@jax.custom_jvp
def _barrier(values: PyTree) -> PyTree:
    """`optimization_barrier`, whose derivative JAX cannot transpose where some of the values
    have none."""
    return jax.lax.optimization_barrier(values)


@_barrier.defjvp
def _slope_of_barrier(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    return _barrier(*primals), tangents[0]


def _jacobians(
    factor: Factor, who: Array, variables: Variables, z: Array, width: int
) -> tuple[Float[Array, "E R B"], Float[Array, "E R K d B"]]:
    """Residuals of rows, and their derivatives by the increments of each variable.

    They are derivatives by coordinates, the first two of a pose turned into its frame; derivatives
    by the increments themselves take two to five times as long. Common parts of the derivatives
    are computed once: without the barrier XLA would compute it again for each of their entries.
    """
    involved = _select(factor, who, variables)
    e, slope = jax.linearize(lambda *involved: _over_rows(factor.residual, involved, z), *involved)
    slope, common = jax.closure_convert(slope, *involved)
    e, common = _barrier((e, common))

    def by_coordinate(k: int) -> Array:
        """The derivatives by the coordinates of variable k, (size, E, R, B)."""
        still = [jnp.zeros_like(x) for x in involved]

        def along(unit: Array) -> Array:
            still[k] = jnp.broadcast_to(unit[:, None], involved[k].shape)
            derivative: Array = slope(*still, *common)
            return derivative

        return jax.vmap(along)(jnp.eye(involved[k].shape[1], dtype=e.dtype))

    jacobians = []
    for k, (kind, x) in enumerate(zip(factor.variables, involved, strict=True)):
        by = by_coordinate(k)
        if kind == "pose":
            sin, cos = (y[:, None] for y in sin_cos(x[:, 2]))
            # t moves by R(θ) δt: derivatives along the frame, (cos, sin) and (-sin, cos).
            by_increment = [cos * by[0] + sin * by[1], cos * by[1] - sin * by[0], by[2]]
        else:
            by_increment = list(by)
        by_increment += [jnp.zeros_like(e)] * (width - len(by_increment))
        jacobians.append(jnp.stack(by_increment, axis=2))  # (E, R, d, B)
    return e, jnp.stack(jacobians, axis=2)


def variables_of(graph: Graph) -> Variables:
    """The variables of graphs with a last axis B."""
    return Variables(jnp.asarray(graph.poses), jnp.asarray(graph.points))


def data_of(graph: Graph, column: Array) -> Data:
    """The data of graphs with a last axis B. column: the column of each variable."""
    size = graph.points.shape[1] if len(graph.points) else 0
    width = max(3, size)
    fixed = jnp.concatenate([graph.fixed_pose, graph.fixed_point])
    sizes = np.array([3] * len(graph.poses) + [size] * len(graph.points))
    used = np.arange(width) < sizes[:, None]
    free = used[..., None] & ~fixed[:, None]
    tables = graph.tables.items()
    return Data(
        {name: jnp.where(rows.valid[:, None], rows.z, 0.0) for name, rows in tables},
        {
            name: jnp.where(
                rows.valid[:, None, None],
                # χ² depends on the symmetric part alone; gradient and blocks take Ω as symmetric.
                0.5 * (rows.information + jnp.swapaxes(rows.information, 1, 2)),
                0.0,
            )
            for name, rows in tables
        },
        {name: jnp.asarray(rows.valid) for name, rows in tables},
        jnp.zeros_like(free).at[column].set(free, unique_indices=True),
    )
