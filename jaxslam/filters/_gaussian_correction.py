"""The correction of a Gaussian with a dense covariance, by one function of ν, H and R."""

from typing import NamedTuple

from jaxtyping import Array, Float

from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import GaussianTerms, gaussian_terms


class GaussianCorrection(NamedTuple):
    """The Kalman correction of x ~ N(x̂, P) by a measurement with innovation ν."""

    xi: Float[Array, "D"]
    """K ν, to add to the mean"""
    cov: Float[Array, "D D"]
    terms: GaussianTerms
    """distance, factor and density of N(ν; 0, S)"""


def correct_gaussian(
    nu: Float[Array, "K"],
    h: Float[Array, "K D"],
    cov: Float[Array, "D D"],
    noise: Float[Array, "K K"],
    *,
    joseph: bool = False,
) -> GaussianCorrection:
    """The correction of a covariance P (D, D) by an innovation ν, its Jacobian H and noise R.

        S = H P Hᵀ + R = L Lᵀ    V = L⁻¹ H P    K ν = Vᵀ L⁻¹ ν    P - K S Kᵀ = P - Vᵀ V

    joseph: (I - KH) P (I - KH)ᵀ + K R Kᵀ for the covariance. A direction of ν in which S is
    singular has no effect.
    """
    hp = linalg.matmul(h, cov)
    s = linalg.symmetrize(linalg.matmul(hp, h.T) + noise)
    terms = gaussian_terms(nu, s)
    v = linalg.solve_lower(terms.factor, hp)
    xi = linalg.matmul(terms.whitened[None], v)[0]
    if not joseph:
        return GaussianCorrection(xi, cov - linalg.gram(v, v), terms)
    # K = P Hᵀ S⁻¹ = Vᵀ L⁻¹, so Lᵀ Kᵀ = V: backward substitution, by the flipped system.
    gain = linalg.solve_lower(terms.factor[::-1, ::-1].T, v[::-1])[::-1].T
    left = cov - gain @ hp
    # (I - KH) P Hᵀ, with H P Hᵀ = S - R.
    left_h = hp.T - gain @ (s - noise)
    cov = linalg.symmetrize(left - left_h @ gain.T + gain @ noise @ gain.T)
    return GaussianCorrection(xi, cov, terms)
