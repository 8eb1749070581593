"""The programs of a campaign: a block of B runs, drawn, filtered and scored on every device.

    program                        takes                       returns

    draw                           key, numbers (B,)           truth, log (B, …)
     ├─> drive, one a filter       key, numbers, truth, log    `FilterResults` (T, B, …)
     │    └─> statistics           truth, estimate, info       `Statistics` (B, …)
     ├─> bound, where asked for    key, numbers, truth, log    variances (B, T)
     └─> jacobians, else           truth, log of run 0         `RunJacobians` (T, …)

Estimates and infos have axes (T, B, …), as the loop over time leaves them. The bound, or else the
Jacobians, of run 0 give the divergence limit (`limit.divergence_limit`). Filters whose results have
the same shapes share one statistics program.

Each program takes the campaign's key, the numbers of its runs, and every number that models,
filters and map were made of (`jaxslam.programs`): one compilation serves all blocks, seeds, noises
and map values, in this campaign and the next. Runs are divided over the devices with `shard_map`:
no device ever waits for another.
"""

import contextlib
from concurrent.futures import Future
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree

from jaxslam.consistency import (
    RunStatistics,
    conditional_bound,
    jacobians_at_truth,
    monitor_of,
    own_error_of,
    run_statistics,
)
from jaxslam.filters.ekf.observability import Monitor
from jaxslam.monte_carlo.blocks.blockwise import Axes, Blockwise, Program
from jaxslam.monte_carlo.blocks.limit import divergence_limit
from jaxslam.monte_carlo.blocks.plan import CampaignPlan, Promises, run_numbers
from jaxslam.monte_carlo.candidates import estimator_of, rounded
from jaxslam.protocols import Candidate, Sensor
from jaxslam.simulation.worlds import Scenario, run_keys, world_of_run
from jaxslam.types import Estimate, Info, Log, Trace, Truth

World = tuple[Truth, Log]


class FilterResults(NamedTuple):
    """The results of a filter over the logs of a block, as far as they are scored."""

    estimate: Estimate
    """(T, B, …)"""
    info: Info
    """(T, B, …)"""
    own_error: Float[Array, "T B 3"]
    """the pose error in the filter's own coordinates"""
    monitor: Monitor | None
    """(B, …) its observability monitor at the end, where it has one"""
    information: Float[Array, "T B 3 3"] | None
    """what that monitor had gained after each step"""


_RUN_AXES = FilterResults._make((1, 1, 1, 0, 1))
"""The axis of `FilterResults` that goes over the runs."""


def compile_programs(plan: CampaignPlan, promises: Promises) -> None:
    """Fill in all promises, each program compiled while the next one is traced."""
    with contextlib.closing(Blockwise(plan.devices, plan.wide, plan.library)) as blockwise:
        compiling = _Compiling(plan, promises, blockwise)
        world = compiling.draw()
        compiling.filters(world)
        last = compiling.limit(world)
        for promise in (*promises.drives.values(), *promises.statistics.values(), last):
            promise.result()
        if not promises.complete.done():
            promises.complete.set_result(None)
        if not plan.with_first:
            which = run_numbers(0, plan.wide)
            drawn = promises.draw.result()(plan.key, which)
            promises.limit.set_result(divergence_limit(plan, promises, which, drawn))


class _Compiling(NamedTuple):
    """Starts the compilations; its methods take and return the shapes of what programs pass on."""

    plan: CampaignPlan
    promises: Promises
    blockwise: Blockwise

    def draw(self) -> World:
        """Start `draw_worlds`."""
        plan = self.plan
        draw = partial(draw_worlds, plan.scenario, plan.dtype)
        given = plan.key, run_numbers(0, plan.wide)
        world = self._start(self.promises.draw, "draw", draw, given, (None, 0), quick=True)
        return cast(World, world)

    def filters(self, world: World) -> None:
        """Start `drive_filter` and `run_statistics` of each filter.

        A filter comes before the statistics of the one before it: `BlockRunner` wants them so.
        """
        before: tuple[str, FilterResults] | None = None
        for name, candidate in self.plan.filters.items():
            results = self._drive(name, candidate, world)
            if before is not None:
                self._statistics(*before, world)
            before = name, results
        if before is not None:
            self._statistics(*before, world)

    def limit(self, world: World) -> Future[Program]:
        """Start the program of the divergence limit; returns its future."""
        plan, promises = self.plan, self.promises
        if plan.limit_by_bound:
            bound = partial(bound_variances, plan.scenario)
            given = plan.key, run_numbers(0, plan.wide), world
            self._start(promises.bound, "conditional bound", bound, given, (None, 0, 0))
            return promises.bound
        one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), world)
        jacobians = partial(jacobians_at_truth, plan.scenario)
        self._start(
            promises.jacobians, "jacobians", jacobians, one, (None, None), out=None, quick=True
        )
        return promises.jacobians

    def _drive(self, name: str, candidate: Candidate, world: World) -> FilterResults:
        plan = self.plan
        drive = partial(drive_filter, plan.scenario, candidate)
        results = self._start(
            self.promises.drives[name],
            f"drive {name}",
            drive,
            (plan.key, run_numbers(0, plan.wide), world),
            (None, 0, 0),
            out=_RUN_AXES,
            more=(candidate,),
        )
        return cast(FilterResults, results)

    def _statistics(self, name: str, results: FilterResults, world: World) -> None:
        found = partial(statistics_of_runs, self.plan.scenario.sensor)
        given = world[0], results.estimate, results.info
        self._start(self.promises.statistics[name], "statistics", found, given, (0, 1, 1))

    def _start(
        self,
        promise: Future[Program],
        name: str,
        function: Program,
        given: tuple[PyTree, ...],
        axes: tuple[Axes, ...],
        *,
        out: Axes = 0,
        more: tuple[object, ...] = (),
        quick: bool = False,
    ) -> PyTree:
        """Have `Blockwise.program` keep the promise; the shapes of the results.

        given: arrays or shapes. axes: those that go over the runs, of the arguments. out: of the
        results. more: what the function is made of beside the scenario.
        """
        label = name if self.plan.dtype is None else f"{name}, {self.plan.dtype}"
        objects = self.plan.scenario, *more
        made = self.blockwise.program(label, objects, function, axes, out, *given, straight=quick)
        made.program.add_done_callback(partial(_keep, promise))
        return made.shapes


def _keep(promise: Future[Program], compiling: Future[Program]) -> None:
    """Pass on how a compilation turned out, unless it was cancelled."""
    if compiling.cancelled() or promise.done():
        return
    error = compiling.exception()
    if error is None:
        promise.set_result(compiling.result())
    else:
        promise.set_exception(error)


# --- what the programs compute, of the runs which (B,) ------------------------------------------


def draw_worlds(
    scenario: Scenario, dtype: DTypeLike | None, key: Array, which: Int[Array, "B"]
) -> World:
    """The truths and logs (B, …) of these runs, floating-point numbers in the dtype."""
    world: World = jax.vmap(partial(world_of_run, scenario, key))(which)
    return rounded(world, dtype)


def drive_filter(
    scenario: Scenario, candidate: Candidate, key: Array, which: Int[Array, "B"], world: World
) -> FilterResults:
    """The results of a filter over the logs of these runs."""

    def one(i: Array, truth: Truth, log: Log) -> FilterResults:
        method, chart = estimator_of(candidate, truth, scenario)
        trace = method(log, run_keys(key, i)[1])
        own = own_error_of(chart, scenario.sensor, trace, truth)
        monitor = monitor_of(trace.final)
        information = None if monitor is None else trace.probe
        return FilterResults(trace.estimate, trace.info, own, monitor, information)

    results: FilterResults = jax.vmap(one, out_axes=_RUN_AXES)(which, *world)
    return results


def statistics_of_runs(
    sensor: Sensor, truth: Truth, estimate: Estimate, info: Info
) -> RunStatistics:
    """The statistics (B, …) of each run."""

    def one(truth: Truth, estimate: Estimate, info: Info) -> RunStatistics:
        return run_statistics(Trace(estimate, info, None, None), truth, sensor)

    found: RunStatistics = jax.vmap(one, in_axes=(0, 1, 1))(truth, estimate, info)
    return found


def bound_variances(
    scenario: Scenario, key: Array, which: Int[Array, "B"], world: World
) -> dict[str, Float[Array, "B T"]]:
    """The conditional Cramér-Rao bound of each run: position [m²] and heading [rad²] by step."""

    def one(i: Array, truth: Truth, log: Log) -> Array:
        return jnp.asarray(conditional_bound(scenario, truth, log, run_keys(key, i)[1]).pose_cov)

    cov = jax.vmap(one)(which, *world)
    position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
    return {"position": position, "heading": cov[:, :, 2, 2]}
