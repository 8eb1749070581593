"""Records: frozen dataclasses whose numbers are leaves of a pytree.

A field of a record is a number, an array, None, another record, or a tuple of these; one that is
declared by `static` is part of the program instead.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

from jaxslam.core._names import unfit_signature
from jaxslam.core._reprs import describe, with_article
from jaxslam.core.validation import Check, InvalidField, refusals_of, require

_T = TypeVar("_T")


def field(*, check: Check | None = None, **options: Any) -> Any:
    """A field of data, whose numbers are leaves.

    check: of `core.validation`, or a function of the value that returns it, converted or not, and
    raises ValueError with the reason alone. options: those of `dataclasses.field`.
    """
    return dataclasses.field(**options, metadata={"check": check})


def static(*, check: Check | None = None, **options: Any) -> Any:
    """A field that is part of the program: a size, a name, a choice, a function.

    Records whose static fields differ are compiled apart, so a value is hashable and compared by
    ==, a function by identity. check, options: as of `field`.
    """
    return dataclasses.field(**options, metadata={"check": check, "static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(field, static, dataclasses.field))
def record(cls: type[_T]) -> type[_T]:
    """The class as a frozen dataclass and a pytree, whose fields are its children.

    What `jax.grad`, `jax.vmap` and `jax.tree.map` return of a record is one of its class.
    `dataclasses.replace` changes fields, and checks them again.

    A record that is made by its class first checks each field by the field's `check`, then runs
    `__post_init__`, for what is between fields, then refuses fields of another kind. An
    InvalidField raised there needs no owner: it is the class. JAX rebuilds records without any
    check, since it fills them with tracers, stacks and derivatives.

    Raises InvalidField, a ValueError, at construction.
    """
    between_fields = getattr(cls, "__post_init__", None)

    def __post_init__(self: Any) -> None:
        checked = type(self) is cls  # not where a subclass calls super().__post_init__()
        with refusals_of(type(self).__name__):
            try:
                if checked:
                    _check_declared(self, checks)
                elif "__dataclass_fields__" not in type(self).__dict__:
                    raise InvalidField("", "expected @record above the class")
                if between_fields is not None:
                    between_fields(self)
            except TypeError:  # of a value that cannot be compared, as text: its kind says more
                _check_kinds(self)
                raise
            if checked:
                _check_kinds(self)

    cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
    cls.__setstate__ = _set_state  # type: ignore[attr-defined]
    if cls.__repr__ is object.__repr__:  # else the class, or one above it, has a repr of its own
        cls.__repr__ = _repr_of_fields  # type: ignore[method-assign]
    dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    # A field that is declared again, with another default say, keeps the check from above.
    checks = {
        name: inherited.metadata["check"]
        for base in reversed(cls.__mro__)
        for name, inherited in base.__dict__.get("__dataclass_fields__", {}).items()
        if inherited.metadata.get("check") is not None
    }
    _register(cls)
    return cls


def _register(cls: type) -> None:
    """Make a class of records known to JAX.

    `jax.tree_util.register_dataclass` is of no use: it rebuilds by the constructor, with its
    checks.
    """
    fields = dataclasses.fields(cls)
    data = tuple(field.name for field in fields if not field.metadata.get("static"))
    program = tuple(field.name for field in fields if field.metadata.get("static"))
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(self: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        values = self.__dict__
        return tuple([values[name] for name in data]), tuple([values[name] for name in program])

    def flatten_with_keys(self: Any) -> tuple[Iterable[tuple[Any, Any]], tuple[Any, ...]]:
        children, structure = flatten(self)
        return zip(keys, children, strict=True), structure

    def unflatten(structure: tuple[Any, ...], children: Iterable[Any]) -> Any:
        self: Any = object.__new__(cls)
        self.__dict__.update(zip(data, children, strict=True))
        self.__dict__.update(zip(program, structure, strict=True))
        return self

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def _set_state(self: Any, state: dict[str, Any]) -> None:
    """Fill the record of a pickle, whose class may be unknown to JAX.

    cloudpickle makes the class of a script anew in the process that reads, without its decorator.
    """
    self.__dict__.update(state)
    if jax.tree_util.all_leaves([self]):
        _register(type(self))


def _repr_of_fields(self: Any) -> str:
    values = [f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr]
    return f"{type(self).__qualname__}({', '.join(values)})"


def is_record(value: object) -> bool:
    """Whether a value is a record."""
    return dataclasses.is_dataclass(value) and not jax.tree_util.all_leaves([value])


def set_field(record: Any, name: str, value: Any) -> None:
    """Set a field in `__post_init__`, where its value follows from other fields."""
    object.__setattr__(record, name, value)


def check_field(record: Any, name: str, check: Check) -> None:
    """Check a field in `__post_init__`: where the check follows from other fields, or the field is
    declared by subclasses, None without one."""
    value = getattr(record, name, None)
    result = require(name, value, check)
    if result is not value:
        set_field(record, name, result)


@record
class Function:
    """A plain function as a record without numbers, compared by identity."""

    function: Callable[..., Any] = static()

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


def as_record(value: Any) -> Any:
    """The value if it is a record, else its `Function`."""
    return value if is_record(value) else Function(value)


def function_of(*parameters: str) -> Check:
    """The check of a function of these parameters; a plain one becomes a `Function`."""
    expected = f"expected a function of ({', '.join(parameters)})"

    def check(value: Any) -> Any:
        if not callable(value) or isinstance(value, type):
            raise ValueError(f"{expected}, got {describe(value)}")
        if (signature := unfit_signature(value, len(parameters))) is not None:
            raise ValueError(f"{expected}, got one of {signature}")
        return as_record(value)

    return check


# --- kinds of fields ----------------------------------------------------------------------------

_DATA = "a number, an array or a record (a choice or a function is a static() field)"


def _check_declared(self: Any, checks: dict[str, Check]) -> None:
    """Check each field by the check of its name, in the order of the fields."""
    for field in dataclasses.fields(self):
        if field.metadata.get("static") and _is_array(getattr(self, field.name)):
            # Before its check, in which == of an array would be an array.
            raise InvalidField(field.name, _ARRAY)
        if field.name in checks:
            check_field(self, field.name, checks[field.name])


def _check_kinds(self: Any) -> None:
    """Refuse a field that JAX could not take as data, or as a part of the program."""
    for field in dataclasses.fields(self):
        value = getattr(self, field.name)
        check = _check_static if field.metadata.get("static") else _check_data
        check(field.name, value)


_ARRAY = "expected a value that is compared by ==, got an array"


def _check_static(field: str, value: Any) -> None:
    """Refuse a value that may change, or holds numbers to differentiate by."""
    if isinstance(value, tuple | frozenset):
        for entry in value:
            _check_static(field, entry)
    elif _is_array(value):
        raise InvalidField(field, _ARRAY)
    elif is_record(value) and jax.tree.leaves(value):
        got = f"the record {type(value).__name__}, whose numbers belong in a field of data"
        raise InvalidField(field, f"expected a choice, a size or a function, got {got}")
    elif type(value).__hash__ is None:
        got = with_article(type(value).__name__)
        raise InvalidField(field, f"expected a value that cannot change, as a tuple, got {got}")


def _check_data(field: str, value: Any) -> None:
    """Refuse text, lists, functions and classes."""
    if type(value) is tuple:
        for k, entry in enumerate(value):
            _check_data(f"{field}[{k}]", entry)
    elif isinstance(value, list):
        raise InvalidField(field, "expected an array, as of numpy.asarray, got a list")
    elif isinstance(value, str | Sequence | set | type) and not isinstance(value, tuple):
        raise InvalidField(field, f"expected {_DATA}, got {describe(value)}")
    elif jax.tree_util.all_leaves([value]) and not _is_number(value):
        raise InvalidField(field, f"expected {_DATA}, got {with_article(type(value).__name__)}")


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | jax.Array)


def _is_number(value: Any) -> bool:
    """Whether a leaf is a number or an array of numbers (kind V: those of ml_dtypes)."""
    if isinstance(value, bool | int | float | complex | np.generic | jax.Array):
        return True
    return isinstance(value, np.ndarray) and value.dtype.kind in "biufcV"


class FrozenDict(dict[Any, Any]):
    """A dict that hashes, as a static field needs; do not change it."""

    @classmethod
    def of(cls, value: Mapping[Any, Any]) -> "FrozenDict":
        """A dict, and those in it, frozen; ValueError, which begins with the key, on an array."""
        frozen = {key: cls.of(v) if isinstance(v, Mapping) else v for key, v in value.items()}
        for key, entry in frozen.items():
            if isinstance(entry, np.ndarray | jax.Array | list):
                raise ValueError(f"{key}: expected a value that is compared by ==")
        return cls(frozen)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))
