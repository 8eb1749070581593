"""The programs of a campaign: a block of runs, drawn, filtered and scored on every device.

Each takes the campaign's key, the numbers of its runs, and every number that models, filters and
map were made of (`jaxslam.programs`): one compilation serves all blocks, seeds, noises and map
values, in this campaign and the next. Runs are divided over the devices with `shard_map`: no device
ever waits for another.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxslam import programs
from jaxslam.consistency import Score, mean_pose_nees, own_error_of, posterior_bound, score
from jaxslam.monte_carlo.block import Programs
from jaxslam.monte_carlo.candidates import estimator_of, rounded
from jaxslam.monte_carlo.pieces import cores
from jaxslam.protocols import Candidate
from jaxslam.simulate import Scenario, simulate
from jaxslam.staging import quick_options
from jaxslam.types import Estimate, Info, Log, Trace, Truth


class Driven(NamedTuple):
    """What a filter made of a log, as far as it is scored."""

    estimate: Estimate
    info: Info
    own_error: jax.Array
    watch: Any
    probe: Any


_BY_TIME: Any = Driven(*cast(Any, (1, 1, 1, 0, 1)))
"""Which axis of what a filter made goes over runs: that of time comes first, as its loop has it."""


class _Final(NamedTuple):
    watch: Any


class _Made(NamedTuple):
    """A program that is compiled, or being compiled, and the shapes of its results."""

    program: Future[Callable[..., Any]]
    shapes: Any


_MADE = programs.Kept(programs.ROOM)


def compile_programs(
    promised: Programs,
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    devices: Sequence[jax.Device],
) -> None:
    """Fill in the programs, each compiled while the next is traced; back when all are there.

    Filters whose results have the same shapes share the program that scores them.
    """
    mesh = Mesh(np.asarray(devices), ("runs",))
    key, wide = promised.key, promised.wide
    block = wide // len(devices)
    # Compiling one program keeps nearly two cores busy; more at once only delay the first.
    pool = ThreadPoolExecutor(max(cores() // 2, 1))

    def draw(key: jax.Array, which: jax.Array) -> tuple[Truth, Log]:
        world: tuple[Truth, Log] = jax.vmap(lambda i: simulate(scenario, _keys(key, i)[0]))(which)
        return rounded(world, promised.dtype)

    def drive(
        candidate: Candidate, key: jax.Array, which: jax.Array, world: tuple[Truth, Log]
    ) -> Driven:
        def one(i: jax.Array, truth: Truth, log: Log) -> Driven:
            method, chart = estimator_of(candidate, truth, scenario)
            trace = method(log, _keys(key, i)[1])
            own = own_error_of(chart, scenario.sensor, trace, truth)
            watch = getattr(trace.final, "watch", ())
            return Driven(trace.estimate, trace.info, own, watch, trace.probe if watch else ())

        driven: Driven = jax.vmap(one, out_axes=_BY_TIME)(which, *world)
        return driven

    def judge(truth: Truth, driven: Driven) -> Score:
        def one(truth: Truth, driven: Driven) -> Score:
            trace = Trace(driven.estimate, driven.info, _Final(driven.watch), driven.probe)
            return score(trace, truth, scenario.sensor, driven.own_error)

        scores: Score = jax.vmap(one, in_axes=(0, _BY_TIME))(truth, driven)
        return scores

    def peek(truth: jax.Array, pose: jax.Array, cov: jax.Array) -> tuple[jax.Array, jax.Array]:
        found: tuple[jax.Array, jax.Array] = jax.vmap(mean_pose_nees, (0, 1, 1))(truth, pose, cov)
        return found

    def least(key: jax.Array, which: jax.Array, world: tuple[Truth, Log]) -> dict[str, jax.Array]:
        def one(i: jax.Array, truth: Truth, log: Log) -> jax.Array:
            return posterior_bound(scenario, truth, log, _keys(key, i)[1]).pose_cov

        cov = jax.vmap(one)(which, *world)
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        return {"position": position, "heading": cov[:, :, 2, 2]}

    def program(
        promise: Future[Any],
        name: str,
        objects: tuple[Any, ...],
        function: Callable[..., Any],
        axes: Sequence[Any],
        out: Any,
        *arguments: Any,
        straight: bool = False,
    ) -> Any:
        """Have the promise kept by it, compiled; the shapes of its results.

        name, objects: of the function and what it is made of, by which it is known again. axes: of
        each argument the axis that goes over runs, or None; or a tree's prefix of such. out: that
        of the results. straight: see `staging.quick_options`.
        """

        def make() -> _Made:
            own = [_resized(x, block, axis) for x, axis in zip(arguments, axes, strict=True)]
            traced = programs.trace(function, *own)
            assert traced is not None

            def pure(numbers: list[Any], *arguments: Any) -> Any:
                leaves = traced.call(numbers, *jax.tree.leaves(arguments))
                return jax.tree.unflatten(traced.out, leaves)

            spread = jax.shard_map(
                pure,
                mesh=mesh,
                in_specs=(PartitionSpec(), *map(_spec, axes)),
                out_specs=_spec(out),
                check_vma=False,
            )
            shapes = [jax.tree.map(_struct, x) for x in arguments]
            lowered = jax.jit(spread).lower(traced.numbers, *shapes)
            # Tracing holds Python's lock, compiling does not: the next is traced meanwhile.
            finished = pool.submit(_compiled, lowered, mesh, traced.numbers, straight)
            return _Made(finished, _resized(traced.shapes, wide, out))

        leaves, tree = jax.tree.flatten(arguments)
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        known = name, promised.dtype, *map(programs.Same, objects)
        where = wide, tuple(devices), programs.context()
        key = (known, tree, shapes, where)
        made = _MADE.get(key, make)
        if made.program.cancelled() or (made.program.done() and made.program.exception()):
            _MADE.drop(key)
            made = _MADE.get(key, make)
        made.program.add_done_callback(partial(_keep, promise))
        return made.shapes

    which = jnp.arange(wide)
    try:
        world = program(
            promised.draw, "draw", (scenario,), draw, (None, 0), 0, key, which, straight=True
        )
        if promised.glimpse is not None:
            pose = world[0].pose
            steps, size = pose.shape[1:]
            by_time, cov = (
                jax.ShapeDtypeStruct((steps, wide, *shape), pose.dtype)
                for shape in ((size,), (size, size))
            )
            program(
                promised.peek, "peek", (), peek, (0, 1, 1), 0, pose, by_time, cov, straight=True
            )

        def scored(name: str, driven: Any) -> None:
            promise = promised.scores[name]
            axes, made = (0, _BY_TIME), (world[0], driven)
            program(promise, "judge", (scenario,), judge, axes, 0, *made, straight=True)

        # Each filter before the score of the one before it: `Programs.block` wants them so.
        before: tuple[str, Any] | None = None
        for name, candidate in filters.items():
            one = partial(drive, candidate)
            promise, of = promised.drives[name], (scenario, candidate)
            driven = program(promise, "drive", of, one, (None, 0, 0), _BY_TIME, key, which, world)
            if before is not None:
                scored(*before)
            before = name, driven
        if before is not None:
            scored(*before)
        program(promised.least, "least", (scenario,), least, (None, 0, 0), 0, key, which, world)
        found = promised.least.result()(key, which, promised.draw.result()(key, which))
        ideal = float(found["position"][0, -1]) ** 0.5
        dtype = world[0].pose.dtype
        for promise in (*promised.drives.values(), *promised.scores.values()):
            promise.result()
        promised.complete()
        promised.limit.set_result(jnp.asarray(_divergence_limit(scenario, ideal, dtype), dtype))
    finally:
        pool.shutdown(cancel_futures=True)


def _keep(promise: Future[Any], compiling: Future[Any]) -> None:
    """The promise is kept as the compilation turns out, unless that was cancelled."""
    if compiling.cancelled() or promise.done():
        return
    error = compiling.exception()
    if error is None:
        promise.set_result(compiling.result())
    else:
        promise.set_exception(error)


def _resized(tree: Any, runs: int, axes: Any) -> Any:
    """The shapes of arrays by runs, with so many of them. axes: see `program`."""

    def resized(axis: int | None, part: Any) -> Any:
        if axis is None:
            return part
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(
                (*leaf.shape[:axis], runs, *leaf.shape[axis + 1 :]), leaf.dtype
            ),
            part,
        )

    return jax.tree.map(resized, axes, tree, is_leaf=lambda axis: axis is None)


def _spec(axes: Any) -> Any:
    """How arrays are divided over the devices. axes: see `program`."""
    return jax.tree.map(
        lambda axis: PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "runs"),
        axes,
        is_leaf=lambda axis: axis is None,
    )


def _compiled(
    lowered: jax.stages.Lowered, mesh: Mesh, numbers: list[Any], straight: bool
) -> Callable[..., Any]:
    """The program with its numbers, which are put on every device once."""
    devices = tuple(mesh.devices.flat)
    options = quick_options(devices[0].platform) if straight else None
    run = programs.compiled(lowered, devices, options)
    return partial(run, jax.device_put(numbers, NamedSharding(mesh, PartitionSpec())))


def _struct(leaf: Any) -> Any:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def _keys(key: jax.Array, i: jax.Array) -> jax.Array:
    """The keys of run i: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, i))


def _divergence_limit(scenario: Scenario, spread: float, dtype: Any) -> float:
    """5 σ of the ideal spread, or, in a world without noise, what rounding can do."""
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    return max(5 * spread, 1000 * float(jnp.finfo(dtype).eps) * reach)
