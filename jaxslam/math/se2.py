"""SE(2): poses, frames and polar coordinates, each function with its hand-derived Jacobians.

A pose is an array (3,) = (x, y, θ), metres and radians, counter-clockwise positive. It is the
frame at (x, y) turned by θ; θ is wrapped to (-π, π] wherever a pose is returned. `f_jacobians`
returns the derivatives of `f` with respect to the *coordinates* (x, y, θ) of each argument in
turn, the last index being the argument's. All functions take one pose; use `jax.vmap` for more.

The order of the box operators is fixed here once: `boxplus(pose, τ) = pose ∘ exp(τ)` (the
increment is in the local frame) and `boxminus(a, b) = log(b⁻¹ ∘ a)`, so that
`boxplus(b, boxminus(a, b)) = a`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Num

from jaxslam.math._arrays import Point, PointByPose, PointMatrix, Pose, PoseMatrix, Scalar
from jaxslam.math._series import horner
from jaxslam.math._xla import traced_once
from jaxslam.math.angles import sinc, sinc_slope, wrap

__all__ = [
    "adjoint",
    "align",
    "between",
    "between_jacobians",
    "boxminus",
    "boxplus",
    "compose",
    "compose_jacobians",
    "exp",
    "exp_jacobians",
    "from_frame",
    "from_frame_jacobians",
    "inverse",
    "inverse_jacobians",
    "log",
    "log_jacobians",
    "polar",
    "polar_in_frame",
    "polar_jacobians",
    "rectangular",
    "rectangular_jacobians",
    "rotation",
    "to_frame",
    "to_frame_jacobians",
]

_ZETA_LESS_1 = [np.pi**2 / 6 - 1, np.pi**4 / 90 - 1]
_ZETA_LESS_1 += [sum(k ** (-2.0 * n) for k in range(999, 1, -1)) for n in range(3, 14)]
"""ζ(2n) - 1, n >= 1; of the sum of its terms 1e-16 is left out at most."""


def rotation(theta: Scalar) -> PointMatrix:
    """The rotation matrix R(θ) = [cos θ, -sin θ; sin θ, cos θ], (2, 2) (Solà (54))."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return _rows([c, -s], [s, c])


@traced_once
def compose(a: Pose, b: Pose) -> Pose:
    """The composition a ∘ b = (t_a + R(θ_a) t_b, θ_a + θ_b): Williams' ⊕, Solà (59), (60)."""
    c, s = jnp.cos(a[2]), jnp.sin(a[2])
    return jnp.stack([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrap(a[2] + b[2])])


def compose_jacobians(a: Pose, b: Pose) -> tuple[PoseMatrix, PoseMatrix]:
    """Derivatives of `compose` by a (3, 3) and by b (3, 3): Williams' J1 and J2."""
    c, s = jnp.cos(a[2]), jnp.sin(a[2])
    by_a = _rows([1, 0, -s * b[0] - c * b[1]], [0, 1, c * b[0] - s * b[1]], [0, 0, 1])
    return by_a, _rows([c, -s, 0], [s, c, 0], [0, 0, 1])


def inverse(a: Pose) -> Pose:
    """The inverse pose a⁻¹ = (-R(θ)ᵀ t, -θ), so that a ∘ a⁻¹ is the identity."""
    c, s = jnp.cos(a[2]), jnp.sin(a[2])
    return jnp.stack([-c * a[0] - s * a[1], s * a[0] - c * a[1], wrap(-a[2])])


def inverse_jacobians(a: Pose) -> tuple[PoseMatrix]:
    """Derivative of `inverse`, (3, 3)."""
    c, s = jnp.cos(a[2]), jnp.sin(a[2])
    return (_rows([-c, -s, s * a[0] - c * a[1]], [s, -c, c * a[0] + s * a[1]], [0, 0, -1]),)


@traced_once
def between(a: Pose, b: Pose) -> Pose:
    """The relative pose a⁻¹ ∘ b: b in the frame of a."""
    p = to_frame(a, b[:2])
    return jnp.stack([p[0], p[1], wrap(b[2] - a[2])])


def between_jacobians(a: Pose, b: Pose) -> tuple[PoseMatrix, PoseMatrix]:
    """Derivatives of `between` by a (3, 3) and by b (3, 3)."""
    by_frame, by_point = to_frame_jacobians(a, b[:2])
    by_a = jnp.concatenate([by_frame, _rows([0, 0, -1]).astype(by_frame.dtype)])
    by_b = jnp.zeros((3, 3), by_point.dtype).at[:2, :2].set(by_point).at[2, 2].set(1)
    return by_a, by_b


@traced_once
def exp(tau: Pose) -> Pose:
    """The pose reached by the constant twist τ = (u, v, ω) in unit time: (V(ω)(u, v), ω).

    V(ω) = [sin ω/ω, -(1 - cos ω)/ω; (1 - cos ω)/ω, sin ω/ω], smooth through ω = 0.
    """
    s, c = sinc(tau[2]), _cosc(tau[2])
    return jnp.stack([s * tau[0] - c * tau[1], c * tau[0] + s * tau[1], wrap(tau[2])])


def exp_jacobians(tau: Pose) -> tuple[PoseMatrix]:
    """Derivative of `exp`, (3, 3)."""
    u, v, w = tau[0], tau[1], tau[2]
    s, c, ds, dc = sinc(w), _cosc(w), sinc_slope(w), _cosc_slope(w)
    return (_rows([s, -c, ds * u - dc * v], [c, s, dc * u + ds * v], [0, 0, 1]),)


@traced_once
def log(pose: Pose) -> Pose:
    """The twist τ with exp(τ) = pose, |ω| <= π: (V(θ)⁻¹ t, θ).

    V(θ)⁻¹ = [a, θ/2; -θ/2, a] with a = (θ/2) cot(θ/2).
    """
    w = wrap(pose[2])
    a, h = _half_cot(w), w / 2
    return jnp.stack([a * pose[0] + h * pose[1], -h * pose[0] + a * pose[1], w])


def log_jacobians(pose: Pose) -> tuple[PoseMatrix]:
    """Derivative of `log`, (3, 3)."""
    x, y, w = pose[0], pose[1], wrap(pose[2])
    a, h = _half_cot(w), w / 2
    da = _half_cot_slope(w)
    return (_rows([a, h, da * x + 0.5 * y], [-h, a, -0.5 * x + da * y], [0, 0, 1]),)


def boxplus(pose: Pose, tau: Pose) -> Pose:
    """The pose moved by a local twist: pose ⊞ τ = pose ∘ exp(τ)."""
    return compose(pose, exp(tau))


def boxminus(a: Pose, b: Pose) -> Pose:
    """The twist from b to a: a ⊟ b = log(b⁻¹ ∘ a)."""
    return log(between(b, a))


def adjoint(pose: Pose) -> PoseMatrix:
    """The adjoint Ad (3, 3), pose ∘ exp(τ) = exp(Ad τ) ∘ pose: [R, (y, -x)ᵀ; 0, 1]."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return _rows([c, -s, pose[1]], [s, c, -pose[0]], [0, 0, 1])


@traced_once
def to_frame(frame: Pose, point: Point) -> Point:
    """A world point p (2,) in the frame's coordinates, R(θ)ᵀ(p - t) (Solà (56))."""
    c, s = jnp.cos(frame[2]), jnp.sin(frame[2])
    dx, dy = point[0] - frame[0], point[1] - frame[1]
    return jnp.stack([c * dx + s * dy, -s * dx + c * dy])


def to_frame_jacobians(frame: Pose, point: Point) -> tuple[PointByPose, PointMatrix]:
    """Derivatives of `to_frame` by the frame (2, 3) and by the point (2, 2)."""
    c, s = jnp.cos(frame[2]), jnp.sin(frame[2])
    dx, dy = point[0] - frame[0], point[1] - frame[1]
    by_frame = _rows([-c, -s, -s * dx + c * dy], [s, -c, -c * dx - s * dy])
    return by_frame, _rows([c, s], [-s, c])


@traced_once
def from_frame(frame: Pose, point: Point) -> Point:
    """A point p (2,) of the frame in world coordinates, R(θ) p + t (Solà (55))."""
    c, s = jnp.cos(frame[2]), jnp.sin(frame[2])
    return jnp.stack(
        [frame[0] + c * point[0] - s * point[1], frame[1] + s * point[0] + c * point[1]]
    )


def from_frame_jacobians(frame: Pose, point: Point) -> tuple[PointByPose, PointMatrix]:
    """Derivatives of `from_frame` by the frame (2, 3) and by the point (2, 2)."""
    c, s = jnp.cos(frame[2]), jnp.sin(frame[2])
    by_frame = _rows([1, 0, -s * point[0] - c * point[1]], [0, 1, c * point[0] - s * point[1]])
    return by_frame, _rows([c, -s], [s, c])


@traced_once
def polar(point: Point) -> Point:
    """(range, bearing) of a point (2,) (Solà (61)); at the origin (0, 0) with zero gradient."""
    x, y, away = _away_from_origin(point)
    return jnp.stack([jnp.where(away, jnp.sqrt(x * x + y * y), 0.0), jnp.arctan2(y, x)])


@traced_once
def polar_in_frame(frame: Pose, point: Point) -> Point:
    """(range, bearing) of a world point (2,) in the frame: `polar` of `to_frame`, (Solà (63)).

    Without the frame's sine and cosine: (|p - t|, atan2(p - t) - θ); (0, 0) at the origin.
    """
    x, y, away = _away_from_origin(point - frame[:2])
    bearing = wrap(jnp.arctan2(y, x) - frame[2])
    return jnp.where(away, jnp.stack([jnp.sqrt(x * x + y * y), bearing]), 0.0)


def polar_jacobians(point: Point) -> tuple[PointMatrix]:
    """Derivative of `polar`, (2, 2): [x/r, y/r; -y/r², x/r²] (errata, Solà C.1.2); 0 at r = 0."""
    x, y, away = _away_from_origin(point)
    r2 = x * x + y * y
    r = jnp.sqrt(r2)
    return (jnp.where(away, _rows([x / r, y / r], [-y / r2, x / r2]), 0.0),)


def rectangular(polar_point: Point) -> Point:
    """(r cos φ, r sin φ) of (range, bearing) (Solà (62))."""
    r, phi = polar_point[0], polar_point[1]
    return jnp.stack([r * jnp.cos(phi), r * jnp.sin(phi)])


def rectangular_jacobians(polar_point: Point) -> tuple[PointMatrix]:
    """Derivative of `rectangular`, (2, 2)."""
    r, phi = polar_point[0], polar_point[1]
    c, s = jnp.cos(phi), jnp.sin(phi)
    return (_rows([c, -r * s], [s, r * c]),)


def align(source: Float[Array, "N 2"], target: Float[Array, "N 2"]) -> Pose:
    """The pose T that minimises Σ |T·source_i - target_i|² over SE(2) (no scale).

    source, target (N, 2). Closed form: θ = atan2(Σ s×t, Σ s·t) over the centred points, then the
    translation between the centroids (Umeyama 1991 without scale). One point gives θ = 0.
    """
    s0, t0 = source.mean(axis=0), target.mean(axis=0)
    s, t = source - s0[None, :], target - t0[None, :]
    theta = polar(jnp.stack([jnp.sum(s * t), jnp.sum(s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])]))[1]
    shift = t0 - rotation(theta) @ s0
    return jnp.stack([shift[0], shift[1], theta])


def _away_from_origin(point: Point) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """The point, replaced by (1, 0) at the origin, where sqrt and arctan2 have no derivative.

    The range is set to zero where x² + y² underflows, hence the test on the squares.
    """
    away = point[0] * point[0] + point[1] * point[1] > 0
    return jnp.where(away, point[0], 1.0), jnp.where(away, point[1], 0.0), away


def _cosc(x: Scalar) -> Scalar:
    """(1 - cos x)/x without cancellation: sin(x/2) sinc(x/2)."""
    return jnp.sin(x / 2) * sinc(x / 2)


def _cosc_slope(x: Scalar) -> Scalar:
    return 0.5 * (jnp.cos(x / 2) * sinc(x / 2) + jnp.sin(x / 2) * sinc_slope(x / 2))


@jax.custom_jvp
def _half_cot(x: Scalar) -> Scalar:
    """(x/2) cot(x/2), 1 at 0, for |x| <= π: with u = (x/2π)²,

    (1 - 3u)/(1 - u) - 2 Σ (ζ(2n) - 1) uⁿ, n >= 1 (DLMF 4.19.6 and 25.6.2, the term 1 of ζ summed).
    """
    u = (x / (2 * np.pi)) ** 2
    return (1 - 3 * u) / (1 - u) - 2 * u * horner(u, _ZETA_LESS_1)


@_half_cot.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    return _half_cot(*primals), _half_cot_slope(*primals) * tangents[0]


def _half_cot_slope(x: Scalar) -> Scalar:
    u = (x / (2 * np.pi)) ** 2
    series = horner(u, [(n + 1) * term for n, term in enumerate(_ZETA_LESS_1)])
    # du/dx = x/(2π²); d/du of (1 - 3u)/(1 - u) is -2/(1 - u)², of the sum uⁿ⁻¹ with a factor n.
    return -x / np.pi**2 * (1 / (1 - u) ** 2 + series)


def _rows(*rows: list[Array | float]) -> Num[Array, "rows columns"]:
    dtype = jnp.result_type(*(entry for row in rows for entry in row))
    # One array, and so one kernel and not one a row.
    entries = jnp.stack([jnp.asarray(entry, dtype) for row in rows for entry in row])
    return entries.reshape(len(rows), -1)
