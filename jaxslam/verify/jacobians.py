"""A Jacobian four ways (forward, reverse, by hand, by differences), and who is wrong."""

from collections.abc import Callable
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxslam.math.xla import quick_jit
from jaxslam.verify.differences import Quotient, complex_step, quotients
from jaxslam.verify.record import Check
from jaxslam.verify.samples import Samples
from jaxslam.verify.subject import Function, periods
from jaxslam.verify.trouble import told

Values = NDArray[np.float64]

_CHUNK = 2048
"""rows in one call of a compiled function"""
_FEW = 8
"""step sizes for a function that cannot be traced, which is called one state at a time"""


class Evaluation(NamedTuple):
    """The Jacobians of one function by one argument at S states."""

    methods: dict[str, Values]
    """jacfwd, jacrev, hand: (S, m, n) float64; a method that could not be had is missing"""
    single: dict[str, Values]
    """the same computed in float32, held in float64"""
    single_error: Values
    """(S, m, n) how far autodiff in float32 is from float64 at the states rounded to float32"""
    quotient: Quotient | None
    how: str


class Evaluated(NamedTuple):
    """All that is computed about one function."""

    function: Function
    """with its outputs named"""
    samples: Samples
    values: Values | None
    """(S, m) in float64"""
    by_argument: tuple[Evaluation, ...]
    checks: tuple[Check, ...]


def evaluate(function: Function, samples: Samples) -> Evaluated:
    """Compute every Jacobian of a function in float64 and float32. Troubles become checks."""
    arguments = samples.values
    return _Evaluator(function, samples, arguments).result()


class _Evaluator:
    def __init__(self, function: Function, samples: Samples, arguments: tuple[Values, ...]):
        self.function, self.samples, self.arguments = function, samples, arguments
        self.sizes = [a.shape[1] for a in arguments]
        self.over = tuple(range(len(arguments)))
        self.checks: list[Check] = []

    def result(self) -> Evaluated:
        outputs = self._outputs()
        if outputs is None:
            return Evaluated(self.function, self.samples, None, (), tuple(self.checks))
        function = self.function
        self.function = Function(
            function.name, function.call, function.arguments, outputs, function.hand
        )
        rounded = tuple(a.astype(np.float32) for a in self.arguments)
        double = self._autodiff(self.arguments)
        single = self._autodiff(rounded)
        reference = self._autodiff(tuple(a.astype(np.float64) for a in rounded))
        autodiff32 = dict(single)
        self._add_hand(double, single)
        values = np.asarray(self.values(*self.arguments), np.float64)
        evaluations = []
        for k in self.over:
            quotient, how = self._quotient(k)
            evaluations.append(
                Evaluation(
                    _of_argument(double, k),
                    _of_argument(single, k),
                    _worst_gap(_of_argument(autodiff32, k), _of_argument(reference, k)),
                    quotient,
                    how,
                )
            )
        return Evaluated(
            self.function, self.samples, values, tuple(evaluations), tuple(self.checks)
        )

    @cached_property
    def traceable(self) -> bool:
        """Whether JAX can trace the function; the check that says so is made here."""
        try:
            jax.eval_shape(self.function.call, *(a[0] for a in self.arguments))
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{self.function.name} is traceable", False, told(error)))
            return False
        self.checks.append(Check(f"{self.function.name} is traceable", True))
        return True

    def _outputs(self) -> tuple[str, ...] | None:
        name, named = self.function.name, self.function.outputs
        first = [jnp.asarray(a[0]) for a in self.arguments]
        call = self.function.call
        try:
            out = jax.eval_shape(call, *first) if self.traceable else call(*first)
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be called", False, told(error)))
            return None
        shape = getattr(out, "shape", None)
        if np.issubdtype(getattr(out, "dtype", float), np.complexfloating):
            self.checks.append(Check(f"{name} returns its shape", False, "returns complex numbers"))
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
    def values(self) -> Callable[..., Any]:
        """Batches of arguments -> values (B, m)."""
        if self.traceable:
            return _in_chunks(quick_jit(jax.vmap(self.function.call)))
        return _looped(self.function.call)

    @cached_property
    def both_modes(self) -> Callable[..., Any]:
        """Batches of arguments -> Jacobians by forward and by reverse mode."""

        def both(*arguments: jax.Array) -> Any:
            forward = jax.jacfwd(self.function.call, argnums=self.over)(*arguments)
            return forward, jax.jacrev(self.function.call, argnums=self.over)(*arguments)

        return quick_jit(jax.vmap(both))

    def _autodiff(self, arguments: tuple[Any, ...]) -> dict[str, list[Values | None]]:
        if not self.traceable:
            return {}
        try:
            forward, reverse = self.both_modes(*arguments)
        except (Exception, SystemExit) as error:
            name = f"{self.function.name} can be differentiated in {arguments[0].dtype}"
            if all(check.name != name for check in self.checks):
                self.checks.append(Check(name, False, told(error)))
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

        def hand(*arguments: Any) -> Any:
            return _as_claim(claim(*arguments))

        name = f"the Jacobian claimed for {self.function.name}"
        try:
            first = [jnp.asarray(a[0]) for a in self.arguments]
            try:
                shaped = self._split(jax.eval_shape(hand, *first))
                batch: Callable[..., Any] = quick_jit(jax.vmap(hand))
            except (jax.errors.JAXTypeError, TypeError) as error:
                shaped = self._split(hand(*first))  # raises again if it is not about tracing
                batch = _looped(hand)
                self.checks.append(Check(f"{name} is called state by state", True, told(error)))
            for into, dtype in ((double, np.float64), (single, np.float32)):
                parts = self._split(batch(*(a.astype(dtype) for a in self.arguments)))
                into["hand"] = [
                    None if part is None else np.asarray(part, np.float64) for part in parts
                ]
            claimed = sum(part is not None for part in shaped)
            self.checks.append(Check(f"{name} has its shape", True, f"{claimed} claimed"))
        except (Exception, SystemExit) as error:
            self.checks.append(Check(f"{name} can be used", False, told(error)))

    def _split(self, claim: Any) -> list[Any]:
        """One part an argument of what a hand-derived Jacobian returns; ValueError on a shape."""
        rows = len(self.function.outputs)
        if not isinstance(claim, tuple | list):
            shape = np.shape(claim)
            total = sum(self.sizes)
            if shape[-2:] == (rows, total) and len(self.sizes) > 1:
                ends = np.cumsum(self.sizes)[:-1]
                edges = [0, *ends.tolist(), total]
                if isinstance(claim, jax.ShapeDtypeStruct):
                    return [jax.ShapeDtypeStruct((rows, n), claim.dtype) for n in self.sizes]
                return [claim[..., a:b] for a, b in pairwise(edges)]
            claim = (claim, *(None for _ in self.over[1:]))
        if len(claim) != len(self.sizes):
            raise ValueError(
                f"returns {len(claim)} Jacobians where the function has {len(self.sizes)} arguments"
            )
        for part, size, argument in zip(claim, self.sizes, self.function.arguments, strict=True):
            if part is not None and np.shape(part)[-2:] != (rows, size):
                raise ValueError(
                    f"has shape {np.shape(part)[-2:]} by {argument.name}; expected ({rows}, {size})"
                )
        return list(claim)

    def _quotient(self, which: int) -> tuple[Quotient, str]:
        circle = periods(self.function.outputs)
        arguments = self.arguments
        halvings = {} if self.traceable else {"halvings": _FEW}
        found = quotients(self.values, arguments, which, circle, **halvings)
        if self.traceable and arguments[which].shape[1] and not np.isfinite(circle).any():
            try:
                exact = complex_step(self.values, arguments, which)
            except (Exception, SystemExit):
                return found, "differences"
            # Only where differences confirm it: `abs` or a comparison spoils it silently.
            off = np.abs(exact - found.value) > 10 * found.error + 1e-9 * np.abs(found.value)
            if np.isfinite(exact).all() and not off[found.error < np.inf].any():
                rounding = 1e-14 * np.abs(exact).max(axis=2, keepdims=True, initial=0)
                error = np.broadcast_to(rounding, exact.shape)
                return Quotient(exact, error, found.kink), "complex step"
        return found, "differences"


def _in_chunks(batch: Callable[..., Any]) -> Callable[..., Any]:
    """Any number of rows through a function of _CHUNK rows, so that it is compiled once."""

    def call(*arguments: Values) -> Any:
        count = len(arguments[0])
        padded = [np.resize(a, (-(-count // _CHUNK) * _CHUNK, *a.shape[1:])) for a in arguments]
        parts = [
            np.asarray(batch(*(a[start : start + _CHUNK] for a in padded)))
            for start in range(0, count, _CHUNK)
        ]
        return np.concatenate(parts)[:count]

    return call


def _of_argument(methods: dict[str, list[Values | None]], k: int) -> dict[str, Values]:
    parts = {name: jacobians[k] for name, jacobians in methods.items()}
    return {name: part for name, part in parts.items() if part is not None}


def _as_claim(claim: Any) -> Any:
    """A claim as one array, or as a tuple of them; a list of numbers is an array."""
    if claim is None:
        raise ValueError("returns None: is a `return` missing?")
    if isinstance(claim, list):
        nested = all(isinstance(row, list | tuple) for row in claim)
        return jnp.asarray(claim) if nested else tuple(claim)
    return claim


def _worst_gap(methods: dict[str, Values], reference: dict[str, Values]) -> Values:
    gaps = [np.abs(methods[how] - reference[how]) for how in methods if how in reference]
    worst: Values = np.max(gaps, axis=0) if gaps else np.zeros(())
    return np.where(np.isfinite(worst), worst, 0.0)


def _looped(call: Callable[..., Any]) -> Callable[..., Any]:
    """A batch one state at a time, for what cannot be traced; keeps None in tuples."""

    def batch(*arguments: Values) -> Any:
        rows = [call(*(jnp.asarray(a[i]) for a in arguments)) for i in range(len(arguments[0]))]
        if isinstance(rows[0], tuple | list):
            return tuple(
                None if part[0] is None else np.stack([np.asarray(p) for p in part])
                for part in zip(*rows, strict=True)
            )
        return np.stack([np.asarray(row) for row in rows])

    return batch
