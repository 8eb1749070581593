"""The Jacobians of a function by four methods: forward, reverse, by hand, by differences."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jaxslam.math._xla import quick_jit
from jaxslam.verify._differences import Batch, Quotient, complex_step, quotients
from jaxslam.verify._findings import Check
from jaxslam.verify._inputs.functions import Function, as_claim, periods, split_claim
from jaxslam.verify._inputs.samples import Samples
from jaxslam.verify._user_errors import describe_error

Values: TypeAlias = Float[np.ndarray, "_ _ _"]
"""Jacobians (S, m, n)."""

States: TypeAlias = Float[np.ndarray, "_ _"]
"""States (S, n) of one argument."""

_CHUNK = 2048
"""number of rows in one call of a compiled function"""
_FEW = 8
"""number of step sizes for a function that cannot be traced and is called state by state"""


class Jacobians(NamedTuple):
    """The Jacobians of one function by one argument at S states."""

    methods: dict[str, Values]
    """jacfwd, jacrev and hand in float64; a method that failed is missing"""
    single: dict[str, Values]
    """the same computed in float32, held in float64"""
    single_error: np.ndarray
    """(S, m, n) error of autodiff in float32: of its arithmetic at the states rounded to float32,
    plus that of rounding the states; () if unknown"""
    quotient: Quotient | None
    how: str
    """the kind of quotient: differences or complex step"""


class Evaluated(NamedTuple):
    """A function with its values and Jacobians at the samples."""

    function: Function
    """with its outputs named"""
    samples: Samples
    values: Float[np.ndarray, "S m"] | None
    """in float64; None if the function cannot be called"""
    by_argument: tuple[Jacobians, ...]
    checks: tuple[Check, ...]


def evaluate_jacobians(function: Function, samples: Samples) -> Evaluated:
    """Compute every Jacobian of a function in float64 and float32; failures become checks."""
    arguments = samples.values
    return _Evaluator(function, samples, arguments).result()


class _Evaluator:
    """One evaluation of a function, which collects checks on its way."""

    def __init__(self, function: Function, samples: Samples, arguments: tuple[States, ...]):
        self.function, self.samples, self.arguments = function, samples, arguments
        self.sizes = [a.shape[1] for a in arguments]
        self.over = tuple(range(len(arguments)))
        self.checks: list[Check] = []

    def result(self) -> Evaluated:
        outputs = self._outputs()
        if outputs is None:
            return Evaluated(self.function, self.samples, None, (), tuple(self.checks))
        self.function = replace(self.function, outputs=outputs)
        rounded = tuple(a.astype(np.float32) for a in self.arguments)
        double = self._autodiff(self.arguments)
        single = self._autodiff(rounded)
        reference = self._autodiff(tuple(a.astype(np.float64) for a in rounded))
        autodiff32, autodiff64 = dict(single), dict(double)
        self._add_hand(double, single)
        values = np.asarray(self.values(*self.arguments), np.float64)
        evaluations = []
        for k in self.over:
            quotient, how = self._quotient(k)
            exact = _of_argument(reference, k)
            arithmetic = _worst_gap(_of_argument(autodiff32, k), exact)
            rounding = _worst_gap(exact, _of_argument(autodiff64, k))
            evaluations.append(
                Jacobians(
                    _of_argument(double, k),
                    _of_argument(single, k),
                    arithmetic + rounding,
                    quotient,
                    how,
                )
            )
        return Evaluated(
            self.function,
            self.samples,
            values,
            tuple(evaluations),
            tuple(self.checks),
        )

    @cached_property
    def traceable(self) -> bool:
        """Whether JAX can trace the function; also adds the check of it."""
        try:
            jax.eval_shape(self.function.call, *(a[0] for a in self.arguments))
        except (Exception, SystemExit) as error:
            self.checks.append(
                Check(f"{self.function.name} is traceable", False, describe_error(error))
            )
            return False
        self.checks.append(Check(f"{self.function.name} is traceable", True))
        return True

    def _outputs(self) -> tuple[str, ...] | None:
        """The names of the outputs; None, with a failed check, if they are not a vector."""
        name, named = self.function.name, self.function.outputs
        first = [jnp.asarray(a[0]) for a in self.arguments]
        call = self.function.call
        try:
            out = jax.eval_shape(call, *first) if self.traceable else call(*first)
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be called", False, describe_error(error)))
            return None
        shape = getattr(out, "shape", None)
        if np.issubdtype(getattr(out, "dtype", float), np.complexfloating):
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
            got = type(out).__name__ if shape is None else shape
            detail = f"returns {got} where an array of shape {wanted} is expected"
            self.checks.append(Check(f"{name} returns its shape", False, detail))
            return None
        self.checks.append(Check(f"{name} returns its shape", True))
        return named or tuple(f"{name}[{k}]" for k in range(shape[0]))

    @cached_property
    def values(self) -> Batch:
        """The function of batches of arguments -> values (B, m)."""
        if self.traceable:
            return _in_chunks(quick_jit(jax.vmap(self.function.call)))
        return _loop(self.function.call)

    @cached_property
    def both_modes(self) -> Callable[..., PyTree]:
        """The function of batches of arguments -> Jacobians by forward and by reverse mode."""

        def both(*arguments: jax.Array) -> PyTree:
            forward = jax.jacfwd(self.function.call, argnums=self.over)(*arguments)
            return forward, jax.jacrev(self.function.call, argnums=self.over)(*arguments)

        return quick_jit(jax.vmap(both))

    def _autodiff(self, arguments: tuple[States, ...]) -> dict[str, list[Values | None]]:
        if not self.traceable:
            return {}
        try:
            forward, reverse = self.both_modes(*arguments)
        except (Exception, SystemExit) as error:
            name = f"{self.function.name} can be differentiated in {arguments[0].dtype}"
            if all(check.name != name for check in self.checks):
                self.checks.append(Check(name, False, describe_error(error)))
            return {}
        return {
            "jacfwd": [np.asarray(part, np.float64) for part in forward],
            "jacrev": [np.asarray(part, np.float64) for part in reverse],
        }

    def _add_hand(
        self, double: dict[str, list[Values | None]], single: dict[str, list[Values | None]]
    ) -> None:
        if self.function.hand is None:
            return
        claim = self.function.hand

        def hand(*arguments: PyTree) -> PyTree:
            return as_claim(claim(*arguments))

        name = f"the Jacobian claimed for {self.function.name}"
        try:
            first = [jnp.asarray(a[0]) for a in self.arguments]
            try:
                shaped = self._split(jax.eval_shape(hand, *first))
                batch: Callable[..., PyTree] = quick_jit(jax.vmap(hand))
            except (jax.errors.JAXTypeError, TypeError) as error:
                shaped = self._split(hand(*first))  # raises again unless tracing was the fault
                batch = _loop(hand)
                self.checks.append(
                    Check(f"{name} is called state by state", True, describe_error(error))
                )
            for into, dtype in ((double, np.float64), (single, np.float32)):
                parts = self._split(batch(*(a.astype(dtype) for a in self.arguments)))
                into["hand"] = [
                    None if part is None else np.asarray(part, np.float64) for part in parts
                ]
            claimed = sum(part is not None for part in shaped)
            self.checks.append(Check(f"{name} has its shape", True, f"{claimed} claimed"))
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be used", False, describe_error(error)))

    def _split(self, claim: PyTree) -> list[PyTree]:
        """A claimed Jacobian split by argument; raises ValueError on a wrong shape."""
        names = [argument.name for argument in self.function.arguments]
        return split_claim(claim, len(self.function.outputs), names, self.sizes)

    def _quotient(self, which: int) -> tuple[Quotient, str]:
        """The Jacobian by differences or, where possible, by the complex step; and which it is."""
        circle = periods(self.function.outputs)
        arguments = self.arguments
        halvings = {} if self.traceable else {"halvings": _FEW}
        found = quotients(self.values, arguments, which, circle, **halvings)
        if self.traceable and arguments[which].shape[1] and not np.isfinite(circle).any():
            try:
                exact = complex_step(self.values, arguments, which)
            except (Exception, SystemExit):
                return found, "differences"
            # Only where differences confirm it: `abs` and comparisons make it wrong.
            off = np.abs(exact - found.value) > 10 * found.error + 1e-9 * np.abs(found.value)
            if np.isfinite(exact).all() and not off[found.error < np.inf].any():
                rounding = 1e-14 * np.abs(exact).max(axis=2, keepdims=True, initial=0)
                error = np.broadcast_to(rounding, exact.shape)
                return Quotient(exact, error, found.kink), "complex step"
        return found, "differences"


def _in_chunks(batch: Batch) -> Batch:
    """The function applied to any number of rows, _CHUNK at a time, so that it is compiled once."""

    def call(*arguments: States) -> np.ndarray:
        count = len(arguments[0])
        padded = [np.resize(a, (-(-count // _CHUNK) * _CHUNK, *a.shape[1:])) for a in arguments]
        parts = [
            np.asarray(batch(*(a[start : start + _CHUNK] for a in padded)))
            for start in range(0, count, _CHUNK)
        ]
        return np.concatenate(parts)[:count]

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


def _loop(call: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The function applied state by state, if it cannot be traced; keeps None in tuples."""

    def batch(*arguments: States) -> PyTree:
        rows = [call(*(jnp.asarray(a[i]) for a in arguments)) for i in range(len(arguments[0]))]
        if isinstance(rows[0], tuple | list):
            return tuple(
                None if part[0] is None else np.stack([np.asarray(p) for p in part])
                for part in zip(*rows, strict=True)
            )
        return np.stack([np.asarray(row) for row in rows])

    return batch
