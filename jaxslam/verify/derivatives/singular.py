"""Singular places of a function: the operation without a finite value or derivative, its cure."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal, Var
from jax.typing import ArrayLike
from jaxtyping import PyTree

_CALLS = ("jit", "pjit", "custom_jvp_call", "custom_vjp_call", "closed_call", "checkpoint")
"""operations that call a function"""

_BOTH = (
    "One `where` is not enough: JAX differentiates both of its branches, and 0 · inf is NaN. The "
    "first makes the argument safe, the second chooses the value."
)
_OUTSIDE = (
    "Keep the argument in the domain, or give states inside it: f_states in the file, states= in "
    "Python."
)

CURES: dict[str, tuple[str, ...]] = {
    "a division by 0": (
        "If the quotient has a limit, use a series (sin(x)/x is jaxslam.math.angles.sinc) or two "
        f"`where`. {_BOTH}",
        "safe = jnp.where(x != 0, x, 1.0)",
        "out = jnp.where(x != 0, y / safe, limit)",
    ),
    "a square root of 0": (
        f"Its derivative is infinite; choose a value with two `where`. {_BOTH}",
        "safe = jnp.where(r2 > 0, r2, 1.0)",
        "r = jnp.where(r2 > 0, jnp.sqrt(safe), 0.0)",
    ),
    "arctan2(0, 0)": (
        f"No angle is defined; choose a value with two `where`. {_BOTH}",
        "there = (dx != 0) | (dy != 0)",
        "angle = jnp.where(there, jnp.arctan2(dy, jnp.where(there, dx, 1.0)), 0.0)",
    ),
    "an arcsine or arccosine at ±1": (
        "Its derivative is infinite; compute the angle with arctan2 from its sine and cosine.",
        "angle = jnp.arctan2(sine, cosine)",
    ),
    "a square root of a negative number": (_OUTSIDE,),
    "a logarithm of 0 or less": (_OUTSIDE,),
    "an arcsine or arccosine beyond ±1": (_OUTSIDE,),
}
"""The cure of each singular operation: a sentence, then lines of code."""


def singular_operation(call: Callable[..., PyTree], state: Sequence[np.ndarray]) -> str:
    """The first operation of a function that is singular at a state: a key of `CURES`, or "".

    The function is computed operation by operation; a loop counts as one operation.
    """
    try:
        traced = jax.make_jaxpr(call)(*state)
        return _first_singular(traced, state)[0]
    except (Exception, SystemExit):  # a cure is offered only for what can be traced
        return ""


def _first_singular(traced: Jaxpr, arguments: Sequence[ArrayLike]) -> tuple[str, list[ArrayLike]]:
    """The first singular operation or "", and the values of a traced function."""
    jaxpr, consts = getattr(traced, "jaxpr", traced), getattr(traced, "consts", ())
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

    def value(atom: Literal | Var) -> ArrayLike:
        found: ArrayLike = atom.val if isinstance(atom, Literal) else known[atom]
        return found

    for equation in jaxpr.eqns:
        operands = [value(atom) for atom in equation.invars]
        if kind := _kind(equation.primitive.name, equation.params.get("y"), operands):
            return kind, []
        if equation.primitive.name in _CALLS:
            inner = "jaxpr" if "jaxpr" in equation.params else "call_jaxpr"
            kind, results = _first_singular(equation.params[inner], operands)
            if kind:
                return kind, []
        else:
            out = equation.primitive.bind(*operands, **equation.params)
            results = out if equation.primitive.multiple_results else [out]
        known |= dict(zip(equation.outvars, results, strict=True))
    return "", [value(atom) for atom in jaxpr.outvars]


def _kind(primitive: str, exponent: float | None, operands: list[ArrayLike]) -> str:
    """The key of `CURES` for an operation that is singular at its operands, or ""."""
    first = np.asarray(operands[0]) if operands else np.zeros(0)
    second = np.asarray(operands[1]) if len(operands) > 1 else np.zeros(())
    if primitive == "div":
        return "a division by 0" if np.any(second == 0) else ""
    if primitive == "atan2":
        return "arctan2(0, 0)" if np.any((first == 0) & (second == 0)) else ""
    if primitive in ("log", "log1p"):
        return "a logarithm of 0 or less" if np.any(first + (primitive == "log1p") <= 0) else ""
    if primitive in ("asin", "acos"):
        side = "beyond" if np.any(np.abs(first) > 1) else "at"
        return f"an arcsine or arccosine {side} ±1" if np.any(np.abs(first) >= 1) else ""
    powers = {"sqrt": 0.5, "rsqrt": -0.5, "integer_pow": exponent, "pow": second}
    power = np.asarray(powers.get(primitive, 1.0))
    if np.any((first < 0) & (power != np.round(power))):
        return "a square root of a negative number"
    if np.any((first == 0) & (power < 0)):
        return "a division by 0"
    if np.any((first == 0) & (power > 0) & (power < 1)):
        return "a square root of 0"
    return ""
