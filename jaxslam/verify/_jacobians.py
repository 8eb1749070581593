"""The Jacobians of a function by four methods: forward, reverse, by hand, by differences."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree
from numpy.typing import DTypeLike

from jaxslam.math._xla import quick_jit
from jaxslam.verify._differences import Quotient, complex_step, quotients
from jaxslam.verify._findings import Check
from jaxslam.verify._inputs.functions import Function, as_claim, at_state, periods, split_claim
from jaxslam.verify._inputs.samples import Samples
from jaxslam.verify._loops import ROUNDS, has_loop, with_loop_end
from jaxslam.verify._user_errors import describe_error

Values: TypeAlias = Float[np.ndarray, "_ _ _"]
"""Jacobians (S, m, n)."""

States: TypeAlias = Float[np.ndarray, "_ _"]
"""States (S, n) of one argument."""

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
    quotient: Quotient | None
    how: str
    """the kind of quotient: differences or complex step"""


class Evaluated(NamedTuple):
    """A function with its values and Jacobians at the samples."""

    function: Function
    """function with its outputs named"""
    samples: Samples
    """states at which the loops of the function end"""
    values: Float[np.ndarray, "S m"] | None
    """values in float64; None if the function cannot be called"""
    by_argument: tuple[Jacobians, ...]
    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()
    """remarks that are not failures"""
    loops: bool = False
    """True if the function has `while` loops"""


def evaluate_jacobians(function: Function, samples: Samples) -> Evaluated:
    """Compute every Jacobian of a function in float64 and float32; failures become checks."""
    evaluator = _Evaluator(function, samples)
    try:
        return evaluator.result()
    except (Exception, SystemExit) as error:  # as of a callback that fails at some state
        check = Check(
            f"{function.name} can be evaluated at every state", False, describe_error(error)
        )
        return evaluator.without_values(check)


class _Evaluator:
    """The evaluation of a function, which collects checks on its way."""

    def __init__(self, function: Function, samples: Samples):
        self.function, self.samples = function, samples
        self.sizes = [a.shape[1] for a in samples.values]
        self.over = tuple(range(len(samples.values)))
        self.checks: list[Check] = []
        self.notes: list[str] = []
        self.loops = False
        self.modes = tuple(MODES)

    @property
    def arguments(self) -> tuple[States, ...]:
        """The states in float64."""
        return self.samples.values

    def without_values(self, *checks: Check) -> Evaluated:
        """The result for a function that cannot be evaluated."""
        checks = (*self.checks, *checks)
        return Evaluated(
            self.function, self.samples, None, (), checks, tuple(self.notes), self.loops
        )

    def result(self) -> Evaluated:
        outputs = self._outputs()
        if outputs is None:
            return self.without_values()
        self.function = replace(self.function, outputs=outputs)
        values = self._values_where_loops_end()
        if values is None:
            return self.without_values()
        rounded = tuple(a.astype(np.float32) for a in self.arguments)
        double, ended = self._autodiff(self.arguments)
        single, ended32 = self._autodiff(rounded)
        reference, ended64 = self._autodiff(tuple(a.astype(np.float64) for a in rounded))
        autodiff32, autodiff64 = dict(single), dict(double)
        hand_ended, hand_ended32 = self._add_hand(double, single)
        self._check_loops(f"a derivative of {self.function.name}", ended)
        self._check_loops(f"the Jacobian claimed for {self.function.name}", hand_ended)
        compared = ended32 & ended64 & hand_ended32  # in float32
        if not compared.all():
            self.notes.append(
                f"in float32 a while loop of {self.function.name} has not ended after {ROUNDS:,} "
                f"rounds at {np.sum(~compared)} of {len(compared)} states, which are compared in "
                "float64 alone"
            )
        if not compared.any():
            single.clear()
        evaluations = []
        for k in self.over:
            quotient, how = self._quotient(k)
            exact = _of_argument(reference, k)
            arithmetic = _worst_gap(_of_argument(autodiff32, k), exact)
            rounding = _worst_gap(exact, _of_argument(autodiff64, k))
            error, in_single = arithmetic + rounding, _of_argument(single, k)
            if not compared.all():
                error = np.where(compared[:, None, None], error, 0.0)
                in_single = {
                    how: np.where(compared[:, None, None], part, 0.0)
                    for how, part in in_single.items()
                }
            evaluations.append(Jacobians(_of_argument(double, k), in_single, error, quotient, how))
        return Evaluated(
            self.function,
            self.samples,
            values,
            tuple(evaluations),
            tuple(self.checks),
            tuple(self.notes),
            self.loops,
        )

    def _values_where_loops_end(self) -> Float[np.ndarray, "S m"] | None:
        """The values at the states at which the loops end; the others are left out, with a check.

        None if they end at no state. A function that fails under `vmap` is called state by state.
        """
        try:
            values, ended = self.values_and_ends(*self.arguments)
        except (Exception, SystemExit) as error:
            if not self.traceable:
                raise
            name = f"{self.function.name} works under vmap"
            self.checks.append(Check(name, False, describe_error(error)))
            self.values_and_ends = _StateByState(self.function.call)
            values, ended = self.values_and_ends(*self.arguments)
        self._check_loops(self.function.name, ended)
        if not ended.any():
            return None
        if not ended.all():
            rows = np.flatnonzero(ended)
            labels = tuple(self.samples.labels[i] for i in rows)
            self.samples = Samples(tuple(a[rows] for a in self.arguments), labels)
        return np.asarray(values[ended], np.float64)

    def _check_loops(self, subject: str, ended: Bool[np.ndarray, "S"]) -> None:
        """Add a failed check if the loops of something have not ended at some states."""
        if ended.all():
            return
        first = int(np.argmin(ended))
        state = at_state(self.function, [a[first] for a in self.arguments])
        self.checks.append(
            Check(
                f"the loops of {subject} end",
                False,
                f"in float64 a while loop has not ended after {ROUNDS:,} rounds at "
                f"{np.sum(~ended)} of {len(ended)} states; {self.samples.labels[first]}: {state}",
            )
        )

    @cached_property
    def traceable(self) -> bool:
        """Whether JAX can trace the function; also adds the check of it."""
        try:
            program = jax.make_jaxpr(self.function.call)(*(a[0] for a in self.arguments))
        except (Exception, SystemExit) as error:
            self.checks.append(
                Check(f"{self.function.name} is traceable", False, describe_error(error))
            )
            return False
        self.loops = has_loop(program.jaxpr)
        self.checks.append(Check(f"{self.function.name} is traceable", True))
        return True

    def _outputs(self) -> tuple[str, ...] | None:
        """The names of the outputs; None, with a failed check, if they are not a vector."""
        name, named = self.function.name, self.function.outputs
        first = [jnp.asarray(a[0]) for a in self.arguments]
        call = self.function.call
        try:
            value = jax.eval_shape(call, *first) if self.traceable else call(*first)
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be called", False, describe_error(error)))
            return None
        shape = getattr(value, "shape", None)
        if np.issubdtype(getattr(value, "dtype", float), np.complexfloating):
            self.checks.append(
                Check(
                    f"{name} returns its shape",
                    False,
                    "returns complex numbers where real ones are expected",
                )
            )
            return None
        wanted = f"({len(named)},)" if named else "(m,)"
        if shape is None or len(shape) != 1 or (named and shape != (len(named),)):
            got = type(value).__name__ if shape is None else shape
            detail = f"returns {got} where an array of shape {wanted} is expected"
            self.checks.append(Check(f"{name} returns its shape", False, detail))
            return None
        self.checks.append(Check(f"{name} returns its shape", True))
        return named or tuple(f"{name}[{k}]" for k in range(shape[0]))

    @cached_property
    def values_and_ends(self) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
        """The function of batches of arguments -> values (B, m), and (B,) whether its loops end."""
        if self.traceable:
            return _in_chunks(quick_jit(jax.vmap(with_loop_end(self.function.call))))
        return _StateByState(self.function.call)

    def values(self, *arguments: States) -> np.ndarray:
        """The values (B, m), NaN where the loops do not end."""
        values, ended = self.values_and_ends(*arguments)
        return np.where(ended[:, None], values, np.nan)

    @property
    def by_modes(self) -> Callable[..., PyTree]:
        """The function of batches of arguments -> by each mode, Jacobians and whether loops end."""
        jacobians = {
            name: with_loop_end(MODES[name](self.function.call, argnums=self.over))
            for name in self.modes
        }

        def jacobians_at(*arguments: jax.Array) -> PyTree:
            return {name: jacobian(*arguments) for name, jacobian in jacobians.items()}

        return quick_jit(jax.vmap(jacobians_at))

    def _autodiff(
        self, arguments: tuple[States, ...]
    ) -> tuple[dict[str, list[Values | None]], Bool[np.ndarray, "S"]]:
        """The Jacobians by each mode, and where their loops end."""
        ends = np.ones(len(arguments[0]), bool)
        if not (self.traceable and self.modes):
            return {}, ends
        try:
            by_mode = self.by_modes(*arguments)
        except (Exception, SystemExit) as error:
            if self._one_mode_is_missing():
                return self._autodiff(arguments)
            name = self.function.name
            if arguments[0].dtype == np.float32:
                self.notes.append(f"{name} is compared in float64 alone: {describe_error(error)}")
            else:
                check = Check(f"{name} can be differentiated", False, describe_error(error))
                self.checks.append(check)
            return {}, ends
        jacobians: dict[str, list[Values | None]] = {
            name: [np.asarray(part, np.float64) for part in parts]
            for name, (parts, _) in by_mode.items()
        }
        return jacobians, np.logical_and.reduce([np.asarray(end) for _, end in by_mode.values()])

    def _one_mode_is_missing(self) -> bool:
        """Whether one mode of differentiation is missing; it is noted and not used.

        A `while` loop has no reverse mode, a function with its own vector-Jacobian product
        (`jax.custom_vjp`) no forward mode.
        """
        reasons = {}
        for name in self.modes:
            try:
                jax.eval_shape(
                    MODES[name](self.function.call, argnums=self.over),
                    *(jnp.asarray(a[0]) for a in self.arguments),
                )
            except (Exception, SystemExit) as error:
                reasons[name] = describe_error(error)
        if len(reasons) == len(self.modes):
            self.modes = ()
        if len(reasons) != 1 or not self.modes:
            return False
        ((missing, why),) = reasons.items()
        self.modes = tuple(name for name in self.modes if name != missing)
        wanted = ", which filters use" if missing == "jacfwd" else ""
        self.notes.append(f"{self.function.name} has no {missing}{wanted}: {why}")
        return True

    def _add_hand(
        self, double: dict[str, list[Values | None]], single: dict[str, list[Values | None]]
    ) -> tuple[Bool[np.ndarray, "S"], Bool[np.ndarray, "S"]]:
        """Add the hand-derived Jacobian to both precisions; returns where its loops end in each.

        A claim that cannot be traced is called in float64 alone: its loops cannot be limited.
        """
        everywhere = np.ones(len(self.arguments[0]), bool)
        if self.function.hand is None:
            return everywhere, everywhere
        claim = self.function.hand

        def hand(*arguments: PyTree) -> PyTree:
            return as_claim(claim(*arguments))

        name = f"the Jacobian claimed for {self.function.name}"
        try:
            first = [jnp.asarray(a[0]) for a in self.arguments]
            try:
                shaped = self._split(jax.eval_shape(hand, *first))
                batch: Callable[..., PyTree] = quick_jit(jax.vmap(with_loop_end(hand)))
            except (jax.errors.JAXTypeError, TypeError) as error:
                shaped = self._split(hand(*first))  # raises again unless tracing was the fault
                batch = _StateByState(hand)
                single.clear()
                why = f"{describe_error(error)}; in float64 alone"
                self.checks.append(Check(f"{name} is called state by state", True, why))
            double["hand"], ends = self._claims(batch, np.float64)
            count = sum(part is not None for part in shaped)
            self.checks.append(Check(f"{name} has its shape", True, f"{count} claimed"))
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be used", False, describe_error(error)))
            return everywhere, everywhere
        if not single:
            return ends, everywhere
        try:
            single["hand"], ends32 = self._claims(batch, np.float32)
        except (Exception, SystemExit) as error:
            single.clear()
            self.notes.append(f"{name} is compared in float64 alone: {describe_error(error)}")
            return ends, everywhere
        return ends, ends32

    def _claims(
        self, batch: Callable[..., PyTree], dtype: DTypeLike
    ) -> tuple[list[Values | None], Bool[np.ndarray, "S"]]:
        """The claimed Jacobians at all states, computed in a precision, and where loops end."""
        claimed, ended = batch(*(a.astype(dtype) for a in self.arguments))
        parts = self._split(claimed)
        return [None if p is None else np.asarray(p, np.float64) for p in parts], np.asarray(ended)

    def _split(self, claim: PyTree) -> list[PyTree]:
        """A claimed Jacobian split by argument; raises ValueError on a wrong shape."""
        names = [argument.name for argument in self.function.arguments]
        return split_claim(claim, len(self.function.outputs), names, self.sizes)

    def _quotient(self, k: int) -> tuple[Quotient, str]:
        """The Jacobian by differences or, where possible, by the complex step; and which it is."""
        circle = periods(self.function.outputs)
        arguments = self.arguments
        one_by_one = isinstance(self.values_and_ends, _StateByState)
        halvings = {"halvings": _FEW} if one_by_one else {}
        by_differences = quotients(self.values, arguments, k, circle, **halvings)
        if not one_by_one and arguments[k].shape[1] and not np.isfinite(circle).any():
            try:
                exact = complex_step(self.values, arguments, k)
            except (Exception, SystemExit):
                return by_differences, "differences"
            # Only where differences confirm it: `abs` and comparisons make it wrong.
            off = np.abs(exact - by_differences.value) > 10 * by_differences.error + 1e-9 * np.abs(
                by_differences.value
            )
            if np.isfinite(exact).all() and not off[by_differences.error < np.inf].any():
                rounding = 1e-14 * np.abs(exact).max(axis=2, keepdims=True, initial=0)
                error = np.broadcast_to(rounding, exact.shape)
                return Quotient(exact, error, by_differences.kink), "complex step"
        return by_differences, "differences"


def _in_chunks(batch: Callable[..., PyTree]) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """The function applied to any number of rows, _CHUNK at a time, so that it is compiled once."""

    def call(*arguments: States) -> tuple[np.ndarray, np.ndarray]:
        count = len(arguments[0])
        padded = [np.resize(a, (-(-count // _CHUNK) * _CHUNK, *a.shape[1:])) for a in arguments]
        parts = [
            jax.device_get(batch(*(a[start : start + _CHUNK] for a in padded)))
            for start in range(0, count, _CHUNK)
        ]
        values, ended = (np.concatenate(part)[:count] for part in zip(*parts, strict=True))
        return values, ended

    return call


def _of_argument(methods: dict[str, list[Values | None]], k: int) -> dict[str, Values]:
    """The Jacobians by argument k, by each method that has one."""
    parts = {name: jacobians[k] for name, jacobians in methods.items()}
    return {name: part for name, part in parts.items() if part is not None}


def _worst_gap(methods: dict[str, Values], reference: dict[str, Values]) -> np.ndarray:
    """The largest difference of any method from its reference; () without methods."""
    gaps = [np.abs(methods[how] - reference[how]) for how in methods if how in reference]
    worst: np.ndarray = np.max(gaps, axis=0) if gaps else np.zeros(())
    return np.where(np.isfinite(worst), worst, 0.0)


class _StateByState:
    """The function applied state by state, if it cannot be traced; keeps None in tuples."""

    def __init__(self, call: Callable[..., PyTree]) -> None:
        self.call = call

    def __call__(self, *arguments: States) -> tuple[PyTree, np.ndarray]:
        """The results of all states, and that all have ended."""
        count = len(arguments[0])
        rows = [self.call(*(jnp.asarray(a[i]) for a in arguments)) for i in range(count)]
        ended = np.ones(count, bool)
        if isinstance(rows[0], tuple | list):
            return tuple(
                None if part[0] is None else np.stack([np.asarray(p) for p in part])
                for part in zip(*rows, strict=True)
            ), ended
        return np.stack([np.asarray(row) for row in rows]), ended
