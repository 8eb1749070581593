"""A block of runs: computed by the programs of the campaign, then condensed to scores."""

import time
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import Float, PyTree

from jaxslam.consistency._bound import final_covariance
from jaxslam.consistency._measures import REGISTRY
from jaxslam.consistency._measures.further import measures_of_state
from jaxslam.consistency._measures.measure import RunStatistics
from jaxslam.consistency._run_scores import score
from jaxslam.consistency._tally import FAR, condense, condensed_sums
from jaxslam.consistency.campaign._block_programs import (
    RUN_AXES,
    Draws,
    FilterResults,
    mesh_of,
    programs,
    spec,
    statistics_program,
    structs,
)
from jaxslam.consistency.campaign._pieces import cores
from jaxslam.core._record import as_record
from jaxslam.core._validation import reworded_tracer_errors
from jaxslam.core.protocols import Candidate
from jaxslam.core.types import Estimate, Info, Trace, Truth
from jaxslam.core.validation import refusals_of
from jaxslam.filters._ekf.monitor import MonitoredState
from jaxslam.simulation._twin import Twin
from jaxslam.simulation._worlds import Scenario, World

BOUND = ""
"""The name, which no filter has, under which a block keeps the sums of the conditional bound and
the limit of accuracy."""


@dataclass(frozen=True)
class CampaignPlan:
    """The settings of the programs of one campaign."""

    scenario: World
    filters: Mapping[str, Candidate]
    key: jax.Array
    """run i has key fold_in(key, i)"""
    devices: Sequence[jax.Device]
    block: int
    """runs a device"""
    bound: bool = False
    """compute the conditional Cramér-Rao bound of every run"""
    dtype: np.dtype | None = None
    """dtype of the worlds; None for JAX's default"""
    stride: int = 1
    """k: steps k, 2k, …, T are judged; a divisor of T"""

    @property
    def wide(self) -> int:
        """The number B of runs of a block, on all devices together."""
        return self.block * len(self.devices)

    @property
    def limit_by_bound(self) -> bool:
        """Whether the divergence limit comes from the conditional bound of run 0: always where that
        is computed, and in worlds whose Jacobians at the truth are not known."""
        world = self.scenario
        own_draw = type(world).draw not in (Scenario.draw, Twin.draw)
        return self.bound or own_draw or world.spurious is not None


class BlockResult(NamedTuple):
    """The scores of a block of runs, and its times."""

    scores: dict[str, dict[str, np.ndarray]]
    """condensed scores by filter"""
    first: dict[str, tuple[Truth, Estimate]]
    """run 0 by filter, of the block that has it"""
    seconds: dict[str, float]
    """wall time of a run of each filter on a device [s]"""
    compile_seconds: float
    """wall time in which the programs were compiled, for this and other blocks [s]"""


class BlockRunner:
    """Computes the blocks of a plan, once its programs are compiled."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.plan, self._devices = plan, tuple(plan.devices)
        self.programs = programs(self._devices, plan.dtype)
        measures = tuple(m for m in REGISTRY.values() if m.of_run is not None)
        measures += measures_of_state(plan.scenario.motion.state)
        self._statistics = statistics_program(self._devices, measures)
        # The numbers of world and filters are put on every device once.
        everywhere = NamedSharding(mesh_of(self._devices), spec(None))
        self._world: World = jax.device_put(plan.scenario, everywhere)
        self._key = jax.device_put(plan.key, everywhere)
        self._filters: dict[str, Candidate] = {
            name: jax.device_put(as_record(candidate), everywhere)
            for name, candidate in plan.filters.items()
        }
        self.compile_seconds = 0.0
        self._limit: Float[np.ndarray, ""] = np.zeros(())

    def compile(self) -> None:
        """Compile all programs, each while the next one is traced: a block finds them compiled.

        A program is traced here, and not in a helper: each call would be a frame of the tracebacks
        in a user's model.
        """
        began = time.perf_counter()
        # Compiling one program keeps nearly two cores busy; more at once only delay the first.
        pool = ThreadPoolExecutor(max(cores() // 2, 1))
        compiling: dict[Hashable, Future[PyTree]] = {}

        def start(program: PyTree, traced: PyTree) -> PyTree:
            """Start a compilation; returns the shapes of the results."""
            leaves, tree = jax.tree.flatten(traced.args_info)
            shapes = program, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
            if shapes not in compiling:
                compiling[shapes] = pool.submit(traced.lower().compile)
            return traced.out_info

        plan, world, devices, numbers = self.plan, self._world, self._devices, self._numbers(0)
        draw, drive, bound, _ = self.programs
        try:
            with refusals_of(f"{world.name}: draw"), reworded_tracer_errors():
                traced = draw.trace(world, self._key, numbers)
            draws: Draws = structs(start(draw, traced), devices)
            for name, candidate in self._filters.items():
                with refusals_of(f"monte_carlo: {name}"), reworded_tracer_errors():
                    traced = drive.trace(world, candidate, self._key, numbers, *draws)
                results: FilterResults = structs(start(drive, traced), devices, RUN_AXES)
                scored = world.sensor, draws[0], results.estimate, results.info
                start(self._statistics, self._statistics.trace(*scored))
            if plan.limit_by_bound:
                start(bound, bound.trace(world, self._key, numbers, *draws))
            for program in compiling.values():
                program.result()
        finally:
            pool.shutdown(cancel_futures=True)
        self.compile_seconds = time.perf_counter() - began
        self._limit = self._divergence_limit()

    def _numbers(self, first: int) -> np.ndarray:
        """The numbers (B,) of the runs of a block."""
        return np.arange(first, first + self.plan.wide, dtype=jnp.result_type(int))

    def _divergence_limit(self) -> Float[np.ndarray, ""]:
        """The limit of accuracy: 5 σ [m] of the ideal spread of run 0's last position.

        In a world without noise it is what rounding can do.
        """
        plan, numbers = self.plan, self._numbers(0)
        draws: Draws = self.programs.draw(self._world, self._key, numbers)
        if plan.limit_by_bound:
            bound = self.programs.bound(self._world, self._key, numbers, *draws)
            variance = float(first_run(bound["position"])[-1])
        else:
            jacobians = jax.device_get(
                self.programs.jacobians(plan.scenario, *jax.tree.map(first_run, draws))
            )
            cov = final_covariance(jacobians, np.asarray(plan.scenario.pose_cov))
            variance = float(np.trace(cov[:2, :2]))
        dtype = draws[0].pose.dtype
        reach = 1.0 + float(np.max(np.abs(np.asarray(plan.scenario.landmarks)), initial=0.0))
        # In a world without noise σ is 0, and only rounding is left.
        rounding = 1000 * float(jnp.finfo(dtype).eps) * reach
        return np.asarray(max(FAR * max(variance, 0.0) ** 0.5, rounding), dtype)

    def draws(self, first: int, runs: int) -> Draws:
        """The truth and the logs (R, …) of runs first … first + runs - 1, all within a block, on
        the host."""
        numbers, wanted = self._place(first, runs)
        draws = jax.device_get(self.programs.draw(self._world, self._key, numbers))
        of_runs: Draws = jax.tree.map(lambda leaf: leaf[wanted], draws)
        return of_runs

    def _place(self, first: int, runs: int) -> tuple[np.ndarray, slice]:
        """The numbers (B,) of the runs of a block, and where some of its runs are among them."""
        # The number of a run sets its place in a block, in any piece: the same bits.
        base = first // self.plan.wide * self.plan.wide
        return self._numbers(base), slice(first - base, first - base + runs)

    def block(self, first: int, runs: int) -> BlockResult:
        """The result of runs first … first + runs - 1, all within a block."""
        plan, (draw, drive, bound, _) = self.plan, self.programs
        numbers, wanted = self._place(first, runs)
        draws: Draws = jax.block_until_ready(draw(self._world, self._key, numbers))
        truth = jax.device_get(draws[0])
        valid = np.asarray(jax.device_get(draws[1].scan.valid))
        measured = valid.reshape(len(valid), -1).sum(axis=1)
        scores: dict[str, dict[str, np.ndarray]] = {}
        run_0, seconds = {}, {}
        judged = slice(plan.stride - 1, None, plan.stride)
        for name, candidate in self._filters.items():
            began = time.perf_counter()
            results: FilterResults = jax.block_until_ready(
                drive(self._world, candidate, self._key, numbers, *draws)
            )
            seconds[name] = (time.perf_counter() - began) / plan.block
            if first == 0:
                run_0[name] = (
                    rows_of_truth(jax.tree.map(lambda leaf: leaf[0], truth), judged),
                    jax.tree.map(lambda leaf: first_run(leaf, 1)[judged], results.estimate),
                )
            statistics = jax.device_get(
                self._statistics(self._world.sensor, draws[0], results.estimate, results.info)
            )
            chart_error = np.swapaxes(jax.device_get(results.chart_error), 0, 1)
            by_run: PyTree = _on_host(results), truth, statistics, chart_error, measured
            by_run = jax.tree.map(lambda leaf: leaf[wanted], by_run)
            score_of_runs = score(*select_steps(plan.stride, *by_run))
            scores[name] = condense(score_of_runs, first, float(self._limit))
        scores[BOUND] = {"limit": self._limit}
        if plan.bound:
            variances = jax.device_get(bound(self._world, self._key, numbers, *draws))
            scores[BOUND] |= condensed_sums(
                {n: rows[wanted, plan.stride - 1 :: plan.stride] for n, rows in variances.items()}
            )
        return BlockResult(scores, run_0, seconds, self.compile_seconds)


def select_steps(
    stride: int,
    trace: Trace,
    truth: Truth,
    statistics: RunStatistics,
    chart_error: np.ndarray | None,
    measured: np.ndarray,
) -> tuple[Trace, Truth, RunStatistics, np.ndarray | None, np.ndarray]:
    """The arguments of `score` at steps k, 2k, …, T of R runs; k is `stride`.

    Measurements are none of a step alone: those of k steps are put side by side.
    """
    if stride == 1:
        return trace, truth, statistics, chart_error, measured
    at = np.s_[:, stride - 1 :: stride]

    def of_windows(leaf: np.ndarray) -> np.ndarray:
        # (R, T, M) -> (R, T/k, k M)
        return leaf.reshape(len(leaf), leaf.shape[1] // stride, -1)

    estimate, info = trace.estimate, trace.info
    by_window: PyTree = {name: of_windows(getattr(info, name)) for name in ("nis", "dof", "status")}
    likelihood = of_windows(np.asarray(info.log_likelihood))
    by_window["log_likelihood"] = likelihood.sum(axis=2, dtype=np.float64)
    values = {
        name: value[at] if isinstance(value, np.ndarray) and value.ndim == 2 else value
        for name, value in statistics.values.items()
    }
    return (
        trace._replace(
            estimate=estimate._replace(pose=estimate.pose[at], pose_cov=estimate.pose_cov[at]),
            info=info._replace(**by_window),
            probe=None if trace.probe is None else trace.probe[at],
        ),
        truth._replace(
            pose=truth.pose[at], further=None if truth.further is None else truth.further[at]
        ),
        statistics._replace(
            landmark_nees=statistics.landmark_nees[at],
            regular_landmarks=statistics.regular_landmarks[at],
            values=values,
        ),
        None if chart_error is None else chart_error[at],
        measured,
    )


def rows_of_truth(truth: Truth, rows: slice) -> Truth:
    """The truth of one run at some of its steps."""
    further = None if truth.further is None else truth.further[rows]
    return truth._replace(pose=truth.pose[rows], missed=truth.missed[rows], further=further)


def first_run(leaf: jax.Array, axis: int = 0) -> np.ndarray:
    """Run 0 of an array on the devices, copied from its shard. axis: over the runs."""
    shard = next(part for part in leaf.addressable_shards if not part.index[axis].start)
    run: np.ndarray = np.take(np.asarray(shard.data), 0, axis)
    return run.copy()


def _on_host(results: FilterResults) -> Trace:
    """The part of a trace that `score` reads, on the host, axis of the runs first; else None."""
    absent: PyTree = None
    estimate, info = results.estimate, results.info
    by_time = (
        Estimate(estimate.pose, estimate.pose_cov, *[absent] * 4),
        info._replace(innovation=absent, innovation_cov=absent, slot=absent),
        results.information,
    )
    by_run: tuple[Estimate, Info, PyTree] = jax.tree.map(
        lambda leaf: np.swapaxes(leaf, 0, 1), jax.device_get(by_time)
    )
    final: MonitoredState | None = None
    if results.monitor is not None:
        final = MonitoredState(None, jax.device_get(results.monitor._replace(directions=absent)))
    return Trace(by_run[0], by_run[1], final, by_run[2])
