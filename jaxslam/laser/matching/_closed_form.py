"""Exact minima of the quadratic costs of a step: over points, over lines, with a prior."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.laser.matching._point_sets import Prior
from jaxslam.math import _linalg as linalg

_NEWTON = 12
"""Newton steps for the secular equation: they converge quadratically from the left, without a
safeguard."""


class Quadratic(NamedTuple):
    """A cost tᵀ A t + 2 tᵀ B r + rᵀ D r - 2 aᵀ t - 2 dᵀ r of a shift t and r = (cos θ, sin θ)."""

    shift: Float[Array, "2 2"]
    """A"""
    cross: Float[Array, "2 2"]
    """B"""
    turn: Float[Array, "2 2"]
    """D"""
    shift_slope: Float[Array, "2"]
    """a"""
    turn_slope: Float[Array, "2"]
    """d"""


def add(first: Quadratic, second: Quadratic) -> Quadratic:
    """The sum of two costs."""
    return Quadratic(*(a + b for a, b in zip(first, second, strict=True)))


def of_points(
    source: Float[Array, "N 2"], target: Float[Array, "N 2"], weight: Float[Array, "N"]
) -> Quadratic:
    """The cost Σ w |R s + t - q|² of pairs of points."""
    weighted = weight[:, None] * source
    x, y = weighted.sum(axis=0)
    eye = jnp.eye(2, dtype=source.dtype)
    # R s = (s_x r_x - s_y r_y, s_y r_x + s_x r_y).
    along = (weighted * target).sum()
    across = (weighted[:, 0] * target[:, 1] - weighted[:, 1] * target[:, 0]).sum()
    return Quadratic(
        shift=weight.sum() * eye,
        cross=jnp.stack([jnp.stack([x, -y]), jnp.stack([y, x])]),
        turn=(weighted * source).sum() * eye,
        shift_slope=(weight[:, None] * target).sum(axis=0),
        turn_slope=jnp.stack([along, across]),
    )


def of_lines(
    source: Float[Array, "N 2"],
    target: Float[Array, "N 2"],
    normal: Float[Array, "N 2"],
    weight: Float[Array, "N"],
) -> Quadratic:
    """The cost Σ w (n·(R s + t - q))² of points and lines.

    The residual is linear in (t, r): n·t + a·r - b, a = (n·s, n × s) as n_x s_x + n_y s_y and
    n_y s_x - n_x s_y, b = n·q.
    """
    nx, ny = normal[:, 0], normal[:, 1]
    a = jnp.stack([nx * source[:, 0] + ny * source[:, 1], ny * source[:, 0] - nx * source[:, 1]], 1)
    b = weight * (normal * target).sum(axis=1)
    weighted = weight[:, None] * normal
    return Quadratic(
        shift=linalg.gram(weighted, normal),
        cross=linalg.gram(weighted, a),
        turn=linalg.gram(weight[:, None] * a, a),
        shift_slope=b @ normal,
        turn_slope=b @ a,
    )


def of_prior(prior: Prior, pose: Float[Array, "3"], middle: Float[Array, "2"]) -> Quadratic:
    """The cost eᵀ Λ e of the error after a motion (t, r) about a middle of a pose (p, θ).

    e = (R (p - m) + t + m - p₀, (θ - θ₀) cos δ + sin δ), δ the motion's angle. The last equals
    θ + δ - θ₀ and has its slope where δ = 0, so that the minimum is exact where a pose stays.
    """
    arm, off = pose[:2] - middle, prior.error(pose)[2]
    zero, unit = jnp.zeros_like(off), jnp.ones_like(off)
    by_turn = jnp.stack(
        [jnp.stack([arm[0], -arm[1]]), jnp.stack([arm[1], arm[0]]), jnp.stack([off, unit])]
    )
    offset = jnp.concatenate([prior.pose[:2] - middle, zero[None]])
    weighted = prior.information @ by_turn
    return Quadratic(
        shift=prior.information[:2, :2],
        cross=weighted[:2],
        turn=by_turn.T @ weighted,
        shift_slope=prior.information[:2] @ offset,
        turn_slope=offset @ weighted,
    )


def normal_equations(of: Quadratic) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Gauss-Newton's curvature (3, 3) and half of the slope (3,) of a cost by (t, θ), at no motion.

    There r = (1, 0) and ∂r/∂θ = (0, 1).
    """
    by_turn = of.cross[:, 1:]
    curvature = jnp.block([[of.shift, by_turn], [by_turn.T, of.turn[1:, 1:]]])
    turning = of.turn[1, 0] - of.turn_slope[1]
    return curvature, jnp.concatenate([of.cross[:, 0] - of.shift_slope, turning[None]])


def minimizer(of: Quadratic) -> Float[Array, "3"]:
    """The motion (t, θ) of the least cost, exactly.

    The minimum over t is at A t = a - B r; what remains is min rᵀ S r + hᵀ r over |r| = 1, S = D -
    BᵀA⁻¹B (Censi 2008, "An ICP variant using a point-to-line metric", ICRA, minimizes the same by
    the roots of a polynomial of degree four). Stationary points have 2 (S + λ) r = -h, and the
    least cost is at the largest λ: with the eigenvalues s₁ <= s₂ of S and the parts of h along its
    eigenvectors,

        φ(λ) = h₁²/(s₁ + λ)² + h₂²/(s₂ + λ)² = 4,     λ > -s₁,

    where φ falls from ∞ to 0, so there is one. 1/√φ is concave there, so that Newton's method for
    1/√φ = ½ from λ = max(|h₁|/2 - s₁, |h₂|/2 - s₂), where φ >= 4, climbs to it without overshoot.

    A share ε^¾ of the traces (ε of the dtype) pulls towards the identity, so that what the cost
    does not determine stays as it is. Take points about their mean, for small rounding.
    """
    eye = jnp.eye(2, dtype=of.shift.dtype)
    pull = float(jnp.finfo(of.shift.dtype).eps) ** 0.75

    def pull_of(matrix: Array) -> Array:
        trace = jnp.trace(matrix)
        return jnp.asarray(pull * jnp.where(trace > 0, trace, 1.0))

    turn_pull = pull_of(of.turn)
    inverse = linalg.inverse(of.shift + pull_of(of.shift) * eye)
    s = linalg.symmetrize(of.turn + turn_pull * eye - of.cross.T @ inverse @ of.cross)
    # The pull is towards r = (1, 0), no turn, and t = 0.
    h = -2 * (of.turn_slope + turn_pull * eye[0] - of.cross.T @ inverse @ of.shift_slope)
    r = _on_circle(s, h)
    shift = inverse @ (of.shift_slope - of.cross @ r)
    return jnp.concatenate([shift, jnp.arctan2(r[1], r[0])[None]])


def _on_circle(s: Float[Array, "2 2"], h: Float[Array, "2"]) -> Float[Array, "2"]:
    """The unit vector r of the least rᵀ S r + hᵀ r, by the secular equation of `minimizer`."""
    mean, half, off = 0.5 * (s[0, 0] + s[1, 1]), 0.5 * (s[0, 0] - s[1, 1]), s[0, 1]
    square = half**2 + off**2
    apart = square > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    angle = 0.5 * jnp.arctan2(jnp.where(apart, off, 0.0), jnp.where(apart, half, 1.0))
    e2 = jnp.stack([jnp.cos(angle), jnp.sin(angle)])  # eigenvector of the larger eigenvalue
    e1 = jnp.stack([-e2[1], e2[0]])
    low, high = mean - root, mean + root
    h1, h2 = e1 @ h, e2 @ h
    size = jnp.sqrt(h1**2 + h2**2)
    # h along e1 is not 0: φ would have no pole at -s₁, and perhaps no root (the "hard case").
    tiny = jnp.finfo(s.dtype).eps * jnp.where(size > 0, size, 1.0)
    h1 = jnp.where(jnp.abs(h1) > tiny, h1, jnp.where(h1 < 0, -tiny, tiny))
    start = jnp.maximum(0.5 * jnp.abs(h1) - low, 0.5 * jnp.abs(h2) - high)

    def newton(_: Array, at: Array) -> Array:
        u, v = low + at, high + at
        phi = (h1 / u) ** 2 + (h2 / v) ** 2
        slope = h1**2 / u**3 + h2**2 / v**3
        # ψ = φ^-½, ψ' = φ^-3/2 (h₁²/u³ + h₂²/v³); the step is (½ - ψ)/ψ'.
        return jnp.asarray(at + (0.5 * jnp.sqrt(phi) - 1.0) * phi / slope)

    at: Array = jax.lax.fori_loop(0, _NEWTON, newton, start)
    r = -0.5 * (h1 / (low + at) * e1 + h2 / (high + at) * e2)
    return r / jnp.sqrt((r**2).sum())
