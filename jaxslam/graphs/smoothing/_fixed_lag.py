"""The fixed-lag smoother: the last poses and the map are optimized together at every scan."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Associate, Filter, Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan, Status
from jaxslam.core.validation import InvalidField, at_least, or_none, probability
from jaxslam.filters._ekf.ekf_slam import EkfSlam, associate_scan
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.graphs._chain.window import (
    WindowIterate,
    WindowPrior,
    WindowSteps,
    linearize_window,
    marginalize_oldest,
    newest_cov,
    solve_window,
    step_window,
)
from jaxslam.graphs.smoothing._forward_pass import joint_ekf
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.sensors._suite import Suite

_POINT = ("x [m]", "y [m]")


class _WindowState(NamedTuple):
    """The state of `FixedLag`."""

    joint: Joint
    """the newest pose and the map"""
    prior: WindowPrior
    """prior of the oldest pose of the window, and of the map before it"""
    steps: WindowSteps
    at: WindowIterate
    """the path in the window, and the map"""


@record
class FixedLag(Filter):
    """Fixed-lag smoothing SLAM: Gauss-Newton over the last `window` motions and scans, and the map.

    At each scan EKF-SLAM predicts, associates, gates and starts landmarks; then the poses of the
    window, the noises of its motions and the map are optimized together (`window`), and the
    estimate is the newest pose and the map. The oldest step leaves the window by marginalization:
    its motion and scan, linearized at the estimates of then, become the prior of the next pose
    and the map.

    That prior keeps its linearization, while later Jacobians are taken at newer estimates; so the
    window's linearized system has two unobservable directions instead of three, and the heading
    becomes certain without reason. With first_estimates Jacobians by a variable of the prior are
    taken where that was linearized, and there are three (Dong-Si & Mourikis 2011, "Motion tracking
    with fixed-lag smoothing: algorithm and consistency analysis", ICRA). A window as long as the
    log marginalizes nothing: then the newest pose and the map are those of `BatchMap`.

    A measurement with a singular R(ẑ), or R(z) where it would start a landmark, is dropped as
    `Status.SINGULAR`. Where the numbers of the window are not finite (it is optimized without step
    control), it restarts from the state of EKF-SLAM, and `exhausted` is set. O(W N²) for the
    window, and O(N³) for the prior, an iteration.

    Raises ValueError as `EkfSlam` does; on a sensor of another kind, and on a slots, window or
    iterations below 1; from `update`, on a scan of more measurement slots.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """the models; Jacobians come from `jax.jacfwd`. A measurement must determine its landmark and
    have as many numbers (K = 0, Z = L)"""
    capacity: int = static(check=at_least(1))
    """landmark slots N"""
    slots: int = static(check=at_least(1))
    """most measurement slots M of a scan; the window stores scans"""
    _: dataclasses.KW_ONLY
    window: int = static(default=5, check=at_least(1))
    """motions and scans W that are optimized"""
    first_estimates: bool = static(default=False)
    """whether Jacobians by a variable of the prior are taken where that was linearized; needs
    landmarks (x, y)"""
    iterations: int = static(default=2, check=at_least(1))
    """Gauss-Newton steps at each scan"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """See `EkfSlam.associate`."""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`; NIS is of the innovations of EKF-SLAM, not of the window."""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """See `EkfSlam.births`."""
    chart = Euclidean()

    def __post_init__(self) -> None:
        sensor = self.sensor
        same = len(sensor.measurements) == len(sensor.landmark)
        several = isinstance(sensor, Suite) or sensor.reduced is not None
        if several or sensor.free.mean.shape[0] or not same:
            raise InvalidField(
                "sensor",
                "expected one whose measurement determines its landmark by as many numbers as it "
                f"has, got {sensor.name}",
            )
        if self.first_estimates and sensor.landmark != _POINT:
            reason = f"expected landmarks (x, y) for first_estimates, got {sensor.landmark}"
            raise InvalidField("sensor", reason)
        super().__post_init__()

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.landmark

    def init(self, pose: Array, pose_cov: Array) -> _WindowState:
        return self._started_at(self._ekf.init(pose, pose_cov))

    def predict(self, state: _WindowState, u: Array, key: Array) -> _WindowState:
        motion, joint = self.motion, self._ekf.predict(state.joint, u, key)
        system = linearize_window(
            motion, self.sensor, state.prior, state.steps, state.at, self.first_estimates
        )
        # The oldest step leaves before the new motion enters: W steps at every scan.
        prior = marginalize_oldest(state.prior, system, state.steps, state.at, joint.tag)
        state = _restart_unless_finite(state._replace(prior=prior), self._started_at(state.joint))
        root = linalg.root_psd(motion.noise_cov(state.joint.pose, u))
        steps, at = shift(state.steps, state.at, u, root, joint.pose)
        return _WindowState(joint, state.prior, steps, at)

    def update(self, state: _WindowState, scan: Scan, key: Array) -> tuple[_WindowState, Info]:
        motion, sensor = self.motion, self.sensor
        if scan.z.shape[0] > self.slots:
            reason = f"expected at least {scan.z.shape[0]}, as a scan has, got {self.slots}"
            raise InvalidField("slots", reason, owner="FixedLag")
        # The window weights by R⁻¹: R(ẑ) of what EKF-SLAM will match, R(z) of a new landmark.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        ekf = self._ekf
        association, matched = associate_scan(
            self.associate, sensor, scan, lambda: prediction_of(ekf, sensor, state.joint)
        )
        landmark = state.joint.landmarks[jnp.maximum(association.slot, 0)]
        z_hat = jax.vmap(sensor.observe, (None, 0))(state.joint.pose, landmark)
        noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, scan.z, matched)
        regular = jax.vmap(linalg.cholesky)(noise)[1]
        lost = (matched | association.is_new) & ~regular
        kept = scan._replace(valid=scan.valid & ~lost)
        joint, info = ekf.update(state.joint, kept, key)
        status = jnp.where(lost, jnp.int32(Status.SINGULAR), info.status)
        info = info._replace(status=status.astype(info.status.dtype))
        # The window has the measurements that were fused or started landmarks.
        used = (info.status == Status.FUSED) | (info.status == Status.BORN)
        z = jnp.where(scan.valid[:, None], scan.z, 0.0)
        slot, count = jnp.maximum(info.slot, 0), scan.z.shape[0]
        steps = state.steps._replace(
            z=state.steps.z.at[-1, :count].set(z),
            slot=state.steps.slot.at[-1, :count].set(slot),
            used=state.steps.used.at[-1, :count].set(used),
        )
        born = joint.alive & ~state.joint.alive
        # New landmarks start where EKF-SLAM has them; the others where the window has them.
        landmarks = jnp.where(born[:, None], joint.landmarks, state.at.landmarks)
        at = state.at._replace(landmarks=landmarks)
        for _ in range(self.iterations):
            system = linearize_window(motion, sensor, state.prior, steps, at, self.first_estimates)
            solved = solve_window(state.prior, system, at, joint.alive)
            at = step_window(motion, steps, at, solved)
        # The newest pose and the map of the window; unit variance at dead slots.
        alive = jnp.repeat(joint.alive, joint.landmarks.shape[1])
        alive = jnp.concatenate([jnp.ones(3, bool), alive])
        cov = newest_cov(system, solved)
        cov = jnp.where(alive[:, None] & alive[None], cov, jnp.eye(len(alive), dtype=cov.dtype))
        landmarks = jnp.where(joint.alive[:, None], at.landmarks, 0.0)
        newest = joint._replace(pose=at.path[-1], landmarks=landmarks, cov=cov)
        after = _WindowState(newest, state.prior, steps, at)
        exhausted = jnp.asarray(info.exhausted) | ~_is_finite(after)
        info = info._replace(exhausted=exhausted)
        return _restart_unless_finite(after, self._started_at(joint)), info

    def estimate(self, state: _WindowState) -> Estimate:
        return self._ekf.estimate(state.joint)

    @property
    def _ekf(self) -> EkfSlam:
        return joint_ekf(self)

    def _started_at(self, joint: Joint) -> _WindowState:
        """The state at a joint, with a window of absent steps."""
        window, dtype = self.window, joint.pose.dtype
        controls, noises = len(self.motion.controls), len(self.motion.noises)
        steps = WindowSteps(
            present=jnp.zeros(window, bool),
            control=jnp.zeros((window, controls), dtype),
            root=jnp.zeros((window, noises, noises), dtype),
            z=jnp.zeros((window, self.slots, joint.landmarks.shape[1]), dtype),
            slot=jnp.zeros((window, self.slots), jnp.int32),
            used=jnp.zeros((window, self.slots), bool),
        )
        path = jnp.tile(joint.pose, (window + 1, 1))
        at = WindowIterate(path, jnp.zeros((window, noises), dtype), joint.landmarks)
        return _WindowState(joint, WindowPrior(joint, (joint.pose, joint.landmarks)), steps, at)


def _is_finite(state: _WindowState) -> Bool[Array, ""]:
    """Whether all numbers of a state are finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(state)]).all()


def _restart_unless_finite(state: _WindowState, restart: _WindowState) -> _WindowState:
    """The state if all its numbers are finite, else the restart."""
    finite = _is_finite(state)
    chosen: _WindowState = jax.tree.map(lambda a, b: jnp.where(finite, a, b), state, restart)
    return chosen


def shift(
    steps: WindowSteps,
    at: WindowIterate,
    u: Float[Array, "U"],
    root: Float[Array, "Q Q"],
    pose: Array,
) -> tuple[WindowSteps, WindowIterate]:
    """The window without its oldest step, and with a new motion to a predicted pose (3,)."""

    def append(rows: Array, new: Array | bool | float) -> Array:
        # All rows move up by one: fixed shapes, newest last.
        return jnp.roll(rows, -1, axis=0).at[-1].set(new)

    after = WindowSteps(
        present=append(steps.present, True),
        control=append(steps.control, u),
        root=append(steps.root, root),
        z=append(steps.z, 0.0),
        slot=append(steps.slot, 0),
        used=append(steps.used, False),
    )
    return after, at._replace(path=append(at.path, pose), noise=append(at.noise, 0.0))
