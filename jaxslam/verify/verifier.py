"""`verify_jacobians`: what is looked at, in which order, and the report."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.experimental
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.math.xla import quick_jit
from jaxslam.protocols import Motion, Sensor
from jaxslam.verify import properties, samples, subject
from jaxslam.verify.jacobians import Evaluated, evaluate
from jaxslam.verify.judge import judge
from jaxslam.verify.linearity import motion_linearity, sensor_linearity
from jaxslam.verify.record import Check, Report
from jaxslam.verify.samples import Samples
from jaxslam.verify.trouble import told

MOUNT = (0.4, -0.3, 0.9)
"""Where `build` puts a sensor: off the robot's centre, or half of its Jacobian is not seen."""

TOLERANCE = 1e-12
FLOAT32_TOLERANCE = 1e-5


def verify_jacobians(
    model: Motion | Sensor | Callable[..., jax.Array],
    jacobian: Callable[..., Any] | None = None,
    *,
    arguments: Mapping[str, Sequence[str] | int] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[ArrayLike] | None = None,
    name: str | None = None,
    count: int = 24,
    seed: int = 0,
    tolerance: float = TOLERANCE,
    float32_tolerance: float = FLOAT32_TOLERANCE,
) -> Report:
    """Hold the Jacobians of a model, by every argument, against each other.

    At each sampled state: `jax.jacfwd`, `jax.jacrev`, the hand-derived one where there is one, and
    difference quotients in float64 (Ridders' extrapolation with its error estimate; the complex
    step where the function is analytic). States: random ones and the hard ones, by the units of
    the arguments: across the ±π seam, landmark close to and at the robot and the sensor, zero rate,
    zero inverse depth, coordinates of 1e5 m, zero control. Differences are relative to the largest
    entry of the Jacobian's row; angles are compared on the circle. In float32, autodiff and hand
    are compared again.

    Beside Jacobians: values and derivatives finite everywhere, purity, jit and vmap, dtypes, noise
    covariances, and of sensors the residual and the round trips of `invert`.

    Runs in float64 whatever JAX is set to, and leaves that as it was. Nothing in the model makes it
    raise: a model that does not trace, raises or returns the wrong shape is reported, with the line
    in its file, and whatever can still be checked is.

    Args:
        model: a `Motion`, a `Sensor`, or a pure function of vectors.
        jacobian: for a function: its claimed Jacobian. Called with the function's arguments it
            returns a tuple of one (m, n_k) array an argument (None: no claim), or one array: by the
            first argument, or by all of them side by side. Models bring their own.
        arguments: for a function: the entries of its arguments, named with units, as in
            {"pose": ("x [m]", "y [m]", "theta [rad]")}, or only their number. Parameters called
            pose, frame, landmark, l or point need not be given.
        outputs: for a function: the names of its outputs with units; [rad] is on the circle.
        states: your own states, one array (S, n_k) an argument, instead of the sampled ones. For a
            sensor those of `observe`.
        name: for a function: what to call it, default its own name.
        count: random states.
        seed: of the random states.
        tolerance, float32_tolerance: relative, of autodiff and hand against each other.
    Returns:
        A `Report`: `passed`, `findings`, `checks`, `as_dict()`, and text when printed.
    Raises:
        ValueError: if the arguments of a function have no known size, states have the wrong shape,
            or count or a tolerance is not positive.
    """
    if not tolerance > 0 or not float32_tolerance > 0:
        raise ValueError("verify_jacobians: expected tolerances above 0")
    examined = examine(
        model,
        jacobian,
        arguments=arguments,
        outputs=outputs,
        states=states,
        name=name,
        count=count,
        seed=seed,
    )
    with np.errstate(all="ignore"):
        findings = [
            finding
            for evaluated in examined.evaluated
            for finding in judge(evaluated, tolerance, float32_tolerance)
        ]
    with _float64():
        bend = _typical_linearity(model, examined)
    return Report(examined.name, examined.kind, tuple(findings), examined.checks, bend)


class Examined(NamedTuple):
    """What `verify_jacobians` computes before it judges."""

    kind: str
    name: str
    evaluated: tuple[Evaluated, ...]
    checks: tuple[Check, ...]


def examine(
    model: Motion | Sensor | Callable[..., jax.Array],
    jacobian: Callable[..., Any] | None = None,
    *,
    arguments: Mapping[str, Sequence[str] | int] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[ArrayLike] | None = None,
    name: str | None = None,
    count: int = 24,
    seed: int = 0,
) -> Examined:
    """All Jacobians of a model at all states, and the other checks; as `verify_jacobians`."""
    if count < 2:
        raise ValueError(f"verify_jacobians: expected count >= 2, got {count}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"verify_jacobians: expected a seed between 0 and 2³²-1, got {seed}")
    if not (isinstance(model, Motion | Sensor) or callable(model)):
        raise ValueError(
            "verify_jacobians: expected a Motion, a Sensor or a function of vectors, got "
            f"{type(model).__name__}"
        )
    if not (jacobian is None or callable(jacobian)):
        raise ValueError(
            f"verify_jacobians: expected jacobian to be a function, got {type(jacobian).__name__}"
        )
    functions: tuple[subject.Function, ...]
    if isinstance(model, Motion):
        kind, name, functions = "motion", model.name, subject.motion_functions(model)
    elif isinstance(model, Sensor):
        kind, name, functions = "sensor", model.name, subject.sensor_functions(model)
    else:
        function = subject.plain_function(model, jacobian, arguments, outputs, name)
        kind, name, functions = "function", function.name, (function,)
    given = None if states is None else _given(functions[0], states)
    with _float64(), np.errstate(all="ignore"):
        drawn = _drawn(functions, model, count, seed)
        if given is not None:
            drawn = (given, *drawn[1:])
        evaluated = tuple(evaluate(f, sampled) for f, sampled in zip(functions, drawn, strict=True))
        checks: list[Check] = []
        for one in evaluated:
            checks += [*one.checks, *properties.of_function(one)]
            if kind != "function":
                checks += properties.of_model_function(one)
        checks += _of_model(model, drawn)
    return Examined(kind, name, evaluated, tuple(checks))


def build(factory: Callable[..., Motion] | Callable[..., Sensor]) -> Motion | Sensor:
    """A model of a factory like those of the registries, for verification: noise 0.01 I, and a
    sensor mounted off the robot's centre."""
    probe = factory(lambda *_: None)
    size = len(probe.noises if isinstance(probe, Motion) else probe.measurements)
    mounted = {"mount": MOUNT} if "mount" in inspect.signature(factory).parameters else {}
    return factory(0.01 * np.eye(size), **mounted)


def _of_model(model: Any, drawn: tuple[Samples, ...]) -> Iterator[Check]:
    try:
        if isinstance(model, Motion):
            yield from properties.of_motion(model, drawn[0])
        elif isinstance(model, Sensor):
            yield from properties.of_sensor(model, *drawn)
    except (Exception, SystemExit) as error:
        yield Check("the rest of the checks", False, told(error))


def _typical_linearity(model: Any, examined: Examined) -> float | None:
    """The median over the random states, for standard deviations by the units; None if it fails."""
    if not isinstance(model, Motion | Sensor):
        return None
    first = examined.evaluated[0]
    usual = [i for i, label in enumerate(first.samples.labels) if label == "random"]
    states = tuple(a[usual] for a in first.samples.values)
    spread = [np.array([_spread(e) for e in a.entries]) for a in first.function.arguments]

    def index(*state: jax.Array) -> jax.Array:
        if isinstance(model, Motion):
            return motion_linearity(model, state[0], state[1], np.diag(spread[0]) ** 2).hessian
        cov = np.diag(np.concatenate(spread)) ** 2
        return sensor_linearity(model, state[0], state[1], cov).hessian

    try:
        return float(np.median(np.asarray(quick_jit(jax.vmap(index))(*states))))
    except (Exception, SystemExit):  # what is wrong with the model is in the checks
        return None


def _spread(entry: str) -> float:
    return 0.05 if entry.endswith(("[rad]", "[1/m]")) else 0.1


def _drawn(
    functions: tuple[subject.Function, ...], model: Any, count: int, seed: int
) -> tuple[Samples, ...]:
    if isinstance(model, Sensor):
        try:
            return samples.of_sensor(model, count, seed)
        except (
            Exception,
            SystemExit,
        ):  # a sensor whose `embed` fails is tried at states drawn by units alone
            pass
    return tuple(samples.of_arguments(f.arguments, count, seed) for f in functions)


def _given(function: subject.Function, states: Sequence[ArrayLike]) -> Samples:
    tables = [np.asarray(table, np.float64) for table in states]
    wanted = [len(argument.entries) for argument in function.arguments]
    shapes = [table.shape for table in tables]
    fits = len(tables) == len(wanted) and all(
        table.shape == (len(tables[0]), n) for table, n in zip(tables, wanted, strict=True)
    )
    if not fits or len(tables[0]) == 0:
        expected = ", ".join(f"(S, {n})" for n in wanted)
        raise ValueError(f"verify_jacobians: expected states of shapes {expected}, got {shapes}")
    return Samples(tuple(tables), ("given",) * len(tables[0]))


def _float64() -> AbstractContextManager[Any]:
    """JAX in 64 bits, for this thread and until the block ends."""
    home: Any = jax if hasattr(jax, "enable_x64") else jax.experimental  # from jax 0.8, before
    context: AbstractContextManager[Any] = home.enable_x64(True)
    return context
