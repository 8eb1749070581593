"""Checks of the filters of a campaign, and of the noise and the dtype of its worlds."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import describe
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.protocols import Candidate, Estimator, Filter, Motion, Sensor
from jaxslam.core.types import Truth
from jaxslam.core.validation import Check, InvalidField, covariance, instance_of, require
from jaxslam.graphs.smoothing._forward_pass import LogEstimator
from jaxslam.math._definite import is_invertible
from jaxslam.sensors._suite import Suite
from jaxslam.simulation._worlds import World

_T = TypeVar("_T")


def check_dtype(dtype: DTypeLike | None) -> np.dtype | None:
    """The dtype of a campaign's worlds, or None; InvalidField unless JAX is set to have it."""
    if dtype is None:
        return None
    wanted = jnp.dtype(dtype)
    if wanted not in (jnp.float32, jnp.float64):
        raise InvalidField("dtype", f"expected float32 or float64, got {wanted}")
    if wanted == jnp.float64 and jnp.result_type(float) != jnp.float64:
        raise InvalidField("dtype", "float64 needs jax.config.update('jax_enable_x64', True)")
    return wanted


def cast_floats(tree: _T, dtype: DTypeLike | None) -> _T:
    """A tree whose arrays of floating-point numbers are in the dtype; None leaves them."""
    if dtype is None:
        return tree
    in_dtype: _T = jax.tree.map(
        lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree
    )
    return in_dtype


def check_noise(scenario: World) -> None:
    """Raise InvalidField if the noise of a model of the scenario is not a covariance.

    A `noise_cov` that is a function can only be looked at where it is called. That of the motion is
    called for the start and the first control; a sensor's, and each part's of a suite, for
    z = 0 and, if it is not a covariance there, for the first landmark as measured from the start.
    """
    if not is_concrete(scenario.controls, scenario.pose, scenario.landmarks):
        return
    motion = scenario.motion
    pose, control = _number(scenario.pose), _number(scenario.controls)[0]
    _check_stated(motion, len(motion.noises), pose, control)
    for model in _sensors(scenario):
        size, nothing = len(model.measurements), _number(np.zeros(len(model.measurements)))
        try:
            _check_stated(model, size, nothing)
        except ValueError:
            _check_stated(model, size, _first_measurement(model, scenario))


def without_noise(scenario: World) -> str:
    """The names of the scenario's measurements without noise; "" without such a measurement.

    Looked at where `check_noise` looks; a noise that grows from 0 with z is one.
    """
    if not is_concrete(scenario.pose, scenario.landmarks):
        return ""
    exact_sensors = []
    for model in _sensors(scenario):
        for z in (_number(np.zeros(len(model.measurements))), _first_measurement(model, scenario)):
            cov, names = np.asarray(_noise_cov(model, z)), model.measurements
            sigma = np.sqrt(np.diagonal(cov))
            exact = ", ".join(n for n, s in zip(names, sigma, strict=True) if s == 0)
            if not exact and not is_invertible(cov):
                exact = f"a combination of {', '.join(names)}"
            if not exact:
                break
        if exact:
            exact_sensors.append(f"{exact} of {model.name}")
    return " and ".join(exact_sensors)


def least_noise(scenario: World) -> float:
    """The least eigenvalue of the noise covariances of the scenario's sensors; 0 of exact ones.

    Looked at where `check_noise` looks, the larger of both places: noise may grow from 0 with z.
    """
    if not is_concrete(scenario.pose, scenario.landmarks):
        return 0.0
    least = []
    for model in _sensors(scenario):
        places = _number(np.zeros(len(model.measurements))), _first_measurement(model, scenario)
        covs = [np.asarray(_noise_cov(model, z), np.float64) for z in places]
        least.append(max(float(np.linalg.eigvalsh(cov).min(initial=np.inf)) for cov in covs))
    return max(min(least, default=0.0), 0.0)


def _sensors(scenario: World) -> list[Sensor]:
    sensor = scenario.sensor
    return [part.sensor for part in sensor.parts] if isinstance(sensor, Suite) else [sensor]


def _first_measurement(sensor: Sensor, scenario: World) -> jax.Array:
    """The first landmark as measured from the start, (Z,)."""
    landmark = _number(scenario.landmarks)[0, : len(sensor.landmark)]
    z: jax.Array = _observe(sensor, _number(scenario.pose), landmark)
    return z


@jax.jit
def _observe(sensor: Sensor, pose: jax.Array, landmark: jax.Array) -> jax.Array:
    return sensor.observe(pose, landmark)


@jax.jit
def _noise_cov(model: Motion | Sensor, *at: jax.Array) -> jax.Array:
    cov: jax.Array = model.noise_cov(*at)
    return cov


def _number(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, jnp.result_type(float))


def _check_stated(model: Motion | Sensor, size: int, *at: PyTree) -> None:
    require(f"noise_cov of {model.name}", _noise_cov(model, *at), covariance(size))


def candidate_for(scenario: World) -> Check:
    """The check of a filter for the scenario's log, or of a function of the truth."""

    def check(value: Any) -> Candidate:
        if isinstance(value, Filter):
            _check_sizes(value, scenario)
        elif isinstance(value, type) or not callable(value):
            instance_of(Filter, "; a function of the truth is taken, too")(value)
        elif not isinstance(value, LogEstimator):
            _check_function(value)
        candidate: Candidate = value
        return candidate

    return check


def _check_sizes(filter: Filter, scenario: World) -> None:
    """Raise ValueError unless a filter takes the controls, measurements and map of a scenario."""
    for field, expected, present in (
        ("controls", filter.controls, scenario.motion.controls),
        ("measurements", filter.measurements, scenario.sensor.measurements),
    ):
        # An entry without a unit fits any.
        pairs = zip(expected, present, strict=False)
        units = [{split_unit(a)[1], split_unit(b)[1]} for a, b in pairs]
        fit = all(len(pair) == 1 or None in pair for pair in units)
        if len(expected) != len(present) or not fit:
            raise ValueError(
                f"it takes {field} ({', '.join(expected)}), the scenario {scenario.name} gives "
                f"({', '.join(present)})"
            )
    size, count = filter.map_size, np.shape(scenario.landmarks)[0]
    if size is not None and size != count:
        raise ValueError(
            f"it has a map of {size} landmarks, the scenario {scenario.name} has {count}; a map of "
            "some of them needs their tags"
        )


def _check_function(candidate: Callable[..., object]) -> None:
    """Raise ValueError on a factory of filters in place of what it returns, and on a function of
    other arguments than the truth."""
    parameters = list(inspect.signature(candidate).parameters.values())
    if parameters:
        first = parameters[0]
        ours = (getattr(candidate, "__module__", None) or "").partition(".")[0] == "jaxslam"
        named = first.name in ("motion", "sensor", "robots", "scenario", "world")
        if (ours and named) or first.annotation in (Motion, Sensor, World):
            raise ValueError(f"it is a factory of ({first.name}, …): call it")
    try:
        inspect.signature(candidate).bind(None)
    except TypeError:
        listed = ", ".join(parameter.name for parameter in parameters)
        if listed != "log, key":
            raise ValueError(f"it is a factory of ({listed}): call it") from None
        raise ValueError(
            "expected a function of the truth alone; a function of (log, key) is given as "
            "lambda truth: estimator"
        ) from None


def method_of(candidate: Candidate, truth: Truth) -> Filter | Estimator:
    """A filter or an estimator: a candidate, or its result for the truth.

    Raises InvalidField where it fails on the truth, as a function of the world.
    """
    if isinstance(candidate, Filter | LogEstimator):
        return candidate
    try:
        method: Filter | Estimator = candidate(truth)
    except AttributeError as error:
        name = getattr(getattr(candidate, "function", candidate), "__name__", str(candidate))
        raise InvalidField(
            "filters",
            f"{name} was called with the truth (poses and landmarks) and fails: {error}; of a "
            f"function of the scenario give what it returns, {name}(scenario)",
        ) from error
    if not callable(method) and not isinstance(method, Filter):
        reason = "expected a function of the truth to return a filter or an estimator, got "
        raise InvalidField("filters", reason + describe(method))
    return method
