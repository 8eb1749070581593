"""Chordal residuals: those of a measurement where a heading is cosine and sine, not an angle."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxslam.math import se2

Rows = list[list[list[Array]]]


class Chordal(NamedTuple):
    """The chordal residual r of a measurement, linear in the positions p and u = (cos θ, sin θ)."""

    residual: Callable[[tuple[Array, ...], Array], Array]
    """(variables, z) -> r (S,), on one row"""
    size: int
    """S: two of the position, then those of the heading"""
    rows: Callable[[Array], Rows] | None
    """(z) -> ∂r/∂(p, u) of each variable; None of a prior, which is left out of the cost"""


def _pose_error(variables: tuple[Array, ...], z: Array) -> Array:
    e = se2.between(z, se2.between(*variables))
    return jnp.stack([e[0], e[1], jnp.cos(e[2]) - 1.0, jnp.sin(e[2])])


def _point_error(variables: tuple[Array, ...], z: Array) -> Array:
    return se2.to_frame(variables[0], variables[1][:2]) - z


def _no_error(variables: tuple[Array, ...], z: Array) -> Array:
    return jnp.zeros(1, z.dtype)


def _pose_rows(z: Array) -> Rows:
    """The ∂r/∂(p, u) of both poses, r = (p_j - p_i - t u_i, u_j - exp(iφ) u_i), (4, 4) each."""
    o, i = jnp.zeros_like(z[:, 0]), jnp.ones_like(z[:, 0])
    x, y, c, s = z[:, 0], z[:, 1], jnp.cos(z[:, 2]), jnp.sin(z[:, 2])
    one = [[-i, o, -x, y], [o, -i, -y, -x], [o, o, -c, s], [o, o, -s, -c]]
    return [one, [[i, o, o, o], [o, i, o, o], [o, o, i, o], [o, o, o, i]]]


def _point_rows(z: Array) -> Rows:
    """The derivatives ∂r/∂(p, u) of a pose and ∂r/∂p of a point, r = p_j - p_i - t u_i."""
    return [rows[:2] for rows in _pose_rows(jnp.concatenate([z, jnp.zeros_like(z[:, :1])], axis=1))]


RELATIVE_POSE = Chordal(_pose_error, 4, _pose_rows)
RELATIVE_POSITION = Chordal(_point_error, 2, _point_rows)
PRIOR = Chordal(_no_error, 1, None)
