"""Mapping from known poses: landmarks that have nothing to do with one another."""

from functools import partial

import jax
import jax.numpy as jnp

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.particles import landmark_ekf
from jaxslam.filters.particles.proposal import look
from jaxslam.filters.particles.slam_state import Particles, empty, moments
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.math.stats import chi2_quantile
from jaxslam.protocols import Associate, Filter, Life, Sensor
from jaxslam.sensors.suite import Suite
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array


def mapping(
    sensor: Sensor,
    capacity: int,
    *,
    associate: Associate | None = None,
    gate: float | None = None,
    births: int | None = None,
    life: Life | None = None,
) -> Filter:
    """The map alone, of a robot whose poses are known (Williams): the control *is* the pose.

    Given the path, landmarks are independent: each has an EKF of its own, l ← l + C Hᵀ S⁻¹ ν with
    S = H C Hᵀ + R, and a measurement costs O(1) however large the map is. It is what one particle
    of `fastslam` does; no joint matrix exists.

    The state is one particle of a `particles.Particles`. `log._replace(control=poses)` makes a log
    of recorded poses (T, 3) and scans; `as_prior` makes the map one that `ekf_slam` goes on from.

    Args:
        sensor: of landmarks; Jacobians come from `jax.jacfwd`.
        capacity: landmark slots N.
        associate, gate, births, life: as for `ekf_slam`.
    Raises:
        ValueError: on a capacity or births below 1, a gate not above 0, or a sensor that is a
            suite, absolute, or whose landmarks turn into points.
    """
    validation.check_sensor("mapping", sensor)
    validation.check_parts("mapping", associate=associate)
    for name, value in (("capacity", capacity), ("births", births)):
        if value is not None or name != "births":
            linalg.check_count(f"mapping: {name}", value)
    linalg.check_gate("mapping", gate)
    if isinstance(sensor, Suite) or not sensor.landmark or sensor.reduced is not None:
        raise ValueError(
            "mapping: expected one sensor of landmarks that stay what they are, not a suite, an "
            f"absolute sensor or landmarks that turn into points, got {sensor.name}"
        )
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    seen_from = partial(
        look,
        sensor=sensor,
        associate=associate or known_association(),
        gate=gate,
        edge=chi2_quantile(0.99, size_z),
    )
    change_map = partial(landmark_ekf.after_scan, sensor=sensor, births=births, life=life)

    def init(pose: Array, pose_cov: Array) -> Particles:
        one: Particles = jax.tree.map(
            lambda leaf: leaf[0], empty(pose, pose_cov, 1, capacity, size_l)._replace(best=())
        )
        one = one._replace(pose_cov=jnp.zeros_like(pose_cov))
        return one if life is None else one._replace(life=life.init(pose, one.landmarks))

    def predict(state: Particles, u: Array, key: Array) -> Particles:
        return state._replace(pose=jnp.concatenate([u[:2], wrap(u[2:])]))

    def update(state: Particles, scan: Scan, key: Array) -> tuple[Particles, Info]:
        # Padding may hold anything, and is multiplied by zero further down.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        _, _, fit, _, sight = seen_from(
            state.pose,
            state.pose_cov,
            state.landmarks,
            state.covs,
            state.alive,
            state.tag,
            scan,
        )
        state, info = change_map(state, sight, scan)
        return state, info._replace(log_likelihood=fit, exhausted=sight.exhausted)

    def estimate(state: Particles) -> Estimate:
        alone: Particles = jax.tree.map(lambda leaf: leaf[None], state)
        believed = moments(alone._replace(best=jnp.zeros((), jnp.int32)), sensor)
        return believed._replace(pose=state.pose, pose_cov=state.pose_cov)

    return Filter(
        name="mapping",
        control_size=3,
        measurement_size=size_z,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
    )


def as_prior(state: Particles, filter: Filter, pose: Array, pose_cov: Array) -> Joint:
    """The state of a filter that begins in this map, with nothing correlated yet.

    `run` begins in it by `dataclasses.replace(filter, init=partial(as_prior, final, filter))`.

    Args:
        state: the final state of `mapping`.
        filter: an `ekf_slam` of as many landmarks, in the Euclidean chart.
        pose, pose_cov: (3,) and (3, 3) where its robot begins.
    Raises:
        ValueError: on other shapes; on a filter whose state is no `slots.Joint` of as many
            landmarks, holds a root of its covariance, is in another chart, or remembers where it
            linearized.
    """
    if jnp.shape(pose) != (3,) or jnp.shape(pose_cov) != (3, 3):
        raise ValueError(
            f"as_prior: expected a pose (3,) and covariance (3, 3), got {jnp.shape(pose)} and "
            f"{jnp.shape(pose_cov)}"
        )
    capacity, size = state.landmarks.shape
    kind = state.landmarks.dtype
    joint = filter.init(jnp.asarray(pose, kind), jnp.asarray(pose_cov, kind))
    if not isinstance(joint, Joint) or joint.landmarks.shape != (capacity, size):
        raise ValueError(
            f"as_prior: the state of {filter.name} has no {capacity} landmarks of {size} numbers"
        )
    plain = filter.chart.basis is None and not filter.chart.motion_apart
    if not plain or filter.square_root or jax.tree.leaves(joint.lin):
        raise ValueError(
            "as_prior: expected a filter in the Euclidean chart, with a covariance and Jacobians "
            "at the estimate"
        )
    blocks = jnp.where(state.alive[:, None, None], state.covs, jnp.eye(size, dtype=kind)[None])
    rows = 3 + jnp.arange(capacity)[:, None] * size + jnp.arange(size)[None, :]
    return joint._replace(
        landmarks=state.landmarks,
        cov=joint.cov.at[rows[:, :, None], rows[:, None, :]].set(blocks),
        alive=state.alive,
        tag=state.tag,
    )
