"""Covariances by matching again: other starts, other noise."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.numbers import check_count, check_covariance, check_positive
from jaxslam.matching.covariance.implicit import implicit
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    range_count,
    stated,
    with_ranges,
)
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.points import Points, moved_along_rays
from jaxslam.math import linalg
from jaxslam.math.angles import wrap


def unscented(sigma: ArrayLike, start_cov: ArrayLike) -> MatchCovariance:
    """The covariance of what six starts lead to, plus `implicit` of the noise of the ranges.

    The starts are start ± √3 L_k, L Lᵀ = start_cov, with weights 1/6 each: Σ (x_k - x̂)(x_k - x̂)ᵀ/6.
    It sees wrong minima and directions that the scans do not determine, where a match stays as far
    off as it began. Brossard, Bonnabel & Barrau 2020, "A new approach to 3D ICP covariance
    estimation", IEEE Robotics and Automation Letters 5, which adds the bias of the sensor.

    Args:
        sigma: standard deviation of a range [m].
        start_cov: (3, 3) covariance of the start.
    """
    check_covariance("unscented", start_cov, 3)
    of_noise = implicit(sigma)

    def of(matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, start, _ = scans
        root = linalg.root_psd(jnp.asarray(start_cov, start.dtype))
        sides = jnp.sqrt(3.0).astype(start.dtype) * jnp.concatenate([root.T, -root.T])
        prepared = matcher.prepare(reference)
        ends = jax.vmap(lambda off: matcher.match(prepared, points, start + off, found.prior).pose)(
            sides
        )
        apart = _apart(ends, found.pose)
        return apart.T @ apart / 6 + of_noise.of(matcher, scans)

    return stated("unscented", of, sigma)


def sampling(sigma: ArrayLike, start_cov: ArrayLike, samples: int = 30) -> MatchCovariance:
    """The second moment about the match of matches with noise added, from starts that are drawn.

    Noise N(0, σ²) is added to the ranges of both scans (of a grid: to those of the scan),
    N(0, start_cov) to the start, and N(0, σ² Λ⁻¹) to the pose of a prior. The scans have noise
    already, so partners lie a little farther apart than in the truth.

    Args:
        sigma: standard deviation of a range [m].
        start_cov: (3, 3) covariance of the start.
        samples: number of matches.
    """
    check_positive("sampling", sigma=sigma)
    check_covariance("sampling", start_cov, 3)
    check_count("sampling: samples", samples)

    def of(matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, start, key = scans
        root = linalg.root_psd(jnp.asarray(start_cov, start.dtype))

        def one(key: Array) -> Array:
            key_reference, key_scan, key_start, key_prior = jax.random.split(key, 4)
            dtype = start.dtype
            other = reference
            if isinstance(reference, Points):
                noise = jax.random.normal(key_reference, (range_count(reference),), dtype)
                other = with_ranges(reference, jnp.asarray(sigma) * noise)
            scan = moved_along_rays(
                points, jnp.asarray(sigma) * jax.random.normal(key_scan, points.valid.shape, dtype)
            )
            begin = start + root @ jax.random.normal(key_start, (3,), dtype)
            prior = found.prior
            if prior is not None:
                spread = jnp.asarray(sigma) * _inverse_root(prior.information)
                drawn = spread @ jax.random.normal(key_prior, (3,), dtype)
                prior = prior._replace(pose=prior.pose + drawn)
            return matcher.match(matcher.prepare(other), scan, begin, prior).pose

        ends = jax.vmap(one)(jax.random.split(key, samples))
        apart = _apart(ends, found.pose)
        return apart.T @ apart / samples

    return stated("sampling", of, sigma)


def _inverse_root(information: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The root Wᵀ with WᵀW = Λ⁻¹; of a share 1e-6 of the trace along what Λ does not determine."""
    floor = 1e-6 * jnp.trace(information)
    floor = jnp.where(floor > 0, floor, 1.0) * jnp.eye(3, dtype=information.dtype)
    return linalg.whitener(linalg.symmetrize(information) + floor)[0].T


def _apart(poses: Float[Array, "S 3"], middle: Float[Array, "3"]) -> Float[Array, "S 3"]:
    off = poses - middle[None]
    return off.at[:, 2].set(wrap(off[:, 2]))
