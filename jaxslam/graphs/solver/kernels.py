"""Robust kernels: what a measurement costs, by its squared residual s = eᵀ Ω e."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxslam.core.numbers import check_positive
from jaxslam.core.record import record, static

Array = jax.Array


@record
class Kernel:
    """A robust cost ρ(s) of a squared residual s, with ρ(s) ≈ s at zero; both elementwise."""

    name: str = static()
    cost: Callable[[Array], Array] = static()
    """ρ(s), what stands in χ² in place of s"""
    weight: Callable[[Array], Array] = static()
    """ρ'(s), what multiplies the information in a Gauss-Newton step"""
    limit: float | None = static(default=None)
    """of a truncated kernel, c: `optimize` reaches it by graduated non-convexity (`gnc`)"""


def huber(limit: float = 1.345) -> Kernel:
    """Huber's kernel: s below k², else 2k√s - k² (Huber 1964; k = 1.345 keeps 95 % efficiency for
    one Gaussian residual)."""
    check_positive("graphs.huber", limit=limit)

    def cost(s: Array) -> Array:
        near = s <= limit**2
        root = jnp.sqrt(jnp.where(near, limit**2, s))
        return jnp.where(near, s, 2 * limit * root - limit**2)

    def weight(s: Array) -> Array:
        near = s <= limit**2
        return jnp.where(near, 1.0, limit / jnp.sqrt(jnp.where(near, 1.0, s)))

    return Kernel("huber", cost, weight)


def cauchy(limit: float = 2.385) -> Kernel:
    """Cauchy's kernel: k² log(1 + s/k²) (k = 2.385: 95 % efficiency for one Gaussian residual)."""
    check_positive("graphs.cauchy", limit=limit)
    return Kernel(
        "cauchy",
        lambda s: limit**2 * jnp.log1p(s / limit**2),
        lambda s: 1.0 / (1.0 + s / limit**2),
    )


def dcs(limit: float = 1.0) -> Kernel:
    """Dynamic covariance scaling: s below Φ, else Φ (3s - Φ)/(s + Φ), which tends to 3Φ.

    Agarwal et al. 2013, "Robust map optimization using dynamic covariance scaling", ICRA: the
    information is multiplied by c², c = min(1, 2Φ/(Φ + s)); ρ is the integral of c² (s).
    """
    check_positive("graphs.dcs", limit=limit)

    def cost(s: Array) -> Array:
        return jnp.where(s <= limit, s, limit * (3 * s - limit) / (s + limit))

    def weight(s: Array) -> Array:
        return jnp.minimum(1.0, 2 * limit / (limit + s)) ** 2

    return Kernel("dcs", cost, weight)


def truncated(limit: float = 3.37) -> Kernel:
    """Truncated least squares: min(s, c²), so that a measurement is kept or costs c².

    c² should be a quantile of χ² with as many degrees of freedom as residuals: c = 3.37 is that of
    99 % for three. `optimize` finds its minimum by graduated non-convexity.
    """
    check_positive("graphs.truncated", limit=limit)
    return Kernel(
        "truncated",
        lambda s: jnp.minimum(s, limit**2),
        lambda s: jnp.where(s <= limit**2, 1.0, 0.0),
        limit,
    )


REGISTRY = {"huber": huber, "cauchy": cauchy, "dcs": dcs, "truncated": truncated}
"""Factories of kernels by name."""
