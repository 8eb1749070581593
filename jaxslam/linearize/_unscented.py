"""Statistical linearization by the unscented transform, in any chart."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.core._record import field, record
from jaxslam.core.protocols import LinearizationPoint, Linearizer, Motion, Sensor
from jaxslam.core.validation import in_range, or_none, positive
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number


class _Regression(NamedTuple):
    """The affine fit y ≈ mean + slope · ξ + rest, ξ ~ N(0, L Lᵀ), through sigma points."""

    mean: Array
    """(m,)"""
    slope: Array
    """(m, n) times L; that is, by the standard normals"""
    rest: Array
    """(m, m) covariance of y that no affine function of ξ has"""


@record
class Unscented(Linearizer):
    """The linearizer of the UKF: sigma points of the pose, or of pose and landmark, in the chart.

    With n variables and P = L Lᵀ, points at 0 and ±α√n L_j, weights 1/(2α²n) and, for the centre,
    1 - 1/α² for means and that + 3 - α² for covariances (UKF-M: Brossard, Barrau, Bonnabel, "A Code
    for Unscented Kalman Filtering on Manifolds", ICRA 2020). The slope of the fit replaces the
    Jacobian, and the residual covariance is added to the noise; so the correction by one
    measurement is that of a UKF on the whole map, in which only robot and landmark are perturbed,
    and P may be singular. A joint update assumes uncorrelated residuals of different measurements,
    which in a UKF of the whole scan they are not. The residual covariance is used here, as in
    UKF-M; the authors' own program for SLAM (JUKF) drops it. As there, the predicted pose and a
    new landmark are those of the centre. In the charts `right_invariant` and `left_invariant` this
    is their UKF on SE_{1+N}(2).

    Raises ValueError unless 0 < alpha <= 1.
    """

    alpha: Number | None = field(
        default=None, check=or_none(lambda alpha: in_range(0.0, 1.0)(positive(alpha)))
    )
    """spread of the sigma points; default 1e-3 in float64, as theirs, with which the UKF equals an
    EKF to rounding, and 0.1 in float32, because of rounding. 1 reaches √n σ."""
    iterates = False

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, tuple[()]]:
        pose, chart, width = point.pose, point.chart, len(motion.noises)
        moved = motion.step(pose, u, jnp.zeros(width, pose.dtype))
        root = _root(point.cov)
        root_noise = linalg.root_psd(motion.noise_cov(pose, u))

        def f(xi: Array) -> Array:
            start = chart.retract_pose(pose, xi[:3])
            return chart.local_pose(moved, motion.step(start, u, xi[3:]))

        # The noise of the motion is independent of the error of the pose.
        fit = self._fit(f, jax.scipy.linalg.block_diag(root, root_noise))
        by_pose = by_variables(fit.slope[:, :3], root)
        noise = linalg.matmul(fit.slope[:, 3:], fit.slope[:, 3:].T) + fit.rest
        if chart.basis is not None:
            # From errors in the chart to differences of coordinates, after and before the motion.
            basis = chart.pose_basis(moved)
            by_pose = basis @ by_pose @ linalg.inverse(chart.pose_basis(pose))
            noise = basis @ noise @ basis.T
        return moved, by_pose, noise, ()

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        pose, landmark, chart = point.pose, point.landmark, point.chart
        root = _root(point.cov)
        centre = sensor.observe(pose, landmark)
        is_known = len(point.cov) == 3  # P is that of the robot alone

        def h(xi: Array) -> Array:
            if is_known:
                seen_from, seen = chart.retract_pose(pose, xi), landmark
            else:
                seen_from, seen = chart.retract(pose, landmark, xi[:3], xi[3:])
            return sensor.residual(sensor.observe(seen_from, seen), centre)

        fit = self._fit(h, root)
        slope = by_variables(fit.slope, root)
        by_pose, by_landmark = slope[:, :3], slope[:, 3:]
        if is_known:
            by_landmark = jnp.zeros((len(centre), len(landmark)), centre.dtype)
        if chart.basis is not None and is_known:
            by_pose = by_pose @ linalg.inverse(chart.pose_basis(pose))
        elif chart.basis is not None:
            basis = chart.basis(pose, landmark)
            if basis.landmark is not None:
                by_landmark = by_landmark @ linalg.inverse(basis.landmark)
            # From errors to coordinates: dx = E_x⁻¹ δx and dl = E_l⁻¹ (δl - c dx).
            by_pose = (by_pose - by_landmark @ basis.cross) @ linalg.inverse(basis.pose)
        return centre + fit.mean, by_pose, by_landmark, fit.rest

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        pose, chart, size_z = point.pose, point.chart, z.shape[0]
        mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
        centre = sensor.invert(pose, z, mean)
        zero = jnp.zeros_like(centre)
        root = _root(point.cov)
        noise_roots = [linalg.root_psd(sensor.noise_cov(z)), linalg.root_psd(cov_s)]

        def g(xi: Array) -> Array:
            # Only the pose is perturbed; there is no landmark yet.
            start, _ = chart.retract(pose, zero, xi[:3], zero)
            landmark = sensor.invert(start, z + xi[3 : 3 + size_z], mean + xi[3 + size_z :])
            return chart.local(pose, centre, start, landmark)[1]

        fit = self._fit(g, jax.scipy.linalg.block_diag(root, *noise_roots))
        by_pose = by_variables(fit.slope[:, :3], root)
        cov = linalg.matmul(fit.slope[:, 3:], fit.slope[:, 3:].T) + fit.rest
        if chart.basis is not None:
            basis = chart.basis(pose, centre)
            if basis.landmark is not None:
                by_pose, cov = basis.landmark @ by_pose, basis.landmark @ cov @ basis.landmark.T
            # δl = c dx + E_l dl of the fitted dl, and dx = E_x⁻¹ δx.
            by_pose = (basis.cross + by_pose) @ linalg.inverse(basis.pose)
        return centre, by_pose, cov

    def _fit(self, f: Callable[[Array], Array], root: Array) -> _Regression:
        alpha: float | Array = 1e-3 if root.dtype == jnp.float64 else 0.1
        if self.alpha is not None:
            alpha = jnp.asarray(self.alpha, root.dtype)
        return regress(f, root, alpha)


def regress(f: Callable[[Array], Array], root: Array, alpha: float | Array) -> _Regression:
    """The unscented transform of f: (n,) -> (m,), f(0) = 0, over ξ ~ N(0, L Lᵀ), L = root (n, n).

    With o_j and e_j the odd and even parts of f at α√n L_j, the transform's sums come to
    mean = Σ e_j/(α²n), slope·L = (o_j/(α√n))_j and rest = Σ e_j e_jᵀ/(α²n) + (2 - α²) mean meanᵀ,
    without cancellation of large terms.
    """
    reach2 = alpha**2 * root.shape[0]
    points = jnp.sqrt(reach2) * root.T
    ahead, back = jax.vmap(f)(points), jax.vmap(f)(-points)
    odd, even = (ahead - back) / 2, (ahead + back) / 2
    mean = even.sum(axis=0) / reach2
    rest = linalg.gram(even, even) / reach2 + (2 - alpha**2) * mean[:, None] * mean[None, :]
    return _Regression(mean, odd.T / jnp.sqrt(reach2), rest)


def by_variables(slope: Array, root: Array) -> Array:
    """The Jacobian H with H L = slope (m, n), for a regular lower L (n, n)."""
    # H = slope L⁻¹ is (L⁻ᵀ slopeᵀ)ᵀ; Lᵀ is lower with its rows and columns reversed.
    return linalg.solve_lower(root.T[::-1, ::-1], slope.T[::-1])[::-1].T


def _root(cov: Array) -> Array:
    """A regular square root of P; zero variances are raised to about the square root of eps.

    Along such a direction the slope is then the derivative; a column of zeros would leave it
    undetermined.
    """
    root = linalg.cholesky(cov)[0]
    # √eps: variances of eps add nothing to P, and a quotient over √eps keeps half of the digits.
    floor = float(jnp.finfo(cov.dtype).eps) ** 0.5
    pivots = jnp.diagonal(root)
    return root + jnp.diag(jnp.where(pivots > floor, 0.0, floor))
