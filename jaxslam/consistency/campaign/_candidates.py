"""Checks of the filters of a campaign, and of the noise and the dtype of its worlds."""

import inspect
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import check_covariance, is_concrete
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.protocols import Candidate, Estimator, Filter, Motion, Sensor
from jaxslam.core.types import Truth
from jaxslam.core.validation import InvalidField
from jaxslam.graphs.smoothing._forward_pass import LogEstimator
from jaxslam.math._definite import invertible
from jaxslam.sensors._suite import Suite
from jaxslam.simulation._worlds import World

_T = TypeVar("_T")


def check_dtype(dtype: DTypeLike | None) -> np.dtype | None:
    """The dtype of a campaign's worlds, or None; ValueError unless JAX is set to have it."""
    if dtype is None:
        return None
    wanted = jnp.dtype(dtype)
    if wanted not in (jnp.float32, jnp.float64):
        raise ValueError(f"monte_carlo: expected a dtype float32 or float64, got {wanted}")
    if wanted == jnp.float64 and jnp.result_type(float) != jnp.float64:
        raise ValueError("monte_carlo: float64 needs jax.config.update('jax_enable_x64', True)")
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
    """Raise ValueError if the noise of a model of the scenario is not a covariance.

    A `noise_cov` that is a function can only be looked at where it is called. That of the motion is
    called for the start and the first control; a sensor's, and each part's of a suite, for
    z = 0 and, if it is not a covariance there, for the first landmark as measured from the start.
    """
    if not is_concrete(scenario.controls, scenario.pose, scenario.landmarks):
        return
    motion = scenario.motion
    pose, control = _number(scenario.pose), _number(scenario.controls)[0]
    _check_stated(motion.name, len(motion.noises), motion, pose, control)
    for model in _sensors(scenario):
        size, nothing = len(model.measurements), _number(np.zeros(len(model.measurements)))
        try:
            _check_stated(model.name, size, model, nothing)
        except ValueError:
            _check_stated(model.name, size, model, _first_measurement(model, scenario))


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
            if not exact and not invertible(cov):
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


def _check_stated(name: str, size: int, model: Motion | Sensor, *at: PyTree) -> None:
    try:
        check_covariance(name, _noise_cov(model, *at), size)
    except InvalidField as error:
        raise InvalidField("monte_carlo", f"noise_cov of {name}", error.reason) from None


def check_fits(name: str, candidate: Candidate, scenario: World) -> None:
    """Raise ValueError unless a candidate fits the scenario's log."""
    if isinstance(candidate, LogEstimator):
        return
    if isinstance(candidate, type):
        got = f"the class {candidate.__name__}: call it"
        raise ValueError(f"monte_carlo: expected {name} to be a filter, got {got}")
    if not isinstance(candidate, Filter):
        if not callable(candidate):
            raise ValueError(
                f"monte_carlo: expected {name} to be a Filter or a function of the truth, got "
                f"{type(candidate).__name__}"
            )
        check_called(name, candidate)
        try:
            inspect.signature(candidate).bind(None)
        except TypeError:
            parameters = ", ".join(inspect.signature(candidate).parameters)
            if parameters != "log, key":
                raise ValueError(
                    f"monte_carlo: {name!r} is a factory: call it, {name}({parameters})"
                ) from None
            raise ValueError(
                f"monte_carlo: expected {name} to be a function of the truth alone; a function of "
                "(log, key) is given as lambda truth: estimator"
            ) from None
        return
    for field, expected, present in (
        ("controls", candidate.controls, scenario.motion.controls),
        ("measurements", candidate.measurements, scenario.sensor.measurements),
    ):
        # An entry without a unit fits any.
        pairs = zip(expected, present, strict=False)
        units = [{split_unit(a)[1], split_unit(b)[1]} for a, b in pairs]
        fit = all(len(pair) == 1 or None in pair for pair in units)
        if len(expected) != len(present) or not fit:
            raise ValueError(
                f"monte_carlo: filter {name} takes {field} ({', '.join(expected)}), "
                f"the scenario {scenario.name} gives ({', '.join(present)})"
            )

    size, count = candidate.map_size, np.shape(scenario.landmarks)[0]
    if size is not None and size != count:
        raise ValueError(
            f"monte_carlo: filter {name} has a map of {size} landmarks, the scenario "
            f"{scenario.name} has {count}; a map of some of them needs their tags"
        )


def check_called(name: str, candidate: Callable[..., object]) -> None:
    """Raise ValueError if a candidate is a factory of filters instead of what one returns."""
    first = next(iter(inspect.signature(candidate).parameters.values()), None)
    if first is None:
        return
    ours = (getattr(candidate, "__module__", None) or "").partition(".")[0] == "jaxslam"
    named = first.name in ("motion", "sensor", "robots", "scenario", "world")
    if (ours and named) or first.annotation in (Motion, Sensor, World):
        raise ValueError(f"monte_carlo: {name!r} is a factory: call it, {name}({first.name}, …)")


def method_of(candidate: Candidate, truth: Truth) -> Filter | Estimator:
    """A filter or an estimator: a candidate, or its result for the truth.

    Raises ValueError where it fails on the truth, as a function of the world.
    """
    if isinstance(candidate, Filter | LogEstimator):
        return candidate
    try:
        method: Filter | Estimator = candidate(truth)
    except AttributeError as error:
        name = getattr(getattr(candidate, "function", candidate), "__name__", str(candidate))
        raise ValueError(
            f"monte_carlo: {name} was called with the truth (poses and landmarks) and fails: "
            f"{error}; of a function of the scenario give what it returns, {name}(scenario)"
        ) from error
    if not callable(method) and not isinstance(method, Filter):
        raise ValueError(
            "monte_carlo: expected a function of the truth to return a filter or an estimator, got "
            f"{type(method).__name__}"
        )
    return method
