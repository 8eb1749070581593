"""Functions whose `while` loops end: by themselves, or after a limited number of rounds.

A loop until a tolerance that the precision cannot reach runs for ever, and compiled code cannot be
interrupted. The limit is put into the traced program, a jaxpr, by an interpreter as JAX's
documentation writes them ("Writing custom Jaxpr interpreters in JAX").
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

_F = TypeVar("_F", bound=Callable[..., PyTree])

ROUNDS = 10_000
"""largest number of rounds of all `while` loops of one call together; a loop that a filter can use
ends long before, and a batch of states takes this many in seconds"""


def with_loop_end(function: Callable[..., PyTree]) -> Callable[..., tuple[PyTree, jax.Array]]:
    """The function (arguments) -> its result, and () bool: whether its loops ended by themselves.

    Where they did not, the result is that after `ROUNDS` rounds. For a derivative use
    with_loop_end(jax.jacfwd(f)), not jax.jacfwd(with_loop_end(f)): then loops in derivative rules
    are limited, and these rules are used.
    """

    def call(*arguments: PyTree) -> tuple[PyTree, jax.Array]:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        if not has_loop(closed.jaxpr):
            return function(*arguments), jnp.bool_(True)
        values, left = _evaluate(closed, jax.tree.leaves(arguments), jnp.int32(ROUNDS))
        return jax.tree.unflatten(jax.tree.structure(shape), values), left > 0

    return call


def limit_loops(function: _F) -> _F:
    """The function with limited loops, NaN where they have not ended; also if differentiated."""

    def until_limit(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
        values, ended = with_loop_end(function)(*arguments)
        return jax.tree.map(lambda value: jnp.where(ended, value, jnp.nan), values)

    @jax.custom_jvp
    def call(*arguments: PyTree) -> PyTree:
        return until_limit(function, *arguments)

    @call.defjvp
    def rule(primals: PyTree, tangents: PyTree) -> PyTree:
        return until_limit(lambda x, dx: jax.jvp(function, x, dx), primals, tangents)

    return cast(_F, call)


def has_loop(jaxpr: Any) -> bool:
    """Whether a `while` occurs in a program, in nested ones, too.

    A `fori_loop` of a number of rounds known to the trace is a scan, which always ends.
    """
    return any(
        equation.primitive.name == "while" or any(map(has_loop, _nested(equation.params)))
        for equation in jaxpr.eqns
    )


def _nested(params: dict[str, Any]) -> Iterator[Any]:
    """The programs among the parameters of an operation."""
    for value in params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if _is_program(part):
                yield getattr(part, "jaxpr", part)


def _is_program(value: object) -> bool:
    """Whether a parameter of an operation is a program, with its constants (.jaxpr) or without."""
    return hasattr(getattr(value, "jaxpr", value), "eqns")


def _evaluate(
    program: Any, arguments: Sequence[Any], left: jax.Array
) -> tuple[list[Any], jax.Array]:
    """The outputs of a program whose loops have `left` rounds, and how many are left; 0 if they
    have not ended."""
    jaxpr = getattr(program, "jaxpr", program)
    held: dict[Any, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
    held |= dict(zip(jaxpr.constvars, getattr(program, "consts", ()), strict=True))

    def read(variable: Any) -> Any:
        return variable.val if hasattr(variable, "val") else held[variable]  # a literal

    for equation in jaxpr.eqns:
        inputs = [read(variable) for variable in equation.invars]
        name, params = equation.primitive.name, equation.params
        parts = [part for part in params.values() if _is_program(part)]
        loops = any(map(has_loop, _nested(params)))
        if name == "while":
            outputs, left = _while(params, inputs, left)
        elif loops and name == "scan":
            outputs, left = _scan(equation, inputs, left)
        elif loops and name == "cond":
            outputs, left = _cond(params, inputs, left)
        elif loops and len(parts) == 1:  # a call: jit, checkpoint, a function with its own rules
            outputs, left = _evaluate(parts[0], inputs, left)
        else:  # with loops only JAX's iterative solvers of linear systems, which limit them
            bound = equation.primitive.get_bind_params(params)
            # Until jax 0.11 with the functions that are called, before the parameters.
            functions, rest = bound if isinstance(bound, tuple) else ((), bound)
            outputs = equation.primitive.bind(*functions, *inputs, **rest)
            outputs = outputs if equation.primitive.multiple_results else [outputs]
        held |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(variable) for variable in jaxpr.outvars], left


def _while(
    params: dict[str, Any], inputs: list[Any], left: jax.Array
) -> tuple[list[Any], jax.Array]:
    """A `while` loop that also ends when no round is left."""
    of_cond, of_body = params["cond_nconsts"], params["body_nconsts"]
    for_cond, for_body = inputs[:of_cond], inputs[of_cond : of_cond + of_body]

    def condition(values: list[Any], left: jax.Array) -> tuple[jax.Array, jax.Array]:
        (go_on,), left = _evaluate(params["cond_jaxpr"], [*for_cond, *values], left)
        return go_on & (left > 0), left

    def goes_on(state: tuple[list[Any], jax.Array]) -> jax.Array:
        return condition(*state)[0].any()

    def body(state: tuple[list[Any], jax.Array]) -> tuple[list[Any], jax.Array]:
        values, left = state
        go_on, _ = condition(values, left)
        new, left = _evaluate(params["body_jaxpr"], [*for_body, *values], left)
        if go_on.ndim:  # a `vmap` inside, as of jacfwd: a part that has ended stays as it is
            new = [
                jnp.where(go_on.reshape(go_on.shape + (1,) * (was.ndim - go_on.ndim)), is_now, was)
                for is_now, was in zip(new, values, strict=True)
            ]
        return new, jnp.maximum(left - 1, 0)

    return jax.lax.while_loop(goes_on, body, (inputs[of_cond + of_body :], left))


def _scan(equation: Any, inputs: list[Any], left: jax.Array) -> tuple[list[Any], jax.Array]:
    """A scan with loops inside, which share the rounds that are left."""
    program, reverse = equation.params["jaxpr"], equation.params["reverse"]

    def count_whole(outside: Sequence[Any], inside: Sequence[Any]) -> int:
        """The number of variables that enter whole; those with the axis of the scan come after."""
        pairs = zip(outside, inside, strict=True)
        return sum(len(a.aval.shape) == len(b.aval.shape) for a, b in pairs)

    # The parameters that say what is a constant and what is carried differ between versions of JAX.
    end = count_whole(equation.invars, program.jaxpr.invars)
    carried = count_whole(equation.outvars, program.jaxpr.outvars)
    consts = inputs[: end - carried]

    def step(state: tuple[list[Any], jax.Array], x: list[Any]) -> tuple[Any, list[Any]]:
        values, left = state
        outputs, left = _evaluate(program, [*consts, *values, *x], left)
        return (outputs[:carried], left), outputs[carried:]

    start, length = (inputs[end - carried : end], left), equation.params["length"]
    (last, left), stacked = jax.lax.scan(step, start, inputs[end:], length, reverse)
    return [*last, *stacked], left


def _cond(
    params: dict[str, Any], inputs: list[Any], left: jax.Array
) -> tuple[list[Any], jax.Array]:
    """A branch, with loops in some of the branches."""

    def evaluate(branch: Any) -> Callable[..., tuple[list[Any], jax.Array]]:
        return lambda left, *operands: _evaluate(branch, operands, left)

    index, *operands = inputs
    outputs: tuple[list[Any], jax.Array] = jax.lax.switch(
        index, [evaluate(branch) for branch in params["branches"]], left, *operands
    )
    return outputs
