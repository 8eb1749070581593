"""The programs of a campaign: a block of B runs, drawn, filtered and scored on every device.

    program                        takes                                  returns

    draw                           world, key, numbers (B,)               truth, log (B, …)
     ├─> drive, one a filter       world, filter, key, numbers, *draws    `FilterResults` (T, B, …)
     │    └─> statistics           sensor, truth, estimate, info          `RunStatistics` (B, …)
     ├─> bound, where needed       world, key, numbers, *draws            variances (B, T)
     └─> jacobians, else           world, truth, log of run 0             `RunJacobians` (T, …)

Estimates and infos have axes (T, B, …), as the loop over time leaves them. The bound, or else the
Jacobians, of run 0 give the divergence limit. Filters whose results have the same shapes share one
statistics program.

World and filter are records, so their numbers are arguments: one compilation serves all blocks,
seeds, noises and maps of a structure, in this campaign and the next. What a program computes is a
function of one run, vectorized over the runs of a device; runs are divided over the devices with
`shard_map`: no device ever waits for another.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree

from jaxslam._driver import run
from jaxslam.charts import Euclidean
from jaxslam.consistency._bound import conditional_bound, jacobians_at_truth
from jaxslam.consistency._measures.measure import Measure, RunStatistics
from jaxslam.consistency._measures.nees import chart_error_of
from jaxslam.consistency._measures.observability import monitor_of
from jaxslam.consistency._run_scores import run_statistics
from jaxslam.consistency.campaign._candidates import candidate_for, cast_floats, method_of, start_of
from jaxslam.core.protocols import Candidate, Filter, Sensor
from jaxslam.core.types import Estimate, Info, Log, Trace, Truth
from jaxslam.core.validation import require
from jaxslam.filters._ekf.monitor import Monitor
from jaxslam.math._xla import hot_options, quick_options
from jaxslam.simulation._worlds import BLOCK, World, run_keys

Draws = tuple[Truth, Log]


class FilterResults(NamedTuple):
    """The results of a filter over the logs of a block, as far as they are scored."""

    estimate: Estimate
    """(T, B, …)"""
    info: Info
    """(T, B, …)"""
    chart_error: Float[Array, "T B 3"]
    """the pose error in the coordinates of the filter"""
    monitor: Monitor | None
    """(B, …) the observability monitor at the end, if the filter has one"""
    information: Float[Array, "T B 3 3"] | None
    """information in the monitor after each step"""


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
    """The programs on these devices; dtype: of the worlds, None for JAX's default."""
    draw = over_runs(devices, functools.partial(draw_run, dtype), (None, None, 0), 0)
    quick = quick_options(devices[0].platform)
    return Programs(jax.jit(draw, compiler_options=quick), *_programs_of_draws(devices))


@functools.cache
def _programs_of_draws(devices: Sequence[jax.Device]) -> tuple[PyTree, PyTree, PyTree]:
    """The programs drive, bound and jacobians; apart, since they are compiled once for draws of any
    dtype."""
    platform = devices[0].platform
    hot, quick = hot_options(platform), quick_options(platform)
    drive = over_runs(devices, drive_run, (None, None, None, 0, 0, 0), RUN_AXES)
    bound = over_runs(devices, bound_variances, (None, None, 0, 0, 0), 0)
    return (
        jax.jit(drive, compiler_options=hot),
        jax.jit(bound, compiler_options=hot),
        jax.jit(jacobians_at_truth, compiler_options=quick),
    )


@functools.cache
def statistics_program(devices: Sequence[jax.Device], measures: tuple[Measure, ...]) -> PyTree:
    """The statistics program on these devices. measures: those with `of_run`."""
    of_run = functools.partial(statistics_of_run, measures)
    statistics = over_runs(devices, of_run, (None, 0, 1, 1), 0)
    return jax.jit(statistics, compiler_options=hot_options(devices[0].platform))


def over_runs(
    devices: Sequence[jax.Device], function: Callable[..., PyTree], axes: PyTree, out_axes: PyTree
) -> PyTree:
    """The function of one run for a block of runs, divided over the devices.

    axes, out_axes: the axis of each argument and result that goes over the runs, or None.
    """
    in_specs, out_specs = (
        jax.tree.map(spec, tree, is_leaf=lambda axis: axis is None) for tree in (axes, out_axes)
    )
    return jax.shard_map(
        jax.vmap(function, in_axes=axes, out_axes=out_axes),
        mesh=mesh_of(devices),
        in_specs=in_specs,
        out_specs=out_specs,
        check_vma=False,
    )


def mesh_of(devices: Sequence[jax.Device]) -> Mesh:
    """The devices in a row, over which runs are divided."""
    return Mesh(np.asarray(devices), ("runs",))


def spec(axis: int | None) -> PartitionSpec:
    """The division of an array over the devices; axis: over the runs, None without one."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "runs")


def structs(shapes: PyTree, devices: Sequence[jax.Device], axes: PyTree = 0) -> PyTree:
    """Results of a program as the next one gets them: their shapes, and where they lie.

    axes: those over runs, a prefix of the tree.
    """
    mesh = mesh_of(devices)

    def placed(axis: int, part: PyTree) -> PyTree:
        sharding = NamedSharding(mesh, spec(axis))
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), part
        )

    return jax.tree.map(placed, axes, shapes)


# --- the programs for one run: its number, its truth, its log -----------------------------------


def draw_run(dtype: DTypeLike | None, scenario: World, key: Array, number: Int[Array, ""]) -> Draws:
    """The truth and log of a run, floating-point numbers in the dtype."""
    return cast_floats(scenario.run(key, number), dtype)


def drive_run(
    scenario: World,
    candidate: Candidate,
    key: Array,
    number: int | Int[Array, ""],
    truth: Truth,
    log: Log,
) -> FilterResults:
    """The results of a filter, or an estimator, over the log of a run."""
    method, filter_key = method_of(candidate, truth), run_keys(key, number)[1]
    if isinstance(method, Filter):
        require(f"filter {method.name}", method, candidate_for(scenario))
        chart, start = getattr(method, "chart", Euclidean()), start_of(method, scenario)
        trace = run(method, log, *start, filter_key, probe=_information_gained)
        if method.robot_state != scenario.motion.state:  # its further states are not the truth's
            estimate = trace.estimate._replace(further=None, further_cov=None)
            trace = trace._replace(estimate=estimate)
    else:
        trace, chart = method(log, filter_key), Euclidean()
    chart_error = chart_error_of(chart, scenario.sensor, trace, truth)
    monitor = monitor_of(trace.final)
    information = None if monitor is None else trace.probe
    return FilterResults(trace.estimate, trace.info, chart_error, monitor, information)


def _information_gained(state: PyTree) -> Array | None:
    """The information in a filter's observability monitor, where it has one.

    The probe of `run`: a function of the module, since another one would be compiled anew.
    """
    monitor = monitor_of(state)
    return None if monitor is None else monitor.information


def statistics_of_run(
    measures: tuple[Measure, ...], sensor: Sensor, truth: Truth, estimate: Estimate, info: Info
) -> RunStatistics:
    """The statistics of a run."""
    return run_statistics(Trace(estimate, info, None, None), truth, sensor, measures)


def bound_variances(
    scenario: World, key: Array, number: Int[Array, ""], truth: Truth, log: Log
) -> dict[str, Float[Array, "T"]]:
    """The conditional Cramér-Rao bound of a run: position [m²] and heading [rad²] by step."""
    cov = jnp.asarray(conditional_bound(scenario, truth, log, run_keys(key, number)[1]).pose_cov)
    return {"position": jnp.trace(cov[:, :2, :2], axis1=1, axis2=2), "heading": cov[:, 2, 2]}


def fitting_block(scenario: World, filters: Mapping[str, Candidate], device: jax.Device) -> int:
    """The number of runs computed together on a device: 16 on a CPU, whose caches they fit.

    On an accelerator as many as take a quarter of its memory, counting a run's world and what the
    first filter makes of it, which the scores read several times over: a power of two from 32 on,
    4096 at most, and 1024 where the device does not tell its memory.
    """
    if device.platform == "cpu":
        return BLOCK
    memory = (device.memory_stats() or {}).get("bytes_limit")
    if memory is None:
        return 1024

    def kept(key: Array) -> PyTree:
        truth, log = scenario.draw(key)
        results = drive_run(scenario, next(iter(filters.values())), key, 0, truth, log)
        return truth, log, results.estimate, results.info

    shapes = jax.tree.leaves(jax.eval_shape(kept, jax.random.key(0)))
    bytes_of_run = sum(leaf.size * leaf.dtype.itemsize for leaf in shapes)
    return int(np.clip(2 ** int(np.log2(max(memory / 4 / bytes_of_run, 1.0))), 32, 4096))
