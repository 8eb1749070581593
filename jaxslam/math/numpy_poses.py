"""Poses of the plane on the host: many at once, in NumPy, where `math.se2` would be compiled."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

__all__ = ["Poses", "adjoint", "between", "chain", "compose", "inverse", "part", "wrapped"]

Poses = Float[np.ndarray, "... 3"]


def wrapped(angle: ArrayLike) -> Float[np.ndarray, "..."]:
    """Angles [rad] in (-π, π]; an angle in this interval is unchanged."""
    a = np.asarray(angle, np.float64)
    return np.asarray(a - 2 * np.pi * np.ceil((a - np.pi) / (2 * np.pi)))


def compose(a: Poses, b: Poses) -> Poses:
    """The compositions a ∘ b, leading axes broadcast; as `se2.compose`."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrapped(a[..., 2] + b[..., 2])], axis=-1)


def inverse(a: Poses) -> Poses:
    """The inverse a⁻¹ of each pose."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = -c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1]
    return np.stack([x, y, wrapped(-a[..., 2])], axis=-1)


def between(a: Poses, b: Poses) -> Poses:
    """The relative poses a⁻¹ ∘ b: b in the frame of a."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, wrapped(b[..., 2] - a[..., 2])], axis=-1)


def chain(first: Poses, steps: Poses) -> Poses:
    """The poses (T + 1, 3) of a path: the first, then those that T relative poses lead to."""
    out = np.empty((len(steps) + 1, 3))
    out[0] = first
    for t, step in enumerate(steps):
        out[t + 1] = compose(out[t], step)
    return out


def part(step: Poses, share: Float[np.ndarray, "..."]) -> Poses:
    """The share s of each step at constant velocity on SE(2): exp(s log(step))."""
    half = step[..., 2] / 2
    # (exp(iθs) - 1) / (exp(iθ) - 1), without its zeros
    ratio = share * np.sinc(share * half / np.pi) / np.sinc(half / np.pi)
    moved = (step[..., 0] + 1j * step[..., 1]) * ratio * np.exp(1j * (share - 1) * half)
    return np.stack([moved.real, moved.imag, share * step[..., 2]], axis=-1)


def adjoint(pose: Poses) -> Float[np.ndarray, "... 3 3"]:
    """The adjoint of each pose: pose ∘ e = (Ad e) ∘ pose to first order in a small pose e."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    zero, unit = np.zeros_like(c), np.ones_like(c)
    rows = [[c, -s, pose[..., 1]], [s, c, -pose[..., 0]], [zero, zero, unit]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
