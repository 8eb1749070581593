"""Checks of values before tracing, and the errors that say which value of what is wrong.

A check is a function of a value. It returns the value, or its converted form where several forms
are accepted, and raises ValueError with the reason alone. Beside a field (`core.record.field`,
`core.record.static`) the record adds the field and its class. For an argument `require` adds the
argument, and the public function, which opens `refusals_of` once around its checks, its name: no
check takes the name of its caller. What JAX traces is checked for its shape and dtype alone.

    with refusals_of("simulate"):
        require("scenario", scenario, instance_of(World))
"""

import math
import warnings
from collections.abc import Callable
from numbers import Integral
from os import PathLike
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam._public import publish
from jaxslam.core._reprs import describe, real_array, shape_text, with_article
from jaxslam.core._units import TURN
from jaxslam.math._arrays import as_array, is_concrete
from jaxslam.math._definite import is_asymmetric, is_indefinite

__all__ = [
    "Check",
    "InvalidField",
    "InvalidFile",
    "array_of",
    "at_least",
    "covariance",
    "finite",
    "in_range",
    "instance_of",
    "is_concrete",
    "mounting_pose",
    "names",
    "not_negative",
    "one_of",
    "or_none",
    "positive",
    "prng_key",
    "probability",
    "real",
    "refusals_of",
    "require",
]

Check = Callable[[Any], Any]
"""value -> the value as it is kept; raises ValueError with the reason"""


class InvalidField(ValueError):
    """A field of a record, or an argument of a function, that is not what was expected."""

    def __init__(self, field: str, reason: str, *, owner: str = "") -> None:
        reason = " ".join(reason.split()) if "\n" in reason else reason  # of an array, say
        super().__init__(field, reason)
        self.owner = owner
        """the class of the record, or the function; "" until a `refusals_of` fills it in"""
        self.field = field
        """"" where the reason is about several"""
        self.reason = reason
        """what was expected, and what it got"""

    def __str__(self) -> str:
        return ": ".join(part for part in (self.owner, self.field, self.reason) if part)


class InvalidFile(ValueError):
    """A file that cannot be read as what it should be."""

    def __init__(
        self,
        path: str | PathLike[str],
        reason: str,
        line: int | None = None,
        column: str | None = None,
    ) -> None:
        super().__init__(path, reason, line, column)
        self.path = path
        self.reason = reason
        """what was expected, and what it got"""
        self.line = line
        """counted from 1; None where the reason is about the file"""
        self.column = column
        """the name of the column or key; None where the reason is about the line"""

    def __str__(self) -> str:
        place = f"{self.path}" if self.line is None else f"{self.path}:{self.line}"
        return ": ".join(part for part in (place, self.column, self.reason) if part)


class refusals_of:
    """A context that fills in the owner of an InvalidField that has none.

    owner: the function or command whose arguments are checked within. A class adds no frame to a
    traceback, as a generator's context would.
    """

    def __init__(self, owner: str) -> None:
        self.owner = owner

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if isinstance(error, InvalidField) and not error.owner:
            error.owner = self.owner


def require(field: str, value: Any, check: Check) -> Any:
    """The value as a check returns it; InvalidField, with the field, where it refuses.

    A field that is refused within the value is named as log.control.
    """
    try:
        return check(value)
    except InvalidField as error:
        if error.owner:  # of a record within, which names itself
            raise
        inner = ".".join(part for part in (field, error.field) if part)
        raise InvalidField(inner, error.reason) from error.__cause__
    except ValueError as error:
        raise InvalidField(field, str(error)) from None


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of an array, or of numbers in lists; None of rows of unlike lengths."""
    try:
        return np.shape(value) if is_concrete(value) else jnp.asarray(value).shape
    except (TypeError, ValueError):
        return None


# --- checks -------------------------------------------------------------------------------------


def or_none(check: Check) -> Check:
    """The check of a value that may be None."""
    return lambda value: None if value is None else check(value)


def instance_of(kind: type, hint: str = "") -> Check:
    """The check of an instance of a class.

    hint: advice that follows the reason, where no other is known.
    """

    def check(value: Any) -> Any:
        if isinstance(value, kind):
            return value
        got = describe(value)
        if callable(value) and not isinstance(value, type):
            name = getattr(value, "__name__", type(value).__name__)
            got = f"the function {name}: call it, {name}(…)"
        # Of a tuple of results, as `Loaded` of a file, a field may have been meant.
        fields = getattr(value, "_fields", ())
        field = next((name for name in fields if isinstance(getattr(value, name), kind)), None)
        advice = f"; give its field {field}" if field else hint
        raise ValueError(f"expected {with_article(kind.__name__)}, got {got}{advice}")

    return check


def one_of(*choices: object) -> Check:
    """The check of one of several values, compared by ==."""

    def check(value: Any) -> Any:
        if np.ndim(value) == 0 and value in choices:  # an array has no single truth value
            return value
        expected = " or ".join(f'"{c}"' if isinstance(c, str) else repr(c) for c in choices)
        raise ValueError(f"expected {expected}, got {describe(value)}")

    return check


def names(value: Any) -> Any:
    """The check of a tuple of names."""
    if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value):
        raise ValueError(f'expected a tuple of names as ("x [m]",), got {value!r}')
    return value


def at_least(least: int) -> Check:
    """The check of an integer >= least; a bool is no integer."""

    def check(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
            raise ValueError(f"expected an integer >= {least}, got {value!r}")
        return value

    return check


def positive(value: Any) -> Any:
    """The check of a finite number above 0."""
    return in_range(0.0, math.inf, open=True)(value)


def not_negative(value: Any) -> Any:
    """The check of a finite number >= 0."""
    finite(least=0.0)(value)
    return value


def in_range(low: float, high: float, *, open: bool = False) -> Check:
    """The check of a number from low to high; open: without the ends."""
    expected = f"a number from {low:g} to {high:g}"
    if open:
        expected = f"a number above {low:g}" + f" and below {high:g}" * (high < math.inf)

    def check(value: Any) -> Any:
        number = real_array(value)
        if number is not None and number.shape == ():
            inside = True  # a tracer, whose value is not known
            if is_concrete(number):
                inside = bool(low < number < high if open else low <= number <= high)
            if inside:
                return value
        raise ValueError(f"expected {expected}, got {describe(value)}")

    return check


def probability(value: Any) -> Any:
    """The check of a gate's probability, above 0 and below 1.

    A number that seems to be a squared distance d² is answered with its probability.
    """
    number = real_array(value)
    if number is not None and number.shape == ():
        if not is_concrete(number) or 0 < number < 1:
            return value
        hint = " (None for no gate)" if number >= 1 else ""
        # χ² of 2 degrees of freedom is exponential: P(d² <= g) = 1 - exp(-g/2). Its nines are
        # shown, at most twelve, since 1 - 1e-16 is 1.
        tail = math.exp(-float(number) / 2) if number > 1 else 0.0
        if tail > 1e-12:
            p = f"{1 - tail:.{1 - math.floor(math.log10(tail))}f}".rstrip("0")
            hint = f" (the χ² quantile {number:g} of 2 degrees of freedom is that of {p})"
        raise ValueError(f"expected a probability above 0 and below 1, as 0.999, got {value}{hint}")
    raise ValueError(f"expected a probability above 0 and below 1, as 0.999, got {describe(value)}")


def real(value: Any) -> Any:
    """The check of a real number, or of an array of them; a bool counts as a number."""
    if is_concrete(value):
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError):  # a key; rows of unlike lengths
            dtype = np.dtype(object)
        if not any(jnp.issubdtype(dtype, kind) for kind in (np.integer, np.floating, np.bool_)):
            got = repr(value) if isinstance(value, tuple | list) else describe(value)
            raise ValueError(f"expected real numbers, got {got}")
    return value


def array_of(*shape: int | str, kind: type = np.generic) -> Check:
    """The check of an array of this shape, in which a letter is any size, and of this kind."""

    def check(value: Any) -> Any:
        got = shape_text(value)
        sizes = np.shape(value) if got.startswith("(") else ()
        if len(sizes) != len(shape) or any(
            isinstance(n, int) and n != m for n, m in zip(shape, sizes, strict=True)
        ):
            expected = ", ".join(map(str, shape)) + "," * (len(shape) == 1)
            raise ValueError(f"expected shape ({expected}), got {got}")
        if not hasattr(value, "dtype"):
            raise ValueError(f"expected an array, got {with_article(type(value).__name__)}")
        dtype = jnp.result_type(value)
        if not jnp.issubdtype(dtype, kind):
            raise ValueError(f"expected {kind.__name__} values, got {dtype}")
        return value

    return check


def finite(*shape: int, least: float = -math.inf) -> Check:
    """The check of finite real numbers of a shape, each >= least; lists become an array."""
    expected = f"finite numbers of shape {shape}" if shape else "a finite number"
    expected += f" >= {least:g}" * (least > -math.inf)

    def check(value: Any) -> Any:
        array = real_array(value)
        if array is None or array.shape != shape:
            raise ValueError(f"expected {expected}, got {describe(value)}")
        if is_concrete(array):
            numbers = np.asarray(array)
            if not np.all(np.isfinite(numbers) & (numbers >= least)):
                raise ValueError(f"expected {expected}, got {' '.join(str(numbers).split())}")
        return as_array(value)

    return check


def covariance(size: int) -> Check:
    """The check of a covariance (size, size): finite, symmetric, positive semi-definite."""

    def check(value: Any) -> Any:
        shape = _shape(value)
        if shape != (size, size):
            got = str(shape) if shape else describe(value)
            raise ValueError(f"expected a covariance of shape {(size, size)}, got {got}")
        if (array := real_array(value)) is None:
            raise ValueError(f"expected real numbers, got dtype {np.asarray(value).dtype}")
        if not is_concrete(array):
            return as_array(value)
        matrix = np.asarray(array)
        if not np.issubdtype(matrix.dtype, np.floating):
            matrix = matrix.astype(np.float64)
        if not np.all(np.isfinite(matrix)):
            raise ValueError("the covariance has a NaN or an infinity")
        # 1e-6: numbers are often written with six digits.
        if is_asymmetric(matrix, 1e-6):
            raise ValueError("the covariance is not symmetric")
        if is_indefinite(matrix, 1e-6):
            variance = np.diagonal(matrix).min()
            eigenvalue = np.linalg.eigvalsh(matrix.astype(np.float64))[0]
            cause = "negative variance" if variance < 0 else f"eigenvalue {eigenvalue:.3g}"
            raise ValueError(f"the covariance is not positive semi-definite ({cause})")
        return as_array(value)

    return check


def mounting_pose(value: Any) -> Any:
    """The check of a sensor's pose (3,) on the robot; a list becomes an array.

    Warns of a heading beyond 2π, which may be in degrees.
    """
    array, shape = real_array(value), _shape(value)
    if array is None or shape != (3,):
        got = str(shape) if shape else describe(value)
        raise ValueError(f"expected a mounting pose of shape (3,), got {got}")
    if is_concrete(array):
        if not np.all(np.isfinite(np.asarray(array))):
            raise ValueError("the mounting pose is not finite")
        if abs(heading := float(np.asarray(array)[2])) > TURN:
            warnings.warn(
                f"the heading of the mounting pose, {heading:g} rad, is beyond 2π: is it in "
                "degrees?",
                # through `require`, `check_field`, two __post_init__ and __init__ to the user
                stacklevel=7,
            )
    return as_array(value)


def prng_key(value: Any) -> Any:
    """The check of one PRNG key: of `jax.random.key`, or the raw numbers of one."""
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if shape != ():
            raise ValueError(f"expected one PRNG key, got keys of shape {shape}")
    elif dtype != np.uint32 or shape is None or len(shape) != 1:
        got = describe(value) if dtype is None else f"an array of {dtype} of shape {shape}"
        raise ValueError(f"expected a PRNG key, as jax.random.key(0), got {got}")
    return value


publish(__name__)
