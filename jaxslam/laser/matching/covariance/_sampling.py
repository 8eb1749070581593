"""Covariances of a match from its cost at many poses, or from further matches.

`Lattice` takes the likelihood over a lattice of poses (Olson 2009), `Unscented` and `Sampling`
match again from other starts and with other noise.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core._record import field, record, static
from jaxslam.core.validation import at_least, covariance, positive
from jaxslam.laser.matching._matcher import Matcher
from jaxslam.laser.matching._point_sets import Points, move_along_rays, prior_cost
from jaxslam.laser.matching.covariance._implicit import Implicit
from jaxslam.laser.matching.covariance._match_covariance import (
    MatchCovariance,
    MatchedScans,
    add_prior,
    change_ranges,
    curvature,
    inverse_of,
    range_count,
)
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math.angles import wrap


@record
class Lattice(MatchCovariance):
    """The covariance of p(x) ∝ exp(-E(x)/σ²) over a lattice of steps³ poses around the match.

    K = Σ p x xᵀ, u = Σ p x, and the covariance K - u uᵀ with Σ p = 1. The lattice is x̂ + L z, z in
    [-4, 4]³, L Lᵀ the inverse of ∂²E/∂x²/σ² and the window's information: as fine as the peak
    needs, and as wide as the window where nothing else bounds it. Residuals are evaluated at each
    pose: in a grid all that a shift changes counts, with the pairs of an ICP kept.

    Olson 2009, "Real-time correlative scan matching", ICRA, where the lattice is the search's.
    """

    sigma: ArrayLike
    """standard deviation of a residual [m]"""
    _: dataclasses.KW_ONLY
    window: Number = field(default=0.3, check=positive)
    """[m] standard deviation of x and y in a window, which acts as a further prior"""
    turn_window: Number = field(default=0.3, check=positive)
    """[rad] standard deviation of the heading in the window"""
    steps: int = static(default=13, check=at_least(3))
    """poses along each axis"""

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        axis = np.linspace(-4.0, 4.0, self.steps)  # 4 σ of the peak: exp(-8) is left out
        grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
        reference, points, match, *_ = scans
        prepared = matcher.prepare(reference)
        dtype = match.pose.dtype
        alone = match._replace(prior=None)
        windows = jnp.asarray([self.window, self.window, self.turn_window], dtype)
        bound = jnp.diag(windows**-2.0)
        variance = jnp.asarray(self.sigma, dtype) ** 2
        shape = curvature(matcher, prepared, points, match) / variance + bound
        peak = inverse_of(shape, add_prior(match, match.information) / variance + bound)
        root = linalg.cholesky(peak)[0]
        offset = jnp.asarray(grid, dtype) @ root.T

        def log_likelihood(shift: Array) -> Array:
            far = (shift * (bound @ shift)).sum()
            cost = prior_cost(match.prior, match.pose + shift)
            if match.prior is not None:
                # The scans count only along what they determine, prior and window along all.
                shift = match.determined @ shift
            cost = cost + matcher.cost(prepared, points, match.pose + shift, alone)
            return -cost / variance - 0.5 * far

        # 64 poses at once: all of them would need memory for steps³ scans.
        weight = jax.nn.softmax(jax.lax.map(log_likelihood, offset, batch_size=64))
        mean = weight @ offset
        apart = offset - mean[None]
        return (weight[:, None] * apart).T @ apart


@record
class Unscented(MatchCovariance):
    """The covariance of what six starts lead to, plus `Implicit` of the noise of the ranges.

    The starts are start ± √3 L_k, L Lᵀ = start_cov, with weights 1/6 each: Σ (x_k - x̂)(x_k - x̂)ᵀ/6.
    It includes wrong minima and directions that the scans do not determine, where a match stays as
    far off as it began. Brossard, Bonnabel & Barrau 2020, "A new approach to 3D ICP covariance
    estimation", IEEE Robotics and Automation Letters 5, which adds the bias of the sensor.
    """

    sigma: ArrayLike
    """standard deviation of a range [m]"""
    start_cov: ArrayLike = field(check=covariance(3))
    """(3, 3) covariance of the start"""

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, match, start, _ = scans
        root = linalg.root_psd(jnp.asarray(self.start_cov, start.dtype))
        # √n σ for n = 3: six points of equal weight have the covariance of the start.
        sides = jnp.sqrt(3.0).astype(start.dtype) * jnp.concatenate([root.T, -root.T])
        prepared = matcher.prepare(reference)
        ends = jax.vmap(lambda off: matcher.match(prepared, points, start + off, match.prior).pose)(
            sides
        )
        apart = _pose_differences(ends, match.pose)
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
    start_cov: ArrayLike = field(check=covariance(3))
    """(3, 3) covariance of the start"""
    samples: int = static(default=30, check=at_least(1))
    """number of matches"""

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, match, start, key = scans
        root = linalg.root_psd(jnp.asarray(self.start_cov, start.dtype))
        sigma = jnp.asarray(self.sigma, start.dtype)

        def match_with_noise(key: Array) -> Array:
            key_reference, key_scan, key_start, key_prior = jax.random.split(key, 4)
            dtype = start.dtype
            noisy = reference
            if isinstance(reference, Points):
                noise = jax.random.normal(key_reference, (range_count(reference),), dtype)
                noisy = change_ranges(reference, sigma * noise)
            scan = move_along_rays(
                points, sigma * jax.random.normal(key_scan, points.valid.shape, dtype)
            )
            begin = start + root @ jax.random.normal(key_start, (3,), dtype)
            prior = match.prior
            if prior is not None:
                # The root Wᵀ with WᵀW = (Λ + 1e-6 tr(Λ) I)⁻¹, which is finite if Λ is singular.
                floor = 1e-6 * jnp.trace(prior.information)
                floor = jnp.where(floor > 0, floor, 1.0) * jnp.eye(3, dtype=prior.information.dtype)
                information = linalg.symmetrize(prior.information) + floor
                drawn = (sigma * linalg.whitener(information)[0].T) @ jax.random.normal(
                    key_prior, (3,), dtype
                )
                prior = prior._replace(pose=prior.pose + drawn)
            return matcher.match(matcher.prepare(noisy), scan, begin, prior).pose

        ends = jax.vmap(match_with_noise)(jax.random.split(key, self.samples))
        apart = _pose_differences(ends, match.pose)
        return apart.T @ apart / self.samples


def _pose_differences(poses: Float[Array, "S 3"], middle: Float[Array, "3"]) -> Float[Array, "S 3"]:
    """The differences of poses from a pose, with angles in (-π, π]."""
    off = poses - middle[None]
    return off.at[:, 2].set(wrap(off[:, 2]))
