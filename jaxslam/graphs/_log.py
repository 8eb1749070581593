"""The graph of a log: its motions, measurements and prior as factors."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core._noise import Constant
from jaxslam.core._numbers import is_concrete
from jaxslam.core._validation import check_models, log_of
from jaxslam.core.protocols import POSE, Motion, Sensor, motion_of_pose, sensor_of_robot
from jaxslam.core.types import JaxOrNumPy, Log
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    covariance,
    finite,
    or_none,
    refusals_of,
    require,
)
from jaxslam.graphs._factor import Factor, FromMotion, FromSensor, NominalMotion, Prior
from jaxslam.graphs._graph import Graph, Table
from jaxslam.linearize._first_order import motion_jacobians, nominal_path, predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.sensors._suite import Suite, Wrapped

_STILL = 1e-9
"""The determinant of ∂step/∂w, with columns of length one, below which it is singular; in float32
ten eps, its rounding."""


def of_log(
    log: Log,
    motion: Motion,
    sensor: Sensor,
    pose: ArrayLike,
    pose_cov: ArrayLike,
    *,
    slack: float | None = None,
    tags: ArrayLike | None = None,
    capacity: int | None = None,
) -> tuple[Graph, dict[str, Factor]]:
    """The graph of a log of T steps, and its factors: `BatchMap` has the same optimum.

    Its tables, their factors, and the number of their rows:

        prior    Prior() of the pose before the first control              1; none where P0 = 0
        motion   FromMotion(motion), z = u, Ω = Q⁻¹; or NominalMotion     T
        sensor   FromSensor(sensor), Ω = R⁻¹; or with own_noise, Ω = I    T·M

    χ² of the graph is twice the cost of `smoothing.BatchMap`, and `pose_id` t is the pose after t
    controls. Poses start along the nominal motion, points at their first measurement. There Q is
    evaluated: as data of the graph it is fixed. An R that is no constant is R(ẑ) of each iterate
    (`FromSensor.own_noise`).

    A noise of other than three components is not determined by two poses. Then, and where `slack` s
    is given, the factor of the motion is `NominalMotion` with Ω = (G Q Gᵀ + s² I)⁻¹. With fewer
    components (`Unicycle`, `Increment`, `Ackermann`) the motion is a constraint, which s > 0, the
    standard deviation of each coordinate [m, m, rad], makes soft: its optimum and the one of
    `BatchMap` differ by the order of s², and the condition of the problem is worse by s⁻².

    With `capacity` a tag is the number of its point, and all shapes are known, so that logs may be
    traced and batched; points that no scan saw are fixed at the origin. Without, the points are the
    tags that occur, in ascending order. Bad tags, and noise that has no information, are noticed
    where the log is concrete.

    Args:
        log: row t of the scans was taken at pose t + 1.
        motion: the model; without `slack` its noise has at least three components.
        sensor: of landmarks, or an absolute one; not a suite. Landmark parameters that it does not
            measure start at the mean of its `free`; that prior is not in the graph.
        pose, pose_cov: (3,) and (3, 3) of the robot before the first control; zero fixes it.
        slack: see above.
        tags: (T, M) identities from an association, -1 where a measurement is left out; by default
            the tags of the scans, which must be known.
        capacity: number of points.
    Raises:
        ValueError: on models, a log or a covariance that do not fit, and at the row where a motion
            or a measurement has a singular noise (at its prediction from the initial graph, where R
            is no constant), or a noise does not move the pose in all directions (a robot at rest,
            with `Odometry`).
    """
    with refusals_of("graphs.of_log"):
        check_models(motion, sensor)
        require("motion", motion, motion_of_pose)
        require("sensor", sensor, sensor_of_robot(POSE))
        if isinstance(sensor, Suite) or sensor.reduced is not None:
            reason = f"expected one of landmarks that stay what they are, got {sensor.name}"
            raise InvalidField("sensor", reason)
        require("slack", slack, or_none(finite(least=0.0)))
        if not slack and len(motion.noises) < 3:
            raise InvalidField(
                "slack",
                f"{motion.name} has {len(motion.noises)} noises, which do not move the pose in all "
                "directions: give the standard deviation of a soft constraint, as slack=1e-3",
            )
        sizes = len(motion.controls), len(sensor.measurements)
        require("log", log, log_of(*sizes))
        require("pose", pose, finite(3))
        require("pose_cov", pose_cov, covariance(3))
        index, valid, ids = _points_of(log, sensor, tags, capacity)
    exact = len(motion.noises) == 3 and slack is None
    motion_factor = FromMotion(motion) if exact else NominalMotion(motion)
    # R may depend on z unless the noise of the innermost sensor is a constant.
    innermost = sensor
    while isinstance(innermost, Wrapped) and type(innermost).noise_cov is Wrapped.noise_cov:
        innermost = innermost.sensor
    sensor_factor = FromSensor(sensor, own_noise=not isinstance(innermost.noise_cov, Constant))
    factors: dict[str, Factor] = {"motion": motion_factor, "sensor": sensor_factor}
    fixed = is_concrete(pose_cov) and not np.any(np.asarray(pose_cov))
    arguments = jnp.asarray(pose), jnp.asarray(pose_cov), index, valid, ids
    soft = None if exact else np.asarray(slack or 0.0)
    graph, regular = _graph_of(motion, sensor_factor, fixed, log, *arguments, soft)
    with refusals_of("graphs.of_log"):
        _check_noise(regular, motion, sensor, valid, fixed)
    if not fixed:
        factors["prior"] = Prior()
    return graph, factors


class _Regular(NamedTuple):
    """Whether each covariance can be inverted."""

    prior: Bool[Array, ""]
    motion: Bool[Array, "T"]
    sensor: Bool[Array, "T M"]
    moving: Bool[Array, "T"]
    """whether the noise moves the pose in all directions"""


def _points_of(
    log: Log, sensor: Sensor, tags: ArrayLike | None, capacity: int | None
) -> tuple[JaxOrNumPy, JaxOrNumPy, Int[np.ndarray, "P"]]:
    """The point of each measurement, whether it is used, and the tags of the points."""
    tag = log.scan.tag if tags is None else tags
    array: JaxOrNumPy = tag if isinstance(tag, Array) else np.asarray(tag)
    valid = log.scan.valid
    if not sensor.landmark:
        return log.scan.tag * 0, valid, np.zeros(0, np.int32)
    if np.shape(array) != np.shape(valid):
        raise InvalidField("tags", f"expected shape {np.shape(valid)}, got {np.shape(array)}")
    if not jnp.issubdtype(array.dtype, np.integer):
        raise InvalidField("tags", f"expected integers, got {array.dtype}")
    if is_concrete(array) and is_concrete(valid):
        unknown = np.asarray(valid) & (np.asarray(array) < 0)
        if tags is None and unknown.any():
            row, place = np.argwhere(unknown)[0]
            raise InvalidField(
                "log",
                f"the measurement of row {row}, slot {place} has no identity: give tags= "
                "of an association",
            )
        high = np.asarray(valid) & (np.asarray(array) >= (2**31 if capacity is None else capacity))
        if high.any():
            raise InvalidField(
                "tags",
                f"expected a number below {capacity}, the capacity, got "
                f"{np.asarray(array)[high][0]}",
            )
    elif capacity is None:
        raise InvalidField("capacity", "expected the number of points of a traced log, got None")
    if capacity is not None:
        require("capacity", capacity, at_least(1))
        used = valid & (array >= 0)
        return array * used.astype(array.dtype), used, np.arange(capacity, dtype=np.int32)
    tagged = np.asarray(valid) & (np.asarray(array) >= 0)
    ids = np.unique(np.asarray(array)[tagged]).astype(np.int32)
    if not len(ids):
        raise InvalidField("log", "it has no measurement of a landmark")
    return np.where(tagged, np.searchsorted(ids, array), 0).astype(np.int32), tagged, ids


@partial(jax.jit, static_argnames="fixed", inline=True)
def _graph_of(
    motion: Motion,
    factor: FromSensor,
    fixed: bool,
    log: Log,
    pose: Float[Array, "3"],
    pose_cov: Float[Array, "3 3"],
    index: Int[Array, "T M"],
    valid: Bool[Array, "T M"],
    ids: Int[Array, "P"],
    slack: Float[Array, ""] | None,
) -> tuple[Graph, _Regular]:
    """The graph, each measurement at the point of its index.

    Args:
        motion, factor, log, pose, pose_cov: the models and the data, as of `of_log`.
        fixed: the first pose is fixed, and has no prior.
        index, valid, ids: of `_points_of`.
        slack: None for the exact factor of the motion.
    """
    sensor, kind = factor.sensor, jnp.result_type(log.control, log.scan.z)
    control, pose = log.control.astype(kind), pose.astype(kind)
    z = jnp.where(valid[:, :, None], log.scan.z.astype(kind), 0.0)
    path = jnp.concatenate([pose[None], nominal_path(motion, pose, control)])
    motion_cov = jax.vmap(motion.noise_cov)(path[:-1], control)
    by_noise = jax.vmap(lambda x, u: motion_jacobians(motion, x, u)[1])(path[:-1], control)
    moving = jnp.ones(len(control), bool)
    if slack is None:
        # The volume that the columns of ∂f/∂w span, at unit length: not 0 if they move the pose in
        # all directions.
        length = jnp.linalg.norm(by_noise, axis=1, keepdims=True)
        first, second, third = jnp.moveaxis(by_noise / jnp.where(length > 0, length, 1.0), 2, 0)
        least = max(_STILL, 10 * float(jnp.finfo(by_noise.dtype).eps))
        moving = jnp.abs((first * jnp.cross(second, third)).sum(axis=1)) > least
    else:
        over_steps = jax.vmap(_pose_noise, (0, 0, 0, None))
        motion_cov = over_steps(path[1:], by_noise, motion_cov, slack)
    points, seen = _place_points(sensor, path[1:], z, index, valid, ids.shape[0])
    if factor.own_noise:
        # The weights are by R(ẑ), at first of this graph; R(z) is not used.
        landmark = points[index] if sensor.landmark else z[..., :0]
        z_hat = jax.vmap(jax.vmap(sensor.observe, (None, 0)))(path[1:], landmark)
        by_slot = jax.vmap(jax.vmap(partial(predicted_noise, sensor)))
        sensor_cov = by_slot(z_hat, z, valid)
    else:
        sensor_cov = jax.vmap(jax.vmap(sensor.noise_cov))(z)
    # The prior's error is rotated into the frame of its mean, as the factor needs it.
    turned = jnp.eye(3, dtype=kind).at[:2, :2].set(se2.rotation(pose[2]))
    q, q_regular = jax.vmap(_information)(motion_cov)
    r, r_regular = jax.vmap(jax.vmap(_information))(sensor_cov)
    if factor.own_noise:
        r = jnp.broadcast_to(jnp.eye(r.shape[-1], dtype=kind), r.shape)
    p, p_regular = _information(turned.T @ pose_cov.astype(kind) @ turned)

    count = jnp.arange(path.shape[0], dtype=jnp.int32)
    rows = jnp.repeat(count[1:], valid.shape[1])
    # T·M rows: (T, M, …) becomes (T·M, …).
    who = [rows, index.reshape(-1).astype(rows.dtype)] if sensor.landmark else [rows]
    size = z.shape[2]
    tables = {
        "motion": Table(
            jnp.stack([count[:-1], count[1:]], axis=1), control, q, jnp.ones(len(control), bool)
        ),
        "sensor": Table(
            jnp.stack(who, axis=1),
            z.reshape(-1, size),
            r.reshape(-1, size, size),
            valid.reshape(-1),
        ),
    }
    if not fixed:
        first = jnp.zeros((1, 1), count.dtype)
        tables["prior"] = Table(first, path[:1], p[None], jnp.ones(1, bool))
    graph = Graph(path, points, tables, (count == 0) & fixed, ~seen, count, ids)
    return graph, _Regular(p_regular, q_regular, r_regular, moving)


def _pose_noise(
    pose: Float[Array, "3"],
    by_noise: Float[Array, "3 W"],
    noise_cov: Float[Array, "W W"],
    slack: Float[Array, ""],
) -> Float[Array, "3 3"]:
    """The noise covariance G Q Gᵀ + s² I of a motion, in the frame of the pose that it led to."""
    turned = jnp.eye(3, dtype=pose.dtype).at[:2, :2].set(se2.rotation(pose[2]))
    local = turned.T @ by_noise
    soft = slack.astype(pose.dtype) ** 2 * jnp.eye(3, dtype=pose.dtype)
    return local @ noise_cov @ local.T + soft


def _information(cov: Float[Array, "R R"]) -> tuple[Float[Array, "R R"], Bool[Array, ""]]:
    """The inverse of a covariance, and whether it is positive definite."""
    inverse, regular = linalg.solve_psd(cov, jnp.eye(cov.shape[0], dtype=cov.dtype))
    return linalg.symmetrize(inverse), regular


def _place_points(
    sensor: Sensor,
    path: Float[Array, "T 3"],
    z: Float[Array, "T M Z"],
    index: Int[Array, "T M"],
    valid: Bool[Array, "T M"],
    count: int,
) -> tuple[Float[Array, "P L"], Bool[Array, "P"]]:
    """The place of each point by its first measurement, and whether it has one."""
    size = len(sensor.landmark)
    if count == 0:
        return jnp.zeros((0, size), z.dtype), jnp.zeros(0, bool)
    mean = jnp.asarray(sensor.free.mean, z.dtype)
    # The first measurement of each point, as a number in (T, M) flattened; `total` without one.
    slots, total = index.shape[1], index.size
    order = jnp.where(valid, jnp.arange(total).reshape(index.shape), total).reshape(-1)
    first = jnp.full(count, total).at[index.reshape(-1)].min(order)
    seen = first < total
    row = jnp.where(seen, first, 0)
    flat = z.reshape(total, -1)
    # Number t·M + m is measurement m of scan t.
    places = jax.vmap(lambda x, z: sensor.invert(x, z, mean))(path[row // slots], flat[row])
    return jnp.where(seen[:, None], places, 0.0), seen


def _check_noise(
    regular: _Regular, motion: Motion, sensor: Sensor, valid: JaxOrNumPy, fixed: bool
) -> None:
    """Raise InvalidField where a covariance has no inverse, if the values are concrete."""
    if not is_concrete((regular, valid)):
        return
    prior, of_motion, of_sensor, moving = (np.asarray(part) for part in regular)
    if not fixed and not prior:
        raise InvalidField(
            "pose_cov",
            "expected zero, which fixes the first pose, or a positive definite covariance, got a "
            "singular one",
        )
    for good, reason in (
        (of_motion, f"the noise covariance of {motion.name} is singular"),
        (
            moving,
            f"the noise of {motion.name} does not move the pose in all directions",
        ),
        (
            (of_sensor | ~np.asarray(valid)).all(axis=1),
            f"the noise covariance of {sensor.name} is singular",
        ),
    ):
        if not good.all():
            row = int(good.argmin())
            raise InvalidField("", f"{reason} at row {row}, so that it has no information")
