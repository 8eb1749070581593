"""Values and derivatives that are not finite: at which state, and by which line."""

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.claims import Claim
from jaxslam.math._xla import quick_jit
from jaxslam.verify._findings import Check
from jaxslam.verify._inputs.functions import at_state
from jaxslam.verify._inputs.samples import coincident_states
from jaxslam.verify._jacobians import MODES, Evaluated
from jaxslam.verify._loops import has_loop, with_loop_end
from jaxslam.verify._user_errors import describe_error, place_of_error

State = Sequence[np.ndarray]


def finite_check(evaluated: Evaluated) -> Check:
    """The check that values and Jacobians are finite at every state."""
    claim, samples = evaluated.claim, evaluated.samples
    assert evaluated.values is not None
    parts = {"a value": evaluated.values}
    for argument, evaluation in zip(claim.arguments, evaluated.by_argument, strict=True):
        for how, jacobian in evaluation.methods.items():
            parts[f"{how} by {argument.name}"] = jacobian
        for how, jacobian in evaluation.single.items():
            parts[f"{how} by {argument.name} in float32"] = jacobian
    name, count = f"{claim.name} and its derivatives are finite", len(samples.labels)
    for quantity, part in parts.items():
        bad = ~np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
        if bad.any():
            i = int(np.argmax(bad))
            state = tuple(a[i] for a in samples.values)
            hand = claim.jacobian if quantity.startswith("hand") else None
            where = _line_of_nan(claim, state, hand, derivative=quantity != "a value")
            often = f"at {int(np.sum(bad))} of {count} states"
            at = f"{samples.labels[i]}: {at_state(claim, state)}"
            return Check(name, False, f"{where}{quantity} is not finite, {often}; {at}")
    return Check(name, True, f"{count} states")


def singular_notes(evaluated: Evaluated) -> Iterator[str]:
    """Notes on what is not finite with a place at the origin, or with two places at one point.

    A claim need not be defined there, so this is not a failure; but a gradient through it is NaN.
    """
    claim = evaluated.claim
    methods = [x.methods for x in evaluated.by_argument]
    modes = [mode for mode in MODES if methods and all(mode in by_mode for by_mode in methods)]
    if evaluated.values is None or not modes:
        return
    jacobian = MODES[modes[0]](claim.function, argnums=tuple(range(len(claim.arguments))))

    @quick_jit
    def both(*state: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        return with_loop_end(claim.function)(*state)[0], with_loop_end(jacobian)(*state)[0]

    tables = evaluated.samples.values
    for label, moved in coincident_states(claim.arguments, tables):
        state = [moved.get(k, table)[0] for k, table in enumerate(tables)]
        try:
            value, by_argument = both(*state)
        except (Exception, SystemExit) as error:  # as of a callback
            yield f"{describe_error(error)}; with the {label}: {at_state(claim, state)}"
            continue
        if not np.isfinite(value).all():
            quantity = "the value"
        elif bad := [
            argument.name
            for argument, part in zip(claim.arguments, by_argument, strict=True)
            if not np.isfinite(part).all()
        ]:
            quantity = f"the derivative by {' and '.join(bad)}"
        else:
            continue
        where = _line_of_nan(claim, state, None, derivative=quantity != "the value")
        yield f"{where}{quantity} is not finite with the {label}: {at_state(claim, state)}"


def _line_of_nan(
    claim: Claim, state: State, hand: Callable[..., object] | None, *, derivative: bool
) -> str:
    """The user's line at which a NaN or an infinity first appears, as "line: " or ""."""
    call: Callable[..., object] = hand or claim.function
    if derivative and hand is None:
        call = jax.jacfwd(claim.function, argnums=tuple(range(len(state))))
    with contextlib.suppress(Exception, SystemExit):  # one that cannot be traced is called
        if has_loop(jax.make_jaxpr(call)(*map(jnp.asarray, state)).jaxpr):
            return ""  # it might not end
    try:  # JAX prints where the number is
        with jax.debug_nans(True), jax.debug_infs(True), contextlib.redirect_stdout(io.StringIO()):
            call(*(jnp.asarray(a) for a in state))
    except (Exception, SystemExit) as error:
        where = place_of_error(error)
        return f"{where}: " if where else ""
    return ""
