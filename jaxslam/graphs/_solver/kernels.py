"""Robust kernels: the cost of a measurement, by its squared residual s = eᵀ Ω e."""

import jax
import jax.numpy as jnp

from jaxslam.core._record import check_field, record
from jaxslam.core.protocols import Component
from jaxslam.core.validation import positive
from jaxslam.math._arrays import Number

Array = jax.Array


class Kernel(Component):
    """A robust cost ρ(s) of a squared residual s, with ρ(s) ≈ s at zero.

    A subclass is a record (`core.record`) that defines `cost` and `weight`, both elementwise.
    """

    def __post_init__(self) -> None:
        self._check(Kernel, {"cost": "s", "weight": "s"})

    def cost(self, s: Array) -> Array:
        """ρ(s), which replaces s in χ²."""
        raise NotImplementedError

    def weight(self, s: Array) -> Array:
        """ρ'(s), the factor of the information in a Gauss-Newton step."""
        raise NotImplementedError


class _OfWidth(Kernel):
    """The base of kernels of one number. Raises ValueError on a width not above 0."""

    width: Number

    def __post_init__(self) -> None:
        super().__post_init__()
        check_field(self, "width", positive)

    def _widths(self, s: Array) -> tuple[Array, Array]:
        """The width and its square, in the dtype of s."""
        return jnp.asarray(self.width, s.dtype), jnp.asarray(self.width**2, s.dtype)


@record
class Huber(_OfWidth):
    """Huber's kernel: s below k², else 2k√s - k² (Huber 1964; k = 1.345 keeps 95 % efficiency for
    one Gaussian residual)."""

    width: Number = 1.345
    """k"""

    def cost(self, s: Array) -> Array:
        width, square = self._widths(s)
        near = s <= square
        # k² in place of a small s, where the root is not used: it has no finite derivative at zero.
        root = jnp.sqrt(jnp.where(near, square, s))
        return jnp.where(near, s, 2 * width * root - square)

    def weight(self, s: Array) -> Array:
        width, square = self._widths(s)
        near = s <= square
        # ρ' = k/√s beyond k²; 1 in place of a small s, as in `cost`.
        return jnp.where(near, 1.0, width / jnp.sqrt(jnp.where(near, 1.0, s)))


@record
class Cauchy(_OfWidth):
    """Cauchy's kernel: k² log(1 + s/k²) (k = 2.385: 95 % efficiency for one Gaussian residual)."""

    width: Number = 2.385
    """k"""

    def cost(self, s: Array) -> Array:
        _, square = self._widths(s)
        return square * jnp.log1p(s / square)

    def weight(self, s: Array) -> Array:
        _, square = self._widths(s)
        return 1.0 / (1.0 + s / square)


@record
class DynamicCovarianceScaling(_OfWidth):
    """Dynamic covariance scaling: s below Φ, else Φ (3s - Φ)/(s + Φ), which tends to 3Φ.

    Agarwal et al. 2013, "Robust map optimization using dynamic covariance scaling", ICRA: the
    information is multiplied by c², c = min(1, 2Φ/(Φ + s)); ρ is the integral of c² (s).
    """

    name = "dcs"
    width: Number = 1.0
    """Φ, of s itself"""

    def cost(self, s: Array) -> Array:
        width, _ = self._widths(s)
        return jnp.where(s <= width, s, width * (3 * s - width) / (s + width))

    def weight(self, s: Array) -> Array:
        width, _ = self._widths(s)
        return jnp.minimum(1.0, 2 * width / (width + s)) ** 2


@record
class Truncated(_OfWidth):
    """Truncated least squares: min(s, c²), so that a measurement is kept or costs c².

    c² should be a quantile of χ² with as many degrees of freedom as residuals: c = 3.37 is for
    99 % and three. `optimize` finds its minimum by graduated non-convexity (`gnc`).
    """

    width: Number = 3.37
    """c"""

    def cost(self, s: Array) -> Array:
        _, square = self._widths(s)
        return jnp.minimum(s, square)

    def weight(self, s: Array) -> Array:
        _, square = self._widths(s)
        return (s <= square).astype(s.dtype)

    def ratio(self, s: Array) -> Array:
        """s/c², above 1 for rejected measurements."""
        _, square = self._widths(s)
        return s / square


REGISTRY: dict[str, type[Huber | Cauchy | DynamicCovarianceScaling | Truncated]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "dcs": DynamicCovarianceScaling,
    "truncated": Truncated,
}
"""The kernels by name."""
