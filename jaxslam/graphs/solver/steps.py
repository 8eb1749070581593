"""The step of an iteration, by a factor of the information matrix."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.graphs.solver.linearized import System
from jaxslam.graphs.solver.plan import Plan
from jaxslam.graphs.sparse.cholesky import factorize, substitute


class Step(NamedTuple):
    """An increment, and what the quadratic model of χ² says of it."""

    increments: Float[Array, "n d B"]
    predicted: Float[Array, "B"]
    """decrease of χ²: -2 gᵀδ - δᵀHδ = λ δᵀDδ - gᵀδ"""
    regular: Bool[Array, "n B"]
    """of each column of the factor"""


def dot(a: Float[Array, "n d B"], b: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """The inner product Σ a b over all variables."""
    return (a * b).sum(axis=(0, 1))


def marquardt(plan: Plan, system: System, damping: Float[Array, "B"]) -> Step:
    """The step of (H + λD) δ = -g, D = diag H.

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
    diagonal = jnp.diagonal(system.blocks[plan.cholesky.diagonal], axis1=1, axis2=2)
    square = dot(step * jnp.moveaxis(diagonal, 2, 1), step)
    return Step(step, damping * square - dot(step, system.gradient), factored.regular)
