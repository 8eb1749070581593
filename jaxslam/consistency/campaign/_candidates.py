"""Checks of the filters of a campaign, and the number of runs that fit a device."""

import inspect
from collections.abc import Callable, Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam._driver import run
from jaxslam.charts import Euclidean
from jaxslam.consistency._measures.observability import monitor_of
from jaxslam.core._numbers import check_covariance, is_concrete
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.protocols import Candidate, Chart, Estimator, Filter, Motion, Sensor
from jaxslam.core.types import Log, Trace, Truth
from jaxslam.core.validation import InvalidField
from jaxslam.graphs.smoothing._forward_pass import LogEstimator
from jaxslam.math._definite import invertible
from jaxslam.sensors._suite import Suite
from jaxslam.simulation._worlds import World

_T = TypeVar("_T")


def fitting_block(scenario: World, filters: Mapping[str, Candidate], device: jax.Device) -> int:
    """The number of runs computed together on a device: 16 on a CPU, whose caches they fit.

    On an accelerator as many as take a quarter of its memory, counting a run's world and what the
    first filter makes of it, which the scores read several times over: a power of two from 32 on,
    4096 at most, and 1024 where the device does not tell its memory.
    """
    if device.platform == "cpu":
        return 16
    room = (device.memory_stats() or {}).get("bytes_limit")
    if room is None:
        return 1024

    def one(key: jax.Array) -> PyTree:
        truth, log = scenario.draw(key)
        method, _ = estimator_of(next(iter(filters.values())), truth, scenario)
        trace = method(log, key)
        return truth, log, trace.estimate, trace.info

    shapes = jax.tree.leaves(jax.eval_shape(one, jax.random.key(0)))
    each = sum(leaf.size * leaf.dtype.itemsize for leaf in shapes)
    return int(np.clip(2 ** int(np.log2(max(room / 4 / each, 1.0))), 32, 4096))


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


def rounded(tree: _T, dtype: DTypeLike | None) -> _T:
    """The same arrays, those of floating-point numbers in the dtype; None leaves them."""
    if dtype is None:
        return tree
    out: _T = jax.tree.map(
        lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree
    )
    return out


def check_noise(scenario: World) -> None:
    """Raise ValueError if the noise of a model of the scenario is not a covariance.

    A `noise_cov` that is a function can only be looked at where it is called. That of the motion is
    called for the start and the first control, that of a sensor, or of each part of a suite, for
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
    found = []
    for model in _sensors(scenario):
        for z in (_number(np.zeros(len(model.measurements))), _first_measurement(model, scenario)):
            exact = _exact(model, np.asarray(_noise_cov(model, z)))
            if not exact:
                break
        if exact:
            found.append(f"{exact} of {model.name}")
    return " and ".join(found)


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


def _exact(sensor: Sensor, cov: np.ndarray) -> str:
    """The measurements of variance 0; a combination of them if no single one has variance 0."""
    sigma = np.sqrt(np.diagonal(cov))
    if (sigma == 0).any():
        return ", ".join(n for n, one in zip(sensor.measurements, sigma, strict=True) if one == 0)
    return "" if invertible(cov) else f"a combination of {', '.join(sensor.measurements)}"


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
    for what, taken, given in (
        ("controls", candidate.controls, scenario.motion.controls),
        ("measurements", candidate.measurements, scenario.sensor.measurements),
    ):
        if len(taken) != len(given) or not all(map(_one_unit, taken, given)):
            raise ValueError(
                f"monte_carlo: filter {name} takes {what} ({', '.join(taken)}), "
                f"the scenario {scenario.name} gives ({', '.join(given)})"
            )

    size, count = candidate.map_size, np.shape(scenario.landmarks)[0]
    if size is not None and size != count:
        raise ValueError(
            f"monte_carlo: filter {name} has a map of {size} landmarks, the scenario "
            f"{scenario.name} has {count}; a map of some of them needs their tags"
        )


def _one_unit(name: str, other: str) -> bool:
    """Whether two names have the same unit; True where either has none."""
    units = {split_unit(each)[1] for each in (name, other)}
    return len(units) == 1 or None in units


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
        made: Filter | Estimator = candidate(truth)
    except AttributeError as error:
        name = getattr(getattr(candidate, "function", candidate), "__name__", str(candidate))
        raise ValueError(
            f"monte_carlo: {name} was called with the truth (poses and landmarks) and fails: "
            f"{error}; of a function of the scenario give what it returns, {name}(scenario)"
        ) from error
    if not callable(made) and not isinstance(made, Filter):
        raise ValueError(
            "monte_carlo: expected a function of the truth to return a filter or an estimator, got "
            f"{type(made).__name__}"
        )
    return made


def estimator_of(candidate: Candidate, truth: Truth, scenario: World) -> tuple[Estimator, Chart]:
    """The estimator that a candidate is, and the chart of its errors.

    Its probe is the information in the filter's observability monitor, where it has one.
    """
    method = method_of(candidate, truth)
    if not isinstance(method, Filter):
        return method, Euclidean()
    check_fits(method.name, method, scenario)

    def drive(log: Log, key: jax.Array) -> Trace:
        return run(method, log, scenario.pose, scenario.pose_cov, key, probe=_gained)

    return drive, getattr(method, "chart", Euclidean())


def _gained(state: PyTree) -> jax.Array | None:
    monitor = monitor_of(state)
    return None if monitor is None else monitor.information
