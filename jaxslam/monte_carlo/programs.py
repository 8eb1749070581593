"""The programs of a campaign: a block of runs, drawn, filtered and scored on every device.

Each takes the campaign's key, the numbers of its runs, and every array that models, filters and map
were made of: one compilation serves all blocks, seeds, noises and map values. Runs are divided over
the devices with `shard_map`: no device ever waits for another.
"""

import hashlib
import inspect
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxslam.charts.euclidean import euclidean
from jaxslam.consistency import (
    Measure,
    Score,
    condense,
    interval,
    own_error_of,
    posterior_bound,
    score,
)
from jaxslam.consistency.tally import condensed_sums
from jaxslam.monte_carlo.pieces import cores
from jaxslam.protocols import Candidate, Chart, Estimator, Filter
from jaxslam.run import run
from jaxslam.simulate import Scenario, simulate
from jaxslam.staging import compiled
from jaxslam.types import Estimate, Info, Log, Trace, Truth

BOUND = "bound"
"""The name under which a block keeps the sums of the posterior bound, and the divergence limit."""


Glimpse = Callable[[str, int, Measure | None], Any]
"""(filter, runs, their mean pose NEES)."""


class Programs:
    """Of blocks of `wide` runs; run i has key fold_in(key, i).

    `compile_programs` fills in one after the other. A block may be begun before: where it needs a
    program that is not there yet, it waits.
    """

    def __init__(
        self, names: Iterable[str], key: jax.Array, block: int, devices: int, bound: bool
    ) -> None:
        self.key, self.wide, self.devices, self.bound = key, block * devices, devices, bound
        self.draw: Future[Callable[..., Any]] = Future()
        self.drives: dict[str, Future[Callable[..., Any]]] = {name: Future() for name in names}
        self.scores: dict[str, Future[Callable[..., Any]]] = {name: Future() for name in names}
        self.least: Future[Callable[..., Any]] = Future()
        self.limit: Future[jax.Array] = Future()
        """() [m] the divergence limit, from run 0"""
        self._quiet = threading.Event()
        self._spent: dict[str, list[tuple[bool, float]]] = {name: [] for name in names}
        """whether nothing was being compiled, and wall seconds; of each block so far"""

    def block(
        self, first: int, runs: int, early: bool, glimpse: Glimpse | None
    ) -> dict[str, dict[str, np.ndarray]]:
        """Condensed scores of runs first … first + runs - 1 (at most `wide`), by filter.

        early: begin while other programs are being compiled, and do not time that. glimpse: told of
        each filter as soon as it is scored.
        """
        if not early:
            self.limit.result()
        which = first + jnp.arange(self.wide)
        world = jax.block_until_ready(self.draw.result()(self.key, which))
        scores = {}
        for name, promised in self.drives.items():
            drive = promised.result()
            began, quiet = time.perf_counter(), self._quiet.is_set()
            driven = jax.block_until_ready(drive(self.key, which, world))
            self._spent[name].append((quiet, time.perf_counter() - began))
            found = jax.device_get(self.scores[name].result()(world[0], driven))
            scores[name] = jax.tree.map(lambda leaf: leaf[:runs], found)
            if glimpse is not None:
                nees, defined = scores[name].measures["nees_pose"]
                glimpse(name, runs, interval(nees[defined]))
        limit = self.limit.result()
        out = {name: condense(each, first, float(limit)) for name, each in scores.items()}
        out[BOUND] = {"limit": np.asarray(limit)}
        if self.bound:
            least = jax.device_get(self.least.result()(self.key, which, world))
            out[BOUND] |= condensed_sums({name: rows[:runs] for name, rows in least.items()})
        return out

    def promises(self) -> list[Future[Any]]:
        """All that blocks may wait for."""
        return [self.draw, *self.drives.values(), *self.scores.values(), self.least, self.limit]

    def complete(self) -> None:
        """Nothing is being compiled any more."""
        self._quiet.set()

    def give_up(self, error: BaseException) -> None:
        """Whoever waits for a program that is not there gets the error."""
        for promise in self.promises():
            if not promise.done():
                promise.set_exception(error)

    def run_seconds(self) -> dict[str, float]:
        """What one run took on one device, by filter: the median over blocks so far."""
        out = {}
        for name, all_ in self._spent.items():
            times = [seconds for quiet, seconds in all_ if quiet] or [s for _, s in all_]
            if times:
                out[name] = self.devices / self.wide * float(np.median(times))
        return out


class Driven(NamedTuple):
    """What a filter made of a log, as far as it is scored."""

    estimate: Estimate
    info: Info
    own_error: jax.Array
    watch: Any
    probe: Any


class _Final(NamedTuple):
    watch: Any


def compile_programs(
    programs: Programs,
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    devices: Sequence[jax.Device],
) -> None:
    """Fill in the programs, several compiled at once; back when all are there.

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
            method, chart = _estimator(candidate, truth, scenario)
            trace = method(log, _keys(key, i)[1])
            own = own_error_of(chart, scenario.sensor, trace, truth)
            watch = getattr(trace.final, "watch", ())
            return Driven(trace.estimate, trace.info, own, watch, trace.probe)

        driven: Driven = jax.vmap(one)(which, *world)
        return driven

    def judge(truth: Truth, driven: Driven) -> Score:
        def one(truth: Truth, driven: Driven) -> Score:
            trace = Trace(driven.estimate, driven.info, _Final(driven.watch), driven.probe)
            return score(trace, truth, scenario.sensor, driven.own_error)

        scores: Score = jax.vmap(one)(truth, driven)
        return scores

    def least(key: jax.Array, which: jax.Array, world: tuple[Truth, Log]) -> dict[str, jax.Array]:
        def one(i: jax.Array, truth: Truth, log: Log) -> jax.Array:
            return posterior_bound(scenario, truth, log, _keys(key, i)[1]).pose_cov

        cov = jax.vmap(one)(which, *world)
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        return {"position": position, "heading": cov[:, :, 2, 2]}

    def program(
        promises: Iterable[Future[Any]],
        function: Callable[..., Any],
        by_runs: str,
        *arguments: Any,
        straight: bool = False,
    ) -> Any:
        """Have it compiled for those promises; the shapes of its results.

        by_runs: "r" for an argument by runs. straight: see `staging.compiled`.
        """
        own = [
            _resized(x, block) if r == "r" else x for r, x in zip(by_runs, arguments, strict=True)
        ]
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*own)

        def pure(constants: list[Any], *arguments: Any) -> Any:
            leaves = jax.core.eval_jaxpr(traced.jaxpr, constants, *jax.tree.leaves(arguments))
            return jax.tree.unflatten(jax.tree.structure(shapes), leaves)

        specs = tuple(PartitionSpec("runs") if each == "r" else PartitionSpec() for each in by_runs)
        spread = jax.shard_map(
            pure,
            mesh=mesh,
            in_specs=(PartitionSpec(), *specs),
            out_specs=PartitionSpec("runs"),
            check_vma=False,
        )
        lowered = jax.jit(spread).lower(traced.consts, *arguments)
        # Tracing holds Python's lock, compiling does not: the next is traced meanwhile.
        pool.submit(_compiled, lowered, tuple(devices), traced.consts, straight).add_done_callback(
            lambda compiling: _keep(promises, compiling)
        )
        return _resized(shapes, wide)

    which = jnp.arange(wide)
    try:
        world = program([programs.draw], draw, "-r", key, which, straight=True)
        alike: dict[Any, Future[Any]] = {}
        for name, candidate in filters.items():
            one = partial(drive, candidate)
            driven = program([programs.drives[name]], one, "-rr", key, which, world)
            leaves, structure = jax.tree.flatten(driven)
            kind = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
            if kind in alike:
                alike[kind].add_done_callback(partial(_keep, [programs.scores[name]]))
            else:
                alike[kind] = programs.scores[name]
                program([alike[kind]], judge, "rr", world[0], driven, straight=True)
        program([programs.least], least, "-rr", key, which, world)
        found = programs.least.result()(key, which, programs.draw.result()(key, which))
        spread = float(found["position"][0, -1]) ** 0.5
        dtype = world[0].pose.dtype
        for promise in (*programs.drives.values(), *programs.scores.values()):
            promise.result()
        programs.complete()
        programs.limit.set_result(jnp.asarray(_divergence_limit(scenario, spread, dtype), dtype))
    finally:
        pool.shutdown(cancel_futures=True)


def _keep(promises: Iterable[Future[Any]], compiling: Future[Any]) -> None:
    """A promise is kept as the compilation turns out, unless it was given up."""
    for promise in promises:
        if promise.done() or compiling.cancelled():
            continue
        error = compiling.exception()
        if error is None:
            promise.set_result(compiling.result())
        else:
            promise.set_exception(error)


def _resized(tree: Any, runs: int) -> Any:
    """The shapes of arrays by runs, with so many of them."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((runs, *leaf.shape[1:]), leaf.dtype), tree
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


def fitting_block(scenario: Scenario, filters: Mapping[str, Candidate], device: jax.Device) -> int:
    """Runs that are well computed together on a device: 32 on a CPU, whose caches they fit.

    On an accelerator as many as take a quarter of its memory, counting a run's world and what the
    first filter makes of it, which the scores read several times over: a power of two from 32 on,
    4096 at most, and 1024 where the device does not tell its memory.
    """
    if device.platform == "cpu":
        return 32
    room = (device.memory_stats() or {}).get("bytes_limit")
    if room is None:
        return 1024

    def one(key: jax.Array) -> Any:
        truth, log = simulate(scenario, key)
        method, _ = _estimator(next(iter(filters.values())), truth, scenario)
        trace = method(log, key)
        return truth, log, trace.estimate, trace.info

    shapes = jax.tree.leaves(jax.eval_shape(one, jax.random.key(0)))
    each = sum(leaf.size * leaf.dtype.itemsize for leaf in shapes)
    return int(np.clip(2 ** int(np.log2(max(room / 4 / each, 1.0))), 32, 4096))


def check_fits(name: str, candidate: Candidate, scenario: Scenario) -> None:
    """Raise ValueError unless a candidate takes what the scenario's log has."""
    if not isinstance(candidate, Filter):
        if not callable(candidate):
            raise ValueError(f"monte_carlo: {name} is neither a filter nor a function of the truth")
        try:
            inspect.signature(candidate).bind(None)
        except TypeError:
            raise ValueError(
                f"monte_carlo: {name} does not take the truth alone; an estimator of (log, key), "
                "as of smoothing.smooth, is given as lambda truth: estimator"
            ) from None
        return
    for what, has, needs in (
        ("control", candidate.control_size, len(scenario.motion.controls)),
        ("measurement", candidate.measurement_size, len(scenario.sensor.measurements)),
    ):
        if has != needs:
            raise ValueError(
                f"monte_carlo: filter {name} takes a {what} of size {has}, "
                f"the scenario {scenario.name} gives {needs}"
            )


def _keys(key: jax.Array, i: jax.Array) -> jax.Array:
    """The keys of run i: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, i))


def _estimator(candidate: Candidate, truth: Truth, scenario: Scenario) -> tuple[Estimator, Chart]:
    """What runs, and the chart of its errors."""
    method = candidate if isinstance(candidate, Filter) else candidate(truth)
    if not isinstance(method, Filter):
        return method, euclidean()

    def learnt(state: Any) -> Any:
        watch = getattr(state, "watch", ())
        return watch.information if watch else ()

    def drive(log: Log, key: jax.Array) -> Any:
        return run(method, log, scenario.pose, scenario.pose_cov, key, probe=learnt)

    return drive, method.chart


def _divergence_limit(scenario: Scenario, spread: float, dtype: Any) -> float:
    """5 σ of the ideal spread, or, in a world without noise, what rounding can do."""
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    return max(5 * spread, 1000 * float(jnp.finfo(dtype).eps) * reach)
