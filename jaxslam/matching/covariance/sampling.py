"""Covariances by matching again: other starts, other noise."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.numbers import check_count, check_covariance, held_array
from jaxslam.core.record import record, set_field, static
from jaxslam.matching.covariance.implicit import Implicit
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    range_count,
    with_ranges,
)
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.points import Points, moved_along_rays
from jaxslam.math import linalg
from jaxslam.math.angles import wrap


@record
class Unscented(MatchCovariance):
    """The covariance of what six starts lead to, plus `Implicit` of the noise of the ranges.

    The starts are start ± √3 L_k, L Lᵀ = start_cov, with weights 1/6 each: Σ (x_k - x̂)(x_k - x̂)ᵀ/6.
    It sees wrong minima and directions that the scans do not determine, where a match stays as far
    off as it began. Brossard, Bonnabel & Barrau 2020, "A new approach to 3D ICP covariance
    estimation", IEEE Robotics and Automation Letters 5, which adds the bias of the sensor.
    """

    sigma: ArrayLike
    """standard deviation of a range [m]"""
    start_cov: ArrayLike
    """(3, 3) covariance of the start"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _hold_start_cov(self)

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, start, _ = scans
        root = linalg.root_psd(jnp.asarray(self.start_cov, start.dtype))
        sides = jnp.sqrt(3.0).astype(start.dtype) * jnp.concatenate([root.T, -root.T])
        prepared = matcher.prepare(reference)
        ends = jax.vmap(lambda off: matcher.match(prepared, points, start + off, found.prior).pose)(
            sides
        )
        apart = _apart(ends, found.pose)
        return apart.T @ apart / 6 + Implicit(self.sigma).of(matcher, scans)


@record
class Sampling(MatchCovariance):
    """The second moment about the match of matches with noise added, from starts that are drawn.

    Noise N(0, σ²) is added to the ranges of both scans (of a grid: to those of the scan),
    N(0, start_cov) to the start, and N(0, σ² Λ⁻¹) to the pose of a prior. The scans have noise
    already, so partners lie a little farther apart than in the truth.
    """

    sigma: ArrayLike
    """standard deviation of a range [m]"""
    start_cov: ArrayLike
    """(3, 3) covariance of the start"""
    samples: int = static(default=30)
    """number of matches"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _hold_start_cov(self)
        check_count("Sampling: samples", self.samples)

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, start, key = scans
        root = linalg.root_psd(jnp.asarray(self.start_cov, start.dtype))
        sigma = jnp.asarray(self.sigma, start.dtype)

        def one(key: Array) -> Array:
            key_reference, key_scan, key_start, key_prior = jax.random.split(key, 4)
            dtype = start.dtype
            other = reference
            if isinstance(reference, Points):
                noise = jax.random.normal(key_reference, (range_count(reference),), dtype)
                other = with_ranges(reference, sigma * noise)
            scan = moved_along_rays(
                points, sigma * jax.random.normal(key_scan, points.valid.shape, dtype)
            )
            begin = start + root @ jax.random.normal(key_start, (3,), dtype)
            prior = found.prior
            if prior is not None:
                spread = sigma * _inverse_root(prior.information)
                drawn = spread @ jax.random.normal(key_prior, (3,), dtype)
                prior = prior._replace(pose=prior.pose + drawn)
            return matcher.match(matcher.prepare(other), scan, begin, prior).pose

        ends = jax.vmap(one)(jax.random.split(key, self.samples))
        apart = _apart(ends, found.pose)
        return apart.T @ apart / self.samples


def _hold_start_cov(of: Unscented | Sampling) -> None:
    check_covariance(type(of).__name__, of.start_cov, 3)
    set_field(of, "start_cov", held_array(of.start_cov))


def _inverse_root(information: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The root Wᵀ with WᵀW = Λ⁻¹; of a share 1e-6 of the trace along what Λ does not determine."""
    floor = 1e-6 * jnp.trace(information)
    floor = jnp.where(floor > 0, floor, 1.0) * jnp.eye(3, dtype=information.dtype)
    return linalg.whitener(linalg.symmetrize(information) + floor)[0].T


def _apart(poses: Float[Array, "S 3"], middle: Float[Array, "3"]) -> Float[Array, "S 3"]:
    off = poses - middle[None]
    return off.at[:, 2].set(wrap(off[:, 2]))
