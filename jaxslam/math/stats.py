"""Chi-square quantiles and bands, of the distributions of a consistent filter's NEES and NIS.

They are host numbers, from SciPy (which JAX itself depends on), because they become constants of a
gate, a table or a plot; from its special functions, because importing its distributions takes
longer than importing jaxslam.
"""

import numpy as np
import scipy  # its parts load where they are used

__all__ = [
    "chi2_band",
    "chi2_quantile",
    "chi2_quantiles",
    "normal_quantile",
    "sigma_gate",
    "t_quantile",
    "truncated_chi2_mean",
]


def chi2_quantile(p: float, dof: float) -> float:
    """The x with P(χ²_dof <= x) = p. Raises ValueError unless 0 < p < 1 and dof > 0."""
    if not 0 < p < 1:
        raise ValueError(f"chi2_quantile: expected a probability between 0 and 1, got {p}")
    if not dof > 0:
        raise ValueError(f"chi2_quantile: expected dof above 0, got {dof}")
    return float(chi2_quantiles(p, np.asarray(dof)))


def chi2_quantiles(p: float, dof: np.ndarray) -> np.ndarray:
    """`chi2_quantile` for every dof of an array, unchecked."""
    return 2 * np.asarray(scipy.special.gammaincinv(dof / 2, p))


def sigma_gate(n_sigma: float) -> float:
    """The squared Mahalanobis distance n² of an n-σ gate; the guide gates at 3 σ, so at 9.

    Which probability that holds depends on the dimension: 3 σ hold 98.89 % in 2-D, 97.07 % in 3-D
    (Solà, Table 3; the text beside it is wrong, see the errata). For a gate by probability use
    `chi2_quantile(0.99, dof)`.
    """
    if not n_sigma > 0:
        raise ValueError(f"sigma_gate: expected n_sigma above 0, got {n_sigma}")
    return float(n_sigma) ** 2


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
