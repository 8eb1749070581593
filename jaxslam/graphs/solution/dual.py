"""The dual matrix of a pose graph's chordal cost, and that cost as factors of a graph."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.graphs.factor import Factor
from jaxslam.graphs.solver.linearized import Data, Variables, variable_numbers
from jaxslam.graphs.solver.model import Model
from jaxslam.graphs.solver.plan import Plan
from jaxslam.graphs.sparse.gathered import summed
from jaxslam.math import se2
from jaxslam.math.linalg import total
from jaxslam.types import JaxOrNumPy


def _pose_error(variables: tuple[Array, ...], z: Array) -> Array:
    e = se2.between(z, se2.between(*variables))
    return jnp.stack([e[0], e[1], jnp.cos(e[2]) - 1.0, jnp.sin(e[2])])


def _point_error(variables: tuple[Array, ...], z: Array) -> Array:
    return se2.to_frame(variables[0], variables[1][:2]) - z


def _no_error(variables: tuple[Array, ...], z: Array) -> Array:
    return jnp.zeros(1, z.dtype)


def _chordal(
    name: str, who: tuple[str, ...], errors: int, residual: Callable[..., Array]
) -> Factor:
    return Factor(name, who, (), ("",) * errors, residual)


_POSE = _chordal("relative_pose", ("pose", "pose"), 4, _pose_error)

FACTORS = {
    "relative_pose": _POSE,
    "relative_pose_log": _POSE,
    "relative_position": _chordal("relative_position", ("pose", "point"), 2, _point_error),
    "prior": _chordal("prior", ("pose",), 1, _no_error),
}
"""The same measurements with chordal residuals."""


def _pose_rows(z: Array) -> list[list[list[Array]]]:
    """The ∂r/∂(p, u) of both poses, r = (p_j - p_i - t u_i, u_j - exp(iφ) u_i), (4, 4) each."""
    o, i = jnp.zeros_like(z[:, 0]), jnp.ones_like(z[:, 0])
    x, y, c, s = z[:, 0], z[:, 1], jnp.cos(z[:, 2]), jnp.sin(z[:, 2])
    one = [[-i, o, -x, y], [o, -i, -y, -x], [o, o, -c, s], [o, o, -s, -c]]
    return [one, [[i, o, o, o], [o, i, o, o], [o, o, i, o], [o, o, o, i]]]


def _point_rows(z: Array) -> list[list[list[Array]]]:
    """The derivatives ∂r/∂(p, u) of a pose and ∂r/∂p of a point, r = p_j - p_i - t u_i."""
    return [rows[:2] for rows in _pose_rows(jnp.concatenate([z, jnp.zeros_like(z[:, :1])], axis=1))]


ROWS = {"relative_pose": _pose_rows, "relative_position": _point_rows}


def chordal_weights(name: str, information: Float[JaxOrNumPy, "E R R B"]) -> Float[Array, "E S B"]:
    """The weights τ, τ, κ, κ or τ, τ of the chordal residuals; zero for a prior."""
    near = 0.5 * (information[:, 0, 0] + information[:, 1, 1])
    if name == "prior":
        return jnp.zeros_like(near)[:, None]
    turn = [information[:, 2, 2]] * 2 if name == "relative_pose" else []
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
    for name, factor in chordal.factors:
        who, valid, k = plan.who[name], data.valid[name], len(factor.variables)
        rows, size = len(who), len(factor.errors)
        if factor.name not in ROWS:
            blocks.append(jnp.zeros((rows, 4, 4, batch), dtype))
            gradients.append(jnp.zeros((rows, 4, batch), dtype))
            continue
        parts = ROWS[factor.name](data.z[name])
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
    own = summed(plan.gradient, jnp.concatenate(gradients))[plan.column]
    multipliers = (own[:poses, 2:] * z[:poses, 2:]).sum(axis=1)
    every = jnp.concatenate([multipliers, jnp.zeros((count - poses, batch), dtype)])
    unit = jnp.eye(4, dtype=dtype)[None, ..., None]
    turn = unit * jnp.array([0.0, 0.0, 1.0, 1.0], dtype)[None, None, :, None]
    at = plan.on_diagonal[:, None, None, None]
    turns = jnp.where(at & is_pose[plan.order][plan.block_column][:, None, None, None], turn, 0.0)
    out = summed(plan.information, jnp.concatenate(blocks))
    out = out + jnp.where(at & ~free[plan.block_column][:, None], unit, 0.0)
    return out - turns * every[plan.order][plan.block_column][:, None, None], multipliers, turns
