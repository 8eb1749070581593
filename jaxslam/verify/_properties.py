"""Checks other than Jacobians: round trips, residuals, noise, purity, finite values, dtypes."""

from collections.abc import Callable, Iterator
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.validation import InvalidField, covariance, require
from jaxslam.math._xla import quick_jit
from jaxslam.verify._differences import modulo_periods
from jaxslam.verify._findings import Check
from jaxslam.verify._finite import finite_check
from jaxslam.verify._inputs.functions import Function, at_state, periods, sensor_functions
from jaxslam.verify._inputs.samples import NOMINAL, Samples
from jaxslam.verify._jacobians import Evaluated
from jaxslam.verify._loops import limit_loops
from jaxslam.verify._user_errors import describe_error

Values: TypeAlias = np.ndarray

_ROUNDING = 1e-9
"""tolerance of round trips in float64, relative to the coordinates"""
_GAUSS_NEWTON = 12
"""number of Gauss-Newton iterations for the free coordinates of a landmark"""


def function_checks(evaluated: Evaluated) -> Iterator[Check]:
    """Checks of any function: finite values and derivatives, purity, and jit and vmap agree."""
    if evaluated.values is None:
        return
    function = evaluated.function
    yield finite_check(evaluated)
    if any(evaluation.methods for evaluation in evaluated.by_argument):
        yield from _guard(f"{function.name} is pure", lambda: _pure(function, evaluated))


def dtype_checks(evaluated: Evaluated) -> Iterator[Check]:
    """The check of a model's function that its result has the dtype of its arguments."""
    if any(evaluation.methods for evaluation in evaluated.by_argument):
        function = evaluated.function
        yield from _guard(
            f"{function.name} keeps the dtype", lambda: _dtypes(function, evaluated.samples)
        )


def motion_checks(motion: Motion, samples: Samples) -> Iterator[Check]:
    """Checks of a motion model: its noise, its heading, and `perturb`."""
    pose, u, w = samples.values
    yield from _guard(
        "noise covariance", lambda: _covariances(motion.noise_cov, (pose, u), w.shape[-1])
    )

    def heading_error() -> str:
        heading = np.asarray(quick_jit(jax.vmap(motion.step))(pose, u, w))[:, 2]
        worst = float(np.max(np.abs(heading)))
        return "" if worst <= np.pi else f"it returns a heading of {worst:.6g} rad"

    yield from _guard("the heading is wrapped to (-π, π]", heading_error)
    perturb = motion.perturb
    if perturb is None:
        return

    def perturb_error() -> str:
        def gap(pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
            perturbed = motion.step(pose, perturb(u, w), jnp.zeros_like(w))
            return perturbed - motion.step(pose, u, w)

        return _deviation(
            quick_jit(jax.vmap(gap))(pose, u, w), np.array([np.inf, np.inf, 2 * np.pi])
        )

    yield from _guard("step(pose, u, w) = step(pose, perturb(u, w), 0)", perturb_error)


def sensor_checks(sensor: Sensor, seen: Samples, inverse: Samples) -> Iterator[Check]:
    """Checks of a sensor: noise, residual, and that `invert` is the inverse of `observe`."""
    circle = periods(sensor.measurements)
    z = np.asarray(quick_jit(jax.vmap(sensor.observe))(*seen.values), np.float64)
    yield from _guard("noise covariance", lambda: _covariances(sensor.noise_cov, (z,), z.shape[-1]))
    residual = quick_jit(jax.vmap(sensor.residual))

    def residual_size() -> str:
        got = jax.eval_shape(residual, z, z).shape[1:]
        return "" if got == z.shape[1:] else f"it returns shape {got}, expected {z.shape[1:]}"

    size = list(_guard("the residual has the size of z", residual_size))
    if not all(check.passed for check in size):
        yield from size
        return
    z_hat = z[::-1] + np.random.default_rng(0).uniform(-1, 1, z.shape)
    yield from _guard(
        "the residual is zero at equality",
        lambda: _exactly(residual(z, z)),
    )
    yield from _guard(
        "the residual is antisymmetric",
        lambda: _deviation(residual(z, z_hat) + residual(z_hat, z), circle),
    )
    wrapped = ", wrapped on the circle" if np.isfinite(circle).any() else ""
    yield from _guard(
        f"the residual is a difference{wrapped}",
        lambda: _residual_error(residual, z, z_hat, circle),
    )
    yield from _guard("angles have [rad] in their names", lambda: _unnamed_angle(sensor, seen))
    if not sensor.landmark:
        return

    def observation_error() -> str:
        def again(pose: jax.Array, z: jax.Array, s: jax.Array) -> jax.Array:
            return sensor.residual(sensor.observe(pose, sensor.invert(pose, z, s)), z)

        # At range zero the bearing is lost.
        regular = np.array(["zero" not in label and "= 0" not in label for label in inverse.labels])
        few = tuple(a[regular] for a in inverse.values)
        size = 1 + np.abs(few[0]).max()
        off = np.asarray(quick_jit(jax.vmap(again))(*few)) / size
        if not (trouble := _exactly(off)):
            return ""
        row, entry = np.unravel_index(
            np.argmax(np.where(np.isnan(off), np.inf, abs(off))), off.shape
        )
        at = at_state(sensor_functions(sensor)[1], [a[row] for a in few])
        away = abs(off[row, entry]) * size
        if abs(away - 2 * np.pi) < 1e-6:
            trouble = "off by 2π (an angle's name ends in [rad])"
        return f"{sensor.measurements[entry]} is {trouble}, at {at}"

    yield from _guard("observe undoes invert, whatever is free", observation_error)
    yield from _guard(
        "invert undoes observe, within what is free", lambda: _inversion_error(sensor, seen)
    )


def _unnamed_angle(sensor: Sensor, seen: Samples) -> str:
    """An entry of z that jumps by 2π as the robot turns, and is not [rad] by its name, or ""."""
    pose, *landmark = (values[0] for values in seen.values)
    turns = np.linspace(0, 2 * np.pi, 65)
    poses = np.stack([np.full(65, pose[0]), np.full(65, pose[1]), turns], axis=1)
    z = quick_jit(jax.vmap(sensor.observe, in_axes=(0, *(None for _ in landmark))))
    steps = np.abs(np.diff(np.asarray(z(poses, *landmark), np.float64), axis=0))
    jumps = np.any(np.abs(steps - 2 * np.pi) < 0.5, axis=0) & (np.median(steps, axis=0) < 0.5)
    jumps &= ~np.isfinite(periods(sensor.measurements))
    for name in np.array(sensor.measurements)[jumps]:
        return f"{name} jumps by 2π as the robot turns: name it '{name.split(' [')[0]} [rad]'"
    return ""


def _inversion_error(sensor: Sensor, seen: Samples) -> str:
    """The error of invert(pose, observe(pose, l), s) = l for the best s, or ""."""
    usual = [i for i, label in enumerate(seen.labels) if label in NOMINAL]
    pose = seen.values[0][usual]
    point = pose[:, :2] + np.roll(pose[:, :2], 1, axis=0) / 2 + 1
    if "given" in seen.labels and sensor.of_points:
        point = seen.values[1]
    mean = np.asarray(sensor.free.mean, np.float64)
    spread = np.sqrt(np.diagonal(np.asarray(sensor.free.cov, np.float64)))
    circular = np.isfinite(circle := periods(sensor.landmark))
    period = np.where(circular, circle, 1.0)

    def gap(pose: jax.Array, point: jax.Array) -> jax.Array:
        landmark = sensor.embed(pose, point)
        z = sensor.observe(pose, landmark)

        def miss(s: jax.Array) -> jax.Array:
            difference = sensor.invert(pose, z, s) - landmark
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

    gaps = np.asarray(quick_jit(jax.vmap(gap))(pose, point))
    worst = int(np.argmax(gaps))
    if gaps[worst] <= _ROUNDING * (1 + np.abs(pose).max()):
        return ""
    return (
        f"a landmark at ({point[worst][0]:.4g}, {point[worst][1]:.4g}) observed from "
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


def _covariances(
    noise_cov: Callable[..., jax.Array], arguments: tuple[Values, ...], size: int
) -> str:
    """The fault of the noise covariances of `size` numbers at some arguments, or ""."""
    covs = np.asarray(quick_jit(jax.vmap(limit_loops(noise_cov)))(*arguments))
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


def _pure(function: Function, evaluated: Evaluated) -> str:
    """Whether the function agrees with itself when called twice, and under jit and vmap; or ""."""
    assert evaluated.values is not None
    finite = np.flatnonzero(np.isfinite(evaluated.values).all(axis=1))
    call = limit_loops(function.call) if evaluated.loops else function.call
    for i in finite[[0, -1]] if len(finite) else ():
        state = tuple(jnp.asarray(a[i]) for a in evaluated.samples.values)
        first, second = (np.asarray(call(*state), np.float64) for _ in range(2))
        if not np.array_equal(first, second, equal_nan=True):
            return (
                "two calls with the same arguments differ: it keeps a state or draws random numbers"
            )
        scale = 1.0 + max(float(np.max(np.abs(np.asarray(a)), initial=0)) for a in (*state, first))
        off = first - evaluated.values[i]
        if bad := _deviation(off / scale, periods(function.outputs) / scale):
            return f"under jit and vmap the value differs, {bad}"
    return ""


def _dtypes(function: Function, samples: Samples) -> str:
    """The dtype that is not kept, or ""."""
    for dtype in (np.float32, np.float64):
        shapes = (jax.ShapeDtypeStruct(a.shape[1:], dtype) for a in samples.values)
        result = jax.eval_shape(function.call, *shapes)
        if result.dtype != dtype:
            return f"{np.dtype(dtype).name} in, {result.dtype} out"
    return ""


def _guard(name: str, run: Callable[[], str]) -> Iterator[Check]:
    """A check by name, passed if run returns ""; else it reports the result or the exception."""
    try:
        trouble = run()
    except (Exception, SystemExit) as error:
        trouble = describe_error(error)
    yield Check(name, not trouble, trouble)
