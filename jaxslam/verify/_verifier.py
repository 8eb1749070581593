"""The function `verify_jacobians`: claims, their Jacobians, other checks, and the report."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._reprs import describe
from jaxslam.core.claims import Claim, Jacobian
from jaxslam.core.protocols import Component
from jaxslam.core.validation import InvalidField, at_least, positive, refusals_of, require
from jaxslam.math._arrays import float64
from jaxslam.math._xla import quick_jit
from jaxslam.verify._comparison import compare_methods
from jaxslam.verify._findings import Finding, Report
from jaxslam.verify._finite import singular_notes
from jaxslam.verify._inputs.functions import NAMED, function_claim, periods
from jaxslam.verify._inputs.samples import NOMINAL, Samples, Seen, claim_samples
from jaxslam.verify._jacobians import Evaluated, evaluate_jacobians
from jaxslam.verify._loops import limit_loops
from jaxslam.verify._properties import all_checks
from jaxslam.verify.linearity import linearity_index

_MOUNT = (0.4, -0.3, 0.9)
"""The mount of a sensor made by `build`: off the robot's centre, so that all terms contribute."""
_MAX_RANGE = 40.0
"""The maximum range [m] of a beam model made by `build`: beyond the walls around it."""

TOLERANCE = 1e-12
FLOAT32_TOLERANCE = 1e-5

_M = TypeVar("_M", bound=Component)


def verify_jacobians(
    model: Component | Callable[..., jax.Array],
    jacobian: Jacobian | None = None,
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
    is one, and difference quotients in float64 (Ridders' extrapolation with its error estimate).
    The states are random ones and difficult ones, which follow from the units of the arguments:
    headings next to ±π, a landmark close to and at the robot and the sensor, zero rate, zero
    inverse depth, coordinates of 1e5 m, zero control.
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
        model: a `Motion`, a `Sensor`, a `graphs.Factor`, a `grids.BeamModel`, or another model with
            `claims`; or a pure function of vectors.
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
        if not (jacobian is None or callable(jacobian)):
            raise InvalidField("jacobian", f"expected a function, got {describe(jacobian)}")
        if isinstance(model, type) or not (isinstance(model, Component) or callable(model)):
            got = f"the class {model.__name__}" if isinstance(model, type) else describe(model)
            reason = "expected a Motion, a Sensor, a Factor, a BeamModel or a function of vectors"
            raise InvalidField("model", f"{reason}, got {got}")
    with float64():
        if isinstance(model, Component):
            claims, kind, name = model.claims(), model.kind, model.name
        else:
            claims = (function_claim(model, jacobian, arguments, outputs, name, states),)
            kind, name = "function", claims[0].name
    with refusals_of("verify_jacobians"):
        if not claims:
            raise InvalidField("model", f"expected one with claims, got {describe(model)}")
        samples = None if states is None else _given(claims[0], states, named=not arguments)
    evaluated = evaluate_claims(claims, samples, count, seed)
    findings: list[Finding] = []
    notes: list[str] = []
    with float64(), np.errstate(all="ignore"):
        for e in evaluated:
            findings += compare_methods(e, tolerance, float32_tolerance)
            notes += e.notes
            if samples is None and e.claim.states is None and not e.claim.everywhere:
                notes += singular_notes(e)
        checks = tuple(all_checks(evaluated, of_model=kind != "function"))
        linearity = _typical_linearity(evaluated[0])
    return Report(name, kind, tuple(findings), checks, linearity, tuple(notes))


def evaluate_claims(
    claims: Sequence[Claim], states: Samples | None = None, count: int = 24, seed: int = 0
) -> list[Evaluated]:
    """All Jacobians of claims, in float64; states: of the first one, in place of samples."""
    evaluated: list[Evaluated] = []
    with float64(), np.errstate(all="ignore"):
        for claim in claims:
            seen = [Seen(e.claim, e.samples, e.values) for e in evaluated if e.values is not None]
            samples = states or claim_samples(claim, count, seed, seen)
            evaluated.append(evaluate_jacobians(claim, samples))
            states = None
    return evaluated


def _typical_linearity(first: Evaluated) -> float | None:
    """The median linearity index over the random states; None without noise, or if it fails.

    Standard deviations are those of a usual start: 0.05 of an angle or inverse depth, 0.1 of all
    else, those of the noise, and none of what is exact.
    """
    claim, (tables, labels) = first.claim, first.samples
    if claim.noise_cov is None and not any(argument.cov for argument in claim.arguments):
        return None
    usual = [i for i, label in enumerate(labels) if label in NOMINAL]
    ends = np.cumsum([table.shape[1] for table in tables])[:-1]
    function = limit_loops(claim.function) if first.loops else claim.function
    turn = np.where(np.isfinite(circle := periods(claim.outputs)), circle, 0.0)

    def residual(y: jax.Array, y0: jax.Array) -> jax.Array:
        return y - y0 - turn * jnp.round((y - y0) / circle)

    def index(*state: jax.Array) -> jax.Array:
        covs: list[ArrayLike] = []
        at = list(state)
        for k, argument in enumerate(claim.arguments):
            spread = [0.05 if e.endswith(("[rad]", "[1/m]")) else 0.1 for e in argument.entries]
            covs.append(np.diag(np.square(spread)) * (not argument.exact))
            if argument.cov is not None:
                covs[k], at[k] = limit_loops(argument.cov)(*state), jnp.zeros_like(at[k])
        return linearity_index(
            lambda x: function(*jnp.split(x, ends)),
            jnp.concatenate(at),
            jax.scipy.linalg.block_diag(*covs),
            residual=residual,
        ).hessian

    try:
        by_state = quick_jit(jax.vmap(index))(*(table[usual] for table in tables))
        return float(np.median(np.asarray(by_state)))
    except (Exception, SystemExit):  # the checks report what is wrong with the model
        return None


def build(factory: Callable[..., _M]) -> _M:
    """A model made by a class or factory of the registries' form: with noise 0.01 I where noise has
    no default, with a maximum range where that has none, and mounted off the robot's centre.

    Raises ValueError where the factory returns no model with claims.
    """
    parameters = inspect.signature(factory).parameters
    required = [p.name for p in parameters.values() if p.default is p.empty]
    options: dict[str, object] = {"mount": _MOUNT} if "mount" in parameters else {}
    if "max_range" in required:
        options["max_range"] = _MAX_RANGE
        required.remove("max_range")
    if len(required) > 1:
        reason = f"expected one that needs a noise covariance alone, got {', '.join(required)}"
        raise InvalidField("factory", reason)
    model = factory(*([lambda *_: None] if required else ()), **options)
    if not isinstance(model, Component):
        raise InvalidField("factory", f"expected one of a model, got {describe(model)}")
    if not required:
        return model
    claim = model.claims()[0]
    noises = [argument.entries for argument in claim.arguments if argument.cov is not None]
    return factory(0.01 * np.eye(len((*noises, claim.outputs)[0])), **options)


def _given(claim: Claim, states: Sequence[ArrayLike], *, named: bool) -> Samples:
    """The states of the caller; raises InvalidField on a wrong shape.

    named: whether lengths may follow from the names of the arguments.
    """
    tables = [np.asarray(table, np.float64) for table in states]
    shapes = [table.shape for table in tables]
    sizes = [len(argument.entries) for argument in claim.arguments]
    rows = shapes[0][:1] if shapes else ()
    if rows in ((), (0,)) or shapes != [(*rows, n) for n in sizes]:
        expected = ", ".join(f"(S, {n})" for n in sizes)
        fixed = [
            f"the name {argument.name} fixes {n} entries, which arguments="
            f'{{"{argument.name}": {shape[1]}}} changes'
            for argument, n, shape in zip(claim.arguments, sizes, shapes, strict=False)
            if named and argument.name in NAMED and len(shape) == 2 and shape[1] != n
        ]
        reason = "; ".join([f"expected shapes {expected}, got {shapes}", *fixed])
        raise InvalidField("states", reason)
    return Samples(tuple(tables), ("given",) * len(tables[0]))
