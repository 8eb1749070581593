"""EIF-SLAM: the extended Kalman filter in its exact canonical form."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots, validation
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.ekf.coordinates import estimate_of
from jaxslam.filters.information import canonical
from jaxslam.filters.reporting import seen_before
from jaxslam.math import linalg
from jaxslam.math.linalg import check_count, check_gate
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.sensors.suite import Suite
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan


class Canonical(NamedTuple):
    """Robot and map in canonical form; D = 3 + N·L, slots and padding as in `slots.Joint`."""

    pose: jax.Array
    """(3,)"""
    landmarks: jax.Array
    """(N, L)"""
    omega: jax.Array
    """(D, D) Ω, the inverse of the covariance; a dead slot has unit diagonal"""
    owed: jax.Array
    """(D,) ρ = ξ - Ω μ, zero after each update"""
    alive: jax.Array
    """(N,) bool"""
    tag: jax.Array
    """(N,) int32, -1 where dead"""
    broken: jax.Array
    """() int32: scans refused because Ω was not positive definite"""

    @property
    def xi(self) -> jax.Array:
        """(D,) the information vector ξ = Ω μ + ρ, of the heading as it is wrapped."""
        return self.omega @ jnp.concatenate([self.pose, self.landmarks.reshape(-1)]) + self.owed


def eif_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    gate: float | None = None,
    floor: float = 1e-4,
) -> Filter:
    """Extended information filter SLAM: `ekf_slam(update="joint")` in canonical form.

    Motion, measurement and new landmarks as `filters.canonical` has them; the mean is Ω⁻¹ ξ, solved
    for after each scan, O(D³). It gives the numbers of the EKF to rounding, costs more, and is what
    `seif` approximates. Landmarks are known by their tags.

    Where rounding has made Ω indefinite (float32), the scan is refused, its measurements are
    `Status.SINGULAR`, `Canonical.broken` counts it, and √eps of Ω's diagonal is added to it, which
    the next scan may find definite.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`, at the estimate.
        capacity: landmark slots N; what finds the map full is `Status.OVERFLOW`.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
        floor: standard deviation [m, rad] added to a singular pose_cov, which has no inverse.
    Raises:
        ValueError: on a capacity below 1, a gate or floor not above 0, a suite, or a sensor that
            has no landmarks or whose landmarks become points.
    """
    check_models("eif_slam", motion, sensor, capacity, gate, floor)
    size = len(sensor.landmark)

    def init(pose: jax.Array, pose_cov: jax.Array) -> Canonical:
        d = 3 + capacity * size
        start = canonical.started(pose_cov, floor).astype(pose.dtype)
        return Canonical(
            pose=pose,
            landmarks=jnp.zeros((capacity, size), pose.dtype),
            omega=jnp.eye(d, dtype=pose.dtype).at[:3, :3].set(start),
            owed=jnp.zeros(d, pose.dtype),
            alive=jnp.zeros(capacity, bool),
            tag=jnp.full(capacity, -1, jnp.int32),
            broken=jnp.zeros((), jnp.int32),
        )

    def predict(state: Canonical, u: jax.Array, key: jax.Array) -> Canonical:
        pose, omega, owed = canonical.moved(motion, state.pose, u, state.omega, state.owed)
        return state._replace(pose=pose, omega=omega, owed=owed)

    def update(state: Canonical, scan: Scan, key: jax.Array) -> tuple[Canonical, Info]:
        named = scan.valid & (scan.tag >= 0)
        at, found = slots.find(state.tag, state.alive, scan.tag)
        known, new = named & found, named & ~found
        weighed = canonical.weigh(
            state.omega, state.pose, state.landmarks, scan, at, known, sensor, gate
        )
        omega, owed = canonical.informed(state.omega, state.owed, weighed)
        step, sound = linalg.solve_psd(omega, owed)
        sound = sound & weighed.sound
        step = jnp.where(sound, step, 0.0)
        pose = canonical.stepped(state.pose, step[:3])
        moved = state.landmarks + step[3:].reshape(capacity, size)
        landmarks = jnp.where(state.alive[:, None], moved, 0.0)

        repeated = new & seen_before(scan.tag, new)
        fresh, room = slots.allocate(state.alive, new & ~repeated)
        omega, started, granted = canonical.born(omega, pose, scan.z, fresh, room & sound, sensor)
        into = jnp.where(granted, fresh, capacity)
        after = state._replace(
            pose=pose,
            landmarks=landmarks.at[into].set(started, mode="drop"),
            omega=jnp.where(sound, omega, canonical.loaded(state.omega)),
            owed=jnp.where(sound, 0.0, state.owed),
            alive=state.alive.at[into].set(True, mode="drop"),
            tag=state.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
            broken=state.broken + (scan.valid.any() & ~sound),
        )
        info = canonical.reported(
            canonical.judged(weighed, sound),
            scan,
            jnp.where(new, fresh, at),
            new=new,
            repeated=repeated,
            granted=granted,
            singular=room,
        )
        return after, info

    def estimate(state: Canonical) -> Estimate:
        cov = linalg.inverse_psd(state.omega)
        joint = Joint(state.pose, state.landmarks, cov, state.alive, state.tag, ())
        return estimate_of(joint, sensor, euclidean())

    return Filter(
        name="eif_slam",
        control_size=len(motion.controls),
        measurement_size=len(sensor.measurements),
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
    )


def check_models(
    name: str,
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    gate: float | None,
    floor: float,
) -> None:
    """Raise ValueError on what no filter in canonical form takes."""
    validation.check_models(name, motion, sensor)
    check_count(f"{name}: capacity", capacity)
    check_gate(name, gate)
    canonical.check_floor(name, floor)
    if isinstance(sensor, Suite):
        raise ValueError(f"{name}: expected one sensor, not a suite")
    if len(sensor.landmark) == 0:
        raise ValueError(f"{name}: the sensor {sensor.name} has no landmarks")
    if sensor.reduced is not None:
        raise ValueError(f"{name}: the landmarks of {sensor.name} become points")
