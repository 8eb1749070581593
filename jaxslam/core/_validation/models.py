"""Checks of models before tracing, and of the results of a user's filter, during it.

Types of records, arguments of functions, sizes of results. Each error is one line that states what
was expected.
"""

import contextlib
import traceback
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.core._names import unfit_signature
from jaxslam.core._numbers import check_array, shape_text
from jaxslam.core._reprs import with_article
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField, instance_of, require

_Shape = tuple[int, ...]
_Record = TypeVar("_Record")
_S = TypeVar("_S")

_SOUND: weakref.WeakSet[Motion | Sensor] = weakref.WeakSet()
"""Models whose sizes have been checked."""


_NEEDS_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


_PACKAGE = str(Path(__file__).parents[2])


@contextlib.contextmanager
def reworded_tracer_errors(name: str) -> Iterator[None]:
    """A context that names the line of a user's code which needs the value of a traced array.

    As a context it adds no frame between `run` and a user's model. JAX's own errors say it in
    twenty lines, and cannot be pickled: a worker of an executor could not send them.

    Raises ValueError, which begins with a name, in place of a tracer's error.
    """
    try:
        yield
    except _NEEDS_VALUES as error:
        frames = traceback.extract_tb(error.__traceback__)
        of_user = [
            frame
            for frame in frames
            if "site-packages" not in frame.filename and not frame.filename.startswith(_PACKAGE)
        ]
        last = (of_user or frames)[-1]
        raise InvalidField(
            name,
            "",
            f"{Path(last.filename).name}:{last.lineno}, in {last.name}, needs the value of an "
            "array, which is not known while JAX traces: write jnp.where or lax.cond in place of "
            "`if`, jax.numpy in place of NumPy, and no float(…)",
        ) from error


def check_models(name: str, motion: object, sensor: object) -> None:
    """Raise ValueError, which begins with a caller's name, unless these are a Motion and a Sensor.

    Their functions are evaluated on shapes alone (`jax.eval_shape`): they must take the arguments
    of `protocols` and return arrays of the sizes of their names.
    """
    if isinstance(motion, Sensor) and isinstance(sensor, Motion):
        raise InvalidField(
            name,
            "",
            f"expected a Motion, then a Sensor, got the sensor {motion.name} and the motion "
            f"{sensor.name}: they are swapped",
        )
    check_motion(name, motion)
    check_sensor(name, sensor)


def check_motion(name: str, motion: object) -> None:
    """Raise ValueError unless this is a Motion; see `check_models`."""
    motion = check_record(name, "motion", motion, Motion)
    if motion in _SOUND:
        return
    pose, u, w = _numbers(3), _numbers(len(motion.controls)), _numbers(len(motion.noises))
    _check_size(name, motion, "step", {"pose": pose, "u": u, "w": w}, (3,))
    _check_size(name, motion, "noise_cov", {"pose": pose, "u": u}, (len(motion.noises),) * 2)
    _SOUND.add(motion)


def check_sensor(name: str, sensor: object) -> None:
    """Raise ValueError unless this is a Sensor, or a suite of them; see `check_models`."""
    sensor = check_record(name, "sensor", sensor, Sensor)
    if parts := getattr(sensor, "parts", ()):  # of a suite
        for part in parts:
            check_sensor(name, part.sensor)
        return
    if sensor in _SOUND:
        return
    size_z, size_l = len(sensor.measurements), len(sensor.landmark)
    pose, z, landmark = _numbers(3), _numbers(size_z), _numbers(size_l)
    free = np.shape(sensor.free.mean)
    if len(free) != 1 or np.shape(sensor.free.cov) != free * 2:
        raise InvalidField(
            name,
            "",
            f"expected {sensor.name}.free of shapes (K,) and (K, K), got {free} and "
            f"{np.shape(sensor.free.cov)}",
        )
    _check_size(name, sensor, "observe", {"pose": pose, "l": landmark}, (size_z,))
    _check_size(name, sensor, "residual", {"z": z, "z_hat": z}, (size_z,))
    _check_size(name, sensor, "noise_cov", {"z": z}, (size_z, size_z))
    _check_size(name, sensor, "invert", {"pose": pose, "z": z, "s": _numbers(*free)}, (size_l,))
    _check_size(name, sensor, "position", {"l": landmark}, (2,))
    _SOUND.add(sensor)


def motion_model(value: object) -> Motion:
    """The check of a field: a Motion whose functions return the sizes of its names."""
    if isinstance(value, Sensor):
        raise ValueError(f"expected a Motion, got the sensor {value.name}: a motion comes first")
    motion: Motion = _sound(value, check_motion)
    return motion


def sensor_model(value: object) -> Sensor:
    """The check of a field: a Sensor, or a suite, whose functions return the sizes of its names."""
    sensor: Sensor = _sound(value, check_sensor)
    return sensor


def _sound(value: Any, check: Callable[[str, object], None]) -> Any:
    """The value, if a check by the caller's name accepts it; ValueError with its reason if not."""
    try:
        check("", value)
    except InvalidField as error:
        raise ValueError(error.reason) from None
    return value


def check_record(name: str, field: str, value: object, kind: type[_Record]) -> _Record:
    """The value, if it is such a record; InvalidField if not, as on a class that was not called."""
    record: _Record = require(name, field, value, instance_of(kind))
    return record


def _numbers(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.result_type(float))


def _check_size(
    name: str,
    model: Motion | Sensor,
    field: str,
    arguments: dict[str, jax.ShapeDtypeStruct],
    shape: _Shape,
) -> None:
    """Raise ValueError unless the model's function returns this shape for these arguments."""
    function: Callable[..., object] = getattr(model, field)
    if (signature := unfit_signature(function, len(arguments))) is not None:
        reason = f"expected {model.name}.{field} to take ({', '.join(arguments)}), got {signature}"
        raise InvalidField(name, "", reason)
    sizes = ", ".join(f"{key} {_shape_text(value.shape)}" for key, value in arguments.items())
    call = f"{model.name}.{field}({sizes})"
    try:
        result = jax.eval_shape(function, *arguments.values())
    except Exception as error:
        line = next(iter(str(error).strip().splitlines()), "")
        reason = f"{call} fails: {type(error).__name__}: {line}"
        raise InvalidField(name, "", reason) from error
    result_shape = getattr(result, "shape", None)
    if result_shape != shape:
        got = with_article(type(result).__name__)
        if result_shape is not None:
            got = f"shape {_shape_text(result_shape)}"
        reason = f"expected {call} to return shape {_shape_text(shape)}, got {got}"
        raise InvalidField(name, "", reason)
    if not jnp.issubdtype(getattr(result, "dtype", np.dtype(object)), jnp.floating):
        reason = f"expected {call} to return real numbers, got {result.dtype}"
        raise InvalidField(name, "", reason)
    dtype = next(iter(arguments.values())).dtype
    # A covariance is converted where it is used: it may be a constant of NumPy.
    if field != "noise_cov" and result.dtype != dtype:
        reason = f"expected {call} to return {dtype}, as its arguments are, got {result.dtype}"
        raise InvalidField(name, "", reason)


def _shape_text(shape: _Shape) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


_REAL = ("nis", "innovation", "innovation_cov", "log_likelihood")
"""Fields of `Info` in the dtype of the measurements."""


def same_state(name: str, before: _S, after: PyTree) -> _S:
    """The state that a filter's function returned; ValueError unless its structure is that before.

    Tree, shapes and dtypes must be the same, since the state is the carry of a `lax.scan`.
    """
    old: PyTree = jax.tree.structure(before)
    if old != jax.tree.structure(after):
        reason = f"expected a state as before, {_kind(before)}, got {_kind(after)}"
        raise InvalidField(name, "", reason)
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    unlike = [
        f"state{jax.tree_util.keystr(path)}: expected {_array(old)}, got {_array(new)}"
        for (path, old), new in pairs
        if _array(old) != _array(new)
    ]
    if unlike:
        raise InvalidField(name, "", "; ".join(unlike))
    state: _S = after
    return state


def _kind(state: PyTree) -> str:
    """The type of a state, and where its arrays are."""
    at = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(state)]
    return "an array" if at == [""] else f"{type(state).__name__} of {', '.join(at) or 'nothing'}"


def _array(leaf: ArrayLike) -> str:
    return f"{jnp.result_type(leaf)} {shape_text(leaf)}"


def state_and_info(name: str, state: _S, scan: Scan, result: object) -> tuple[_S, Info]:
    """The result of a filter's update; ValueError unless it is a state as before, and an `Info`."""
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Info)):
        got = with_article(type(result).__name__)
        if isinstance(result, tuple) and not hasattr(result, "_fields"):
            got = "(" + ", ".join(type(part).__name__ for part in result) + ")"
        raise InvalidField(name, "", f"expected update to return (state, Info), got {got}")
    info: Info = result[1]
    m, real = scan.tag.shape[0], scan.z.dtype.type
    for field, shape in {
        "nis": (m,),
        "dof": (m,),
        "slot": (m,),
        "status": (m,),
        "innovation": (m, "Z"),
        "innovation_cov": (m, "Z", "Z"),
        "log_likelihood": (),
    }.items():
        kind = real if field in _REAL else np.integer if field == "status" else np.generic
        check_array(f"{name}: update: Info.{field}", getattr(info, field), shape, kind)
    return same_state(f"{name}: update", state, result[0]), info


def checked_estimate(name: str, estimate: object, dtype: np.dtype) -> Estimate:
    """The result of a filter's estimate; ValueError unless it is an `Estimate` of N landmarks, with
    numbers of this dtype."""
    if not isinstance(estimate, Estimate):
        got = with_article(type(estimate).__name__)
        raise InvalidField(name, "", f"expected estimate to return an Estimate, got {got}")
    n = np.shape(estimate.alive)[0] if np.ndim(estimate.alive) == 1 else -1
    shapes = {"pose": (3,), "pose_cov": (3, 3), "points": (n, 2), "point_covs": (n, 2, 2)}
    for field, shape in (shapes | {"alive": (n,), "tag": (n,)}).items():
        kind = dtype.type if field in shapes else np.generic
        check_array(f"{name}: Estimate.{field}", getattr(estimate, field), shape, kind)
    return estimate
