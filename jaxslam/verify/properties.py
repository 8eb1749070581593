"""What people get wrong beside Jacobians: round trips, residuals, noise, purity, bad places."""

import contextlib
import io
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxslam.math.linalg import check_covariance
from jaxslam.math.xla import quick_jit
from jaxslam.protocols import Motion, Sensor
from jaxslam.verify.jacobians import Evaluated
from jaxslam.verify.record import Check
from jaxslam.verify.samples import Samples
from jaxslam.verify.subject import Function, periods
from jaxslam.verify.trouble import line_of, told

Values = NDArray[np.float64]

_ROUNDING = 1e-9
"""for round trips in float64, relative to the coordinates"""
_GAUSS_NEWTON = 12


def of_function(evaluated: Evaluated) -> Iterator[Check]:
    """Of any function: finite values and derivatives, purity, the same under jit and vmap."""
    if evaluated.values is None:
        return
    function = evaluated.function
    yield _finite(evaluated)
    if any(evaluation.methods for evaluation in evaluated.by_argument):
        yield from _guarded(f"{function.name} is pure", lambda: _pure(function, evaluated))


def of_model_function(evaluated: Evaluated) -> Iterator[Check]:
    """Of a function of a model: float32 in, float32 out."""
    if any(evaluation.methods for evaluation in evaluated.by_argument):
        function = evaluated.function
        yield from _guarded(
            f"{function.name} keeps the dtype", lambda: _dtypes(function, evaluated.samples)
        )


def of_motion(motion: Motion, samples: Samples) -> Iterator[Check]:
    """Of a motion model: its noise, its heading, and `perturb`."""
    pose, u, w = samples.values
    yield from _guarded("noise covariance", lambda: _covariances(motion.noise_cov, (pose, u)))

    def wrapped() -> str:
        heading = np.asarray(quick_jit(jax.vmap(motion.step))(pose, u, w))[:, 2]
        worst = float(np.max(np.abs(heading)))
        return "" if worst <= np.pi else f"a heading of {worst:.6g} rad is returned"

    yield from _guarded("the heading is wrapped to (-π, π]", wrapped)
    perturb = motion.perturb
    if perturb is None:
        return

    def through_the_control() -> str:
        def gap(pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
            there = motion.step(pose, perturb(u, w), jnp.zeros_like(w))
            return there - motion.step(pose, u, w)

        return _on_circle(
            quick_jit(jax.vmap(gap))(pose, u, w), np.array([np.inf, np.inf, 2 * np.pi])
        )

    yield from _guarded("step(pose, u, w) = step(pose, perturb(u, w), 0)", through_the_control)


def of_sensor(sensor: Sensor, seen: Samples, inverse: Samples) -> Iterator[Check]:
    """Of a sensor: noise, residual, and that `invert` and `observe` undo each other."""
    circle = periods(sensor.measurements)
    z = np.asarray(quick_jit(jax.vmap(sensor.observe))(*seen.values), np.float64)
    yield from _guarded("noise covariance", lambda: _covariances(sensor.noise_cov, (z,)))
    residual = quick_jit(jax.vmap(sensor.residual))
    other = z[::-1] + np.random.default_rng(0).uniform(-1, 1, z.shape)
    yield from _guarded(
        "the residual is zero at equality",
        lambda: _exactly(residual(z, z)),
    )
    yield from _guarded(
        "the residual is antisymmetric",
        lambda: _on_circle(residual(z, other) + residual(other, z), circle),
    )
    yield from _guarded(
        "the residual is a difference, wrapped on the circle",
        lambda: _wrapped(residual, z, other, circle),
    )
    if not sensor.landmark:
        return

    def forth() -> str:
        def again(pose: jax.Array, z: jax.Array, s: jax.Array) -> jax.Array:
            return sensor.residual(sensor.observe(pose, sensor.invert(pose, z, s)), z)

        # At range zero there is no direction to give back, and a measurement without one is not one
        # that the sensor could have made.
        regular = np.array(["zero" not in label and "= 0" not in label for label in inverse.labels])
        few = tuple(a[regular] for a in inverse.values)
        size = 1 + np.abs(few[0]).max()
        return _exactly(np.asarray(quick_jit(jax.vmap(again))(*few)) / size)

    yield from _guarded("observe undoes invert, whatever is free", forth)
    yield from _guarded(
        "invert undoes observe, within what is free", lambda: _inverted(sensor, seen)
    )


def _inverted(sensor: Sensor, seen: Samples) -> str:
    """For a landmark seen first from a pose, some s with invert(pose, observe(pose, l), s) = l."""
    usual = [i for i, label in enumerate(seen.labels) if label == "random"]
    pose = seen.values[0][usual]
    point = pose[:, :2] + np.roll(pose[:, :2], 1, axis=0) / 2 + 1
    mean = np.asarray(sensor.free.mean, np.float64)
    spread = np.sqrt(np.diagonal(np.asarray(sensor.free.cov, np.float64)))

    def gap(pose: jax.Array, point: jax.Array) -> jax.Array:
        landmark = sensor.embed(pose, point)
        z = sensor.observe(pose, landmark)

        def miss(s: jax.Array) -> jax.Array:
            return _wrap_named(sensor.invert(pose, z, s) - landmark, sensor.landmark)

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
        f"a landmark at ({point[worst][0]:.4g}, {point[worst][1]:.4g}) seen from "
        f"({', '.join(f'{v:.4g}' for v in pose[worst])}) comes back {gaps[worst]:.3g} off"
    )


def _wrap_named(difference: jax.Array, names: tuple[str, ...]) -> jax.Array:
    circle = periods(names)
    on_circle = np.isfinite(circle)
    turn = np.where(on_circle, circle, 1.0)
    return difference - jnp.where(on_circle, turn * jnp.round(difference / turn), 0.0)


def _wrapped(
    residual: Callable[[Values, Values], jax.Array], z: Values, other: Values, circle: Values
) -> str:
    plain = np.asarray(residual(z, other))
    on_circle = np.isfinite(circle)
    wanted = z - other
    turn = np.where(on_circle, circle, 1.0)
    wanted = np.where(on_circle, wanted - turn * np.round(wanted / turn), wanted)
    off = plain - wanted
    off = np.where(on_circle, off - turn * np.round(off / turn), off)
    if np.abs(off).max() > _ROUNDING * (1 + np.abs(z).max()):
        return f"residual(z, ẑ) differs from z - ẑ by {np.abs(off).max():.3g}"
    if np.any(np.abs(plain)[:, on_circle] > turn[on_circle] / 2 + 1e-12):
        return "an angle beyond half a turn is returned"
    for turns in (1, -3):
        whole = np.where(on_circle, turns * turn, 0.0)
        far = np.abs(np.asarray(residual(z + whole, other)) - plain)
        far = np.where(on_circle, np.minimum(far, np.abs(far - turn)), far)
        if far.max() > 1e-8:
            return "a whole turn more changes it"
    return ""


def _covariances(noise_cov: Callable[..., Any], arguments: tuple[Values, ...]) -> str:
    covs = np.asarray(quick_jit(jax.vmap(noise_cov))(*arguments))
    for cov in covs:
        try:
            check_covariance("noise_cov", cov, covs.shape[-1])
        except ValueError as error:
            return str(error)
    return ""


def _on_circle(difference: Any, circle: Values) -> str:
    off = np.asarray(difference, np.float64)
    turn = np.where(np.isfinite(circle), circle, 1.0)
    off = np.where(np.isfinite(circle), off - turn * np.round(off / turn), off)
    worst = float(np.max(np.abs(np.where(np.isnan(off), np.inf, off)), initial=0.0))
    return "" if worst <= _ROUNDING else f"off by {worst:.3g}, relative to the coordinates"


def _exactly(difference: Any) -> str:
    """As `_on_circle`, of what is on none."""
    return _on_circle(difference, np.full(np.shape(difference)[-1], np.inf))


def _finite(evaluated: Evaluated) -> Check:
    function, samples = evaluated.function, evaluated.samples
    assert evaluated.values is not None
    parts = {"a value": evaluated.values}
    for argument, evaluation in zip(function.arguments, evaluated.by_argument, strict=True):
        for how, jacobian in evaluation.methods.items():
            parts[f"{how} by {argument.name}"] = jacobian
        for how, jacobian in evaluation.single.items():
            parts[f"{how} by {argument.name} in float32"] = jacobian
    name, count = f"{function.name} and its derivatives are finite", len(samples.labels)
    for what, part in parts.items():
        bad = ~np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
        if bad.any():
            i = int(np.argmax(bad))
            state = tuple(a[i] for a in samples.values)
            where = _line_of_nan(function, state, what)
            at = ", ".join(
                f"{argument.name} = ({', '.join(f'{v:.6g}' for v in row)})"
                for argument, row in zip(function.arguments, state, strict=True)
            )
            line = f"{where}: " if where else ""
            often = f"{int(np.sum(bad))} of {count} states"
            return Check(name, False, f"{line}{what} is not, {often}; {samples.labels[i]}: {at}")
    return Check(name, True, f"{count} states")


def _line_of_nan(function: Function, state: tuple[Values, ...], what: str) -> str:
    """The user's line at which a NaN or an infinity appears, in the function or its derivative."""
    call: Callable[..., Any] = function.call
    if what != "a value" and "hand" not in what:
        call = jax.jacfwd(function.call, argnums=tuple(range(len(state))))
    elif "hand" in what and function.hand is not None:
        call = function.hand
    try:  # jax says on standard output what it found
        with jax.debug_nans(True), jax.debug_infs(True), contextlib.redirect_stdout(io.StringIO()):
            call(*(jnp.asarray(a) for a in state))
    except (Exception, SystemExit) as error:
        return line_of(error)
    return ""


def _pure(function: Function, evaluated: Evaluated) -> str:
    """jit = no jit, twice the same, vmap = one by one; at two states, to keep it quick."""
    assert evaluated.values is not None
    finite = np.flatnonzero(np.isfinite(evaluated.values).all(axis=1))
    for i in finite[[0, -1]] if len(finite) else ():
        state = tuple(jnp.asarray(a[i]) for a in evaluated.samples.values)
        first, second = (np.asarray(function.call(*state), np.float64) for _ in range(2))
        if not np.array_equal(first, second, equal_nan=True):
            return "two calls with the same arguments differ: it keeps or draws something"
        scale = 1.0 + max(float(np.max(np.abs(np.asarray(a)), initial=0)) for a in (*state, first))
        off = first - evaluated.values[i]
        if bad := _on_circle(off / scale, function.periods / scale):
            return f"under jit and vmap the value is another, {bad}"
    return ""


def _dtypes(function: Function, samples: Samples) -> str:
    for dtype in (np.float32, np.float64):
        shapes = (jax.ShapeDtypeStruct(a.shape[1:], dtype) for a in samples.values)
        out = jax.eval_shape(function.call, *shapes)
        if out.dtype != dtype:
            return f"{np.dtype(dtype).name} in, {out.dtype} out"
    return ""


def _guarded(name: str, run: Callable[[], str]) -> Iterator[Check]:
    """The check of that name: passed if run returns "", else what it says or raises."""
    try:
        trouble = run()
    except (Exception, SystemExit) as error:
        trouble = told(error)
    yield Check(name, not trouble, trouble)
