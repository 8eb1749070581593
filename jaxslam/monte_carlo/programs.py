"""The programs of a campaign: a block of runs, drawn, filtered and scored on every device.

Each takes the campaign's key, the numbers of its runs, and every array that models, filters and map
were made of: one compilation serves all blocks, seeds, noises and map values. Runs are divided over
the devices with `shard_map`: no device ever waits for another.
"""

import hashlib
import inspect
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxslam.charts.euclidean import euclidean
from jaxslam.consistency import Score, condense, own_error_of, posterior_bound, score
from jaxslam.consistency.tally import condensed_sums
from jaxslam.protocols import Candidate, Chart, Estimator, Filter
from jaxslam.run import run
from jaxslam.simulate import Scenario, simulate
from jaxslam.types import Estimate, Info, Log, Trace, Truth

BOUND = "bound"
"""The name under which a block keeps the sums of the posterior bound, and the divergence limit."""


@dataclass(frozen=True)
class Programs:
    """Compiled for blocks of `wide` runs; run i has key fold_in(key, i)."""

    key: jax.Array
    wide: int
    draw: Callable[..., Any]
    drives: dict[str, Callable[..., Any]]
    scores: dict[str, Callable[..., Any]]
    least: Callable[..., Any]
    bound: bool
    limit: jax.Array
    """() [m] the divergence limit, from run 0"""
    devices: int
    spent: dict[str, list[float]]
    """wall seconds of each block so far, by filter"""

    def block(self, first: int, runs: int) -> dict[str, dict[str, np.ndarray]]:
        """Condensed scores of runs first … first + runs - 1 (at most `wide`), by filter."""
        which = first + jnp.arange(self.wide)
        world = jax.block_until_ready(self.draw(self.key, which))
        out = {}
        for name, drive in self.drives.items():
            began = time.perf_counter()
            driven = jax.block_until_ready(drive(self.key, which, world))
            self.spent[name].append(time.perf_counter() - began)
            scores = self.scores[name](self.limit, world[0], driven)
            kept = jax.tree.map(lambda leaf: leaf[:runs], jax.device_get(scores))
            out[name] = condense(kept, first)
        out[BOUND] = {"limit": np.asarray(self.limit)}
        if self.bound:
            least = jax.device_get(self.least(self.key, which, world))
            out[BOUND] |= condensed_sums({name: rows[:runs] for name, rows in least.items()})
        return out

    def run_seconds(self) -> dict[str, float]:
        """What one run took on one device, by filter: the median over blocks so far."""
        each = self.devices / self.wide
        return {name: each * float(np.median(all_)) for name, all_ in self.spent.items() if all_}


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
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    key: jax.Array,
    block: int,
    devices: Sequence[jax.Device],
    bound: bool,
    pool: ThreadPoolExecutor,
) -> Programs:
    """Compile for blocks of `block` runs a device, all programs at once.

    Filters whose results have the same shapes share the program that scores them.
    """
    mesh = Mesh(np.asarray(devices), ("runs",))
    wide = block * len(devices)

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

    def judge(limit: jax.Array, truth: Truth, driven: Driven) -> Score:
        def one(truth: Truth, driven: Driven) -> Score:
            trace = Trace(driven.estimate, driven.info, _Final(driven.watch), driven.probe)
            return score(trace, truth, scenario.sensor, limit, driven.own_error)

        scores: Score = jax.vmap(one)(truth, driven)
        return scores

    def least(key: jax.Array, which: jax.Array, world: tuple[Truth, Log]) -> dict[str, jax.Array]:
        def one(i: jax.Array, truth: Truth, log: Log) -> jax.Array:
            return posterior_bound(scenario, truth, log, _keys(key, i)[1]).pose_cov

        cov = jax.vmap(one)(which, *world)
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        return {"position": position, "heading": cov[:, :, 2, 2]}

    def program(
        function: Callable[..., Any], by_runs: str, *arguments: Any, straight: bool = False
    ) -> tuple[Future[Any], Any]:
        """Compiling; and the shapes of its results.

        by_runs: "r" for an argument by runs. straight: its time goes into long passes over arrays,
        not into a loop of small ones.
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
        options = _QUICK if straight and devices[0].platform == "cpu" else {}
        program = pool.submit(_compiled, lowered, tuple(devices), traced.consts, options)
        return program, _resized(shapes, wide)

    which = jnp.arange(wide)
    draws, world = program(draw, "-r", key, which, straight=True)
    dtype = world[0].pose.dtype
    drives: dict[str, Future[Any]] = {}
    scores: dict[Any, Future[Any]] = {}
    kinds = {}
    for name, candidate in filters.items():
        drives[name], driven = program(partial(drive, candidate), "-rr", key, which, world)
        leaves, structure = jax.tree.flatten(driven)
        kinds[name] = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if kinds[name] not in scores:
            limit = jax.ShapeDtypeStruct((), dtype)
            shapes = limit, world[0], driven
            scores[kinds[name]] = program(judge, "-rr", *shapes, straight=True)[0]
    bounds, _ = program(least, "-rr", key, which, world)
    first = bounds.result()(key, which, draws.result()(key, which))
    variance = float(first["position"][0, -1])
    return Programs(
        key=key,
        wide=wide,
        draw=draws.result(),
        drives={name: program.result() for name, program in drives.items()},
        scores={name: scores[kind].result() for name, kind in kinds.items()},
        least=bounds.result(),
        bound=bound,
        limit=jnp.asarray(_divergence_limit(scenario, variance**0.5, dtype), dtype),
        devices=len(devices),
        spent={name: [] for name in filters},
    )


def _resized(tree: Any, runs: int) -> Any:
    """The shapes of arrays by runs, with so many of them."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((runs, *leaf.shape[1:]), leaf.dtype), tree
    )


_KEPT: OrderedDict[Any, Any] = OrderedDict()
_ROOM = 64

# XLA's older emitters of CPU code: straight passes compile in under half the time and run as fast,
# but the small kernels in a filter's loop run half as fast.
_QUICK = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


def _compiled(
    lowered: jax.stages.Lowered,
    devices: tuple[jax.Device, ...],
    constants: list[Any],
    options: dict[str, Any],
) -> Callable[..., Any]:
    """The program with its constants, compiled unless the same has been, whatever its constants."""
    text = hashlib.sha256(lowered.as_text().encode()).digest()
    # Arguments that nothing reads are not in the text.
    which = (text, devices, lowered.in_tree, str(lowered.in_avals))
    kept = _KEPT.get(which)
    if kept is None:
        try:
            kept = lowered.compile(options)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            kept = lowered.compile()
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
