"""Checks of models before tracing, and of the results of a user's filter, during it.

Types of records, arguments of functions, sizes of results. Each error is one line that states what
was expected.
"""

import contextlib
import sysconfig
import traceback
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.core._names import unfit_signature
from jaxslam.core._reprs import shape_text, with_article
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField, array_of, instance_of, require

_Shape = tuple[int, ...]
_S = TypeVar("_S")

_SOUND: weakref.WeakSet[Motion | Sensor] = weakref.WeakSet()
"""Models whose sizes have been checked."""


_NEEDS_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


_LIBRARIES = (
    str(Path(__file__).parents[2]),  # this package
    str(Path(jax.__file__).parent),
    sysconfig.get_path("stdlib"),  # as `dataclasses`, whose `replace` makes a user's record
    "<",  # code without a file, as the __init__ of a dataclass
)


@contextlib.contextmanager
def reworded_tracer_errors() -> Iterator[None]:
    """A context that names the line of a user's code which needs the value of a traced array.

    As a context it adds no frame between `run` and a user's model. JAX's own errors say it in
    twenty lines, and cannot be pickled: a worker of an executor could not send them.

    Raises InvalidField, without a field, in place of a tracer's error.
    """
    try:
        yield
    except _NEEDS_VALUES as error:
        place = _place_in_user_code(error)
        raise InvalidField("", f"{place}, {_NEEDS_VALUES_HINT}") from error


_NEEDS_VALUES_HINT = (
    "needs the value of an array, which is not known while JAX traces: write jnp.where or lax.cond "
    "in place of `if`, jax.numpy in place of NumPy, and no float(…)"
)


def is_user_file(filename: str) -> bool:
    """Whether a source file is the user's own, not a library's."""
    return not (filename.startswith(_LIBRARIES) or "site-packages" in filename)


def _place_in_user_code(error: Exception) -> str:
    """The innermost line of a user's code in a traceback, as "camp.py:12, in observe"."""
    frames = traceback.extract_tb(error.__traceback__)
    of_user = [frame for frame in frames if is_user_file(frame.filename)]
    last = (of_user or frames)[-1]
    return f"{Path(last.filename).name}:{last.lineno}, in {last.name}"


def check_models(motion: object, sensor: object) -> None:
    """Raise InvalidField unless these are a Motion and a Sensor, see `motion_model`."""
    if isinstance(motion, Sensor) and isinstance(sensor, Motion):
        raise InvalidField(
            "",
            f"expected a Motion, then a Sensor, got the sensor {motion.name} and the motion "
            f"{sensor.name}: they are swapped",
        )
    require("motion", motion, motion_model)
    require("sensor", sensor, sensor_model)


def motion_model(value: object) -> Motion:
    """The check of a Motion whose functions return the sizes of its names.

    They are evaluated on shapes alone (`jax.eval_shape`): they must take the arguments of
    `protocols` and return arrays of these sizes.
    """
    if isinstance(value, Sensor):
        raise ValueError(f"expected a Motion, got the sensor {value.name}: a motion comes first")
    motion: Motion = instance_of(Motion)(value)
    if motion not in _SOUND:
        size = len(motion.state)
        robot = {"pose" if size == 3 else "robot": _numbers(size)}
        u, w = _numbers(len(motion.controls)), _numbers(len(motion.noises))
        _check_size(motion, "step", {**robot, "u": u, "w": w}, (size,))
        _check_size(motion, "noise_cov", {**robot, "u": u}, (len(motion.noises),) * 2)
        _SOUND.add(motion)
    return motion


def sensor_model(value: object) -> Sensor:
    """The check of a Sensor, or a suite, whose functions return the sizes of its names."""
    sensor: Sensor = instance_of(Sensor)(value)
    if parts := getattr(sensor, "parts", ()):  # of a suite
        for part in parts:
            sensor_model(part.sensor)
        return sensor
    if sensor in _SOUND:
        return sensor
    size_z, size_l = len(sensor.measurements), len(sensor.landmark)
    robot = {"robot" if sensor.robot else "pose": _numbers(3 + len(sensor.robot))}
    z, landmark = _numbers(size_z), _numbers(size_l)
    free = np.shape(sensor.free.mean)
    if len(free) != 1 or np.shape(sensor.free.cov) != free * 2:
        raise ValueError(
            f"expected {sensor.name}.free of shapes (K,) and (K, K), got {free} and "
            f"{np.shape(sensor.free.cov)}",
        )
    _check_size(sensor, "observe", {**robot, "l": landmark}, (size_z,))
    _check_size(sensor, "residual", {"z": z, "z_hat": z}, (size_z,))
    _check_size(sensor, "noise_cov", {"z": z}, (size_z, size_z))
    _check_size(sensor, "invert", {**robot, "z": z, "s": _numbers(*free)}, (size_l,))
    _check_size(sensor, "position", {"l": landmark}, (2,))
    _SOUND.add(sensor)
    return sensor


def _numbers(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.result_type(float))


def _check_size(
    model: Motion | Sensor,
    method: str,
    arguments: dict[str, jax.ShapeDtypeStruct],
    shape: _Shape,
) -> None:
    """Raise ValueError unless the model's method returns this shape for these arguments."""
    function: Callable[..., object] = getattr(model, method)
    if (signature := unfit_signature(function, len(arguments))) is not None:
        takes = f"{model.name}.{method} to take ({', '.join(arguments)})"
        raise ValueError(f"expected {takes}, got {signature}")
    sizes = ", ".join(f"{key} {_shape_text(value.shape)}" for key, value in arguments.items())
    call = f"{model.name}.{method}({sizes})"
    try:
        result = jax.eval_shape(function, *arguments.values())
    except Exception as error:
        line = next(iter(str(error).strip().splitlines()), "")
        why = f"{type(error).__name__}: {line}"
        if isinstance(error, _NEEDS_VALUES):
            why = f"it {_NEEDS_VALUES_HINT}"
        raise InvalidField("", f"{call} fails at {_place_in_user_code(error)}: {why}") from error
    result_shape = getattr(result, "shape", None)
    if result_shape != shape:
        got = with_article(type(result).__name__)
        if result_shape is not None:
            got = f"shape {_shape_text(result_shape)}"
        raise ValueError(f"expected {call} to return shape {_shape_text(shape)}, got {got}")
    if not jnp.issubdtype(getattr(result, "dtype", np.dtype(object)), jnp.floating):
        raise ValueError(f"expected {call} to return real numbers, got {result.dtype}")
    dtype = next(iter(arguments.values())).dtype
    # A covariance is converted where it is used: it may be a constant of NumPy.
    if method != "noise_cov" and result.dtype != dtype:
        raise ValueError(
            f"expected {call} to return {dtype}, as its arguments are, got {result.dtype}"
        )


def _shape_text(shape: _Shape) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


_REAL = ("nis", "innovation", "innovation_cov", "log_likelihood")
"""Fields of `Info` in the dtype of the measurements."""


def same_state(method: str, before: _S, after: PyTree) -> _S:
    """The state that a filter's method returned; InvalidField unless its structure is as before.

    Tree, shapes and dtypes must be the same, since the state is the carry of a `lax.scan`.
    """
    old: PyTree = jax.tree.structure(before)
    if old != jax.tree.structure(after):
        reason = f"expected a state as before, {_kind(before)}, got {_kind(after)}"
        raise InvalidField(method, reason)
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    unlike = [
        f"state{jax.tree_util.keystr(path)}: expected {_array(old)}, got {_array(new)}"
        for (path, old), new in pairs
        if _array(old) != _array(new)
    ]
    if unlike:
        raise InvalidField(method, "; ".join(unlike))
    state: _S = after
    return state


def _kind(state: PyTree) -> str:
    """The type of a state, and where its arrays are."""
    at = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(state)]
    return "an array" if at == [""] else f"{type(state).__name__} of {', '.join(at) or 'nothing'}"


def _array(leaf: ArrayLike) -> str:
    return f"{jnp.result_type(leaf)} {shape_text(leaf)}"


def state_and_info(state: _S, scan: Scan, result: object) -> tuple[_S, Info]:
    """A filter's result of update; InvalidField unless it is a state as before, and an `Info`."""
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Info)):
        got = with_article(type(result).__name__)
        if isinstance(result, tuple) and not hasattr(result, "_fields"):
            got = "(" + ", ".join(type(part).__name__ for part in result) + ")"
        raise InvalidField("", f"expected update to return (state, Info), got {got}")
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
        require(f"update: Info.{field}", getattr(info, field), array_of(*shape, kind=kind))
    return same_state("update", state, result[0]), info


def checked_estimate(estimate: object, dtype: np.dtype) -> Estimate:
    """A filter's result of estimate; InvalidField unless it is an `Estimate` of N landmarks, with
    numbers of this dtype."""
    if not isinstance(estimate, Estimate):
        got = with_article(type(estimate).__name__)
        raise InvalidField("", f"expected estimate to return an Estimate, got {got}")
    n = np.shape(estimate.alive)[0] if np.ndim(estimate.alive) == 1 else -1
    shapes = {"pose": (3,), "pose_cov": (3, 3), "points": (n, 2), "point_covs": (n, 2, 2)}
    if (further := estimate.further) is not None:
        e = np.shape(further)[-1:]
        shapes |= {"further": e, "further_cov": e * 2}
    for field, shape in (shapes | {"alive": (n,), "tag": (n,)}).items():
        kind = dtype.type if field in shapes else np.generic
        require(f"Estimate.{field}", getattr(estimate, field), array_of(*shape, kind=kind))
    return estimate
