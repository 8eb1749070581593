"""Chi-square quantiles and bands, of the distributions of a consistent filter's NEES and NIS.

They are host numbers, from SciPy (which JAX itself depends on), because they become constants of a
table or a plot; from its special functions, because importing its distributions takes longer than
importing jaxslam. The quantile of a JAX array, as of the gate of a filter within a trace, is
computed by JAX.
"""

import math
from functools import partial
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jax import Array
from jax.scipy.special import erfc, ndtri
from jaxtyping import Float

from jaxslam.math._arrays import Number

__all__ = [
    "chi2_band",
    "chi2_quantile",
    "chi2_quantiles",
    "normal_quantile",
    "sigma_gate",
    "t_quantile",
    "truncated_chi2_mean",
]


_P = TypeVar("_P", bound=Number)


def chi2_quantile(p: _P, dof: float) -> _P:
    """The x with P(χ²_dof <= x) = p. Raises ValueError unless 0 < p < 1 and dof > 0.

    p may be a JAX array of any shape, traced or not, whose values are not checked: 1 counts as the
    number of its precision below 1 (which is 1 - 6e-8 in float32), a number outside 0 to 1 as 0.
    dof is then a whole number.
    """
    if isinstance(p, jax.Array):
        return cast(_P, _traced_quantile(p, dof))
    if not 0 < p < 1:
        raise ValueError(f"chi2_quantile: expected a probability between 0 and 1, got {p}")
    if not dof > 0:
        raise ValueError(f"chi2_quantile: expected dof above 0, got {dof}")
    return cast(_P, float(chi2_quantiles(p, np.asarray(dof))))


def chi2_quantiles(p: float, dof: np.ndarray) -> np.ndarray:
    """`chi2_quantile` for every dof of an array, unchecked."""
    return 2 * np.asarray(scipy.special.gammaincinv(dof / 2, p))


@partial(jax.jit, static_argnames="dof")
def _traced_quantile(p: Float[Array, "*B"], dof: int) -> Float[Array, "*B"]:
    """The quantile of a JAX array, by inverse functions where there are any."""
    valid = (p > 0) & (p <= 1)
    below_one = 1 - float(jnp.finfo(p.dtype).epsneg)
    # ½ in place of an invalid p, for finite derivatives; its quantile is not used.
    p = jnp.where(valid, jnp.minimum(p, below_one), 0.5)
    if dof == 1:
        # The square of a normal: half of 1 - p on either side.
        x = ndtri((1 - p) / 2) ** 2
    elif dof == 2:
        # P(χ²₂ <= x) = 1 - exp(-x/2).
        x = -2 * jnp.log1p(-p)
    else:
        x = 2 * _half_quantile(p, dof)
    return jnp.where(valid, x, 0.0)


def _half_quantile(p: Float[Array, "*B"], dof: int) -> Float[Array, "*B"]:
    """h = x/2 of the quantile x of 3 degrees of freedom or more, by Newton's method.

    Solved is log Q(h) = log(1 - p) of the survival function Q(h) = e⁻ʰ Σ hʲ/Γ(j+1), over
    j = dof/2 - 1, dof/2 - 2, … from 0 on; of an odd dof from 1/2 on, and plus erfc(√h). It starts
    from the approximation of Wilson and Hilferty (1931). The first term of the series of 1 - Q
    about 0 gives a lower bound of h.
    """
    a = dof / 2
    least = (p * math.gamma(a + 1)) ** (1 / a)
    cube_root = 1 - 2 / (9 * dof) + ndtri(p) * math.sqrt(2 / (9 * dof))
    h = a * cube_root**3
    for _ in range(_NEWTON_STEPS):
        # The last step alone gives the derivative by p.
        h = jax.lax.stop_gradient(jnp.maximum(h, least))
        terms = [h**j / math.gamma(j + 1) for j in np.arange(a - 1, -0.5, -1).tolist()]
        tail = sum(terms) + (jnp.exp(h) * erfc(jnp.sqrt(h)) if dof % 2 else 0.0)  # eʰ Q
        h = h + (jnp.log(tail) - h - jnp.log1p(-p)) * tail / terms[0]
    return h


_NEWTON_STEPS = 4
"""steps after which the quantile is exact to rounding for p from 1e-3 on"""


def sigma_gate(n_sigma: float, dof: int) -> float:
    """The probability within n σ, √(errorᵀ cov⁻¹ error) <= n, of a Gaussian of dof numbers: a gate.

    The guide gates at 3 σ, so at d² = 9: 0.9889 of 2 numbers, 0.9707 of 3 (Solà, Table 3; the text
    beside it is wrong, see the errata). Raises ValueError unless n_sigma > 0 and dof > 0.
    """
    if not n_sigma > 0:
        raise ValueError(f"sigma_gate: expected n_sigma above 0, got {n_sigma}")
    if not dof > 0:
        raise ValueError(f"sigma_gate: expected dof above 0, got {dof}")
    return float(scipy.special.gammainc(dof / 2, n_sigma**2 / 2))


def chi2_band(dof: float, runs: int, level: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the average of `runs` independent χ²_dof variables (Bar-Shalom 2001, 5.4).

    [χ²_{runs·dof}((1-level)/2), χ²_{runs·dof}((1+level)/2)]/runs; around dof.
    """
    if runs < 1:
        raise ValueError(f"chi2_band: expected at least one run, got {runs}")
    tail = (1 - level) / 2
    total = dof * runs
    return chi2_quantile(tail, total) / runs, chi2_quantile(1 - tail, total) / runs


def truncated_chi2_mean(share: float, dof: float) -> float:
    """The mean of χ²_dof below the gate that a share of it exceeds, over dof; 1 where none does.

    F_{dof+2}(g)/F_dof(g) with F_dof(g) = 1 - share: the mean NIS of a consistent filter whose gate
    has dropped that share. Raises ValueError unless 0 <= share < 1 and dof > 0.
    """
    if not 0 <= share < 1:
        raise ValueError(f"truncated_chi2_mean: expected a share in [0, 1), got {share}")
    if share == 0:
        return 1.0
    gate = chi2_quantile(1 - share, dof)
    return float(scipy.special.gammainc(dof / 2 + 1, gate / 2)) / (1 - share)


def t_quantile(p: float, dof: float) -> float:
    """Student's t quantile, for confidence intervals of a mean with estimated variance.

    dof > 0, not necessarily whole.
    """
    return float(scipy.special.stdtrit(dof, p))


def normal_quantile(p: float) -> float:
    """The x with P(N(0, 1) <= x) = p. Raises ValueError unless 0 < p < 1."""
    if not 0 < p < 1:
        raise ValueError(f"normal_quantile: expected a probability between 0 and 1, got {p}")
    return float(scipy.special.ndtri(p))
