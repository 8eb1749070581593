"""Compiles functions over a block of runs: divided over devices, kept, restored from a library.

A program takes the numbers of what it is made of (`jaxslam.programs`) and arrays that go over runs.
It is found again by the objects it is made of, without a trace; by its structure, without a
compilation; or, where the caller has a `Library`, by its name there, as it was compiled in another
process, without either.
"""

import functools
import pickle
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from jaxslam import programs
from jaxslam.math.xla import hot_options, quick_options
from jaxslam.monte_carlo.pieces import cores
from jaxslam.programs import cache

RESTORED = "/jaxslam/restore_program_duration"
"""The event that `jax.monitoring` gets when a program is restored from a library, with its time."""


Program: TypeAlias = Callable[..., PyTree]
"""(trees of arrays) -> a tree of arrays, compiled"""

Axes: TypeAlias = PyTree
"""Of a tree of arrays the axis that goes over runs, or None; a prefix of the tree."""


class Library(Protocol):
    """Compiled programs by name, kept beyond the process.

    Whoever gives one answers for it: the same name is the same program, whatever scenario and
    filters it is of. JAX's own cache on the disk must be off: an executable that came from there
    cannot be kept again, since it would not run.
    """

    def get(self, name: str) -> bytes | None:
        """What was put under the name, whole, or None."""

    def put(self, name: str, content: bytes) -> None:
        """Keep the content under the name."""


class Made(NamedTuple):
    """A program that is compiled, or being compiled, and the shapes of its results."""

    program: Future[Program]
    shapes: PyTree


class _Saved(NamedTuple):
    """A program as a library has it."""

    executable: bytes
    inputs: int
    """how many arrays it takes beside its numbers"""
    numbers: list[np.ndarray]
    shapes: PyTree


_MADE = cache.Kept(cache.ROOM)


class Blockwise:
    """Compiles functions over `wide` runs on the devices, several at a time."""

    def __init__(
        self, devices: Sequence[jax.Device], wide: int, library: Library | None = None
    ) -> None:
        self._devices, self._wide, self._library = tuple(devices), wide, library
        self._mesh = Mesh(np.asarray(devices), ("runs",))
        # Compiling one program keeps nearly two cores busy; more at once only delay the first.
        self._pool = ThreadPoolExecutor(max(cores() // 2, 1))

    def close(self) -> None:
        """Cancel the compilations that have not begun."""
        self._pool.shutdown(cancel_futures=True)

    def program(
        self,
        name: str,
        objects: tuple[object, ...],
        function: Program,
        axes: Sequence[Axes],
        out: Axes,
        *arguments: PyTree,
        straight: bool = False,
    ) -> Made:
        """The program of a function of arrays.

        Args:
            name: which one of these objects it is, and its name in the library.
            objects: what the function is made of.
            axes: of each argument. out: of the results.
            arguments: the arrays, or their shapes.
            straight: see `xla.quick_options`.
        """
        leaves, tree = jax.tree.flatten(arguments)
        shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
        known = name, *map(cache.Same, objects)
        key = (known, tree, shapes, self._wide, self._devices, cache.context())

        def make() -> Made:
            label = f"{name}, {self._wide} runs, {len(self._devices)} devices, {shapes}"
            return self._restored(label) or self._traced(
                label, function, axes, out, arguments, straight
            )

        made = _MADE.get(key, make)
        if made.program.cancelled() or (made.program.done() and made.program.exception()):
            _MADE.drop(key)
            made = _MADE.get(key, make)
        return made

    def _traced(
        self,
        label: str,
        function: Program,
        axes: Sequence[Axes],
        out: Axes,
        arguments: Sequence[PyTree],
        straight: bool,
    ) -> Made:
        block = self._wide // len(self._devices)
        own = [_resized(x, block, axis) for x, axis in zip(arguments, axes, strict=True)]
        traced = programs.trace(function, *own)
        assert traced is not None  # a campaign is no part of a trace
        inputs = [_by_leaf(axis, x) for x, axis in zip(arguments, axes, strict=True)]
        spread = jax.shard_map(
            traced.call,
            mesh=self._mesh,
            in_specs=(PartitionSpec(), *(_spec(axis) for one in inputs for axis in one)),
            out_specs=[_spec(axis) for axis in _by_leaf(out, traced.shapes)],
            check_vma=False,
        )
        leaves = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(arguments)]
        lowered = jax.jit(spread).lower(traced.numbers, *leaves)
        shapes = _resized(traced.shapes, self._wide, out)
        # Tracing holds Python's lock, compiling does not: the next is traced meanwhile.
        finished = self._pool.submit(
            self._compiled, label, lowered, traced.numbers, shapes, straight
        )
        return Made(finished, shapes)

    def _compiled(
        self,
        label: str,
        lowered: jax.stages.Lowered,
        numbers: list[PyTree],
        shapes: PyTree,
        straight: bool,
    ) -> Program:
        options = (quick_options if straight else hot_options)(self._devices[0].platform)
        compiled: PyTree = cache.compiled(lowered, self._devices, options)
        arrays = [x for x in numbers if isinstance(x, jax.Array)]
        keys = any(jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in arrays)
        if self._library is not None and not keys:
            executable, _, _ = serialize_executable.serialize(compiled)
            inputs = len(jax.tree.leaves(lowered.in_avals)) - len(numbers)
            saved = _Saved(executable, inputs, [np.asarray(x) for x in numbers], shapes)
            self._library.put(label, pickle.dumps(saved))
        return self._with(compiled, numbers, jax.tree.structure(shapes))

    def _restored(self, label: str) -> Made | None:
        """The program as the library has it."""
        began = time.perf_counter()
        content = None if self._library is None else self._library.get(label)
        if content is None:
            return None
        _load_lapack()
        saved: _Saved = pickle.loads(content)
        in_tree = jax.tree.structure(((saved.numbers, *[0] * saved.inputs), {}))
        out_tree = jax.tree.structure([0] * len(jax.tree.leaves(saved.shapes)))
        compiled = serialize_executable.deserialize_and_load(
            saved.executable, in_tree, out_tree, execution_devices=list(self._devices)
        )
        program: Future[Program] = Future()
        program.set_result(self._with(compiled, saved.numbers, jax.tree.structure(saved.shapes)))
        jax.monitoring.record_event_duration_secs(RESTORED, time.perf_counter() - began)
        return Made(program, saved.shapes)

    def _with(self, compiled: Program, numbers: list[PyTree], out: PyTree) -> Program:
        """The program with its numbers, which are put on every device once."""
        there = jax.device_put(numbers, NamedSharding(self._mesh, PartitionSpec()))

        def run(*arguments: PyTree) -> PyTree:
            return jax.tree.unflatten(out, compiled(there, *jax.tree.leaves(arguments)))

        return run


@functools.cache
def _load_lapack() -> None:
    """Load LAPACK, which JAX does when it lowers what needs it, and restored programs are not."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.result_type(float)))


def _by_leaf(axes: Axes, tree: PyTree) -> list[int | None]:
    """The axis of each leaf of a tree."""
    out: list[int | None] = []

    def spread(axis: int | None, part: PyTree) -> None:
        out.extend([axis] * len(jax.tree.leaves(part)))

    jax.tree.map(spread, axes, tree, is_leaf=lambda axis: axis is None)
    return out


def _resized(tree: PyTree, runs: int, axes: Axes) -> PyTree:
    """The shapes of the arrays of a tree, with so many runs."""
    leaves, structure = jax.tree.flatten(tree)

    def resized(leaf: PyTree, axis: int | None) -> jax.ShapeDtypeStruct:
        shape = leaf.shape
        if axis is not None:
            shape = (*shape[:axis], runs, *shape[axis + 1 :])
        return jax.ShapeDtypeStruct(shape, leaf.dtype)

    sized = [resized(*pair) for pair in zip(leaves, _by_leaf(axes, tree), strict=True)]
    return jax.tree.unflatten(structure, sized)


def _spec(axis: int | None) -> PartitionSpec:
    """How an array is divided over the devices."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "runs")
