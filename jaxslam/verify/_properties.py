"""Checks other than Jacobians: inverses, residuals, noise, purity, finite values, dtypes."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.claims import Claim, Gaussian, Points, ValuesOf
from jaxslam.core.validation import InvalidField, covariance, require
from jaxslam.math._xla import quick_jit
from jaxslam.verify._differences import modulo_periods
from jaxslam.verify._findings import Check
from jaxslam.verify._finite import finite_check
from jaxslam.verify._inputs.functions import at_state, periods
from jaxslam.verify._inputs.samples import NOMINAL
from jaxslam.verify._jacobians import Evaluated
from jaxslam.verify._loops import limit_loops
from jaxslam.verify._user_errors import describe_error

Values: TypeAlias = np.ndarray

_ROUNDING = 1e-9
"""tolerance of round trips in float64, relative to the coordinates"""
_GAUSS_NEWTON = 12
"""number of Gauss-Newton iterations for the free coordinates of a landmark"""


def all_checks(evaluated: Sequence[Evaluated], *, of_model: bool) -> Iterator[Check]:
    """The checks of claims: where they have values these and the derivatives are finite, the
    functions pure, the same under jit and vmap; those of a model keep the dtype of their arguments;
    and what else they claim."""
    for e in evaluated:
        yield from e.checks
        if e.values is None:
            continue
        yield finite_check(e)
        if any(jacobians.methods for jacobians in e.by_argument):
            yield _guarded(f"{e.claim.name} is pure", _pure, e)
            if of_model:
                yield _guarded(f"{e.claim.name} keeps the dtype", _dtypes, e)
    if all(e.values is not None for e in evaluated):  # else they fail for the same reason
        for e in evaluated:
            yield from claim_checks(e, evaluated)


def claim_checks(evaluated: Evaluated, before: Sequence[Evaluated] = ()) -> Iterator[Check]:
    """Checks of what a claim says besides its Jacobian; before: with the claims before it."""
    claim, states, values = evaluated.claim, evaluated.samples.values, evaluated.values
    assert values is not None
    noises = [(a.cov, len(a.entries)) for a in claim.arguments]
    for cov, size in [*noises, (claim.noise_cov, len(claim.outputs))]:
        if cov is not None:
            yield _guarded("noise covariance", _covariances, cov, states, size)
    if claim.wrapped:
        yield _guarded("the heading is wrapped to (-π, π]", _heading_error, claim, values)
    for equation, function in claim.equal.items():
        yield _guarded(equation, _equality_error, function, evaluated)
    if claim.residual is not None:
        yield from _residual_checks(claim.residual, values, periods(claim.outputs))
        yield _guarded("angles have [rad] in their names", _unnamed_angle, evaluated)
    for argument in claim.arguments:
        if isinstance(argument.domain, ValuesOf) and claim.outputs:
            (seen,) = (e for e in before if e.claim.name == argument.domain.claim)
            forth, back = seen.claim.name, claim.name
            yield _guarded(
                f"{forth} undoes {back}, whatever is free", _image_error, seen, evaluated
            )
            yield _guarded(
                f"{back} undoes {forth}, within what is free", _inversion_error, seen, claim
            )


def _heading_error(claim: Claim, values: Values) -> str:
    """An angle beyond half a turn, or ""."""
    angles = values[:, np.isfinite(periods(claim.outputs))]
    heading = np.abs(angles).max(initial=0.0)
    return "" if heading <= np.pi else f"it returns a heading of {heading:.6g} rad"


def _equality_error(function: Callable[..., jax.Array], evaluated: Evaluated) -> str:
    """The difference of another function from a claim's, or ""."""
    values = np.asarray(_batch(function)(*evaluated.samples.values))
    return _deviation(values - evaluated.values, periods(evaluated.claim.outputs))


def _residual_checks(
    function: Callable[[jax.Array, jax.Array], jax.Array], z: Values, circle: Values
) -> Iterator[Check]:
    """Checks of a residual at values z, whose periods are in circle."""
    residual = _batch(function)

    def size_error() -> str:
        got = jax.eval_shape(residual, z, z).shape[1:]
        return "" if got == z.shape[1:] else f"it returns shape {got}, expected {z.shape[1:]}"

    size = _guarded("the residual has the size of z", size_error)
    if not size.passed:
        yield size
        return
    z_hat = z[::-1] + np.random.default_rng(0).uniform(-1, 1, z.shape)
    yield _guarded("the residual is zero at equality", lambda: _exactly(residual(z, z)))
    yield _guarded(
        "the residual is antisymmetric",
        lambda: _deviation(residual(z, z_hat) + residual(z_hat, z), circle),
    )
    wrapped = ", wrapped on the circle" if np.isfinite(circle).any() else ""
    yield _guarded(
        f"the residual is a difference{wrapped}",
        lambda: _residual_error(residual, z, z_hat, circle),
    )


def _unnamed_angle(evaluated: Evaluated) -> str:
    """An entry that jumps by 2π as the robot turns, and is not [rad] by its name, or ""."""
    claim = evaluated.claim
    pose, *fixed = (np.tile(table[0], (65, 1)) for table in evaluated.samples.values)
    pose[:, 2] = np.linspace(0, 2 * np.pi, 65)
    z = np.asarray(_batch(claim.function)(pose, *fixed), np.float64)
    steps = np.abs(np.diff(z, axis=0))
    jumps = np.any(np.abs(steps - 2 * np.pi) < 0.5, axis=0) & (np.median(steps, axis=0) < 0.5)
    jumps &= ~np.isfinite(periods(claim.outputs))
    for name in np.array(claim.outputs)[jumps]:
        return f"{name} jumps by 2π as the robot turns: name it '{name.split(' [')[0]} [rad]'"
    return ""


def _image_error(seen: Evaluated, inverse: Evaluated) -> str:
    """The error of observe(pose, invert(pose, z, s)) = z, or ""."""
    observe, invert, labels = seen.claim, inverse.claim, inverse.samples.labels

    def again(pose: jax.Array, z: jax.Array, s: jax.Array) -> jax.Array:
        return observe.function(pose, invert.function(pose, z, s)) - z

    # At range zero the bearing is lost.
    regular = np.array(["zero" not in label and "= 0" not in label for label in labels])
    if sum(len(argument.entries) for argument in invert.arguments[1:]) > len(invert.outputs):
        # z tells more than a landmark, as a range rate; at the random states it was observed.
        regular = np.array([label in NOMINAL for label in labels])
    few = tuple(table[regular] for table in inverse.samples.values)
    size = 1 + np.abs(few[0]).max()
    off = modulo_periods(np.asarray(_batch(again)(*few)), periods(observe.outputs)) / size
    if not (trouble := _exactly(off)):
        return ""
    row, entry = np.unravel_index(np.argmax(np.where(np.isnan(off), np.inf, abs(off))), off.shape)
    if abs(abs(off[row, entry]) * size - 2 * np.pi) < 1e-6:
        trouble = "off by 2π (an angle's name ends in [rad])"
    at = at_state(invert, [table[row] for table in few])
    return f"{observe.outputs[entry]} is {trouble}, at {at}"


def _inversion_error(seen: Evaluated, invert: Claim) -> str:
    """The error of invert(pose, observe(pose, l), s) = l for the best s, or ""."""
    observe = seen.claim
    (points,) = (a.domain for a in observe.arguments if isinstance(a.domain, Points))
    (free,) = (a.domain for a in invert.arguments if isinstance(a.domain, Gaussian))
    usual = [i for i, label in enumerate(seen.samples.labels) if label in NOMINAL]
    pose, landmark = (table[usual] for table in seen.samples.values)
    mean, spread = np.asarray(free.mean), np.sqrt(np.diagonal(np.asarray(free.cov)))
    circular = np.isfinite(circle := periods(invert.outputs))
    period = np.where(circular, circle, 1.0)

    def gap(pose: jax.Array, landmark: jax.Array) -> jax.Array:
        landmark = points.embed(pose[:3], points.position(landmark))
        z = observe.function(pose, landmark)

        def miss(s: jax.Array) -> jax.Array:
            difference = invert.function(pose, z, s) - landmark
            turns = jnp.round(difference / period)
            return difference - jnp.where(circular, turns * period, 0.0)

        if not len(mean):
            return jnp.abs(miss(jnp.zeros(0, pose.dtype))).max()

        def refine(_: int, s: jax.Array) -> jax.Array:
            return s - jnp.linalg.pinv(jax.jacfwd(miss)(s)) @ miss(s)

        def from_start(start: jax.Array) -> jax.Array:
            return jnp.abs(miss(jax.lax.fori_loop(0, _GAUSS_NEWTON, refine, start))).max()

        offsets = jnp.asarray(np.linspace(-1.7, 1.7, 8)[:, None] * spread[None], pose.dtype)
        gaps = jax.vmap(from_start)(jnp.asarray(mean, pose.dtype)[None] + offsets)
        return jnp.where(jnp.isfinite(gaps), gaps, jnp.inf).min()

    gaps = np.asarray(_batch(gap)(pose, landmark))
    worst = int(np.argmax(gaps))
    if gaps[worst] <= _ROUNDING * (1 + np.abs(pose).max()):
        return ""
    return (
        f"the landmark ({', '.join(f'{v:.4g}' for v in landmark[worst])}) observed from "
        f"({', '.join(f'{v:.4g}' for v in pose[worst])}) is returned with an error of "
        f"{gaps[worst]:.3g}"
    )


def _residual_error(
    residual: Callable[[Values, Values], jax.Array], z: Values, z_hat: Values, circle: Values
) -> str:
    """The fault of residual(z, ẑ) = z - ẑ modulo the periods, or ""."""
    plain = np.asarray(residual(z, z_hat))
    circular = np.isfinite(circle)
    period = np.where(circular, circle, 1.0)
    off = modulo_periods(plain - modulo_periods(z - z_hat, circle), circle)
    if np.abs(off).max() > _ROUNDING * (1 + np.abs(z).max()):
        return f"residual(z, ẑ) differs from z - ẑ by {np.abs(off).max():.3g}"
    if np.any(np.abs(plain)[:, circular] > period[circular] / 2 + 1e-12):
        return "it returns an angle beyond half a turn"
    for turns in (1, -3):
        shift = np.where(circular, turns * period, 0.0)
        far = np.abs(np.asarray(residual(z + shift, z_hat)) - plain)
        far = np.where(circular, np.minimum(far, np.abs(far - period)), far)
        if far.max() > 1e-8:
            return "adding whole turns to z changes the residual"
    return ""


def _covariances(noise_cov: Callable[..., jax.Array], states: Sequence[Values], size: int) -> str:
    """The fault of the noise covariances of `size` numbers at some states, or ""."""
    covs = np.asarray(_batch(noise_cov)(*states))
    if covs.shape[1:] != (size, size):
        return f"noise_cov returns shape {covs.shape[1:]}, expected ({size}, {size})"
    for cov in covs:
        try:
            require("noise_cov", cov, covariance(size))
        except InvalidField as error:
            return str(error)
    return ""


def _deviation(difference: ArrayLike, circle: Float[np.ndarray, "m"]) -> str:
    """The size of a difference modulo the periods, as text, or "" within rounding."""
    off = modulo_periods(np.asarray(difference, np.float64), circle)
    worst = float(np.max(np.abs(np.where(np.isnan(off), np.inf, off)), initial=0.0))
    return "" if worst <= _ROUNDING else f"off by {worst:.3g} relative to the coordinates"


def _exactly(difference: ArrayLike) -> str:
    """The `_deviation` of entries that are not on a circle."""
    return _deviation(difference, np.full(np.shape(difference)[-1], np.inf))


def _pure(evaluated: Evaluated) -> str:
    """Whether the function agrees with itself when called twice, and under jit and vmap; or ""."""
    claim, values = evaluated.claim, evaluated.values
    assert values is not None
    finite = np.flatnonzero(np.isfinite(values).all(axis=1))
    call = limit_loops(claim.function) if evaluated.loops else claim.function
    for i in finite[[0, -1]] if len(finite) else ():
        state = tuple(jnp.asarray(a[i]) for a in evaluated.samples.values)
        first, second = (np.asarray(call(*state), np.float64) for _ in range(2))
        if not np.array_equal(first, second, equal_nan=True):
            return (
                "two calls with the same arguments differ: it keeps a state or draws random numbers"
            )
        scale = 1.0 + max(float(np.max(np.abs(np.asarray(a)), initial=0)) for a in (*state, first))
        off = first - values[i]
        if bad := _deviation(off / scale, periods(claim.outputs) / scale):
            return f"under jit and vmap the value differs, {bad}"
    return ""


def _dtypes(evaluated: Evaluated) -> str:
    """The dtype that is not kept, or ""."""
    for dtype in (np.float32, np.float64):
        shapes = (jax.ShapeDtypeStruct(a.shape[1:], dtype) for a in evaluated.samples.values)
        result = jax.eval_shape(evaluated.claim.function, *shapes)
        if result.dtype != dtype:
            return f"{np.dtype(dtype).name} in, {result.dtype} out"
    return ""


def _batch(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The function over states, its loops limited."""
    return quick_jit(jax.vmap(limit_loops(function)))


def _guarded(name: str, run: Callable[..., str], *arguments: object) -> Check:
    """A check by name, passed if run(*arguments) returns ""; it reports the result or the error."""
    try:
        trouble = run(*arguments)
    except (Exception, SystemExit) as error:
        trouble = describe_error(error)
    return Check(name, not trouble, trouble)
