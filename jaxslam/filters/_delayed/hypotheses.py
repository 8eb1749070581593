"""Residuals of hypotheses against stored measurements, and their spread and distance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Sensor
from jaxslam.core.slots import Joint
from jaxslam.filters._delayed.delayed_filter import DelayedFilter, Distance
from jaxslam.filters._delayed.state import SIZE, DelayedState, TableLayout, covariance_blocks
from jaxslam.filters._delayed.triangulation import Triangulation
from jaxslam.math import uncertain_poses
from jaxslam.math._arrays import Number
from jaxslam.math._xla import materialize
from jaxslam.math.uncertain_poses import Frame

_DISTANCES = {
    "mahalanobis": uncertain_poses.mahalanobis_squared,
    "bhattacharyya": uncertain_poses.bhattacharyya,
}


class _PointResiduals(NamedTuple):
    """The residuals g(s, x) of p points x against q stored measurements s, and their moments."""

    value: Float[Array, "p q"]
    """g at the estimate; its true value is 0 for the same landmark [rad or m]"""
    variance: Float[Array, "p q"]
    """var(g), with the correlation of x and s"""
    by_point: Float[Array, "p q 2"]
    """∂g/∂x"""
    by_stored: Float[Array, "p q 3"]
    """∂g/∂s"""

    def squared_distance(self) -> Float[Array, "p q"]:
        """The squared distance g²/var(g), infinite where the variance is not positive."""
        positive = self.variance > 0
        ratio = self.value**2 / jnp.where(positive, self.variance, 1.0)
        return jnp.where(positive, ratio, jnp.inf)


def point_residuals(
    joint: Joint, triangulation: Triangulation, points: Int[Array, "p"], stored: Int[Array, "q"]
) -> _PointResiduals:
    """The residuals of p points against q stored measurements, by their slots.

    With the Jacobians G_x, G_s: var(g) = G_x P_xx G_xᵀ + G_s P_ss G_sᵀ + 2 G_x P_xs G_sᵀ.
    """
    residual = triangulation.residual
    of_pairs = jax.vmap(jax.vmap(residual, (0, None)), (None, 0))
    jacobians = jax.vmap(jax.vmap(jax.jacfwd(residual, argnums=(1, 0)), (0, None)), (None, 0))
    x, s = joint.landmarks[points, :2], joint.landmarks[stored]
    value, (by_point, by_stored) = of_pairs(s, x), jacobians(s, x)
    blocks = covariance_blocks(joint)
    rows = blocks[points][:, :2]  # (p, 2, S, 3)
    p_xx, p_xs = rows[jnp.arange(points.shape[0]), :, points, :2], rows[:, :, stored]
    # (q, 3, 3), the diagonal blocks.
    p_ss = blocks[stored, :, stored]
    variance = jnp.einsum("pqi,pij,pqj->pq", by_point, p_xx, by_point)
    variance = variance + jnp.einsum("pqi,qij,pqj->pq", by_stored, p_ss, by_stored)
    variance = variance + 2 * jnp.einsum("pqi,piqj,pqj->pq", by_point, p_xs, by_stored)
    return materialize(_PointResiduals(value, variance, by_point, by_stored))


class StoredNoise(NamedTuple):
    """The noise of q stored measurements, which P has with R(z), at their predictions.

    R(z) would trust a range that came out short too much (`predicted_noise`). A residual g of a
    point predicts ẑ = z ⊖ g/(∂q/∂z). The noise of a stored measurement is independent of robot,
    landmarks and other stored ones, so R(ẑ) in place of R(z) changes its own variance alone.
    """

    sensor: Sensor
    z: Float[Array, "q 1"]
    by_z: Float[Array, "q"]
    """∂q/∂z"""

    def variance(self, residual: Float[Array, "q"]) -> Float[Array, "q"]:
        """R(ẑ) in the units of q [rad² or m²], by the residuals of a point."""
        z_hat = jax.vmap(self.sensor.residual)(self.z, (residual / self.by_z)[:, None])
        cov: Array = jax.vmap(self.sensor.noise_cov)(z_hat)
        return self.by_z**2 * cov[:, 0, 0]

    def change(self, residual: Float[Array, "q"]) -> Float[Array, "q"]:
        """R(ẑ) - R(z)."""
        return self.variance(residual) - self.variance(jnp.zeros_like(residual))


def noise_of(filter: DelayedFilter, state: DelayedState, stored: Int[Array, "q"]) -> StoredNoise:
    """The noise of stored measurements, by their slots."""
    place = stored - filter.layout.first_stored
    return StoredNoise(filter.sensor_of_table, state.z[place], state.by_z[place])


class UncertainPoints(NamedTuple):
    """Gaussian positions (x, y) [m]."""

    mean: Float[Array, "*n 2"]
    cov: Float[Array, "*n 2 2"]


def relative_to_robot(joint: Joint, layout: TableLayout) -> UncertainPoints:
    """The positions of the hypotheses (C,) relative to the robot's position."""
    first, count = layout.landmarks, layout.hypotheses
    # (C, 2, S, 3) -> (C, 2, 2): of each hypothesis the (x, y) of its diagonal block.
    blocks = covariance_blocks(joint)[first : first + count][:, :2]
    blocks = blocks[jnp.arange(count), :, first + jnp.arange(count), :2]
    cross = joint.cov[:2, 3:].reshape(2, layout.slots, SIZE)[:, first : first + count, :2]
    cross = cross.transpose(1, 0, 2)
    # cov(x - t) = P_xx + P_tt - P_tx - P_xt: what robot and hypothesis share cancels.
    cov = blocks + joint.cov[None, :2, :2] - cross - cross.transpose(0, 2, 1)
    return UncertainPoints(joint.landmarks[layout.of_hypotheses, :2] - joint.pose[None, :2], cov)


def relative_spread(points: UncertainPoints) -> Float[Array, "*n"]:
    """The relative spread: √(largest eigenvalue of the covariance) over the distance from 0."""
    mean, cov = points
    middle = 0.5 * (cov[..., 0, 0] + cov[..., 1, 1])
    half = 0.5 * (cov[..., 0, 0] - cov[..., 1, 1])
    square = half**2 + cov[..., 0, 1] * cov[..., 1, 0]
    # The larger eigenvalue of a symmetric 2×2 matrix, in closed form.
    largest = middle + safe_root(square)
    length = (mean**2).sum(axis=-1)
    return safe_root(largest) / jnp.sqrt(jnp.where(length > 0, length, 1.0))


def closer_than(
    distance: Distance, limit: Number, points: UncertainPoints, others: UncertainPoints
) -> Bool[Array, "p q"]:
    """Mask of the pairs of p points and q other ones whose distance is below a limit.

    The distance is `mahalanobis_squared` (of independent points) or `bhattacharyya` of
    `uncertain_poses`; False where a covariance is singular.
    """
    measure = _DISTANCES[distance]

    def frame(point: UncertainPoints) -> Frame:
        # Points as frames with equal headings and heading variances, which add nothing.
        inert = jnp.pad(point.cov, [(0, 1), (0, 1)]).at[2, 2].set(1.0)
        return Frame(jnp.pad(point.mean, [(0, 1)]), inert)

    def is_close(a: UncertainPoints, b: UncertainPoints) -> Bool[Array, ""]:
        value, regular = measure(frame(a), frame(b))
        return regular & (value < limit)

    close: Array = jax.vmap(jax.vmap(is_close, (None, 0)), (0, None))(points, others)
    return materialize(close)


def safe_root(square: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The square root of x where x is positive, else 0, with a finite derivative."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
