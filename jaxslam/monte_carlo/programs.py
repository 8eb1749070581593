"""The programs of a campaign: a block of runs, drawn, filtered and scored on every device.

Each takes the campaign's key, the numbers of its runs, and every number that models, filters and
map were made of (`jaxslam.programs`): one compilation serves all blocks, seeds, noises and map
values, in this campaign and the next. Runs are divided over the devices with `shard_map`: no device
ever waits for another.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.consistency import (
    Slopes,
    Statistics,
    conditional_bound,
    final_covariance,
    own_error_of,
    slopes_at_truth,
    statistics,
)
from jaxslam.monte_carlo.block import Programs, numbers
from jaxslam.monte_carlo.blockwise import Blockwise
from jaxslam.monte_carlo.candidates import estimator_of, rounded
from jaxslam.protocols import Candidate
from jaxslam.simulation.worlds import Scenario, simulate
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


def compile_programs(
    promised: Programs,
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    devices: Sequence[jax.Device],
) -> None:
    """Fill in the programs, each compiled while the next is traced; back when all are there.

    Filters whose results have the same shapes share the program that sums them up.
    """
    key, wide = promised.key, promised.wide
    maker = Blockwise(devices, wide, promised.library)

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

    def read(truth: Truth, estimate: Estimate, info: Info) -> Statistics:
        def one(truth: Truth, estimate: Estimate, info: Info) -> Statistics:
            return statistics(Trace(estimate, info, (), ()), truth, scenario.sensor)

        found: Statistics = jax.vmap(one, in_axes=(0, 1, 1))(truth, estimate, info)
        return found

    def least(key: jax.Array, which: jax.Array, world: tuple[Truth, Log]) -> dict[str, jax.Array]:
        def one(i: jax.Array, truth: Truth, log: Log) -> jax.Array:
            return conditional_bound(scenario, truth, log, _keys(key, i)[1]).pose_cov

        cov = jax.vmap(one)(which, *world)
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        return {"position": position, "heading": cov[:, :, 2, 2]}

    def program(promise: Future[Any], name: str, *what: Any, straight: bool = False) -> Any:
        """Have the promise kept by `Blockwise.program`; the shapes of its results."""
        label = name if promised.dtype is None else f"{name}, {promised.dtype}"
        made = maker.program(label, *what, straight=straight)
        made.program.add_done_callback(partial(_keep, promise))
        return made.shapes

    which = numbers(0, wide)
    try:
        world = program(
            promised.draw, "draw", (scenario,), draw, (None, 0), 0, key, which, straight=True
        )

        def scored(name: str, driven: Any) -> None:
            promise, made = promised.statistics[name], (world[0], driven.estimate, driven.info)
            program(promise, "statistics", (scenario,), read, (0, 1, 1), 0, *made)

        # Each filter before the statistics of the one before it: `Programs.block` wants them so.
        before: tuple[str, Any] | None = None
        for name, candidate in filters.items():
            one = partial(drive, candidate)
            promise, of = promised.drives[name], (scenario, candidate)
            about = f"drive {name}", of, one, (None, 0, 0), _BY_TIME
            driven = program(promise, *about, key, which, world)
            if before is not None:
                scored(*before)
            before = name, driven
        if before is not None:
            scored(*before)
        # Without a bound, the Jacobians of run 0 tell the divergence limit; where there are none to
        # be had, the ideal filter does, as of the bound.
        plain = scenario.draw is None and scenario.spurious is None
        slow = promised.bound or not plain
        last: Future[Any] = promised.least if slow else promised.slopes
        spread_of = _spread_of_bound if slow else partial(_spread_of_slopes, scenario)
        promised.limit_of = partial(_divergence_limit, scenario, world[0].pose.dtype, spread_of)
        if slow:
            promised.slopes.set_result(None)
            program(last, "least", (scenario,), least, (None, 0, 0), 0, key, which, world)
        else:
            one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), world)
            slopes = partial(slopes_at_truth, scenario)
            program(last, "slopes", (scenario,), slopes, (None, None), None, *one, straight=True)
        for promise in (*promised.drives.values(), *promised.statistics.values(), last):
            promise.result()
        promised.complete()
        if not promised.with_first:
            drawn = promised.draw.result()(key, which)
            promised.limit.set_result(promised.found_limit(which, drawn, {}))
    finally:
        maker.close()


def _keep(promise: Future[Any], compiling: Future[Any]) -> None:
    """The promise is kept as the compilation turns out, unless that was cancelled."""
    if compiling.cancelled() or promise.done():
        return
    error = compiling.exception()
    if error is None:
        promise.set_result(compiling.result())
    else:
        promise.set_exception(error)


def _keys(key: jax.Array, i: jax.Array) -> jax.Array:
    """The keys of run i: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, i))


def _spread_of_bound(least: Mapping[str, np.ndarray]) -> float:
    """[m²] of run 0's last position. least: of a block whose first run it is, (runs, T)."""
    return float(least["position"][0, -1])


def _spread_of_slopes(scenario: Scenario, slopes: Slopes) -> float:
    return float(np.trace(final_covariance(slopes, np.asarray(scenario.pose_cov))[:2, :2]))


def _divergence_limit(
    scenario: Scenario, dtype: Any, spread_of: Callable[[Any], float], found: Any
) -> np.ndarray:
    """5 σ of the ideal spread of run 0, or, in a world without noise, what rounding can do."""
    spread = max(spread_of(found), 0.0) ** 0.5
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    return np.asarray(max(5 * spread, 1000 * float(jnp.finfo(dtype).eps) * reach), dtype)
