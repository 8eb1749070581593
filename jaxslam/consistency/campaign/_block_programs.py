"""The programs of a campaign: a block of B runs, drawn, filtered and scored on every device.

    program                        takes                                  returns

    draw                           world, key, numbers (B,)               truth, log (B, …)
     ├─> drive, one a filter       world, filter, key, numbers, draws     `FilterResults` (T, B, …)
     │    └─> statistics           sensor, truth, estimate, info          `RunStatistics` (B, …)
     ├─> bound, where needed       world, key, numbers, draws             variances (B, T)
     └─> jacobians, else           world, truth, log of run 0             `RunJacobians` (T, …)

Estimates and infos have axes (T, B, …), as the loop over time leaves them. The bound, or else the
Jacobians, of run 0 give the divergence limit. Filters whose results have the same shapes share one
statistics program.

World and filter are records, so their numbers are arguments: one compilation serves all blocks,
seeds, noises and maps of a structure, in this campaign and the next. Runs are divided over the
devices with `shard_map`: no device ever waits for another.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree

from jaxslam.consistency import Measure, RunStatistics, conditional_bound
from jaxslam.consistency._bound import jacobians_at_truth
from jaxslam.consistency._measures.nees import own_error_of
from jaxslam.consistency._measures.observability import monitor_of
from jaxslam.consistency._run_scores import run_statistics
from jaxslam.consistency.campaign._candidates import estimator_of, rounded
from jaxslam.core.protocols import Candidate, Sensor
from jaxslam.core.types import Estimate, Info, Log, Trace, Truth
from jaxslam.filters._ekf.monitor import Monitor
from jaxslam.math._xla import hot_options, quick_options
from jaxslam.simulation._worlds import World, run_keys

Draws = tuple[Truth, Log]


class FilterResults(NamedTuple):
    """The results of a filter over the logs of a block, as far as they are scored."""

    estimate: Estimate
    """(T, B, …)"""
    info: Info
    """(T, B, …)"""
    own_error: Float[Array, "T B 3"]
    """the pose error in the coordinates of the filter"""
    monitor: Monitor | None
    """(B, …) its observability monitor at the end, where it has one"""
    information: Float[Array, "T B 3 3"] | None
    """what that monitor had gained after each step"""


RUN_AXES = FilterResults._make((1, 1, 1, 0, 1))
"""The axis of `FilterResults` that goes over the runs."""


class Programs(NamedTuple):
    """The jitted functions of the table above, on some devices."""

    draw: PyTree
    drive: PyTree
    bound: PyTree
    jacobians: PyTree


@functools.cache
def programs(devices: Sequence[jax.Device], dtype: np.dtype | None) -> Programs:
    """The programs on these devices; dtype: of the worlds, None for that of JAX."""
    of_draw = functools.partial(draw_worlds, dtype)
    draw = over_runs(devices, of_draw, (None, None, 0), 0)
    quick = quick_options(devices[0].platform)
    return Programs(jax.jit(draw, compiler_options=quick), *_programs_of_draws(devices))


@functools.cache
def _programs_of_draws(devices: Sequence[jax.Device]) -> tuple[PyTree, PyTree, PyTree]:
    """The programs drive, bound and jacobians, which take what was drawn in any dtype."""
    platform = devices[0].platform
    hot, quick = hot_options(platform), quick_options(platform)
    drive = over_runs(devices, drive_filter, (None, None, None, 0, 0), RUN_AXES)
    bound = over_runs(devices, bound_variances, (None, None, 0, 0), 0)
    return (
        jax.jit(drive, compiler_options=hot),
        jax.jit(bound, compiler_options=hot),
        jax.jit(jacobians_at_truth, compiler_options=quick),
    )


@functools.cache
def statistics_program(devices: Sequence[jax.Device], measures: tuple[Measure, ...]) -> PyTree:
    """The statistics program on these devices. measures: those with `of_run`."""
    of_runs = functools.partial(statistics_of_runs, measures)
    statistics = over_runs(devices, of_runs, (None, 0, 1, 1), 0)
    return jax.jit(statistics, compiler_options=hot_options(devices[0].platform))


def over_runs(
    devices: Sequence[jax.Device], function: Callable[..., PyTree], axes: PyTree, out: PyTree
) -> PyTree:
    """The function with runs divided over the devices; axes: those over runs, or None."""
    inputs, outputs = (jax.tree.map(spec, one, is_leaf=_is_none) for one in (axes, out))
    return jax.shard_map(
        function, mesh=mesh_of(devices), in_specs=inputs, out_specs=outputs, check_vma=False
    )


def mesh_of(devices: Sequence[jax.Device]) -> Mesh:
    """The devices in a row, over which runs are divided."""
    return Mesh(np.asarray(devices), ("runs",))


def spec(axis: int | None) -> PartitionSpec:
    """How an array is divided over the devices; axis: that of the runs."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "runs")


def _is_none(axis: object) -> bool:
    return axis is None


def structs(shapes: PyTree, devices: Sequence[jax.Device], axes: PyTree = 0) -> PyTree:
    """Results of a program as the next one gets them: their shapes, and where they lie.

    axes: those over runs, a prefix of the tree.
    """
    mesh = mesh_of(devices)

    def placed(axis: int, part: PyTree) -> PyTree:
        where = NamedSharding(mesh, spec(axis))
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), part
        )

    return jax.tree.map(placed, axes, shapes)


# --- what the programs compute, of the runs which (B,) ------------------------------------------


def draw_worlds(
    dtype: DTypeLike | None, scenario: World, key: Array, which: Int[Array, "B"]
) -> Draws:
    """The truths and logs (B, …) of these runs, floating-point numbers in the dtype."""
    draws: Draws = jax.vmap(functools.partial(scenario.run, key))(which)
    return rounded(draws, dtype)


def drive_filter(
    scenario: World, candidate: Candidate, key: Array, which: Int[Array, "B"], draws: Draws
) -> FilterResults:
    """The results of a filter over the logs of these runs."""

    def one(i: Array, truth: Truth, log: Log) -> FilterResults:
        method, chart = estimator_of(candidate, truth, scenario)
        trace = method(log, run_keys(key, i)[1])
        chart_error = own_error_of(chart, scenario.sensor, trace, truth)
        monitor = monitor_of(trace.final)
        information = None if monitor is None else trace.probe
        return FilterResults(trace.estimate, trace.info, chart_error, monitor, information)

    results: FilterResults = jax.vmap(one, out_axes=RUN_AXES)(which, *draws)
    return results


def statistics_of_runs(
    measures: tuple[Measure, ...], sensor: Sensor, truth: Truth, estimate: Estimate, info: Info
) -> RunStatistics:
    """The statistics (B, …) of each run."""

    def one(truth: Truth, estimate: Estimate, info: Info) -> RunStatistics:
        return run_statistics(Trace(estimate, info, None, None), truth, sensor, measures)

    found: RunStatistics = jax.vmap(one, in_axes=(0, 1, 1))(truth, estimate, info)
    return found


def bound_variances(
    scenario: World, key: Array, which: Int[Array, "B"], draws: Draws
) -> dict[str, Float[Array, "B T"]]:
    """The conditional Cramér-Rao bound of each run: position [m²] and heading [rad²] by step."""

    def one(i: Array, truth: Truth, log: Log) -> Array:
        return jnp.asarray(conditional_bound(scenario, truth, log, run_keys(key, i)[1]).pose_cov)

    cov = jax.vmap(one)(which, *draws)
    position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
    return {"position": position, "heading": cov[:, :, 2, 2]}
