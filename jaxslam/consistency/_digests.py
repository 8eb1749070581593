"""The identity of a campaign: the things that agree between two blocks of runs of one campaign.

World, filters and key are data, so it is their structure and their numbers, bit by bit, with the
versions and a digest of the package's source. Of classes and functions outside the package it is
their source too, with what that refers to: an edited line of a user's model is another campaign; a
comment, a docstring, a renamed file and another version of Python are not. Not seen: what other
packages compute, and flags of XLA.
"""

import ast
import dataclasses
import functools
import hashlib
import importlib.resources
import inspect
import linecache
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import CodeType, FunctionType

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxslam.consistency._measures import BUILT_IN, REGISTRY
from jaxslam.core._record import is_record
from jaxslam.core.protocols import Candidate
from jaxslam.simulation._worlds import World

_PACKAGE = Path(str(importlib.resources.files("jaxslam")))

_OF_WORLD = ("landmarks", "controls", "pose", "pose_cov", "motion", "sensor")
"""Parts of a world that are named where they differ."""

_NO_PART_OF_DRAWS = frozenset({"name", "published", "source", "filter_options"})
"""Fields of a world that do not change its draws."""

_BY_DATACLASS = frozenset({"__init__", "__repr__", "__setattr__", "__delattr__", "__replace__"})
"""Methods that are made of the fields."""

_CONSTANT = (str, bytes, bool, int, float, complex, tuple, frozenset, np.ndarray, jax.Array)
"""Attributes of a user's class that its methods may read."""


def identity(
    scenario: World,
    filters: Mapping[str, Candidate],
    key: jax.Array,
    platform: str,
    bound: bool = False,
    dtype: DTypeLike | None = None,
) -> dict[str, str]:
    """A short text by the name of each thing that must agree.

    The number of runs is not part of it: run i has its key. platform: of the devices that
    compute, as "cpu"; rounding differs between platforms.
    """
    parts = {name: digest(getattr(scenario, name)) for name in _OF_WORLD}
    registered = [measure for measure in REGISTRY.values() if measure not in BUILT_IN]
    fields = {field.name for field in dataclasses.fields(scenario)} - _NO_PART_OF_DRAWS
    rest = {
        f"world's {name}": digest(getattr(scenario, name))
        for name in sorted(fields - set(_OF_WORLD))
    }
    return {
        **{name: _version(name) for name in ("jaxslam", "jax", "jaxlib")},
        "source": _source(),
        "platform": platform,
        "dtype": str(jnp.result_type(float) if dtype is None else jnp.dtype(dtype)),
        "drawn in": str(jnp.result_type(float)),
        "key": _key(key),
        "bound": "yes" if bound else "no",
        "filters": ", ".join(filters),
        "scenario": scenario.name,
        "steps": str(scenario.steps),
        **parts,
        "world": digest(type(scenario)),
        **rest,
        **{f"filter {name}": digest(candidate) for name, candidate in filters.items()},
        **{
            f"measure {measure.key}": digest((type(measure), measure.of_run))
            for measure in registered
        },
    }


def digest(value: object) -> str:
    """A digest of records, arrays, functions and what they hold."""
    return hashlib.sha256(_text(value, ()).encode()).hexdigest()[:16]


def _text(value: object, within: tuple[object, ...]) -> str:
    """A value as text, the same in every process. within: the functions that refer to it."""
    if value is None or isinstance(value, str | bytes | bool | int | float | complex):
        return repr(value)
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return _key(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.ascontiguousarray(value)
        return f"{array.shape} {array.dtype} {hashlib.sha256(array.tobytes()).hexdigest()}"
    if isinstance(value, Mapping):
        return str([(str(k), _text(value[k], within)) for k in sorted(value, key=str)])
    if is_record(value):
        fields = [field.name for field in dataclasses.fields(value)]  # type: ignore[arg-type]
        held = [(name, _text(getattr(value, name), within)) for name in fields]
        return f"{_text(type(value), within)} {held}"
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__} {[_text(part, within) for part in value]}"
    if isinstance(value, frozenset):
        return f"frozenset {sorted(_text(part, within) for part in value)}"
    if isinstance(value, functools.partial):
        return _text((value.func, value.args, value.keywords), within)
    if isinstance(value, type):
        return _text_of_class(value, within)
    inner = getattr(value, "__wrapped__", getattr(value, "__func__", value))
    if isinstance(inner, FunctionType):
        bound = _text(getattr(value, "__self__", None), within)
        if not _of_user(inner) or inner in within:
            return f"{bound} {_name(inner)}"
        codes = list(_codes(inner.__code__))
        used = {name for code in codes for name in code.co_names} & inner.__globals__.keys()
        values = {name: inner.__globals__[name] for name in used}
        values |= inspect.getclosurevars(inner).nonlocals
        parts = (inner.__defaults__, inner.__kwdefaults__, values)
        return f"{bound} {_source_of(inner)} {_text(parts, (*within, inner))}"
    return _name(value)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function, and of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _source_of(function: FunctionType) -> str:
    """The source of a function without comments, docstrings and layout.

    Of code that no file has, as of `exec` or of a file that was edited since it was loaded, it is
    the bytecode, which differs between versions of Python.
    """
    code = function.__code__
    linecache.checkcache(code.co_filename)  # the file may have been written again
    text = "".join(linecache.getlines(code.co_filename, function.__globals__))
    functions, compiled = _functions(text)
    nodes = functions.get((code.co_firstlineno, code.co_name), []) if code in compiled else []
    if len(nodes) > 1:  # lambdas of one line: the innermost in which every instruction lies
        columns = [c for line, _, c, end in code.co_positions() if line and c is not None and end]
        around = [
            node
            for node in nodes
            if all(node.col_offset <= c <= (node.end_col_offset or 0) for c in columns)
        ]
        nodes = sorted(around, key=lambda node: node.col_offset)[-1:] or nodes
    if nodes:
        return "; ".join(map(_syntax, nodes))
    parts = [
        (part.co_code.hex(), part.co_names, [c for c in part.co_consts if type(c) is not CodeType])
        for part in _codes(code)
    ]
    return _text(parts, ())


def _syntax(value: object) -> str:
    """A syntax tree as text: `ast.dump` and `ast.unparse` differ between versions of Python."""
    if isinstance(value, ast.AST):
        fields = [(name, part) for name, part in ast.iter_fields(value) if part not in (None, [])]
        return f"{type(value).__name__}({', '.join(f'{n}={_syntax(part)}' for n, part in fields)})"
    if isinstance(value, list):
        return f"[{', '.join(map(_syntax, value))}]"
    return repr(value)


@functools.lru_cache(maxsize=8)
def _functions(
    text: str,
) -> tuple[dict[tuple[int, str], list[ast.FunctionDef | ast.Lambda]], frozenset[CodeType]]:
    """The functions of a source file without docstrings, by first line and name; and their code."""
    functions: dict[tuple[int, str], list[ast.FunctionDef | ast.Lambda]] = {}
    try:
        tree = ast.parse(text)
        compiled = frozenset(_codes(compile(text, "", "exec", dont_inherit=True)))
    except SyntaxError:  # a cell with commands of its own
        return functions, frozenset()
    for node in ast.walk(tree):
        if isinstance(node, ast.Lambda):
            functions.setdefault((node.lineno, "<lambda>"), []).append(node)
        elif isinstance(node, ast.FunctionDef):
            if ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
            first = min([node.lineno, *(part.lineno for part in node.decorator_list)])
            functions.setdefault((first, node.name), []).append(node)
    return functions, compiled


def _text_of_class(cls: type, within: tuple[object, ...]) -> str:
    parts = {
        name: getattr(part, "fget", getattr(part, "__func__", part))
        for name, part in vars(cls).items()
    }
    methods = {
        name: part
        for name, part in parts.items()
        if isinstance(part, FunctionType) and _of_user(part) and name not in _BY_DATACLASS
    }
    if not methods or cls in within or cls.__module__.partition(".")[0] == "jaxslam":
        return _name(cls)
    constants = {
        name: part
        for name, part in parts.items()
        if not name.startswith("__") and isinstance(part, _CONSTANT)
    }
    within = (*within, cls)
    return f"{cls.__qualname__} {_text((methods, constants, cls.__bases__), within)}"


def _of_user(function: FunctionType) -> bool:
    """Whether code is neither of the package, nor of Python, nor of an installed package."""
    path = Path(function.__code__.co_filename)
    python = Path(inspect.__file__).parent
    installed = {"site-packages", "dist-packages"} & set(path.parts)
    return not (installed or path.is_relative_to(_PACKAGE) or path.is_relative_to(python))


def _name(value: object) -> str:
    if isinstance(value, np.ufunc):  # before NumPy 2.2 without __qualname__ and __module__
        return f"numpy.{value.__name__}"
    of = value if hasattr(value, "__qualname__") else type(value)
    return f"{of.__module__}.{of.__qualname__}"


def _key(key: jax.Array) -> str:
    """A PRNG key as text: its kind and its numbers."""
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    data = np.asarray(jax.random.key_data(key) if typed else key)
    kind = str(jax.random.key_impl(key)) if typed else "raw"
    return f"{kind} {':'.join(map(str, data.ravel().tolist()))}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # run from its source, as by PYTHONPATH
        return "not installed"


@functools.cache
def _source() -> str:
    """A digest of every source file of the package."""
    total = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        total.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode())
        total.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return total.hexdigest()[:16]
