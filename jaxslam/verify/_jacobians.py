"""The Jacobians of a claim by four methods: forward, reverse, by hand, by differences."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree
from numpy.typing import DTypeLike

from jaxslam.core._names import unfit_signature
from jaxslam.core.claims import Claim
from jaxslam.math._xla import quick_jit
from jaxslam.verify._differences import Quotient, quotients
from jaxslam.verify._findings import Check
from jaxslam.verify._inputs.functions import at_state, periods, split_jacobian
from jaxslam.verify._inputs.samples import Samples
from jaxslam.verify._loops import ROUNDS, has_loop, with_loop_end
from jaxslam.verify._user_errors import describe_error

Values: TypeAlias = Float[np.ndarray, "_ _ _"]
"""Jacobians (S, m, n)."""

_Methods: TypeAlias = dict[str, list[Any]]
"""By the name of a method, (S, m, n_k) or None for each argument."""

_Batch: TypeAlias = Callable[..., tuple[Any, Any]]
"""States (S, n) of each argument -> the results, and (S,) whether the loops ended."""

_CHUNK = 2048
"""number of rows in one call of a compiled function"""
_FEW = 8
"""number of step sizes for a function that cannot be traced and is called state by state"""

MODES = {"jacfwd": jax.jacfwd, "jacrev": jax.jacrev}
"""modes of differentiation"""


class Jacobians(NamedTuple):
    """The Jacobians of one function by one argument at S states."""

    methods: dict[str, Values]
    """jacfwd, jacrev and hand in float64; a method that failed is missing"""
    single: dict[str, Values]
    """Jacobians computed in float32, held in float64; 0 at states where a loop has not ended"""
    single_error: np.ndarray
    """(S, m, n) error of autodiff in float32: of its arithmetic at the states rounded to float32,
    plus the error of rounding the states; () if unknown"""
    quotient: Quotient


class Evaluated(NamedTuple):
    """A claim with its values and Jacobians at the samples."""

    claim: Claim
    """claim with its outputs named"""
    samples: Samples
    """states at which the loops of the function end"""
    values: Float[np.ndarray, "S m"] | None
    """values in float64; None if the function cannot be called"""
    by_argument: tuple[Jacobians, ...] = ()
    checks: tuple[Check, ...] = ()
    notes: tuple[str, ...] = ()
    """remarks that are not failures"""
    loops: bool = False
    """True if the function has `while` loops"""


def evaluate_jacobians(claim: Claim, samples: Samples) -> Evaluated:
    """Compute every Jacobian of a claim in float64 and float32; failures become checks."""
    evaluator = _Evaluator(claim, samples)
    values: Float[np.ndarray, "S m"] | None = None
    by_argument: tuple[Jacobians, ...] = ()
    try:
        if (values := evaluator.values()) is not None:
            by_argument = evaluator.jacobians()
    except (Exception, SystemExit) as error:  # as of a callback that fails at some state
        evaluator.check(f"{claim.name} can be evaluated at every state", error)
        values = None
    checks, notes = tuple(evaluator.checks), tuple(evaluator.notes)
    claim, samples = evaluator.claim, evaluator.samples
    return Evaluated(claim, samples, values, by_argument, checks, notes, evaluator.loops)


class _Evaluator:
    """The evaluation of a claim, which collects checks on its way."""

    def __init__(self, claim: Claim, samples: Samples):
        self.claim, self.samples = claim, samples
        self.checks: list[Check] = []
        self.notes: list[str] = []
        self.traceable = self.one_by_one = self.loops = False

    @property
    def first(self) -> tuple[jax.Array, ...]:
        """The first state."""
        return tuple(jnp.asarray(table[0]) for table in self.samples.values)

    def check(self, name: str, trouble: BaseException | str = "", detail: str = "") -> None:
        """Add a check, failed where there is a trouble."""
        why = trouble if isinstance(trouble, str) else describe_error(trouble)
        self.checks.append(Check(name, not why, why or detail))

    def values(self) -> Float[np.ndarray, "S m"] | None:
        """The values at the states at which the loops end, the others being dropped with a check.

        None, with a failed check, where there are none, or they are not a vector.
        """
        name, function, named = self.claim.name, self.claim.function, self.claim.outputs
        if (got := unfit_signature(function, len(self.first))) is not None:
            names = ", ".join(argument.name for argument in self.claim.arguments)
            self.check(f"{name} can be called", f"{name} takes ({names}), got a function of {got}")
            return None
        try:
            program, value = jax.make_jaxpr(function, return_shape=True)(*self.first)
            self.traceable, self.loops = True, has_loop(program.jaxpr)
            self.check(f"{name} is traceable")
        except (Exception, SystemExit) as error:
            self.check(f"{name} is traceable", error)
            try:
                value = function(*self.first)
            except (Exception, SystemExit) as error:
                self.check(f"{name} can be called", error)
                return None
        shape: Any = getattr(value, "shape", None)
        wanted = f"({len(named) or 'm'},)"
        trouble = ""
        if np.issubdtype(getattr(value, "dtype", float), np.complexfloating):
            trouble = "returns complex numbers where real ones are expected"
        elif shape is None or len(shape) != 1 or len(named) not in (0, *shape):
            got = type(value).__name__ if shape is None else shape
            trouble = f"returns {got} where an array of shape {wanted} is expected"
        self.check(f"{name} returns its shape", trouble)
        if trouble:
            return None
        outputs = named or tuple(f"{name}[{k}]" for k in range(shape[0]))
        self.claim = replace(self.claim, outputs=outputs)
        self.one_by_one = not self.traceable
        self.batch = _state_by_state(function) if self.one_by_one else _in_chunks(function)
        try:
            values, ended = self.batch(*self.samples.values)
        except (Exception, SystemExit) as error:
            if self.one_by_one:
                raise
            self.check(f"{name} works under vmap", error)
            self.one_by_one, self.batch = True, _state_by_state(function)
            values, ended = self.batch(*self.samples.values)
        self._check_loops(name, ended)
        rows = np.flatnonzero(ended)
        labels = tuple(self.samples.labels[i] for i in rows)
        self.samples = Samples(tuple(table[rows] for table in self.samples.values), labels)
        return np.asarray(values[rows], np.float64) if len(rows) else None

    def jacobians(self) -> tuple[Jacobians, ...]:
        """The Jacobians by each argument; a mode or a precision that is missing is noted.

        A `while` loop has no reverse mode, a function with its own vector-Jacobian product
        (`jax.custom_vjp`) no forward mode. A hand-derived Jacobian that cannot be traced is called
        in float64 alone: its loops cannot be limited.
        """
        claim, name, tables = self.claim, self.claim.name, self.samples.values
        over = tuple(range(len(tables)))
        modes = MODES if self.traceable else {}
        derivatives = {how: mode(claim.function, argnums=over) for how, mode in modes.items()}
        methods, missing = self._traced(derivatives, np.float64)
        for how, error in missing.items() if methods else ():
            use = ", which filters use" if how == "jacfwd" else ""
            self.notes.append(f"{name} has no {how}{use}: {describe_error(error)}")
        if missing and not methods:
            self.check(f"{name} can be differentiated", missing["jacfwd"])
        has_modes, by_hand = bool(methods), None
        claimed = f"the Jacobian claimed for {name}"
        if (jacobian := claim.jacobian) is not None:

            def hand(*state: jax.Array) -> list[PyTree]:
                return split_jacobian(jacobian(*state), claim)

            traced, missing = self._traced({"hand": hand}, np.float64)
            methods |= traced
            for error in missing.values():
                try:
                    if not isinstance(error, jax.errors.JAXTypeError | TypeError):
                        raise error
                    by_hand, _ = _state_by_state(hand)(*tables)  # raises again what tracing did not
                    why = f"{describe_error(error)}; in float64 alone"
                    self.check(f"{claimed} is called state by state", detail=why)
                except (Exception, SystemExit) as fault:
                    self.check(f"{claimed} can be used", fault)
        double: _Methods = {}
        single: _Methods = {}
        reference: _Methods = {}
        compared = np.ones(len(tables[0]), bool)
        if methods:
            batch = _over_states(methods)
            double, ends = batch(*tables)
            for how, end in ends.items():
                self._check_loops(claimed if how == "hand" else f"a derivative of {name}", end)
        if has_modes:
            rounded = [table.astype(np.float32) for table in tables]
            reference, ends = batch(*(table.astype(np.float64) for table in rounded))
            _, missing = self._traced(methods, np.float32)
            for error in [*missing.values()][:1]:
                self.notes.append(f"{name} is compared in float64 alone: {describe_error(error)}")
            if not missing and by_hand is None:
                single, ends32 = batch(*rounded)
                compared = np.logical_and.reduce([*ends.values(), *ends32.values()])
        if not compared.all():
            count = f"{np.sum(~compared)} of {len(compared)}"
            self.notes.append(
                f"in float32 a while loop of {name} has not ended after {ROUNDS:,} rounds at "
                f"{count} states, which are compared in float64 alone"
            )
        if by_hand is not None:
            double["hand"] = by_hand
        if "hand" in double:
            parts = sum(part is not None for part in double["hand"])
            self.check(f"{claimed} has its shape", detail=f"{parts} claimed")
        mask = compared[:, None, None]
        by_argument = []
        for k in over:
            in_single = _of_argument(single if compared.any() else {}, k)
            rounding = np.asarray(
                _largest_gap(single, reference, k) + _largest_gap(reference, double, k)
            )
            by_argument.append(
                Jacobians(
                    _of_argument(double, k),
                    {how: np.where(mask, part, 0.0) for how, part in in_single.items()},
                    np.where(mask, rounding, 0.0) if rounding.ndim else rounding,
                    self._quotient(k),
                )
            )
        return tuple(by_argument)

    def _traced(
        self, functions: Mapping[str, Callable[..., PyTree]], dtype: DTypeLike
    ) -> tuple[dict[str, Callable[..., PyTree]], dict[str, BaseException]]:
        """The functions that JAX traces over states in a precision, and the others' errors."""
        traced: dict[str, Callable[..., PyTree]] = {}
        missing: dict[str, BaseException] = {}
        first = [table[:1].astype(dtype) for table in self.samples.values]
        for how, function in functions.items():
            compiled = jax.jit(function)  # traced once
            try:
                jax.eval_shape(jax.vmap(compiled), *first)
                traced[how] = compiled
            except (Exception, SystemExit) as error:
                missing[how] = error
        return traced, missing

    def _check_loops(self, subject: str, ended: Bool[np.ndarray, "S"]) -> None:
        """Add a failed check if the loops of something have not ended at some states."""
        if ended.all():
            return
        first = int(np.argmin(ended))
        at = at_state(self.claim, [table[first] for table in self.samples.values])
        self.check(
            f"the loops of {subject} end",
            f"in float64 a while loop has not ended after {ROUNDS:,} rounds at {np.sum(~ended)} of "
            f"{len(ended)} states; {self.samples.labels[first]}: {at}",
        )

    def _quotient(self, k: int) -> Quotient:
        """The Jacobian by differences."""

        def values(*tables: np.ndarray) -> np.ndarray:
            batch, ended = self.batch(*tables)
            return np.where(ended[:, None], batch, np.nan)

        circle = periods(self.claim.outputs)
        halvings = {"halvings": _FEW} if self.one_by_one else {}
        return quotients(values, self.samples.values, k, circle, **halvings)


def _over_states(functions: Mapping[str, Callable[..., PyTree]]) -> _Batch:
    """Derivatives over states: by each method a list of (S, m, n_k) or None, and where its loops
    end."""
    limited = {how: with_loop_end(function) for how, function in functions.items()}

    def at(*state: jax.Array) -> PyTree:
        return {how: function(*state) for how, function in limited.items()}

    batch = quick_jit(jax.vmap(at))

    def call(*tables: np.ndarray) -> tuple[_Methods, dict[str, np.ndarray]]:
        by_method = batch(*tables)
        ends = {how: np.asarray(by_method[how][1]) for how in limited}
        return {how: list(by_method[how][0]) for how in limited}, ends  # JAX sorts the names

    return call


def _in_chunks(function: Callable[..., PyTree]) -> _Batch:
    """The function over any number of states, _CHUNK at a time, so that it is compiled once."""
    batch = quick_jit(jax.vmap(with_loop_end(function)))

    def call(*tables: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(tables[0])
        padded = [np.resize(a, (-(-count // _CHUNK) * _CHUNK, *a.shape[1:])) for a in tables]
        parts = [
            jax.device_get(batch(*(a[start : start + _CHUNK] for a in padded)))
            for start in range(0, count, _CHUNK)
        ]
        values, ended = (np.concatenate(part)[:count] for part in zip(*parts, strict=True))
        return values, ended

    return call


def _state_by_state(function: Callable[..., PyTree]) -> _Batch:
    """The function applied state by state, if it cannot be traced or batched."""

    def call(*tables: np.ndarray) -> tuple[PyTree, np.ndarray]:
        rows = [function(*map(jnp.asarray, state)) for state in zip(*tables, strict=True)]
        return jax.tree.map(lambda *parts: np.stack(parts), *rows), np.ones(len(rows), bool)

    return call


def _of_argument(methods: _Methods, k: int) -> dict[str, Values]:
    """The Jacobians by argument k in float64, by each method that has one."""
    parts = {how: jacobians[k] for how, jacobians in methods.items()}
    return {how: np.asarray(p, np.float64) for how, p in parts.items() if p is not None}


def _largest_gap(methods: _Methods, others: _Methods, k: int) -> np.ndarray:
    """The largest difference by argument k between two computations of a mode; () without."""
    ours, theirs = _of_argument(methods, k), _of_argument(others, k)
    gaps = [np.abs(ours[how] - theirs[how]) for how in MODES if how in ours.keys() & theirs]
    worst: np.ndarray = np.max(gaps, axis=0) if gaps else np.zeros(())
    return np.where(np.isfinite(worst), worst, 0.0)
