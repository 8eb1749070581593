"""The base of the information filters, their association by tags, and their gated innovations."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.charts import Euclidean
from jaxslam.core import slots
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import field, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Filter, Motion, Sensor
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField, at_least, or_none, positive, probability
from jaxslam.linearize._first_order import observe_jacobians, predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import gaussian_terms, is_inside, log_density, log_det_of_pivots
from jaxslam.sensors._suite import Suite, of_robot


@record
class InformationFilter(Filter):
    """Models and options of an information filter, whose error is in map coordinates.

    Raises ValueError on a capacity below 1, a gate that is no probability, a floor not above 0, a
    suite, or a sensor that has no landmarks or whose landmarks become points.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """the models; Jacobians come from `jax.jacfwd`, at the estimate"""
    capacity: int = static(check=at_least(1))
    """landmark slots N; a new landmark in a full map is `Status.OVERFLOW`"""
    _: dataclasses.KW_ONLY
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    floor: Number = field(default=1e-4, check=positive)
    """standard deviation [m, rad] added to a singular pose_cov, which has no inverse"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        sensor = self.sensor
        if isinstance(sensor, Suite):
            raise InvalidField("sensor", "expected one sensor, not a suite")
        if sensor.absolute:
            reason = f"expected a sensor of landmarks, got {sensor.name}"
            raise InvalidField("sensor", reason)
        if sensor.reduced is not None:
            reason = f"the landmarks of {sensor.name} are converted to points: not supported"
            raise InvalidField("sensor", reason)
        super().__post_init__()


class TagAssociation(NamedTuple):
    """The landmarks of the M measurements of a scan; measurements without a tag have none."""

    matched: Bool[Array, "M"]
    """the landmark is in the map"""
    new: Bool[Array, "M"]
    """the landmark is not in the map, or its tag occurs earlier in the scan"""
    repeated: Bool[Array, "M"]
    """the tag occurs earlier in the scan"""
    has_slot: Bool[Array, "M"]
    """the landmark has a slot, or a slot is free for a new landmark"""
    slot: Int[Array, "M"]
    """slot of the landmark; any number without a landmark"""


def associate_by_table(tag: Int[Array, "N"], alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association by a table of tags; new landmarks get the free slots, lowest first.

    A landmark of the map may be measured twice in a scan.
    """
    tagged = scan.valid & (scan.tag >= 0)
    slot, in_map = slots.find(tag, alive, scan.tag)
    matched, new = tagged & in_map, tagged & ~in_map
    repeated = new & slots.seen_before(scan.tag, new)
    free_slot, granted = slots.allocate(alive, new & ~repeated)
    slot = jnp.where(new, free_slot, slot)
    return TagAssociation(matched, new, repeated, matched | granted, slot)


def associate_by_index(alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association where a landmark's slot is its tag; measurements without a tag get slot N.

    Of several measurements of one landmark the first is used; the rest is `Status.REPEATED`.
    """
    capacity = alive.shape[0]
    tagged = scan.valid & (scan.tag >= 0)
    repeated = tagged & slots.seen_before(scan.tag, tagged)
    has_slot = tagged & ~repeated & (scan.tag < capacity)
    slot = jnp.where(has_slot, scan.tag, capacity).astype(jnp.int32)
    matched = has_slot & alive.at[slot].get(mode="fill", fill_value=False)
    return TagAssociation(matched, tagged & ~matched, repeated, has_slot, slot)


class CanonicalInnovations(NamedTuple):
    """Innovations of the M measurements (Z) of a scan, and their information."""

    whitened_jacobian: Float[Array, "MZ D"]
    """N⁻¹ H, R = N Nᵀ; zero where not fused"""
    whitened: Float[Array, "MZ"]
    """N⁻¹ ν; zero where not fused"""
    positive: Bool[Array, "M"]
    """S, R and Ω are positive definite"""
    inside: Bool[Array, "M"]
    """d² is within the gate"""
    innovation: Float[Array, "M Z"]
    """ν"""
    innovation_cov: Float[Array, "M Z Z"]
    """S of each measurement"""
    nis: Float[Array, "M"]
    """d² of a fused measurement given those before it in the scan, of another one by itself"""
    log_likelihood: Float[Array, "M"]
    """0 where not fused"""
    omega_positive: Bool[Array, ""]
    """Ω is positive definite"""


def innovations(
    filter: InformationFilter,
    omega: Float[Array, "D D"],
    pose: Float[Array, "R"],
    landmarks: Float[Array, "A L"],
    scan: Scan,
    index: Int[Array, "M"],
    matched: Bool[Array, "M"],
) -> CanonicalInnovations:
    """Gated innovations ν = z ⊖ ẑ, ẑ = h(x, l), and S = H Ω⁻¹ Hᵀ + R(ẑ); Ω is factored once.

    A measurement whose R or S is not positive definite has no effect and is `Status.SINGULAR`, as
    are all where Ω is not.

    Args:
        index: the landmark of each measurement, where matched.
    """
    sensor = of_robot(filter.sensor, filter.motion.state)
    m, size = scan.z.shape
    gamma = gate_quantile(filter.gate, size)
    z = jnp.where(scan.valid[:, None], scan.z, 0.0)
    landmark = landmarks[index]
    z_hat = jax.vmap(sensor.observe, (None, 0))(pose, landmark)
    by_pose, by_landmark = jax.vmap(partial(observe_jacobians, sensor, pose))(landmark)
    nu = jax.vmap(sensor.residual)(z, z_hat)
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, z, matched)
    jacobian = stack_jacobians(by_pose, by_landmark, index, landmarks.shape[0])

    # With Ω = L Lᵀ, H Ω⁻¹ Hᵀ = (L⁻¹ Hᵀ)ᵀ L⁻¹ Hᵀ, by measurements: axes (m, Z, m, Z).
    factor, omega_positive = linalg.cholesky(omega)
    half = linalg.solve_lower(factor, jacobian.T)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    joint_cov = (half.T @ half).reshape(m, size, m, size) + same * noise[:, :, None]
    # (m, Z, Z): index arrays on both sides of a slice put their axis first.
    s = joint_cov[jnp.arange(m), :, jnp.arange(m)]
    alone = jax.vmap(gaussian_terms)(nu, s)
    noise_factor, noise_positive = jax.vmap(linalg.cholesky)(noise)
    positive = alone.positive & noise_positive & omega_positive
    inside = is_inside(alone.distance, gamma)
    fused = matched & inside & positive

    fused_nu = jnp.where(fused[:, None], nu, 0.0)
    nis, log_likelihood = _densities_in_turn(fused_nu, joint_cov, fused)
    # N⁻¹ H and N⁻¹ ν, whose products add Hᵀ R⁻¹ H to Ω without an inverse of R.
    rows = jax.vmap(linalg.solve_lower)(noise_factor, jacobian.reshape(m, size, jacobian.shape[1]))
    return CanonicalInnovations(
        whitened_jacobian=jnp.where(fused[:, None, None], rows, 0.0).reshape(jacobian.shape),
        whitened=jax.vmap(linalg.solve_lower)(noise_factor, fused_nu).reshape(-1),
        positive=positive,
        inside=inside,
        innovation=nu,
        innovation_cov=s,
        nis=jnp.where(fused, nis, alone.distance),
        log_likelihood=jnp.where(fused, log_likelihood, 0.0),
        omega_positive=omega_positive,
    )


def stack_jacobians(
    by_pose: Float[Array, "M Z R"],
    by_landmark: Float[Array, "M Z L"],
    index: Int[Array, "M"],
    count: int,
) -> Float[Array, "MZ D"]:
    """The Jacobian H of M functions of pose and a landmark, index of `count`; D = R + count·L."""
    (m, rows, size), n = by_landmark.shape, by_pose.shape[2]
    columns = jnp.arange(count, dtype=index.dtype)
    at = (index[:, None] == columns[None, :]).astype(by_landmark.dtype)
    # Axes (measurement, row, landmark, parameter); the last two are the columns of the map.
    wide = jnp.einsum("mkl,ma->mkal", by_landmark, at).reshape(m, rows, count * size)
    return jnp.concatenate([by_pose, wide], axis=2).reshape(m * rows, n + count * size)


def _densities_in_turn(
    innovation: Float[Array, "M Z"],
    joint_cov: Float[Array, "M Z M Z"],
    fused: Bool[Array, "M"],
) -> tuple[Float[Array, "M"], Float[Array, "M"]]:
    """The distance d² and log-density of each fused innovation given those before it.

    With S = L Lᵀ of all fused measurements, L⁻¹ ν whitens each by those before it.
    """
    m, size = innovation.shape
    both = fused[:, None, None, None] & fused[None, None, :, None]
    eye = jnp.eye(m * size, dtype=innovation.dtype)
    # The identity where not fused, apart from all others: ν = 0 there adds neither d² nor log |S|.
    fused_cov = jnp.where(both, joint_cov, eye.reshape(joint_cov.shape))
    inverse_factor = linalg.whitener_by_rows(fused_cov.reshape(eye.shape))[0]
    distance = (inverse_factor @ innovation.reshape(-1)).reshape(m, size) ** 2
    # The pivots of L⁻¹ are one over those of L, so the sign turns.
    log_det = -log_det_of_pivots(jnp.diagonal(inverse_factor).reshape(m, size))
    nis = distance.sum(axis=1)
    return nis, log_density(nis, log_det, size)


def refuse_unless(
    solved: Bool[Array, ""], innovations: CanonicalInnovations
) -> CanonicalInnovations:
    """The innovations, all marked singular if the mean could not be solved for."""
    return innovations._replace(
        positive=innovations.positive & solved,
        log_likelihood=jnp.where(solved, innovations.log_likelihood, 0.0),
    )
