"""Records: frozen dataclasses that JAX knows as pytrees."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

_T = TypeVar("_T")


def static(**options: Any) -> Any:
    """A field of a record that is part of the program: a size, a name, a choice, a function.

    Two records whose static fields differ are compiled apart, so a value is hashable and compared
    by ==, a function by identity. options: those of `dataclasses.field`.
    """
    return dataclasses.field(**options, metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def record(cls: type[_T]) -> type[_T]:
    """The class as a frozen dataclass and a pytree, whose fields are its children.

    A field is a number, an array, None, another record, or a tuple of these; one that is declared
    by `static()` is part of the structure instead. What `jax.grad`, `jax.vmap` and `jax.tree.map`
    return of a record is one of its class. `dataclasses.replace` changes fields.

    Fields are checked where a record is made by its class: values in a method `__post_init__`,
    where the class has one, and then kinds here. JAX rebuilds records without any check, since it
    fills them with the values of a transformation: tracers, stacks, derivatives.

    Raises ValueError, at construction, on a field of another kind.
    """
    given = cls.__dict__.get("__post_init__") or getattr(cls, "__post_init__", None)

    def __post_init__(self: Any) -> None:
        for field in dataclasses.fields(self):
            if field.metadata.get("static") and _is_array(value := getattr(self, field.name)):
                _check_static(f"{type(self).__name__}: {field.name}", value)
        try:
            if given is not None:
                given(self)
        except TypeError:  # arithmetic with text, say: a field of another kind says more
            _check_kinds(self)
            raise
        _check_kinds(self)

    cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
    # A custom repr is kept by subclasses; that of the fields is made for each class.
    of_fields = cls.__repr__ in (object.__repr__, getattr(cls, "_repr_of_fields", None))
    made = dataclasses.dataclass(frozen=True, eq=False, repr=of_fields)(cls)
    if of_fields:
        made._repr_of_fields = made.__repr__  # type: ignore[attr-defined]
    made.__reduce__ = lambda self: (_unpickled, (type(self), self.__dict__))  # type: ignore[method-assign]
    _register(made)
    return made


def _unpickled(cls: type, values: dict[str, Any]) -> Any:
    """The record of a class, which a pickle by value, as cloudpickle's, has made anew."""
    made: Any = object.__new__(cls)
    made.__dict__.update(values)
    if jax.tree_util.all_leaves([made]):
        _register(cls)
    return made


def _register(made: type) -> None:
    """Make a class of records known to JAX."""
    fields = dataclasses.fields(made)
    leaves = tuple(field.name for field in fields if not field.metadata.get("static"))
    statics = tuple(field.name for field in fields if field.metadata.get("static"))
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in leaves)

    def flatten(of: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        held = of.__dict__
        return tuple([held[name] for name in leaves]), tuple([held[name] for name in statics])

    def flatten_with_keys(of: Any) -> tuple[Iterable[tuple[Any, Any]], tuple[Any, ...]]:
        children, structure = flatten(of)
        return zip(keys, children, strict=True), structure

    def unflatten(structure: tuple[Any, ...], children: Iterable[Any]) -> Any:
        rebuilt: Any = object.__new__(made)
        rebuilt.__dict__.update(zip(leaves, children, strict=True))
        rebuilt.__dict__.update(zip(statics, structure, strict=True))
        return rebuilt

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)


def is_record(value: object) -> bool:
    """Whether a value is a record."""
    return dataclasses.is_dataclass(value) and not jax.tree_util.all_leaves([value])


class FrozenDict(dict[Any, Any]):
    """A dict that hashes, as a static field needs; do not change it."""

    @classmethod
    def of(cls, name: str, value: Mapping[Any, Any]) -> "FrozenDict":
        """A dict, and those in it, frozen; ValueError, which begins with the name, on an array."""
        made = {k: cls.of(name, v) if isinstance(v, Mapping) else v for k, v in value.items()}
        for key, each in made.items():
            if isinstance(each, np.ndarray | jax.Array | list):
                raise ValueError(f"{name}: {key}: expected a value that is compared by ==")
        return cls(made)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))


def set_field(of: Any, name: str, value: Any) -> None:
    """Set a field in `__post_init__`, for one that is given in another form."""
    object.__setattr__(of, name, value)


@record
class Function:
    """A plain function as a record without numbers, compared by identity."""

    function: Callable[..., Any] = static()

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


def as_record(value: Any) -> Any:
    """The value if it is a record, else its `Function`."""
    return value if is_record(value) else Function(value)


def hold_function(of: Any, name: str, parameters: str) -> None:
    """Make a field that is a plain function a record, in `__post_init__`.

    Raises ValueError unless it is a function, or a record with `__call__`.
    """
    value = getattr(of, name)
    if not callable(value) or isinstance(value, type):
        got = f"the class {value.__name__}: call it" if callable(value) else type(value).__name__
        what = f"{type(of).__name__}: expected {name} to be a function of ({parameters})"
        raise ValueError(f"{what}, got {got}")
    set_field(of, name, as_record(value))


def _check_kinds(of: Any) -> None:
    for field in dataclasses.fields(of):
        value, where = getattr(of, field.name), f"{type(of).__name__}: {field.name}"
        if field.metadata.get("static"):
            _check_static(where, value)
        else:
            _check_child(where, value)


def _check_static(where: str, value: Any) -> None:
    """Check that a value cannot change and holds no numbers to differentiate by."""
    if isinstance(value, tuple | frozenset):
        for each in value:
            _check_static(where, each)
    elif _is_array(value):
        raise ValueError(f"{where}: expected a value that is compared by ==, got an array")
    elif is_record(value) and jax.tree.leaves(value):
        got = f"the record {type(value).__name__}, whose numbers belong in a field of data"
        raise ValueError(f"{where}: expected a choice, a size or a function, got {got}")
    elif isinstance(value, dict | list | set) and not isinstance(value, FrozenDict):
        got = type(value).__name__
        raise ValueError(f"{where}: expected a value that cannot change, as a tuple, got a {got}")


def _check_child(where: str, value: Any) -> None:
    if isinstance(value, tuple) and type(value) is tuple:
        for k, each in enumerate(value):
            _check_child(f"{where}[{k}]", each)
    elif isinstance(value, str | Sequence | set) and not isinstance(value, tuple):
        wanted = "an array, as of numpy.asarray" if isinstance(value, list) else _WANTED
        got = repr(value) if isinstance(value, str) else f"a {type(value).__name__}"
        raise ValueError(f"{where}: expected {wanted}, got {got}")
    elif isinstance(value, type):
        raise ValueError(f"{where}: expected {_WANTED}, got the class {value.__name__}: call it")
    elif jax.tree_util.all_leaves([value]) and not _is_number(value):
        raise ValueError(f"{where}: expected {_WANTED}, got {type(value).__name__}")


_WANTED = "a number, an array or a record (a choice or a function is a static() field)"


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | jax.Array)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool | int | float | complex | np.generic | jax.Array):
        return True
    return isinstance(value, np.ndarray) and value.dtype.kind in "biufcV"
