"""Mapping from known poses, with independent landmarks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import sensor_model
from jaxslam.core.protocols import POSE, Associate, Filter, Life, Sensor, Wrapper
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    or_none,
    probability,
    refusals_of,
)
from jaxslam.filters._particles.landmark_ekf import update_map
from jaxslam.filters._particles.particle_map import ParticleMapFilter
from jaxslam.filters._particles.proposal import associate_particle, propose_pose
from jaxslam.filters._particles.scan_association import zero_padding
from jaxslam.filters._particles.slam_particles import (
    SlamParticles,
    as_only_particle,
    initial_slam_particles,
    slam_estimate,
)
from jaxslam.math._arrays import Number
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import conditioned


@record
class Mapping(ParticleMapFilter):
    """A filter of the map for known poses (Williams): the control *is* the pose.

    Given the path, landmarks are independent: each has a separate EKF, l ← l + C Hᵀ S⁻¹ ν with
    S = H C Hᵀ + R, and a measurement costs O(1) for any size of the map. This is the map update of
    one particle of `FastSlam`, without a joint covariance. The numbers that the sensor asks for
    beside the pose (`Sensor.robot`) are known as well, and follow it in the control.

    The state is one particle of a `SlamParticles`. `log._replace(control=poses)` makes a log
    of recorded poses (T, 3) and scans; `as_prior` makes the map the initial state of `EkfSlam`.

    Raises ValueError on a capacity or births below 1, a gate not above 0 and below 1, or a sensor
    that is a suite, absolute, or whose landmarks turn into points.
    """

    sensor: Sensor = field(check=sensor_model)
    """a sensor of landmarks; Jacobians come from `jax.jacfwd`"""
    capacity: int = static(check=at_least(1))
    """landmark slots N"""
    _: dataclasses.KW_ONLY
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """See `EkfSlam.associate`."""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """See `EkfSlam.births`."""
    life: Life | None = field(default=None, check=or_none(instance_of(Life)))
    """See `EkfSlam.life`."""
    chart = Euclidean()
    further = True

    @property
    def robot_state(self) -> tuple[str, ...]:
        return (*POSE, *self.sensor.robot)

    @property
    def controls(self) -> tuple[str, ...]:
        return self.robot_state

    def init(self, pose: Float[Array, "R"], pose_cov: Float[Array, "R R"]) -> SlamParticles:
        exact, size = jnp.zeros_like(pose_cov), len(self.sensor.landmark)
        further = None
        if self.sensor.robot:
            pose, further, exact = pose[:3], pose[3:], exact[:3, :3]
        state = initial_slam_particles(pose, exact, 1, self.capacity, size)
        particle: SlamParticles = jax.tree.map(lambda leaf: leaf[0], state._replace(best=None))
        particle = particle._replace(further=further)
        if self.life is None:
            return particle
        return particle._replace(life=self.life.init(pose, particle.landmarks))

    def predict(self, state: SlamParticles, u: Float[Array, "R"], key: Array) -> SlamParticles:
        if self.sensor.robot:
            state, u = state._replace(further=u[3:]), u[:3]
        return state._replace(pose=jnp.concatenate([u[:2], wrap(u[2:])]))

    def update(self, state: SlamParticles, scan: Scan, key: Array) -> tuple[SlamParticles, Info]:
        scan, filter = zero_padding(scan), self
        if self.sensor.robot:
            filter = dataclasses.replace(self, sensor=conditioned(self.sensor, state.further))
        association = associate_particle(filter, state, scan)
        # The pose is known, so the proposal does not change it; the other results are used.
        proposed, innovations = propose_pose(filter, state, association, scan)
        state, info = update_map(filter, state, association, innovations, scan)
        return state, info._replace(log_likelihood=proposed.log_matched)

    def estimate(self, state: SlamParticles) -> Estimate:
        believed = slam_estimate(as_only_particle(state), self.sensor)
        believed = believed._replace(pose=state.pose, pose_cov=state.pose_cov)
        if state.further is None:
            return believed
        exact = jnp.zeros((len(state.further),) * 2, state.pose.dtype)
        return believed._replace(further=state.further, further_cov=exact)


@record
class StartingAt(Wrapper):
    """A filter whose first state is given, as of `as_prior`, or the final one of another run."""

    filter: Filter
    state: PyTree
    """independent of the arguments of `init`"""
    further = True

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.filter.name

    def init(self, pose: Float[Array, "R"], pose_cov: Float[Array, "R R"]) -> PyTree:
        return jax.tree.map(jnp.asarray, self.state)


def as_prior(
    state: SlamParticles,
    filter: Filter,
    pose: ArrayLike,
    pose_cov: ArrayLike,
) -> Joint:
    """The initial state of a SLAM filter with this map as an uncorrelated prior.

    `run(StartingAt(filter, as_prior(final, filter, pose, pose_cov)), …)` begins with it.

    Args:
        state: the final state of `mapping`.
        filter: an `EkfSlam` of as many landmarks, in the Euclidean chart.
        pose, pose_cov: (3,) and (3, 3) where its robot begins.
    Raises:
        ValueError: on other shapes; on a filter whose state is no `slots.Joint` of as many
            landmarks, has a root of its covariance, is in another chart, or has a linearizer with
            memory.
    """
    if np.shape(pose) != (3,) or np.shape(pose_cov) != (3, 3):
        raise InvalidField(
            "",
            f"expected a pose (3,) and covariance (3, 3), got {np.shape(pose)} and "
            f"{np.shape(pose_cov)}",
            owner="as_prior",
        )
    capacity, size = state.landmarks.shape
    kind = state.landmarks.dtype
    joint = filter.init(jnp.asarray(pose, kind), jnp.asarray(pose_cov, kind))
    with refusals_of("as_prior"):
        if not isinstance(joint, Joint) or joint.landmarks.shape != (capacity, size):
            raise InvalidField(
                "",
                f"expected a filter of {capacity} landmarks with {size} parameters each, got "
                f"{filter.name}",
            )
        if filter.chart.basis is not None or filter.square_root or jax.tree.leaves(joint.lin):
            raise InvalidField(
                "",
                "expected a filter in the Euclidean chart with a covariance, not its square "
                "root, and with Jacobians at the estimate",
            )
    blocks = jnp.where(state.alive[:, None, None], state.covs, jnp.eye(size, dtype=kind)[None])
    # The rows of P of each landmark; only diagonal blocks are set: an uncorrelated prior.
    rows = 3 + jnp.arange(capacity)[:, None] * size + jnp.arange(size)[None, :]
    return joint._replace(
        landmarks=state.landmarks,
        cov=joint.cov.at[rows[:, :, None], rows[:, None, :]].set(blocks),
        alive=state.alive,
        tag=state.tag,
    )
