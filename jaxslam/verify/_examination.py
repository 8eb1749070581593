"""All Jacobians of a model at all states, with the other checks, in float64."""

import contextlib
import copy
from collections.abc import Callable, Iterator
from typing import TypeAlias

import jax
import numpy as np

from jaxslam.core._record import set_field
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.graphs import Factor
from jaxslam.laser.grids.beam_models import BeamModel
from jaxslam.math._arrays import float64
from jaxslam.math._xla import quick_jit
from jaxslam.verify import _properties as properties
from jaxslam.verify._findings import Check
from jaxslam.verify._finite import singular_notes
from jaxslam.verify._inputs import samples
from jaxslam.verify._inputs.functions import Function, motion_functions, sensor_functions
from jaxslam.verify._inputs.samples import Samples
from jaxslam.verify._jacobians import Evaluated, evaluate_jacobians
from jaxslam.verify._loops import has_loop, limit_loops
from jaxslam.verify._user_errors import describe_error
from jaxslam.verify.linearity import motion_linearity, sensor_linearity

Model: TypeAlias = Motion | Sensor | Factor | BeamModel | Callable[..., jax.Array]


def examine(
    model: Model,
    functions: tuple[Function, ...],
    states: Samples | None = None,
    count: int = 24,
    seed: int = 0,
) -> tuple[tuple[Evaluated, ...], tuple[Check, ...], tuple[str, ...], float | None]:
    """Evaluate all Jacobians of a model, and run the other checks, in float64.

    Args:
        model: a `Motion`, a `Sensor`, or a function.
        functions: of the model, as from `functions_of`.
        states: of the first function, instead of samples.
        count, seed: of the random states.
    Returns:
        The Jacobians of each function, the other checks, the notes (a missing mode of
        differentiation, loops, where a function of places is not finite), and the linearity index.
    """
    with float64(), np.errstate(all="ignore"):
        model = _with_limited_loops(model, functions)
        sampled: tuple[Samples, ...] = ()
        if isinstance(model, Sensor):
            with contextlib.suppress(Exception, SystemExit):
                sampled = samples.sensor_samples(model, count, seed)
        if not sampled:  # states drawn by units alone, also of a sensor whose `embed` fails
            sampled = tuple(samples.argument_samples(f.arguments, count, seed) for f in functions)
        if states is not None:
            sampled = (states, *sampled[1:])
            if isinstance(model, Sensor) and model.landmark:
                # Where `observe` fails, its own checks say so, and `invert` keeps its samples.
                with contextlib.suppress(Exception, SystemExit):
                    sampled = (states, samples.inverse_samples(model, states, sampled[1]))
        evaluated = tuple(
            evaluate_jacobians(*pair) for pair in zip(functions, sampled, strict=True)
        )
        checks: list[Check] = []
        for e in evaluated:
            checks += [*e.checks, *properties.function_checks(e)]
            if isinstance(model, Motion | Sensor | BeamModel):
                checks += properties.dtype_checks(e)
        if all(e.values is not None for e in evaluated):  # else they fail for the same reason
            checks += _model_checks(model, tuple(e.samples for e in evaluated))
        notes = [note for e in evaluated for note in e.notes]
        if states is None and not isinstance(model, Motion | Sensor):
            notes += [note for e in evaluated for note in singular_notes(e)]
        linearity = _typical_linearity(model, evaluated[0])
    return evaluated, tuple(checks), tuple(notes), linearity


def functions_of(model: Motion | Sensor) -> tuple[Function, ...]:
    """The functions of a model whose Jacobians are verified."""
    return motion_functions(model) if isinstance(model, Motion) else sensor_functions(model)


def _with_limited_loops(model: Model, functions: tuple[Function, ...]) -> Model:
    """A model whose functions have `while` loops, with these limited; any other as it is."""
    if not isinstance(model, Motion | Sensor):
        return model
    looping = []
    for function in functions:
        sizes = [len(argument.entries) for argument in function.arguments]
        with contextlib.suppress(Exception, SystemExit):  # other checks report what fails
            if has_loop(jax.make_jaxpr(function.call)(*map(np.ones, sizes)).jaxpr):
                looping.append(function)
    model = copy.copy(model) if looping else model
    for function in looping:
        set_field(model, function.name, limit_loops(function.call))
    return model


def _model_checks(model: Model, sampled: tuple[Samples, ...]) -> Iterator[Check]:
    """The checks of a motion model or a sensor as a whole."""
    try:
        if isinstance(model, Motion):
            yield from properties.motion_checks(model, sampled[0])
        elif isinstance(model, Sensor):
            yield from properties.sensor_checks(model, *sampled)
    except (Exception, SystemExit) as error:
        yield Check("the remaining checks", False, describe_error(error))


def _typical_linearity(model: Model, first: Evaluated) -> float | None:
    """The median linearity index over the random states; None for a function or if it fails.

    Standard deviations follow from the units.
    """
    if not isinstance(model, Motion | Sensor):
        return None
    usual = [i for i, label in enumerate(first.samples.labels) if label in samples.NOMINAL]
    states = tuple(a[usual] for a in first.samples.values)
    # The standard deviations of a usual start: 0.05 of an angle or inverse depth, 0.1 of all else.
    spread = [
        np.array([0.05 if e.endswith(("[rad]", "[1/m]")) else 0.1 for e in argument.entries])
        for argument in first.function.arguments
    ]

    def index(*state: jax.Array) -> jax.Array:
        if isinstance(model, Motion):
            return motion_linearity(model, state[0], state[1], np.diag(spread[0]) ** 2).hessian
        cov = np.diag(np.concatenate(spread)) ** 2
        return sensor_linearity(model, state[0], state[1], cov).hessian

    try:
        return float(np.median(np.asarray(quick_jit(jax.vmap(index))(*states))))
    except (Exception, SystemExit):  # the checks report what is wrong with the model
        return None
