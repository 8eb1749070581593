"""The step of an iteration, and what becomes of it: damping, trust region, acceptance."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.graphs.linearized import System
from jaxslam.graphs.sparse.cholesky import CholeskyTables, factorize, substitute

METHODS = ("levenberg_marquardt", "gauss_newton", "dogleg")


class Step(NamedTuple):
    """An increment, and what the quadratic model of χ² says of it."""

    increments: Float[Array, "n d B"]
    predicted: Float[Array, "B"]
    """decrease of χ²: 2 gᵀδ - δᵀHδ"""
    regular: Bool[Array, "n B"]
    """of each column of the factor"""


def dot(a: Float[Array, "n d B"], b: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """Σ a b over all variables."""
    return (a * b).sum(axis=(0, 1))


def diagonal(tables: CholeskyTables, system: System) -> Float[Array, "n d B"]:
    """The diagonal of the information matrix, by column."""
    own = jnp.diagonal(system.blocks[tables.diagonal], axis1=1, axis2=2)
    return jnp.moveaxis(own, 2, 1)


def damped(
    tables: CholeskyTables,
    system: System,
    on_diagonal: Bool[Array, "M"],
    damping: Float[Array, "B"],
) -> Step:
    """The step of Levenberg and Marquardt: (H + λ diag H) δ = g, g = -Jᵀ Ω e.

    Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM
    11(2). With λ = 0 it is that of Gauss and Newton.
    """
    width = system.blocks.shape[1]
    unit = jnp.eye(width, dtype=bool)[None, ..., None] & on_diagonal[:, None, None, None]
    blocks = system.blocks * jnp.where(unit, 1.0 + damping[None, None, None], 1.0)
    factored = factorize(tables, blocks)
    step = substitute(tables, factored, -system.gradient)
    scaled = damping * dot(step * diagonal(tables, system), step)
    return Step(step, dot(step, -system.gradient) + scaled, factored.regular)
