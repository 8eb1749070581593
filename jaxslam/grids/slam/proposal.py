"""The pose of a particle given motion and scan: drawn among weighted candidates near a match."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.math import linalg
from jaxslam.protocols import Motion

LogDensity = Callable[[Array], Array]
"""(n (W,)) -> () log-density, up to what does not depend on n"""


def climbed(target: LogDensity, start: Float[Array, "W"], iterations: int) -> Float[Array, "W"]:
    """The place of a local maximum of a function of W numbers, by pattern search.

    Steps of ±s along each axis, the best of which is taken; s, at first 1, is halved where none is
    better (Hooke & Jeeves 1961). So no derivative is needed: a likelihood in a grid has many kinks.
    """
    unit = jnp.eye(start.shape[0], dtype=start.dtype)
    axes = jnp.concatenate([unit, -unit])

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        at, value, length = state
        tried = at[None] + length * axes
        values = jax.vmap(target)(tried)
        best = jnp.argmax(values)
        better = values[best] > value
        return (
            jnp.where(better, tried[best], at),
            jnp.where(better, values[best], value),
            jnp.where(better, length, 0.5 * length),
        )

    begin = start, target(start), jnp.ones((), start.dtype)
    found: tuple[Array, ...] = jax.lax.fori_loop(0, iterations, step, begin)
    return found[0]


def propose(
    fit: Callable[[Array], Array],
    motion: Motion,
    pose: Float[Array, "3"],
    control: Float[Array, "U"],
    key: Array,
    *,
    candidates: int,
    iterations: int,
    spread: tuple[float, float],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """A draw of p(x' | x, u, z), nearly, and the logarithm of its weight, nearly p(z | x, u).

    In the noise of the motion, x' = f(x, u, Q^½ n) with n ~ N(0, I), so that a motion of fewer than
    three noises has a density, too. n̂ is the `climbed` maximum of N(n; 0, I) p(z | x'). Of K
    candidates half are from N(0, I) and half from N(n̂, D), D = diag(1/(1 + |∂(x, y)/∂n_i|²/σ² +
    (∂θ/∂n_i)²/τ²)): a likelihood of widths σ and τ times the motion. One is drawn by

        w_k = p(z | x'_k) N(n_k; 0, I) / (½ N(n_k; 0, I) + ½ N(n_k; n̂, D))

    and the weight is the mean of w_k, whose expectation is p(z | x, u) exactly, however bad n̂ and D
    are: w_k is at most 2 p(z | x'_k).

    Grisetti, Stachniss & Burgard 2007, "Improved techniques for grid mapping with Rao-Blackwellized
    particle filters", IEEE T-RO 23(1), section III, draw from a Gaussian with the moments of the
    candidates instead.

    Args:
        fit: (pose) -> log p(z | pose).
        candidates: K, even. spread: σ [m] and τ [rad].
    """
    size = len(motion.noises)
    root = linalg.root_psd(motion.noise_cov(pose, control))

    def moved(n: Array) -> Array:
        return motion.step(pose, control, root @ n)

    def target(n: Array) -> Array:
        return fit(moved(n)) - 0.5 * (n * n).sum()

    mode = climbed(target, jnp.zeros(size, pose.dtype), iterations)
    slope = jax.jacfwd(moved)(mode)
    precision = 1 + (slope[0] ** 2 + slope[1] ** 2) / spread[0] ** 2 + (slope[2] / spread[1]) ** 2
    key_draw, key_choose = jax.random.split(key)
    normal = jax.random.normal(key_draw, (candidates, size), mode.dtype)
    local = jnp.arange(candidates) >= candidates // 2
    n = jnp.where(local[:, None], mode[None] + normal / jnp.sqrt(precision)[None], normal)
    off = n - mode[None]
    log_prior = -0.5 * (n * n).sum(axis=1)
    log_local = -0.5 * (off * off * precision[None]).sum(axis=1) + 0.5 * jnp.log(precision).sum()
    log_mixture = jnp.logaddexp(log_prior, log_local) - math.log(2.0)
    ratio = jax.vmap(target)(n) - log_mixture
    ratio = jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf)
    chosen = jax.random.categorical(key_choose, ratio)
    weight = jax.scipy.special.logsumexp(ratio) - math.log(candidates)
    return moved(n[chosen]), weight
