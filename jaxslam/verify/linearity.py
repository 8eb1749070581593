"""Linearity indices: the nonlinearity of a model relative to its linear change, within n σ."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.validation import InvalidField, covariance, positive, refusals_of, require
from jaxslam.math._linalg import root_psd
from jaxslam.verify._loops import limit_loops

__all__ = ["Linearity", "linearity_index", "motion_linearity", "sensor_linearity"]

_DIRECTIONS = 64
"""number of fixed random directions in which the region is sampled"""
_RADII = (1.0, 0.5)
"""radii of the sampled points, in radii of the region"""


class Linearity(NamedTuple):
    """Linearity indices of a function.

    0: linear; 1: the nonlinear part is as large as the linear change; inf: there is no (finite)
    linear change.
    """

    hessian: Float[Array, ""]
    """largest index of an output, to second order"""
    sampled: Float[Array, ""]
    """largest index of an output, at points of the region"""
    hessian_rows: Float[Array, "m"]
    """index of each output, to second order"""
    sampled_rows: Float[Array, "m"]
    """index of each output, at points of the region"""


def linearity_index(
    f: Callable[[jax.Array], jax.Array],
    x: ArrayLike,
    cov: ArrayLike,
    *,
    sigmas: float = 3.0,
    residual: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
    noise_cov: ArrayLike | None = None,
) -> Linearity:
    """Linearity indices of f: (n,) -> (m,) within n_σ standard deviations of x, with covariance P.

    With P = L Lᵀ, the region |ξ| <= n_σ of x + Lξ (Solà's probability concentration region, 2.3.5
    and fig. 6), Jacobian J and Hessians H_i at x, the index of an output is its largest departure
    from the linearization over its largest linear change,

        index_i = sup |f_i(x + Lξ) - f_i(x) - J_i Lξ| / (n_σ √(J_i P J_iᵀ + R_ii)),

    the supremum once to second order, (n_σ²/2)‖Lᵀ H_i L‖₂, and once as the maximum over points of
    the region: along ± each axis and ± each eigenvector of Lᵀ H_i L, and in 64 fixed random
    directions, at n_σ and n_σ/2. The index has no unit, and the units of x do not change it. R,
    where given, is the covariance of noise added to f: a smaller departure does no harm. (Civera,
    Davison & Montiel 2008 use a related index, along the line of sight.)

    Traceable: wrap it in `jax.jit`, or in `jax.vmap` over states.

    Args:
        f: the function; called with (n,).
        x: (n,) the state.
        cov: (n, n) P, may be singular.
        sigmas: n_σ.
        residual: (y, y0) -> y ⊖ y0, for outputs on a circle.
        noise_cov: (m, m) R.
    Raises:
        ValueError: if cov or noise_cov is not a covariance of the right size, or sigmas <= 0.
    """
    with refusals_of("linearity_index"):
        point = _vector("x", x)
        if is_concrete(point) and not np.all(np.isfinite(np.asarray(point))):
            raise InvalidField("x", "the state is not finite")
        require("cov", cov, covariance(point.shape[0]))
        shape = jax.eval_shape(f, point).shape
        if len(shape) != 1:
            raise InvalidField("f", f"expected it to return (m,), got shape {shape}")
        require("sigmas", sigmas, positive)
    root = root_psd(jnp.asarray(cov, point.dtype))

    def g(xi: jax.Array) -> jax.Array:
        return f(point + root @ xi)

    zero = jnp.zeros_like(point)
    jacobian, hessians = jax.jacfwd(f)(point), jax.jacfwd(jax.jacfwd(g))(zero)
    slope = jacobian @ root
    rows = slope.shape[0]
    reach2 = jnp.sum(slope**2, axis=1)
    if noise_cov is not None:
        with refusals_of("linearity_index"):
            require("noise_cov", noise_cov, covariance(rows))
        reach2 = reach2 + jnp.diagonal(jnp.asarray(noise_cov, point.dtype))
    smooth = jnp.isfinite(hessians).all(axis=(1, 2))
    values, vectors = jnp.linalg.eigh(jnp.where(smooth[:, None, None], hessians, 0.0))  # (m, n, n)
    by_hessian = sigmas**2 / 2 * jnp.max(jnp.abs(values), axis=1, initial=0.0)
    by_hessian = jnp.where(smooth, by_hessian, jnp.inf)

    axes = jnp.eye(len(zero), dtype=point.dtype)
    draws = np.random.default_rng(0).normal(size=(_DIRECTIONS, len(zero)))
    random = jnp.asarray(draws / np.linalg.norm(draws, axis=1, keepdims=True), point.dtype)
    eigenvectors = jnp.swapaxes(jax.lax.stop_gradient(vectors), 1, 2).reshape(-1, len(zero))
    directions = jnp.concatenate([axes, random, eigenvectors])
    tries = jnp.concatenate([sign * r * directions for r in _RADII for sign in (1, -1)]) * sigmas
    centre, difference = g(zero), residual or jnp.subtract
    away = jax.vmap(lambda xi: difference(g(xi), centre) - slope @ xi)(tries)
    if residual is not None:  # changes by more than half a turn are wrapped
        away = jax.vmap(lambda gap: difference(gap, jnp.zeros_like(gap)))(away)
    by_sampling = jnp.max(jnp.abs(away), axis=0, initial=0.0)
    # Differences within the rounding of f and of the points count as none.
    moved = jnp.abs(centre) + jnp.abs(tries @ slope.T).max(axis=0)
    rounding = 16 * jnp.finfo(point.dtype).eps * (moved + jnp.abs(jacobian) @ jnp.abs(point))
    by_sampling = jnp.where(by_sampling <= rounding, 0.0, by_sampling)

    index, sampled = (_index(part, sigmas, reach2) for part in (by_hessian, by_sampling))
    return Linearity(index.max(initial=0.0), sampled.max(initial=0.0), index, sampled)


def motion_linearity(
    motion: Motion, pose: ArrayLike, u: ArrayLike, pose_cov: ArrayLike, *, sigmas: float = 3.0
) -> Linearity:
    """`linearity_index` of `step` by pose and noise, covariance blockdiag(pose_cov, Q(pose, u))."""
    with refusals_of("motion_linearity"):
        at = _vector("pose", pose, 3)
        control = _vector("u", u, len(motion.controls)).astype(at.dtype)
        require("pose_cov", pose_cov, covariance(3))
    noise = limit_loops(motion.noise_cov)(at, control)
    cov = jax.scipy.linalg.block_diag(jnp.asarray(pose_cov, at.dtype), noise)
    x = jnp.concatenate([at, jnp.zeros(noise.shape[0], at.dtype)])

    def heading_wrapped(y: jax.Array, y0: jax.Array) -> jax.Array:
        turn = 2 * np.pi
        off = y - y0
        return off.at[2].add(-turn * jnp.round(off[2] / turn))

    return linearity_index(
        lambda x: motion.step(x[:3], control, x[3:]),
        x,
        cov,
        sigmas=sigmas,
        residual=heading_wrapped,
    )


def sensor_linearity(
    sensor: Sensor,
    pose: ArrayLike,
    landmark: ArrayLike,
    cov: ArrayLike,
    *,
    sigmas: float = 3.0,
    with_noise: bool = False,
) -> Linearity:
    """`linearity_index` of `observe` by pose and landmark, covariance cov (3+L, 3+L).

    with_noise: whether departures are relative to the sensor's noise, too (R in the index).
    """
    with refusals_of("sensor_linearity"):
        at = _vector("pose", pose, 3)
        point = _vector("landmark", landmark, len(sensor.landmark))
    x = jnp.concatenate([at, point.astype(at.dtype)])
    noise = sensor.noise_cov(sensor.observe(x[:3], x[3:])) if with_noise else None
    return linearity_index(
        lambda x: sensor.observe(x[:3], x[3:]),
        x,
        cov,
        sigmas=sigmas,
        residual=sensor.residual,
        noise_cov=noise,
    )


def _vector(argument: str, value: ArrayLike, size: int | None = None) -> Float[Array, "n"]:
    """A value as a floating-point vector; raises InvalidField on another shape."""
    vector = jnp.asarray(value)
    if vector.ndim != 1 or size not in (None, vector.shape[0]):
        expected = "(n,)" if size is None else f"({size},)"
        raise InvalidField(argument, f"expected shape {expected}, got {vector.shape}")
    return vector.astype(jnp.result_type(vector, float))


def _index(bend: Float[Array, "m"], sigmas: float, reach2: Float[Array, "m"]) -> Float[Array, "m"]:
    """The index bend / (n_σ √reach²), with 0/0 = 0; inf if only reach is 0 or f is not finite."""
    defined = jnp.isfinite(bend) & jnp.isfinite(reach2)
    flat = defined & (reach2 == 0)
    bend, reach2 = jnp.where(defined, bend, 0.0), jnp.where(defined & ~flat, reach2, 1.0)
    ratio = jnp.where(flat & (bend > 0), jnp.inf, bend / (sigmas * jnp.sqrt(reach2)))
    return jnp.where(defined, jnp.where(flat & (bend == 0), 0.0, ratio), jnp.inf)
