"""Uncertain frames: the approximate transformations of Smith & Cheeseman.

R. C. Smith, P. Cheeseman, "On the representation and estimation of spatial uncertainty", IJRR 5(4),
1986; as Tacher §2 and Costa, Kantor & Choset 2004 use them. A frame is a Gaussian over a pose
(x, y, θ) in another; errors are differences of coordinates. Compounding and merging behave as
resistors in series and in parallel.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxslam.math import _gaussians as gaussians
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math._gaussians import log_det_of
from jaxslam.math.angles import wrap

__all__ = ["Frame", "bhattacharyya", "compound", "mahalanobis_squared", "merge", "reverse"]


class Frame(NamedTuple):
    """The pose of one frame in another: mean and covariance."""

    pose: Array
    """(3,)"""
    cov: Array
    """(3, 3)"""


def compound(a: Frame, b: Frame, cross: Array | None = None) -> Frame:
    """Frame b in the reference of a (series): x = x_a ∘ x_b, and with its Jacobians J_a, J_b

        P = J_a P_a J_aᵀ + J_b P_b J_bᵀ + J_a C J_bᵀ + (J_a C J_bᵀ)ᵀ

    cross: C = cov(a, b) (3, 3), zero by default. (To first order; not the sum of the two, as Tacher
    has it.)
    """
    for name, value in (("a.cov", a.cov), ("b.cov", b.cov), ("cross", cross)):
        if value is not None and jnp.shape(value) != (3, 3):
            raise ValueError(f"compound: expected {name} of shape (3, 3), got {jnp.shape(value)}")
    by_a, by_b = se2.compose_jacobians(a.pose, b.pose)
    cov = by_a @ a.cov @ by_a.T + by_b @ b.cov @ by_b.T
    if cross is not None:
        shared = by_a @ cross @ by_b.T
        cov = cov + shared + shared.T
    return Frame(se2.compose(a.pose, b.pose), linalg.symmetrize(cov))


def reverse(a: Frame) -> Frame:
    """The inverse of a: the reference frame of a, expressed in a."""
    (by_a,) = se2.inverse_jacobians(a.pose)
    return Frame(se2.inverse(a.pose), linalg.symmetrize(by_a @ a.cov @ by_a.T))


def merge(a: Frame, b: Frame) -> tuple[Frame, Array]:
    """Two independent estimates of one frame as one (parallel), and whether P_a + P_b is regular.

        K = P_a (P_a + P_b)⁻¹,  x = x_a + K (x_b ⊖ x_a),  P = (I - K) P_a (I - K)ᵀ + K P_b Kᵀ

    so P⁻¹ = P_a⁻¹ + P_b⁻¹ where these exist, and an uncertain estimate causes no cancellation.
    Where the sum is singular, a is returned.
    """
    solved, regular = linalg.solve_psd(a.cov + b.cov, a.cov)
    # ((P_a + P_b)⁻¹ P_a)ᵀ = P_a (P_a + P_b)⁻¹, both symmetric.
    gain = jnp.where(regular, solved.T, 0.0)
    pose = a.pose + gain @ _difference(b, a)
    pose = jnp.concatenate([pose[:2], wrap(pose[2:])])
    # Joseph's form: a sum of two positive semi-definite terms.
    left = jnp.eye(3, dtype=gain.dtype) - gain
    cov = left @ a.cov @ left.T + gain @ b.cov @ gain.T
    return Frame(pose, linalg.symmetrize(cov)), regular


def mahalanobis_squared(a: Frame, b: Frame) -> tuple[Array, Array]:
    """The distance δᵀ (P_a + P_b)⁻¹ δ, δ = x_a ⊖ x_b, of independent frames, and its validity."""
    return gaussians.mahalanobis_squared(_difference(a, b), a.cov + b.cov)


def bhattacharyya(a: Frame, b: Frame) -> tuple[Array, Array]:
    """The Bhattacharyya distance -log ∫√(p_a p_b), and whether both covariances are regular:

        D = ⅛ δᵀ P⁻¹ δ + ½ log(|P| / √(|P_a| |P_b|)),  P = (P_a + P_b)/2

    Unlike d², it grows also where one is much less certain than the other (Bhattacharyya 1943).
    """
    middle = 0.5 * (a.cov + b.cov)
    near, positive = gaussians.mahalanobis_squared(_difference(a, b), middle)
    log_dets = []
    for cov in (middle, a.cov, b.cov):
        factor, good = linalg.cholesky(cov)
        positive = positive & good
        log_dets.append(log_det_of(factor))
    spread = 0.5 * (log_dets[0] - 0.5 * (log_dets[1] + log_dets[2]))
    return jnp.where(positive, near / 8 + spread, 0.0), positive


def _difference(a: Frame, b: Frame) -> Array:
    delta = a.pose - b.pose
    return jnp.concatenate([delta[:2], wrap(delta[2:])])
