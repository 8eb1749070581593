"""The step of an iteration, by a factor of the information matrix."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.graphs.solver.linearized import System
from jaxslam.graphs.solver.plan import Plan
from jaxslam.graphs.sparse.cholesky import factorize, substitute
from jaxslam.math.linalg import total


class Step(NamedTuple):
    """An increment, and what the quadratic model of χ² says of it."""

    increments: Float[Array, "n d B"]
    predicted: Float[Array, "B"]
    """decrease of χ²: -2 gᵀδ - δᵀHδ"""
    decrement: Float[Array, "B"]
    """decrease of χ² by the whole step, before a radius shortens it"""
    length: Float[Array, "B"]
    """√(δᵀDδ), D = diag H"""
    regular: Bool[Array, "n B"]
    """of each column of the factor"""


def dot(a: Float[Array, "n d B"], b: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """The inner product Σ a b over all variables."""
    return (a * b).sum(axis=(0, 1))


def _diagonal(plan: Plan, system: System) -> Float[Array, "n d B"]:
    own = jnp.diagonal(system.blocks[plan.cholesky.diagonal], axis1=1, axis2=2)
    return jnp.moveaxis(own, 2, 1)


def marquardt(plan: Plan, system: System, damping: Float[Array, "B"]) -> Step:
    """The step of (H + λD) δ = -g; with λ = 0 that of Gauss and Newton.

    Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM
    11(2).
    """
    width = system.blocks.shape[1]
    unit = jnp.eye(width, dtype=bool)[None, ..., None] & plan.on_diagonal[:, None, None, None]
    # What no measurement sees has a diagonal of zero, and stays where it is.
    scale = jnp.where(system.blocks == 0, 1.0, system.blocks)
    blocks = system.blocks + jnp.where(unit, damping, 0.0) * scale
    factored = factorize(plan.cholesky, blocks)
    step = substitute(plan.cholesky, factored, -system.gradient)
    square = dot(step * _diagonal(plan, system), step)
    predicted = damping * square - dot(step, system.gradient)
    return Step(step, predicted, predicted, jnp.sqrt(square), factored.regular)


def dogleg(plan: Plan, system: System, radius: Float[Array, "B"]) -> Step:
    """The step of at most a length √(δᵀDδ), on the path over the minimum along the gradient.

    Powell 1970; Nocedal and Wright 2006, "Numerical optimization", section 4.1. Where H is singular
    the path ends at that minimum.
    """
    scale = _diagonal(plan, system)
    newton = marquardt(plan, system, jnp.zeros_like(radius))
    regular = newton.regular.all(axis=0)
    down = -system.gradient / jnp.where(scale > 0, scale, 1.0)
    slope, curvature = -dot(down, system.gradient), _quadratic(plan, system, down)
    share = slope / jnp.where(curvature > 0, curvature, 1.0)
    cauchy = share[None, None] * down
    leg = jnp.where(regular[None, None], newton.increments - cauchy, 0.0)
    # |cauchy + s leg| = radius, 0 <= s <= 1
    a, b = dot(leg * scale, leg), dot(leg * scale, cauchy)
    c = dot(cauchy * scale, cauchy) - jnp.where(jnp.isfinite(radius), radius, 0.0) ** 2
    root = jnp.sqrt(jnp.maximum(b * b - a * c, 0.0))
    along = jnp.where(a > 0, (root - b) / jnp.where(a > 0, a, 1.0), 1.0)
    along = jnp.where(jnp.isfinite(radius), jnp.clip(along, 0.0, 1.0), 1.0)
    first = jnp.sqrt(dot(cauchy * scale, cauchy))
    short = jnp.minimum(1.0, radius / jnp.where(first > 0, first, 1.0))
    step = jnp.where(
        (short < 1.0)[None, None], short[None, None] * cauchy, cauchy + along[None, None] * leg
    )
    predicted = -2 * dot(step, system.gradient) - _quadratic(plan, system, step)
    decrement = jnp.where(regular, newton.decrement, slope * share)
    length = jnp.sqrt(dot(step * scale, step))
    return Step(step, predicted, decrement, length, newton.regular)


def _quadratic(plan: Plan, system: System, v: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """The quadratic form vᵀ H v."""
    one, other = v[plan.block_row], v[plan.block_column]
    width = v.shape[1]
    terms = total(
        one[:, i] * system.blocks[:, i, j] * other[:, j] for i in range(width) for j in range(width)
    )
    return (jnp.where(plan.on_diagonal[:, None], 1.0, 2.0) * terms).sum(axis=0)
