"""EIF-SLAM: the extended Kalman filter in exact canonical (information) form."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.ekf.coordinates.map_coordinates import estimate_of
from jaxslam.filters.information import canonical, innovation
from jaxslam.filters.information.settings import InformationSettings
from jaxslam.filters.information.tag_association import associate_by_table
from jaxslam.math import linalg
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan


class CanonicalState(NamedTuple):
    """Robot and map in canonical form; D = 3 + N·L, slots and padding as in `slots.Joint`."""

    pose: Float[Array, "3"]
    landmarks: Float[Array, "N L"]
    omega: Float[Array, "D D"]
    """Ω, the inverse of the covariance; a dead slot has unit diagonal"""
    residual: Float[Array, "D"]
    """information residual ρ = ξ - Ω μ, zero after each update"""
    alive: Bool[Array, "N"]
    tag: Int[Array, "N"]
    """-1 where dead"""
    refused: Int[Array, ""]
    """scans refused because Ω was not positive definite"""

    @property
    def xi(self) -> Float[Array, "D"]:
        """The information vector ξ = Ω μ + ρ, with the heading wrapped."""
        mean = jnp.concatenate([self.pose, self.landmarks.reshape(-1)])
        return self.omega @ mean + self.residual


def eif_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    gate: float | None = None,
    floor: float = 1e-4,
) -> Filter:
    """Extended information filter SLAM: `ekf_slam(update="joint")` in canonical form.

    The steps are those of `canonical`; the mean is Ω⁻¹ ξ, solved for after each scan, O(D³). The
    results equal those of the EKF to rounding, at a higher cost; `seif` approximates this filter.
    Measurements are associated with landmarks by their tags.

    Where rounding has made Ω indefinite (float32), the scan is refused: its measurements are
    `Status.SINGULAR`, `CanonicalState.refused` counts it, and √eps of Ω's diagonal is added to Ω,
    which may make it positive definite for the next scan.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`, at the estimate.
        capacity: landmark slots N; a new landmark in a full map is `Status.OVERFLOW`.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
        floor: standard deviation [m, rad] added to a singular pose_cov, which has no inverse.
    Raises:
        ValueError: on a capacity below 1, a gate or floor not above 0, a suite, or a sensor that
            has no landmarks or whose landmarks become points.
    """
    settings = InformationSettings("eif_slam", motion, sensor, capacity, gate, floor)

    def init(pose: Array, pose_cov: Array) -> CanonicalState:
        size = len(sensor.landmark)
        d = 3 + capacity * size
        information = canonical.initial_information(pose_cov, floor).astype(pose.dtype)
        return CanonicalState(
            pose=pose,
            landmarks=jnp.zeros((capacity, size), pose.dtype),
            omega=jnp.eye(d, dtype=pose.dtype).at[:3, :3].set(information),
            residual=jnp.zeros(d, pose.dtype),
            alive=jnp.zeros(capacity, bool),
            tag=jnp.full(capacity, -1, jnp.int32),
            refused=jnp.zeros((), jnp.int32),
        )

    def predict(state: CanonicalState, u: Array, key: Array) -> CanonicalState:
        pose, omega, residual = canonical.motion_update(
            motion, state.pose, u, state.omega, state.residual
        )
        return state._replace(pose=pose, omega=omega, residual=residual)

    def update(state: CanonicalState, scan: Scan, key: Array) -> tuple[CanonicalState, Info]:
        measured = associate_by_table(state.tag, state.alive, scan)
        innovations = innovation.innovations(
            settings, state.omega, state.pose, state.landmarks, scan, measured.slot, measured.known
        )
        omega, residual = canonical.measurement_update(state.omega, state.residual, innovations)
        error, solved = canonical.mean_error(omega, residual, innovations.omega_positive)
        pose, landmarks = corrected_means(state, error)
        omega, new_landmarks, initialized = canonical.initialize_landmarks(
            sensor, omega, pose, scan.z, measured.slot, measured.new & measured.has_slot & solved
        )
        into = jnp.where(initialized, measured.slot, capacity)
        after = state._replace(
            pose=pose,
            landmarks=landmarks.at[into].set(new_landmarks, mode="drop"),
            omega=jnp.where(solved, omega, canonical.diagonal_loading(state.omega)),
            residual=jnp.where(solved, 0.0, state.residual),
            alive=state.alive.at[into].set(True, mode="drop"),
            tag=state.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
            refused=state.refused + (scan.valid.any() & ~solved),
        )
        innovations = innovation.refuse_unless(solved, innovations)
        return after, canonical.report(scan, measured, innovations, initialized)

    def estimate(state: CanonicalState) -> Estimate:
        cov = linalg.inverse_psd(state.omega)
        joint = Joint(state.pose, state.landmarks, cov, state.alive, state.tag, ())
        return estimate_of(joint, sensor, euclidean())

    return canonical.information_filter(settings, init, predict, update, estimate)


def corrected_means(
    state: CanonicalState, error: Float[Array, "D"]
) -> tuple[Float[Array, "3"], Float[Array, "N L"]]:
    """Pose and landmarks corrected by the error of the mean."""
    moved = state.landmarks + error[3:].reshape(state.landmarks.shape)
    return (
        canonical.correct_pose(state.pose, error[:3]),
        jnp.where(state.alive[:, None], moved, 0.0),
    )
