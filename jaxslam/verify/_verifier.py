"""The function `verify_jacobians`: samples, Jacobians, other checks, and the report."""

import inspect
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.validation import InvalidField, at_least, positive, refusals_of, require
from jaxslam.graphs import Factor
from jaxslam.laser.grids.beam_models import BeamModel
from jaxslam.math._arrays import float64
from jaxslam.verify._comparison import compare_methods
from jaxslam.verify._examination import Model, examine, functions_of
from jaxslam.verify._findings import Report
from jaxslam.verify._inputs.beams import FAR, beam_function, beam_samples
from jaxslam.verify._inputs.functions import (
    NAMED,
    Claim,
    Function,
    factor_function,
    makes_a_model,
    plain_function,
    with_signature_errors,
)
from jaxslam.verify._inputs.samples import Samples

_MOUNT = (0.4, -0.3, 0.9)
"""The mount of a sensor made by `build`: off the robot's centre, so that all terms contribute."""

TOLERANCE = 1e-12
FLOAT32_TOLERANCE = 1e-5


def verify_jacobians(
    model: Model,
    jacobian: Claim | None = None,
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
    """Compare the Jacobians of a model by every argument, computed by four methods.

    At each sampled state these are `jax.jacfwd`, `jax.jacrev`, the hand-derived Jacobian if there
    is one, and difference quotients in float64 (Ridders' extrapolation with its error estimate; the
    complex step where the function is analytic). The states are random ones and difficult ones,
    which follow from the units of the arguments: headings next to ±π, a landmark close to and at
    the robot and the sensor, zero rate, zero inverse depth, coordinates of 1e5 m, zero control.
    Differences are relative to the largest entry of the Jacobian's row; angles are compared modulo
    2π. Autodiff and the hand-derived Jacobian are compared in float32, too. A mode of
    differentiation that the function has not (jacrev of a `while` loop, jacfwd of a
    `jax.custom_vjp`) is noted, and the other used.

    A `while` loop is stopped after 10,000 rounds. At a state where it does not end in float32, the
    comparison is in float64 alone, with a note; where it does not end in float64, a check fails.

    Further checks: values and derivatives are finite everywhere, the functions are pure, agree with
    themselves under jit and vmap, and keep the dtype; noise covariances are covariances; of a
    sensor the residual, and that `invert` and `observe` are inverse to each other.

    The computation is in float64 for any setting of JAX, and restores that setting. No
    fault of the model raises: a model that cannot be traced, raises or returns the wrong shape is
    reported with the line in its file, and the remaining checks are run.

    Args:
        model: a `Motion`, a `Sensor`, a `graphs.Factor`, a `grids.BeamModel` (its log-densities, by
            the pose and the ranges, in a map without rounding: `inputs.beam_models`), or a pure
            function of vectors.
        jacobian: of a function, its hand-derived Jacobian. Called with the function's arguments it
            returns a tuple of one (m, n_k) array an argument (None: no claim), or one array: by the
            first argument, or by all of them side by side. Models have their claims.
        arguments: of a function, the names of the entries of its arguments with units, as in
            {"pose": ("x [m]", "y [m]", "theta [rad]")}, or only their number. Parameters called
            pose, frame, landmark, l or point need not be given, nor others where `states` are.
        outputs: of a function, the names of its outputs with units; [rad] is modulo 2π.
        states: your own states, one array (S, n_k) an argument, instead of the sampled ones. For a
            sensor the states of `observe`; `invert` is tried at their measurements.
        name: name of a function in the report; default: its `__name__`.
        count: number of random states.
        seed: seed of the random states.
        tolerance, float32_tolerance: largest relative difference between autodiff and hand.
    Returns:
        A `Report`: `passed`, `findings`, `checks`, `notes`, `as_dict()`, and text when printed.
    Raises:
        ValueError: if the length of an argument is not known, states have the wrong shape,
            or count or a tolerance is not positive.
    """
    with refusals_of("verify_jacobians"):
        require("tolerance", tolerance, positive)
        require("float32_tolerance", float32_tolerance, positive)
        require("count", count, at_least(2))
        if not 0 <= seed < 2**32:
            raise InvalidField("seed", f"expected a number between 0 and 2³²-1, got {seed}")
        if not (isinstance(model, Motion | Sensor | Factor | BeamModel) or callable(model)):
            raise InvalidField(
                "model",
                "expected a Motion, a Sensor, a Factor, a BeamModel or a function of "
                f"vectors, got {type(model).__name__}",
            )
        if (
            not isinstance(model, Motion | Sensor | Factor | BeamModel)
            and jacobian is None
            and makes_a_model(model)
        ):
            factory = getattr(model, "__name__", "factory")
            factory_kind = "class" if isinstance(model, type) else "factory"
            parameters = inspect.signature(model).parameters.values()
            noise = "noise_cov" if any(p.default is p.empty for p in parameters) else ""
            raise InvalidField(
                "model",
                f"expected a Motion, a Sensor or a Factor, got the {factory_kind} "
                f"{factory} of one: call it, as in {factory}({noise}), or use "
                f"jaxslam.verify.build({factory})",
            )
        if not (jacobian is None or callable(jacobian)):
            raise InvalidField("jacobian", f"expected a function, got {describe(jacobian)}")
    if isinstance(model, Motion | Sensor):
        kind, name = "motion" if isinstance(model, Motion) else "sensor", model.name
        model = with_signature_errors(model)
        functions = functions_of(model)
    elif isinstance(model, Factor):
        kind, name, functions = "factor", model.name, (factor_function(model),)
    elif isinstance(model, BeamModel):
        with float64():
            functions = (beam_function(model),)
        kind, name = "beam model", model.name
    else:
        with float64():
            functions = (plain_function(model, jacobian, arguments, outputs, name, states),)
        kind, name = "function", functions[0].name
    samples = None
    if states is not None:
        with refusals_of("verify_jacobians"):
            by_name = kind == "function" and not arguments
            samples = _samples_of_states(functions[0], states, by_name=by_name)
    if samples is None and isinstance(model, BeamModel):
        samples = beam_samples(model, count, seed)
    evaluated, checks, notes, linearity = examine(model, functions, samples, count, seed)
    with np.errstate(all="ignore"):
        findings = [
            finding
            for of_function in evaluated
            for finding in compare_methods(of_function, tolerance, float32_tolerance)
        ]
    return Report(name, kind, tuple(findings), checks, linearity, notes)


def build(
    factory: Callable[..., Motion | Sensor | BeamModel | Factor],
) -> Motion | Sensor | BeamModel | Factor:
    """A model made by a class or factory of the registries' form: with noise 0.01 I unless
    noise has a default, or, of a beam model, with the maximum range of the trial; a factor with
    nothing.

    A sensor, and a laser, is mounted off the robot's centre. Raises ValueError where the factory
    returns none of these.
    """
    parameters = inspect.signature(factory).parameters
    mounted = {"mount": _MOUNT} if "mount" in parameters else {}
    if "max_range" in parameters:
        model = factory(max_range=FAR, **mounted)
        if isinstance(model, BeamModel):
            return model
    if all(p.default is not p.empty for p in parameters.values()):
        model = factory(**mounted)
        if isinstance(model, Factor | Motion | Sensor):
            return model
    probe = factory(lambda *_: None)
    if not isinstance(probe, Motion | Sensor):
        raise InvalidField(
            "factory", f"expected one of a Motion or a Sensor, got {describe(probe)}"
        )
    size = len(probe.noises if isinstance(probe, Motion) else probe.measurements)
    return factory(0.01 * np.eye(size), **mounted)


def _samples_of_states(
    function: Function, states: Sequence[ArrayLike], *, by_name: bool
) -> Samples:
    """The states of the caller; raises InvalidField on a wrong shape.

    by_name: whether lengths may follow from the names of the arguments.
    """
    tables = [np.asarray(table, np.float64) for table in states]
    wanted = [len(argument.entries) for argument in function.arguments]
    shapes = [table.shape for table in tables]
    fits = len(tables) == len(wanted) and all(
        table.shape == (len(tables[0]), n) for table, n in zip(tables, wanted, strict=True)
    )
    if not fits or len(tables[0]) == 0:
        expected = ", ".join(f"(S, {n})" for n in wanted)
        fixed = [
            f"the name {argument.name} fixes {len(argument.entries)} entries, which arguments="
            f'{{"{argument.name}": {table.shape[1]}}} changes'
            for argument, table in zip(function.arguments, tables, strict=False)
            if by_name and argument.name in NAMED and table.ndim == 2
            if table.shape[1] != len(argument.entries)
        ]
        reason = "; ".join([f"expected shapes {expected}, got {shapes}", *fixed])
        raise InvalidField("states", reason)
    return Samples(tuple(tables), ("given",) * len(tables[0]))
