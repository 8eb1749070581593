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
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import AbstractValue, ShapedArray
from jax.extend import core as _core
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import PyTree

core: Any = _core
"""Its names and their types differ from one JAX to another."""


def hoisted(closed: Jaxpr) -> tuple[Callable[..., list[Array]], list[ArrayLike]]:
    """A function (*numbers, *inputs) -> outputs that computes what a closed jaxpr does, and the
    numbers of that jaxpr.
    """
    jaxpr, numbers = _Hoisting().of(closed.jaxpr, closed.consts)
    return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, [])), numbers


_PLAIN = frozenset(
    [sign * size for sign in (1, -1) for size in (0.0, 1.0, np.inf)]
    + [sign * np.pi * size for sign in (1, -1) for size in (0.5, 1.0, 2.0)]
)


def _number_of(atom: Literal | Var) -> np.ndarray | None:
    """The number of a literal that may come from a parameter; None of any other operand."""
    kind = atom.aval
    if not isinstance(atom, Literal) or not isinstance(kind, ShapedArray):
        return None
    if not jnp.issubdtype(kind.dtype, jnp.floating):
        return None
    value = float(atom.val)
    if math.isnan(value) or value in _kept(kind.dtype):
        return None
    return np.asarray(value, kind.dtype)


@functools.cache
def _kept(dtype: DTypeLike) -> frozenset[float]:
    """The numbers of a dtype that remain literals."""
    limits = jnp.finfo(dtype)
    ends = {sign * float(end) for sign in (1, -1) for end in (limits.eps, limits.tiny, limits.max)}
    return frozenset({float(np.asarray(plain, dtype)) for plain in _PLAIN} | ends)


class _Hoisting:
    """One pass over a jaxpr, which rewrites each inner jaxpr once."""

    def __init__(self) -> None:
        self._done: dict[tuple[int, ...], tuple[PyTree, Jaxpr, list[ArrayLike]]] = {}

    def of(self, jaxpr: Jaxpr, consts: Sequence[ArrayLike]) -> tuple[Jaxpr, list[ArrayLike]]:
        """The result of `hoisted` for a jaxpr and its constants."""
        which = id(jaxpr), *map(id, consts)
        known = self._done.get(which)
        if known is not None:
            return known[1:]
        inputs, numbers = list(jaxpr.constvars), list(consts)

        def given(values: Sequence[ArrayLike], avals: Sequence[AbstractValue]) -> list[Var]:
            new = [Var(aval) for aval in avals]
            inputs.extend(new)
            numbers.extend(values)
            return new

        eqns = []
        for eqn in jaxpr.eqns:
            atoms: list[Literal | Var] = []
            for atom in eqn.invars:
                number = _number_of(atom)
                atoms.append(atom if number is None else given([number], [atom.aval])[0])
            rewrite = _CALLS.get(eqn.primitive.name)
            eqn = _changed(eqn, atoms, eqn.params)
            eqns.append(eqn if rewrite is None else rewrite(self, eqn, given))
        new = jaxpr.replace(
            constvars=(),
            invars=[*inputs, *jaxpr.invars],
            eqns=eqns,
            debug_info=jaxpr.debug_info.with_unknown_names(),
        )
        self._done[which] = (jaxpr, consts), new, numbers
        return new, numbers

    def inner(self, closed: Jaxpr, given: "_Given") -> tuple[Jaxpr, list[Var]]:
        """The jaxpr of a call without its numbers, and the outer variables that replace them."""
        jaxpr, numbers = self.of(closed.jaxpr, closed.consts)
        return jaxpr, given(numbers, [var.aval for var in jaxpr.invars[: len(numbers)]])


_Given = Callable[[Sequence[ArrayLike], Sequence[AbstractValue]], list[Var]]
_Rewrite = Callable[[_Hoisting, JaxprEqn, _Given], JaxprEqn]


def _changed(
    eqn: JaxprEqn, invars: Sequence[Literal | Var], params: Mapping[str, object]
) -> JaxprEqn:
    """The equation with other operands and parameters."""
    changed: JaxprEqn = eqn.replace(invars=list(invars), params=dict(params))
    return changed


@functools.cache
def _plain_call() -> JaxprEqn:
    """The handler of an equation that calls one function."""
    (eqn,) = jax.make_jaxpr(jax.jit(lambda x: x + 1.0))(0.0).eqns
    return eqn


def _call(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
    """The handler of jit."""
    jaxpr, new = work.inner(eqn.params["jaxpr"], given)
    params, plain = dict(eqn.params), _plain_call().params
    params["jaxpr"] = core.ClosedJaxpr(jaxpr, [])
    for name in ("donated_invars", "in_shardings", "in_layouts"):
        params[name] = (*(plain[name] * len(new)), *params[name])
    return _changed(eqn, [*new, *eqn.invars], params)


def _as_call(name: str) -> _Rewrite:
    """A call with custom differentiation rules, rewritten as a plain call."""

    def rewrite(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
        plain = _plain_call()
        params = dict(plain.params)
        params["jaxpr"] = eqn.params[name]
        for key in ("donated_invars", "in_shardings", "in_layouts"):
            params[key] = plain.params[key] * len(eqn.invars)
        for key in ("out_shardings", "out_layouts"):
            params[key] = plain.params[key] * len(eqn.outvars)
        called: JaxprEqn = eqn.replace(primitive=plain.primitive, params=params)
        return _call(work, called, given)

    return rewrite


def _scan(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
    """The handler of scan, whose constants come first."""
    jaxpr, new = work.inner(eqn.params["jaxpr"], given)
    params = dict(eqn.params)
    params["jaxpr"] = core.ClosedJaxpr(jaxpr, [])
    if "ft_in" in params:  # from jax 0.11 on, the inputs by kind
        of_inputs = params["ft_in"]
        consts, *others = of_inputs.unpack()
        pack = sys.modules[type(of_inputs).__module__]
        params["ft_in"] = pack.pack((pack.pack((pack.nones(len(new)), consts)), *others))
    else:
        params["num_consts"] += len(new)
        if "linear" in params:
            params["linear"] = (*(False,) * len(new), *params["linear"])
    return _changed(eqn, [*new, *eqn.invars], params)


def _while(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
    """The handler of while: constants of the condition, then of the body, come first."""
    params, invars = dict(eqn.params), list(eqn.invars)
    at = 0
    for kind in ("cond", "body"):
        jaxpr, new = work.inner(params[f"{kind}_jaxpr"], given)
        params[f"{kind}_jaxpr"] = core.ClosedJaxpr(jaxpr, [])
        invars[at:at] = new
        params[f"{kind}_nconsts"] += len(new)
        at += params[f"{kind}_nconsts"]
    return _changed(eqn, invars, params)


def _cond(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
    """The handler of cond: every branch takes the numbers of all branches."""
    found = [work.inner(branch, given) for branch in eqn.params["branches"]]
    new = [var for _, mine in found for var in mine]
    branches = []
    for i, (jaxpr, mine) in enumerate(found):
        before, after = (
            [Var(var.aval) for _, others in part for var in others]
            for part in (found[:i], found[i + 1 :])
        )
        own, rest = jaxpr.invars[: len(mine)], jaxpr.invars[len(mine) :]
        whole = jaxpr.replace(
            invars=[*before, *own, *after, *rest], debug_info=jaxpr.debug_info.with_unknown_names()
        )
        branches.append(core.ClosedJaxpr(whole, []))
    params = eqn.params | {"branches": tuple(branches)}
    return _changed(eqn, [eqn.invars[0], *new, *eqn.invars[1:]], params)


def _checkpoint(work: _Hoisting, eqn: JaxprEqn, given: _Given) -> JaxprEqn:
    """The handler of checkpoint, whose jaxpr is open."""
    jaxpr, new = work.inner(core.ClosedJaxpr(eqn.params["jaxpr"], []), given)
    return _changed(eqn, [*new, *eqn.invars], eqn.params | {"jaxpr": jaxpr})


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
