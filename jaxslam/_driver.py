"""The driver of all filters: one `lax.scan` over a log."""

import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam._origin import (
    FAR,
    far_origin,
    holds_far_numbers,
    move_near_origin,
    shift_positions,
    to_map_coordinates,
)
from jaxslam._public import publish
from jaxslam._rounding import doubt_on_run
from jaxslam.association._rules import Known
from jaxslam.core._numbers import is_concrete, largest
from jaxslam.core._validation import (
    checked_estimate,
    log_of,
    reworded_tracer_errors,
    same_state,
    state_and_info,
)
from jaxslam.core.protocols import Filter, Wrapper
from jaxslam.core.types import Log, Scan, Status, Trace
from jaxslam.core.validation import (
    InvalidField,
    covariance,
    finite,
    instance_of,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.math._xla import hot_jit


def run(
    filter: Filter,
    log: Log,
    pose: ArrayLike,
    pose_cov: ArrayLike,
    key: jax.Array,
    *,
    probe: Callable[[PyTree], PyTree] | None = None,
) -> Trace:
    """Run a filter over a log: at each row, predict with the control, then update with the scan.

    Traceable: wrap it in `jax.jit`, `jax.vmap` over filters, logs and keys, or `jax.grad`. It is
    compiled once for a structure: another call, with other values or a filter with other noises,
    runs the same program. The arithmetic runs in the wider dtype of the log's controls and
    measurements. A valid measurement that is not finite, or beyond 4e61 (float32: 5e7), is refused
    where its value is concrete, and dropped as `Status.REJECTED` under a trace. Reverse mode
    stores one state a step, and recomputes each step in the backward pass.

    In float32, a log that starts over 1 km from the origin of its coordinates is filtered with
    positions relative to the start, if that makes no difference to the models, and the estimates
    are returned in float64, on the host: float32 could not hold them. `final` is then the state
    relative to the (x, y) of the start. This needs concrete arguments and no probe.

    Where rounding comes near the noise of the measurements (a vague start, coordinates far from the
    origin, in float32), a run outside a trace warns: it is computed again in float64, and where
    the measurements used, NIS or poses differ, the warning has the numbers.

    Args:
        filter: a record, as of `jaxslam.filters`.
        log: T rows; control (T, U), scans of M measurement slots.
        pose: (3,) where the robot is before the first control; of a motion model with E further
            numbers in its state, all 3 + E.
        pose_cov: (3, 3), or (3 + E, 3 + E), its covariance; zero is allowed.
        key: a PRNG key, split into two a step; a filter without randomness ignores them.
        probe: called with the filter's state after each update; its results are stacked.
    Returns:
        Trace with estimates and infos of leading axis T, and the final state.
    Raises:
        ValueError: on wrong shapes or kinds, and, where the values are concrete, on NaN or too
            large numbers in controls or valid measurements, tags repeated within a scan or
            beyond a known map, or an invalid pose_cov.
    Warns:
        UserWarning: on concrete ranges below 0, which a sensor writes where it met nothing. Noise
            makes few of them of landmarks that are near.
    """
    with refusals_of("run"):
        require("filter", filter, instance_of(Filter))
    # A user's transfer guard is there for loops of the user's; arguments may be on the host.
    with (
        jax.transfer_guard("allow"),
        refusals_of(f"run: {filter.name}"),
        reworded_tracer_errors(),
    ):
        with refusals_of("run"):
            check_run(filter, log, pose, pose_cov)
            require("key", key, prng_key)
        _notice_negative_ranges(filter, log.scan)
        # A new array is a tracer where a trace is active, also where all arguments are constants.
        if not is_concrete(filter, log, pose, pose_cov, key, jnp.zeros(())):
            traced: Trace = _drive_in_trace(filter, log, pose, pose_cov, key, probe)
            return traced
        origin = None
        if probe is None and jnp.result_type(log.control, log.scan.z) == jnp.float32:
            origin = far_origin(pose, least=FAR)
        near = filter if origin is None else move_near_origin(filter, origin)
        if origin is None or near is None or holds_far_numbers(log.control, origin):
            near, origin, start = filter, None, pose
        else:
            start = shift_positions(pose, -origin)
        trace = _drive_alone(near, log, start, pose_cov, key, probe)
        arguments = near, log, start, pose_cov, key
        if doubt := doubt_on_run(
            lambda *arguments: _drive_alone(*arguments, None), arguments, trace
        ):
            warnings.warn(f"run: {filter.name}: {doubt}", stacklevel=2)
        if origin is None:
            return trace
        return trace._replace(estimate=to_map_coordinates(jax.device_get(trace.estimate), origin))


def check_run(filter: Filter, log: Log, pose: ArrayLike, pose_cov: ArrayLike) -> None:
    """Raise InvalidField unless a log and a start are what `run` takes."""
    sizes = len(filter.controls), len(filter.measurements)
    require("log", log, log_of(*sizes, filter.places))
    inner = filter
    while isinstance(inner, Wrapper):
        inner = inner.filter
    by_tag = isinstance(getattr(inner, "associate", None), Known)
    size, scan = filter.map_size, log.scan
    # Of a suite the absolute sensors, whose tags mean nothing, are not told from the others here.
    if by_tag and size is not None and not filter.places and is_concrete(scan.tag, scan.valid):
        tag = np.max(np.where(scan.valid, scan.tag, -1), initial=-1)
        if tag >= size:
            raise InvalidField(
                "log",
                f"it has a measurement of landmark {tag}, the map of {filter.name} has {size}, "
                f"0 to {size - 1}; a map of some landmarks needs their tags",
            )
    require("pose", pose, finite(len(filter.robot_state)))
    require("pose_cov", pose_cov, covariance(len(filter.robot_state)))


def _notice_negative_ranges(filter: Filter, scan: Scan) -> None:
    """Warn of valid ranges below 0, where they are concrete."""
    ranges = [name.split(" ")[0] == "range" for name in filter.measurements]
    if not any(ranges) or not is_concrete(scan):
        return
    negative = np.asarray(scan.valid) & (np.asarray(scan.z)[..., ranges] < 0).any(axis=-1)
    if count := int(negative.sum()):
        row, slot = np.argwhere(negative)[0]
        warnings.warn(
            f"run: {count:,} valid measurement{'s have' if count > 1 else ' has'} a range below 0 "
            f"(first in row {row}, slot {slot}): set log.scan.valid to False where the sensor met "
            "nothing",
            stacklevel=3,
        )


def _drive(
    filter: Filter,
    log: Log,
    pose: ArrayLike,
    pose_cov: ArrayLike,
    key: jax.Array,
    probe: Callable[[PyTree], PyTree] | None,
) -> Trace:
    """The trace of a filter over a checked log."""
    # XLA before jaxlib 0.11 compiles some loops over a constant `valid` (`run` in a user's jit, the
    # log closed over) to wrong numbers.
    log = jax.lax.optimization_barrier(jax.tree.map(jnp.asarray, log))
    dtype = jnp.result_type(log.control, log.scan.z)
    tag = log.scan.tag.astype(jnp.int32)  # of any integers, unsigned ones too
    log = Log(log.control.astype(dtype), Scan(log.scan.z.astype(dtype), tag, log.scan.valid))
    most = largest(log.control)
    start = filter.init(jnp.asarray(pose, dtype), jnp.asarray(pose_cov, dtype))
    keys = jax.random.split(key, (log.control.shape[0], 2))

    def step(state: PyTree, row: tuple[Log, jax.Array]) -> tuple[PyTree, PyTree]:
        (control, scan), (key_predict, key_update) = row
        predicted = filter.predict(state, control, key_predict)
        state = same_state("predict", state, predicted)
        # Under jit values are not checked before, and a NaN would spread through the whole state.
        lost = scan.valid & ~(jnp.abs(scan.z) <= most).all(axis=1)
        scan = scan._replace(valid=scan.valid & ~lost)
        state, info = state_and_info(state, scan, filter.update(state, scan, key_update))
        status = jnp.where(lost, jnp.int32(Status.REJECTED), info.status)
        info = info._replace(status=status.astype(info.status.dtype))
        estimate = checked_estimate(filter.estimate(state), dtype)
        return state, (estimate, info, None if probe is None else probe(state))

    # XLA cannot merge the body of a scan with its recomputation, so no barrier is needed.
    body = jax.checkpoint(step, prevent_cse=False)
    final, (estimate, info, probed) = jax.lax.scan(body, start, (log, keys))
    return Trace(estimate, info, final, probed)


_drive_alone = hot_jit(_drive, static_argnames=("probe",))
# Without the wrapper of `hot_jit`, which would be a frame of every traceback in a user's model. It
# is jitted, since `jax.grad` and `jax.vmap` outside of a jit would else run it step by step.
_drive_in_trace = jax.jit(_drive, static_argnames=("probe",), inline=True)

publish("jaxslam", run)
