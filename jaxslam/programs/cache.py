"""A cache of compiled programs: one program a structure, with its numbers as arguments.

`call` runs a function of records of functions (a filter, a scenario) and arrays. Within a trace it
is the plain call. Outside, three steps lead to the program, each skipped where possible:

1. The same structure and the same shapes as before: the program is known. Nothing is traced.
2. The function is traced to a jaxpr. The numbers of records are its inputs. What a plain function
   closed over is in it as constants and literals; `hoisting` turns them into inputs. The rest is
   the structure.
3. The structure is lowered. If the same text was compiled before, that program is used; else XLA
   compiles it.

So another noise, map or gate of the same shapes costs nothing, another plain function that differs
in numbers costs tracing alone. An integer in it, and a number that `hoisting` leaves in the
structure (0, ±1, ±π …), costs one compilation for each value.

The programs least recently used are dropped beyond `ROOM`, and half of them where they have taken
half of the memory maps that Linux grants a process: a program has some hundred. `clear` drops all.
Concurrent threads that need the same program compile it once: the others wait.
"""

import hashlib
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import config as jax_config
from jax._src import core as jax_core
from jaxtyping import PyTree

from jaxslam.core.record import is_record, record, static
from jaxslam.math.xla import hot_options
from jaxslam.programs.hoisting import hoisted

_T = TypeVar("_T")

ROOM = 256
"""The number of programs, and of sets of objects that lead to one, in the cache."""


FULL = 0.5
"""The share of the process's memory maps from which on programs are dropped."""

_ALL: "weakref.WeakSet[Kept]" = weakref.WeakSet()


class Kept:
    """A least-recently-used cache of at most `room` results by key."""

    def __init__(self, room: int) -> None:
        _ALL.add(self)
        self._room = room
        self._lock = threading.Lock()
        self._found: OrderedDict[Hashable, Future[PyTree]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """The cached result for the key, or that of `make()`; errors are not cached."""
        with self._lock:
            promise = self._found.get(key)
            mine = promise is None
            if promise is None:
                promise = self._found[key] = Future()
                while len(self._found) > self._room:
                    self._found.popitem(last=False)
            else:
                self._found.move_to_end(key)
        if mine:
            try:
                promise.set_result(make())
            except BaseException as error:
                with self._lock:
                    if self._found.get(key) is promise:
                        del self._found[key]
                promise.set_exception(error)
        return cast(_T, promise.result())

    def drop(self, key: Hashable) -> None:
        """Drop the result for a key."""
        with self._lock:
            self._found.pop(key, None)

    def halve(self) -> None:
        """Drop the half of the results that was used less recently."""
        with self._lock:
            for _ in range(len(self._found) // 2):
                self._found.popitem(last=False)

    def clear(self) -> None:
        """Drop all results."""
        with self._lock:
            self._found.clear()

    def __len__(self) -> int:
        return len(self._found)


_BY_OBJECTS = Kept(ROOM)
_BY_TEXT = Kept(ROOM)


def clear() -> None:
    """Clear the cache of programs; running programs are not affected."""
    for kept in list(_ALL):
        kept.clear()


@record
class _Option:
    """An argument that is part of the structure."""

    value: Hashable = static()


class Same:
    """An object as a key, compared by identity and kept alive."""

    def __init__(self, what: PyTree) -> None:
        self.what = what

    def __hash__(self) -> int:
        return id(self.what)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.what is other.what


def _held(each: PyTree) -> PyTree:
    """The object that an argument of a program stands for."""
    if not isinstance(each, _Option):
        return each
    return each.value.what if isinstance(each.value, Same) else each.value


def call(function: Callable[..., _T], objects: tuple[PyTree, ...], *arguments: PyTree) -> _T:
    """The result of function(*objects, *arguments), by a program that is compiled once a structure.

    Within a trace, or where JIT is disabled, the plain call.

    Args:
        function: pure; not a lambda created at each call, which would be traced at each call.
        objects: the first arguments of the function: records and options. The numbers of records
            are arguments of the program. Integers and strings are compared by value, all else by
            identity, and kept alive.
        arguments: trees of arrays.
    """
    if not outside(arguments, objects) or jax_config.disable_jit.value:
        return function(*objects, *arguments)
    held = tuple(
        each if is_record(each) else _Option(each if isinstance(each, int | str) else Same(each))
        for each in objects
    )
    leaves, tree = jax.tree.flatten((held, arguments))
    leaves = [leaf if isinstance(leaf, jax.Array) else on_device(leaf) for leaf in leaves]
    shapes = tuple(map(_shape_of, leaves))

    def with_objects(held: tuple[PyTree, ...], arguments: PyTree) -> _T:
        return function(*map(_held, held), *arguments)

    key = Same(function), tree, shapes, context()
    run, numbers, out = _BY_OBJECTS.get(key, lambda: _program(with_objects, tree, shapes))
    if numbers is None:  # it closes over tracers
        return function(*objects, *arguments)
    return cast(_T, jax.tree.unflatten(out, run(numbers, *leaves)))


def on_device(number: PyTree) -> jax.Array:
    """The number or array as `jnp.asarray` has it, which compiles a program for each shape of an
    array of NumPy (jax 0.12). It is a copy: `device_put` may share the memory of its argument.
    """
    if isinstance(number, np.ndarray | np.generic):
        return cast(jax.Array, jax.device_put(np.array(number)))
    return jnp.asarray(number)


def outside(*values: PyTree) -> bool:
    """Whether no trace is active and no leaf is a tracer."""
    return jax_core.trace_state_clean() and not any(
        isinstance(leaf, jax_core.Tracer) for leaf in jax.tree.leaves(values)
    )


def context() -> Hashable:
    """The global settings that a trace depends on: precision, promotion, the default device."""
    return jax_config.trace_context(), jax_config.default_device.value


class Shape(NamedTuple):
    """The shape and type of one array that a program is compiled for."""

    shape: tuple[int, ...]
    dtype: PyTree
    weak_type: bool
    sharding: PyTree
    """where it is committed to devices, else None"""


def _shape_of(leaf: jax.Array) -> Shape:
    committed = getattr(leaf, "committed", False)
    weak = getattr(leaf, "weak_type", False)  # a typed key has no such thing
    return Shape(leaf.shape, leaf.dtype, weak, leaf.sharding if committed else None)


def _program(
    function: Callable[..., PyTree], tree: PyTree, shapes: Sequence[Shape]
) -> tuple[PyTree, list[PyTree] | None, PyTree]:
    structs = [
        jax.ShapeDtypeStruct(s.shape, s.dtype, weak_type=s.weak_type, sharding=s.sharding)
        for s in shapes
    ]
    traced = trace(function, *jax.tree.unflatten(tree, structs))
    if traced is None:
        return None, None, None
    lowered = jax.jit(traced.call).lower(traced.numbers, *structs)
    numbers = [on_device(number) for number in traced.numbers]
    where = tuple(s.sharding for s in shapes), jax_config.default_device.value
    options = hot_options(jax.default_backend())
    return compiled(lowered, where, options), numbers, traced.out


class Traced(NamedTuple):
    """A traced function whose constants are inputs."""

    call: Callable[..., list[PyTree]]
    """(numbers, *leaves of the arguments) -> leaves of the result"""
    numbers: list[PyTree]
    out: PyTree
    """the tree of the result"""
    shapes: PyTree
    """the result as `jax.ShapeDtypeStruct`s"""


def trace(function: Callable[..., PyTree], *arguments: PyTree) -> Traced | None:
    """The function with every number it closes over as an argument; None if one is a tracer."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    flat, numbers = hoisted(closed)
    if any(isinstance(number, jax_core.Tracer) for number in numbers):
        return None

    def program(numbers: list[PyTree], *leaves: PyTree) -> list[PyTree]:
        return cast(list[PyTree], flat(*numbers, *leaves))

    return Traced(program, numbers, jax.tree.structure(shapes), shapes)


def compiled(
    lowered: jax.stages.Lowered, where: Hashable, options: dict[str, int] | None = None
) -> Callable[..., PyTree]:
    """The compiled program of a lowered text, from the cache if compiled for the same devices."""
    text = hashlib.sha256(lowered.as_text().encode()).digest()
    # Unused arguments are not in the text.
    told = tuple(sorted(options.items())) if options else ()
    key = (text, where, lowered.in_tree, str(lowered.in_avals), told)

    def make() -> Callable[..., PyTree]:
        if _share_of_maps() > FULL:
            for kept in list(_ALL):
                kept.halve()
        return cast(Callable[..., PyTree], lowered.compile(options))

    return _BY_TEXT.get(key, make)


def _share_of_maps() -> float:
    """The number of memory maps of the process, by that which Linux grants it; zero elsewhere.

    Beyond it LLVM cannot allocate memory, and the process ends.
    """
    try:
        with open("/proc/sys/vm/max_map_count") as most, open("/proc/self/maps", "rb") as maps:
            return sum(1 for _ in maps) / int(most.read())
    except (OSError, ValueError):
        return 0.0
