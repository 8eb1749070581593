"""Constants of a traced function turned into inputs, so that one program serves all their values.

A jaxpr has the arrays that a function closed over as constants, and its scalars as literals among
the operands. `hoisted` turns both into inputs, through calls, loops and branches. Literals that
are common in formulas remain, since XLA simplifies with them: 0, ±1, ±π/2, ±π, ±2π, infinities
and the limits of the dtype; so do integers, which may be sizes. Unknown primitives keep their
constants.
"""

import functools
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as _core

core: Any = _core


def hoisted(closed: Any) -> tuple[Callable[..., Any], list[Any]]:
    """A function (*numbers, *inputs) -> outputs that computes what a closed jaxpr does, and the
    numbers of that jaxpr.
    """
    jaxpr, numbers = _Hoisting().of(closed.jaxpr, closed.consts)
    return cast(Callable[..., Any], core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, []))), numbers


_PLAIN = frozenset(
    [sign * size for sign in (1, -1) for size in (0.0, 1.0, np.inf)]
    + [sign * np.pi * size for sign in (1, -1) for size in (0.5, 1.0, 2.0)]
)


def _is_number(atom: Any) -> bool:
    """Whether an operand is a literal number that may come from a parameter."""
    if not isinstance(atom, core.Literal) or not jnp.issubdtype(atom.aval.dtype, jnp.floating):
        return False
    value = float(atom.val)
    return not (math.isnan(value) or value in _kept(atom.aval.dtype))


@functools.cache
def _kept(dtype: Any) -> frozenset[float]:
    """The numbers of a dtype that remain literals."""
    limits = jnp.finfo(dtype)
    ends = {sign * float(end) for sign in (1, -1) for end in (limits.eps, limits.tiny, limits.max)}
    return frozenset({float(np.asarray(plain, dtype)) for plain in _PLAIN} | ends)


class _Hoisting:
    """One pass over a jaxpr, which rewrites each inner jaxpr once."""

    def __init__(self) -> None:
        self._done: dict[tuple[int, ...], tuple[Any, Any, Any]] = {}

    def of(self, jaxpr: Any, consts: Sequence[Any]) -> tuple[Any, list[Any]]:
        """The result of `hoisted` for a jaxpr and its constants."""
        which = id(jaxpr), *map(id, consts)
        known = self._done.get(which)
        if known is not None:
            return known[1:]
        inputs, numbers = list(jaxpr.constvars), list(consts)

        def given(values: Sequence[Any], avals: Sequence[Any]) -> list[Any]:
            new = [core.Var(aval) for aval in avals]
            inputs.extend(new)
            numbers.extend(values)
            return new

        eqns = []
        for eqn in jaxpr.eqns:
            atoms = [
                given([np.asarray(a.val, a.aval.dtype)], [a.aval])[0] if _is_number(a) else a
                for a in eqn.invars
            ]
            rewrite = _CALLS.get(eqn.primitive.name)
            eqn = eqn.replace(invars=atoms)
            eqns.append(eqn if rewrite is None else rewrite(self, eqn, given))
        new = jaxpr.replace(
            constvars=(),
            invars=[*inputs, *jaxpr.invars],
            eqns=eqns,
            debug_info=jaxpr.debug_info.with_unknown_names(),
        )
        self._done[which] = (jaxpr, consts), new, numbers
        return new, numbers

    def inner(self, closed: Any, given: "_Given") -> tuple[Any, list[Any]]:
        """The jaxpr of a call without its numbers, and the outer variables that replace them."""
        jaxpr, numbers = self.of(closed.jaxpr, closed.consts)
        return jaxpr, given(numbers, [var.aval for var in jaxpr.invars[: len(numbers)]])


_Given = Callable[[Sequence[Any], Sequence[Any]], list[Any]]
_Rewrite = Callable[[_Hoisting, Any, _Given], Any]


@functools.cache
def _plain_call() -> Any:
    """The handler of an equation that calls one function."""
    (eqn,) = jax.make_jaxpr(jax.jit(lambda x: x + 1.0))(0.0).eqns
    return eqn


def _call(work: _Hoisting, eqn: Any, given: _Given) -> Any:
    """The handler of jit."""
    jaxpr, new = work.inner(eqn.params["jaxpr"], given)
    params, plain = dict(eqn.params), _plain_call().params
    params["jaxpr"] = core.ClosedJaxpr(jaxpr, [])
    for name in ("donated_invars", "in_shardings", "in_layouts"):
        params[name] = (*(plain[name] * len(new)), *params[name])
    return eqn.replace(invars=[*new, *eqn.invars], params=params)


def _as_call(name: str) -> _Rewrite:
    """A call with custom differentiation rules, rewritten as a plain call."""

    def rewrite(work: _Hoisting, eqn: Any, given: _Given) -> Any:
        plain = _plain_call()
        params = dict(plain.params)
        params["jaxpr"] = eqn.params[name]
        for key in ("donated_invars", "in_shardings", "in_layouts"):
            params[key] = plain.params[key] * len(eqn.invars)
        for key in ("out_shardings", "out_layouts"):
            params[key] = plain.params[key] * len(eqn.outvars)
        return _call(work, eqn.replace(primitive=plain.primitive, params=params), given)

    return rewrite


def _scan(work: _Hoisting, eqn: Any, given: _Given) -> Any:
    """The handler of scan, whose constants come first."""
    jaxpr, new = work.inner(eqn.params["jaxpr"], given)
    params = dict(eqn.params)
    params["jaxpr"] = core.ClosedJaxpr(jaxpr, [])
    if "ft_in" in params:  # from jax 0.11 on, the inputs by kind
        of_inputs = params["ft_in"]
        consts, *others = of_inputs.unpack()
        pack: Any = sys.modules[type(of_inputs).__module__]
        params["ft_in"] = pack.pack((pack.pack((pack.nones(len(new)), consts)), *others))
    else:
        params["num_consts"] += len(new)
        if "linear" in params:
            params["linear"] = (*(False,) * len(new), *params["linear"])
    return eqn.replace(invars=[*new, *eqn.invars], params=params)


def _while(work: _Hoisting, eqn: Any, given: _Given) -> Any:
    """The handler of while: constants of the condition, then of the body, come first."""
    params, invars = dict(eqn.params), list(eqn.invars)
    at = 0
    for kind in ("cond", "body"):
        jaxpr, new = work.inner(params[f"{kind}_jaxpr"], given)
        params[f"{kind}_jaxpr"] = core.ClosedJaxpr(jaxpr, [])
        invars[at:at] = new
        params[f"{kind}_nconsts"] += len(new)
        at += params[f"{kind}_nconsts"]
    return eqn.replace(invars=invars, params=params)


def _cond(work: _Hoisting, eqn: Any, given: _Given) -> Any:
    """The handler of cond: every branch takes the numbers of all branches."""
    found = [work.inner(branch, given) for branch in eqn.params["branches"]]
    new = [var for _, mine in found for var in mine]
    branches = []
    for i, (jaxpr, mine) in enumerate(found):
        before, after = (
            [core.Var(var.aval) for _, others in part for var in others]
            for part in (found[:i], found[i + 1 :])
        )
        own, rest = jaxpr.invars[: len(mine)], jaxpr.invars[len(mine) :]
        whole = jaxpr.replace(
            invars=[*before, *own, *after, *rest], debug_info=jaxpr.debug_info.with_unknown_names()
        )
        branches.append(core.ClosedJaxpr(whole, []))
    params = eqn.params | {"branches": tuple(branches)}
    return eqn.replace(invars=[eqn.invars[0], *new, *eqn.invars[1:]], params=params)


def _checkpoint(work: _Hoisting, eqn: Any, given: _Given) -> Any:
    """The handler of checkpoint, whose jaxpr is open."""
    jaxpr, new = work.inner(core.ClosedJaxpr(eqn.params["jaxpr"], []), given)
    return eqn.replace(invars=[*new, *eqn.invars], params=eqn.params | {"jaxpr": jaxpr})


_CALLS: dict[str, _Rewrite] = {
    "jit": _call,
    "pjit": _call,
    "custom_jvp_call": _as_call("call_jaxpr"),
    "custom_vjp_call": _as_call("call_jaxpr"),
    "custom_vmap_call": _as_call("call"),
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "checkpoint": _checkpoint,
    "remat2": _checkpoint,
}
