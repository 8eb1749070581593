"""Innovations of the information filters, after association by tags and the gate.

With what these filters share: their models and options, checked where a filter is made.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core import slots
from jaxslam.core._numbers import check_count, check_gate, check_positive, gate_quantile
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Filter, Motion, Sensor
from jaxslam.core.types import Scan
from jaxslam.linearize._first_order import observe_jacobians, predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import gaussian_terms, log_density, log_det_of_pivots
from jaxslam.sensors._suite import Suite


@record
class InformationFilter(Filter):
    """Models and options of an information filter, whose error is in map coordinates.

    Raises ValueError on a capacity below 1, a gate that is no probability, a floor not above 0, a
    suite, or a sensor that has no landmarks or whose landmarks become points.
    """

    motion: Motion
    sensor: Sensor
    """the models; Jacobians come from `jax.jacfwd`, at the estimate"""
    capacity: int = static()
    """landmark slots N; a new landmark in a full map is `Status.OVERFLOW`"""
    _: dataclasses.KW_ONLY
    gate: Number | None = None
    """as for `EkfSlam`"""
    floor: Number = 1e-4
    """standard deviation [m, rad] added to a singular pose_cov, which has no inverse"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        name, sensor = type(self).__name__, self.sensor
        validation.check_models(name, self.motion, sensor)
        check_count(f"{name}: capacity", self.capacity)
        check_gate(name, self.gate)
        check_positive(name, floor=self.floor)
        if isinstance(sensor, Suite):
            raise ValueError(f"{name}: expected one sensor, not a suite")
        if len(sensor.landmark) == 0:
            raise ValueError(f"{name}: expected a sensor of landmarks, got {sensor.name}")
        if sensor.reduced is not None:
            raise ValueError(
                f"{name}: the landmarks of {sensor.name} are converted to points, which is not "
                "supported"
            )
        super().__post_init__()


class TagAssociation(NamedTuple):
    """The landmarks of the M measurements of a scan; measurements without a tag have none."""

    known: Bool[Array, "M"]
    """the landmark is in the map"""
    new: Bool[Array, "M"]
    """it is not, or its tag occurs earlier in the scan"""
    repeated: Bool[Array, "M"]
    """its tag occurs earlier in the scan"""
    has_slot: Bool[Array, "M"]
    """the landmark has a slot, or a slot is free for a new landmark"""
    slot: Int[Array, "M"]
    """this slot; any number without a landmark"""


def associate_by_table(tag: Int[Array, "N"], alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association by a table of tags; new landmarks get the free slots, lowest first.

    A known landmark may be measured twice in a scan.
    """
    tagged = scan.valid & (scan.tag >= 0)
    found_slot, found = slots.find(tag, alive, scan.tag)
    known, new = tagged & found, tagged & ~found
    repeated = new & slots.seen_before(scan.tag, new)
    free_slot, free = slots.allocate(alive, new & ~repeated)
    slot = jnp.where(new, free_slot, found_slot)
    return TagAssociation(known, new, repeated, known | free, slot)


def associate_by_index(alive: Bool[Array, "N"], scan: Scan) -> TagAssociation:
    """Association where a landmark's slot is its tag; measurements without a tag get slot N.

    Of several measurements of one landmark the first is used, the others are REPEATED.
    """
    capacity = alive.shape[0]
    tagged = scan.valid & (scan.tag >= 0)
    repeated = tagged & slots.seen_before(scan.tag, tagged)
    has_slot = tagged & ~repeated & (scan.tag < capacity)
    slot = jnp.where(has_slot, scan.tag, capacity).astype(jnp.int32)
    known = has_slot & alive.at[slot].get(mode="fill", fill_value=False)
    return TagAssociation(known, tagged & ~known, repeated, has_slot, slot)


class CanonicalInnovations(NamedTuple):
    """Innovations of the M measurements (Z) of a scan, and their information."""

    whitened_jacobian: Float[Array, "MZ D"]
    """N⁻¹ H, R = N Nᵀ; zero where not fused"""
    whitened: Float[Array, "MZ"]
    """N⁻¹ ν of the same"""
    compared: Bool[Array, "M"]
    """of a landmark of the map, and compared with it"""
    positive: Bool[Array, "M"]
    """S, R and Ω are positive definite"""
    inside: Bool[Array, "M"]
    """within the gate"""
    innovation: Float[Array, "M Z"]
    """ν"""
    innovation_cov: Float[Array, "M Z Z"]
    """S of each measurement"""
    nis: Float[Array, "M"]
    """of fused measurements given the earlier ones, of the others without them"""
    log_likelihood: Float[Array, "M"]
    """0 where not fused"""
    omega_positive: Bool[Array, ""]
    """Ω is positive definite"""


def innovations(
    settings: InformationFilter,
    omega: Float[Array, "D D"],
    pose: Float[Array, "3"],
    landmarks: Float[Array, "A L"],
    scan: Scan,
    index: Int[Array, "M"],
    known: Bool[Array, "M"],
) -> CanonicalInnovations:
    """Gated innovations ν = z ⊖ ẑ, ẑ = h(x, l), and S = H Ω⁻¹ Hᵀ + R(ẑ); Ω is factored once.

    A measurement whose R or S is not positive definite has no effect and is `Status.SINGULAR`, as
    are all where Ω is not.

    Args:
        index: the landmark of each measurement, where known.
    """
    sensor = settings.sensor
    m, size = scan.z.shape
    gamma = gate_quantile(settings.gate, size)
    z = jnp.where(scan.valid[:, None], scan.z, 0.0)
    measured = landmarks[index]
    z_hat = jax.vmap(sensor.observe, (None, 0))(pose, measured)
    by_pose, by_landmark = jax.vmap(lambda at: observe_jacobians(sensor, pose, at))(measured)
    innovation = jax.vmap(sensor.residual)(z, z_hat)
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, z, known)
    jacobian = stack_jacobians(by_pose, by_landmark, index, landmarks.shape[0])

    factor, omega_positive = linalg.cholesky(omega)
    half = linalg.solve_lower(factor, jacobian.T)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    joint_cov = (half.T @ half).reshape(m, size, m, size) + same * noise[:, :, None]
    innovation_cov = joint_cov[jnp.arange(m), :, jnp.arange(m)]
    alone = jax.vmap(gaussian_terms)(innovation, innovation_cov)
    noise_factor, noise_positive = jax.vmap(linalg.cholesky)(noise)
    positive = alone.positive & noise_positive & omega_positive
    inside = jnp.isfinite(alone.distance) if gamma is None else alone.distance <= gamma
    fused = known & inside & positive

    fused_innovation = jnp.where(fused[:, None], innovation, 0.0)
    nis, log_likelihood = _densities_in_turn(fused_innovation, joint_cov, fused)
    rows = jax.vmap(linalg.solve_lower)(noise_factor, jacobian.reshape(m, size, jacobian.shape[1]))
    return CanonicalInnovations(
        whitened_jacobian=jnp.where(fused[:, None, None], rows, 0.0).reshape(jacobian.shape),
        whitened=jax.vmap(linalg.solve_lower)(noise_factor, fused_innovation).reshape(-1),
        compared=known,
        positive=positive,
        inside=inside,
        innovation=innovation,
        innovation_cov=innovation_cov,
        nis=jnp.where(fused, nis, alone.distance),
        log_likelihood=jnp.where(fused, log_likelihood, 0.0),
        omega_positive=omega_positive,
    )


def stack_jacobians(
    by_pose: Float[Array, "M Z 3"],
    by_landmark: Float[Array, "M Z L"],
    index: Int[Array, "M"],
    count: int,
) -> Float[Array, "MZ D"]:
    """The Jacobian H of M functions of pose and a landmark, index of `count`; D = 3 + count·L."""
    m, rows, size = by_landmark.shape
    slots = jnp.arange(count, dtype=index.dtype)
    at = (index[:, None] == slots[None, :]).astype(by_landmark.dtype)
    wide = jnp.einsum("mkl,ma->mkal", by_landmark, at).reshape(m, rows, count * size)
    return jnp.concatenate([by_pose, wide], axis=2).reshape(m * rows, 3 + count * size)


def _densities_in_turn(
    innovation: Float[Array, "M Z"],
    joint_cov: Float[Array, "M Z M Z"],
    fused: Bool[Array, "M"],
) -> tuple[Float[Array, "M"], Float[Array, "M"]]:
    """The distance d² and log-density of each fused innovation given those before it."""
    m, size = innovation.shape
    both = fused[:, None, None, None] & fused[None, None, :, None]
    eye = jnp.eye(m * size, dtype=innovation.dtype)
    fused_cov = jnp.where(both, joint_cov, eye.reshape(joint_cov.shape))
    inverse_factor = linalg.whitener_by_rows(fused_cov.reshape(eye.shape))[0]
    distance = (inverse_factor @ innovation.reshape(-1)).reshape(m, size) ** 2
    log_det = -log_det_of_pivots(jnp.diagonal(inverse_factor).reshape(m, size))
    nis = distance.sum(axis=1)
    return nis, log_density(nis, log_det, size)


def refuse_unless(solved: Bool[Array, ""], of: CanonicalInnovations) -> CanonicalInnovations:
    """The innovations, all marked singular if the mean could not be solved for."""
    return of._replace(
        positive=of.positive & solved,
        log_likelihood=jnp.where(solved, of.log_likelihood, 0.0),
    )
