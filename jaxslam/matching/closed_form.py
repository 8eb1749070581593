"""Exact minima of the quadratic costs of a step: over points, and over lines."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.math import linalg

_NEWTON = 12
"""Steps of the secular equation: it converges quadratically from the left, without a safeguard."""


def align_points(
    source: Float[Array, "N 2"], target: Float[Array, "N 2"], weight: Float[Array, "N"]
) -> Float[Array, "3"]:
    """The pose that minimizes Σ w |T ∘ s - t|²: `se2.align` with weights.

    θ = atan2(Σ w s' × t', Σ w s' · t') of the points less their weighted means. The identity where
    no weight is above 0.
    """
    total = weight.sum()
    share = weight / jnp.where(total > 0, total, 1.0)
    s0, t0 = share @ source, share @ target
    s, t = source - s0[None], target - t0[None]
    along = (share * (s * t).sum(axis=1)).sum()
    across = (share * (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])).sum()
    some = (along**2 + across**2) > 0
    theta = jnp.arctan2(jnp.where(some, across, 0.0), jnp.where(some, along, 1.0))
    c, s_ = jnp.cos(theta), jnp.sin(theta)
    shift = t0 - jnp.stack([c * s0[0] - s_ * s0[1], s_ * s0[0] + c * s0[1]])
    return jnp.concatenate([shift, theta[None]])


def align_to_lines(
    source: Float[Array, "N 2"],
    target: Float[Array, "N 2"],
    normal: Float[Array, "N 2"],
    weight: Float[Array, "N"],
) -> Float[Array, "3"]:
    """The pose that minimizes Σ w (n·(R s + t - q))², exactly.

    With r = (cos θ, sin θ) the residual is linear: n·t + a·r - b, a = (n·s, n × s) as n_x s_x +
    n_y s_y and n_y s_x - n_x s_y, b = n·q. Least squares give t for each r; what remains is
    min rᵀ S r + hᵀ r over |r| = 1, S = D - BᵀA⁻¹B (Censi 2008, "An ICP variant using a
    point-to-line metric", ICRA, minimizes the same by the roots of a polynomial of degree four).
    Stationary points have 2 (S + λ) r = -h, and the least cost is at the largest λ: with the
    eigenvalues s₁ <= s₂ of S and the parts of h along its eigenvectors,

        φ(λ) = h₁²/(s₁ + λ)² + h₂²/(s₂ + λ)² = 4,     λ > -s₁,

    where φ falls from ∞ to 0, so there is one. 1/√φ is concave there, so that Newton's method for
    1/√φ = ½ from λ = max(|h₁|/2 - s₁, |h₂|/2 - s₂), where φ >= 4, climbs to it without overshoot.

    A share ε^¾ of the traces (ε of the dtype) pulls towards the identity, so that what the lines do
    not determine stays as it is. Take points about their mean, for small rounding.
    """
    nx, ny = normal[:, 0], normal[:, 1]
    a = jnp.stack([nx * source[:, 0] + ny * source[:, 1], ny * source[:, 0] - nx * source[:, 1]], 1)
    b = (normal * target).sum(axis=1)
    weighted = weight[:, None] * normal
    pull = float(jnp.finfo(a.dtype).eps) ** 0.75
    total = weight.sum()
    total = jnp.where(total > 0, total, 1.0)
    of_turn = linalg.gram(weight[:, None] * a, a)
    scale = jnp.trace(of_turn)
    turn_pull = pull * jnp.where(scale > 0, scale, 1.0)
    eye: Any = jnp.eye(2, dtype=a.dtype)
    of_shift = linalg.gram(weighted, normal) + pull * total * eye
    cross = linalg.gram(weighted, a)
    both = of_turn + turn_pull * eye
    shift_b = (weighted * b[:, None]).sum(axis=0)
    turn_b = ((weight * b)[:, None] * a).sum(axis=0) + turn_pull * eye[0]
    inverse = linalg.inverse(of_shift)
    s = linalg.symmetrize(both - cross.T @ inverse @ cross)
    h = -2 * (turn_b - cross.T @ inverse @ shift_b)
    r = on_circle(s, h)
    shift = inverse @ (shift_b - cross @ r)
    return jnp.concatenate([shift, jnp.arctan2(r[1], r[0])[None]])


def on_circle(s: Float[Array, "2 2"], h: Float[Array, "2"]) -> Float[Array, "2"]:
    """The unit vector r of the least rᵀ S r + hᵀ r, by the secular equation of `align_to_lines`."""
    mean, half, off = 0.5 * (s[0, 0] + s[1, 1]), 0.5 * (s[0, 0] - s[1, 1]), s[0, 1]
    square = half**2 + off**2
    apart = square > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    angle = 0.5 * jnp.arctan2(jnp.where(apart, off, 0.0), jnp.where(apart, half, 1.0))
    e2 = jnp.stack([jnp.cos(angle), jnp.sin(angle)])  # of the larger eigenvalue
    e1 = jnp.stack([-e2[1], e2[0]])
    low, high = mean - root, mean + root
    h1, h2 = e1 @ h, e2 @ h
    size = jnp.sqrt(h1**2 + h2**2)
    tiny = jnp.finfo(s.dtype).eps * jnp.where(size > 0, size, 1.0)
    h1 = jnp.where(jnp.abs(h1) > tiny, h1, jnp.where(h1 < 0, -tiny, tiny))
    start = jnp.maximum(0.5 * jnp.abs(h1) - low, 0.5 * jnp.abs(h2) - high)

    def newton(_: Any, at: Array) -> Array:
        u, v = low + at, high + at
        phi = (h1 / u) ** 2 + (h2 / v) ** 2
        slope = h1**2 / u**3 + h2**2 / v**3
        # ψ = φ^-½, ψ' = φ^-3/2 (h₁²/u³ + h₂²/v³); the step is (½ - ψ)/ψ'.
        return jnp.asarray(at + (0.5 * jnp.sqrt(phi) - 1.0) * phi / slope)

    at: Array = jax.lax.fori_loop(0, _NEWTON, newton, start)
    r = -0.5 * (h1 / (low + at) * e1 + h2 / (high + at) * e2)
    return r / jnp.sqrt((r**2).sum())
