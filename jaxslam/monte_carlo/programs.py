"""The programs of a campaign: a block of runs, drawn, filtered and scored on every device.

Each takes the campaign's key, the numbers of its runs, and every array that models, filters and map
were made of: one compilation serves all blocks, seeds, noises and map values. Runs are divided over
the devices with `shard_map`: no device ever waits for another.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxslam.consistency import Score, conditional_bound, mean_pose_nees, own_error_of, score
from jaxslam.monte_carlo.block import Programs
from jaxslam.monte_carlo.candidates import estimator_of
from jaxslam.monte_carlo.pieces import cores
from jaxslam.protocols import Candidate
from jaxslam.simulate import Scenario, simulate
from jaxslam.staging import compiled
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


def compile_programs(
    programs: Programs,
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    devices: Sequence[jax.Device],
) -> None:
    """Fill in the programs, each compiled while the next is traced; back when all are there.

    Filters whose results have the same shapes share the program that scores them.
    """
    mesh = Mesh(np.asarray(devices), ("runs",))
    key, wide = programs.key, programs.wide
    block = wide // len(devices)
    # Compiling one program keeps nearly two cores busy; more at once only delay the first.
    pool = ThreadPoolExecutor(max(cores() // 2, 1))

    def draw(key: jax.Array, which: jax.Array) -> tuple[Truth, Log]:
        return jax.vmap(lambda i: simulate(scenario, _keys(key, i)[0]))(which)

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
            return conditional_bound(scenario, truth, log, _keys(key, i)[1]).pose_cov

        cov = jax.vmap(one)(which, *world)
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        return {"position": position, "heading": cov[:, :, 2, 2]}

    def program(
        promise: Future[Any],
        function: Callable[..., Any],
        axes: Sequence[Any],
        out: Any,
        *arguments: Any,
        straight: bool = False,
    ) -> Any:
        """Have the promise kept by it, compiled; the shapes of its results.

        axes: of each argument the axis that goes over runs, or None; or a tree's prefix of such.
        out: that of the results. straight: see `staging.compiled`.
        """
        own = [_resized(x, block, axis) for x, axis in zip(arguments, axes, strict=True)]
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*own)

        def pure(constants: list[Any], *arguments: Any) -> Any:
            leaves = jax.core.eval_jaxpr(traced.jaxpr, constants, *jax.tree.leaves(arguments))
            return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

        spread = jax.shard_map(
            pure,
            mesh=mesh,
            in_specs=(PartitionSpec(), *map(_spec, axes)),
            out_specs=_spec(out),
            check_vma=False,
        )
        lowered = jax.jit(spread).lower(traced.consts, *arguments)
        # Tracing holds Python's lock, compiling does not: the next is traced meanwhile.
        pool.submit(_compiled, lowered, tuple(devices), traced.consts, straight).add_done_callback(
            partial(_keep, promise)
        )
        return _resized(shapes, wide, out)

    which = jnp.arange(wide)
    try:
        world = program(programs.draw, draw, (None, 0), 0, key, which, straight=True)
        if programs.glimpse is not None:
            pose = world[0].pose
            steps, size = pose.shape[1:]
            by_time, cov = (
                jax.ShapeDtypeStruct((steps, wide, *shape), pose.dtype)
                for shape in ((size,), (size, size))
            )
            program(programs.peek, peek, (0, 1, 1), 0, pose, by_time, cov, straight=True)
        alike: dict[Any, Future[Any]] = {}

        def scored(name: str, driven: Any) -> None:
            leaves, structure = jax.tree.flatten(driven)
            kind = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
            if kind in alike:
                alike[kind].add_done_callback(partial(_keep, programs.scores[name]))
            else:
                alike[kind] = programs.scores[name]
                program(alike[kind], judge, (0, _BY_TIME), 0, world[0], driven, straight=True)

        # Each filter before the score of the one before it: `Programs.block` wants them so.
        before: tuple[str, Any] | None = None
        for name, candidate in filters.items():
            one = partial(drive, candidate)
            driven = program(programs.drives[name], one, (None, 0, 0), _BY_TIME, key, which, world)
            if before is not None:
                scored(*before)
            before = name, driven
        if before is not None:
            scored(*before)
        program(programs.least, least, (None, 0, 0), 0, key, which, world)
        found = programs.least.result()(key, which, programs.draw.result()(key, which))
        ideal = float(found["position"][0, -1]) ** 0.5
        dtype = world[0].pose.dtype
        for promise in (*programs.drives.values(), *programs.scores.values()):
            promise.result()
        programs.complete()
        programs.limit.set_result(jnp.asarray(_divergence_limit(scenario, ideal, dtype), dtype))
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


_KEPT: OrderedDict[Any, Any] = OrderedDict()
_ROOM = 64


def _compiled(
    lowered: jax.stages.Lowered,
    devices: tuple[jax.Device, ...],
    constants: list[Any],
    straight: bool,
) -> Callable[..., Any]:
    """The program with its constants, compiled unless the same has been, whatever its constants."""
    text = hashlib.sha256(lowered.as_text().encode()).digest()
    # Arguments that nothing reads are not in the text.
    which = (text, devices, lowered.in_tree, str(lowered.in_avals))
    kept = _KEPT.get(which)
    if kept is None:
        kept = compiled(lowered, devices[0].platform, straight=straight)
        _KEPT[which] = kept
        while len(_KEPT) > _ROOM:
            _KEPT.popitem(last=False)
    return partial(kept, constants)


def _keys(key: jax.Array, i: jax.Array) -> jax.Array:
    """The keys of run i: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, i))


def _divergence_limit(scenario: Scenario, spread: float, dtype: Any) -> float:
    """5 σ of the ideal spread, or, in a world without noise, what rounding can do."""
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    return max(5 * spread, 1000 * float(jnp.finfo(dtype).eps) * reach)
