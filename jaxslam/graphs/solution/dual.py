"""The dual matrix of a pose graph's chordal cost, and that cost as factors of a graph."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core.record import record
from jaxslam.graphs.factor import Factor
from jaxslam.graphs.solution.chordal import Chordal
from jaxslam.graphs.solver.linearized import Data, Variables, variable_numbers
from jaxslam.graphs.solver.model import Model
from jaxslam.graphs.solver.plan import Plan
from jaxslam.graphs.sparse.gathered import summed
from jaxslam.math.linalg import total
from jaxslam.types import JaxOrNumPy


@record
class Relaxed(Factor):
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


def chordal_weights(
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
