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
from jaxtyping import Float, Int, PyTree

from jaxslam.consistency import Score, score
from jaxslam.consistency._bound import final_covariance
from jaxslam.consistency._measures import REGISTRY
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
from jaxslam.core.protocols import Candidate
from jaxslam.core.types import Estimate, Info, Trace, Truth
from jaxslam.filters._ekf.monitor import MonitoredState
from jaxslam.simulation._worlds import Scenario, World

BOUND = ""
"""Under this name, which no filter has, a block keeps the sums of the conditional bound, and the
limit of accuracy."""


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
    """whether to compute the conditional Cramér-Rao bound of every run"""
    dtype: np.dtype | None = None
    """of the worlds; None for that of JAX"""

    @property
    def wide(self) -> int:
        """The number B of runs of a block, those of all devices."""
        return self.block * len(self.devices)

    @property
    def limit_by_bound(self) -> bool:
        """Whether the divergence limit comes from the conditional bound of run 0: always where that
        is computed, and in worlds whose Jacobians at the truth are not known."""
        world = self.scenario
        own_draw = type(world).draw is not Scenario.draw
        return self.bound or own_draw or world.spurious is not None


class BlockResult(NamedTuple):
    """What a block of runs gives."""

    scores: dict[str, dict[str, np.ndarray]]
    """condensed scores by filter"""
    first: dict[str, tuple[Truth, Estimate]]
    """run 0 by filter, of the block that has it"""
    seconds: dict[str, float]
    """wall time of a run of each filter on a device [s]"""
    compile_seconds: float
    """wall time in which the programs were compiled, for this and other blocks [s]"""


class BlockRunner:
    """Compiles the programs of a plan where it is made, and computes its blocks."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.plan, self._devices = plan, tuple(plan.devices)
        self.programs = programs(self._devices, plan.dtype)
        traced = tuple(one for one in REGISTRY.values() if one.of_run is not None)
        self._statistics = statistics_program(self._devices, traced)
        # The numbers of world and filters are put on every device once.
        everywhere = NamedSharding(mesh_of(self._devices), spec(None))
        self._world: World = jax.device_put(plan.scenario, everywhere)
        self._key = jax.device_put(plan.key, everywhere)
        self._filters: dict[str, Candidate] = {
            name: jax.device_put(as_record(one), everywhere) for name, one in plan.filters.items()
        }
        began = time.perf_counter()
        self._compile()
        self.compile_seconds = time.perf_counter() - began
        self._limit = self._divergence_limit()

    def _compile(self) -> None:
        """Compile all programs, each while the next one is traced: a call finds them compiled."""
        # Compiling one program keeps nearly two cores busy; more at once only delay the first.
        pool = ThreadPoolExecutor(max(cores() // 2, 1))
        compiling: dict[Hashable, Future[PyTree]] = {}

        def start(program: PyTree, *arguments: PyTree) -> PyTree:
            """Start a compilation; returns the shapes of the results."""
            leaves, tree = jax.tree.flatten(arguments)
            key = program, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
            traced = program.trace(*arguments)
            if key not in compiling:
                compiling[key] = pool.submit(traced.lower().compile)
            return traced.out_info

        plan, made, world, devices = self.plan, self.programs, self._world, self._devices
        runs = self._numbers(0)
        try:
            draws = structs(start(made.draw, world, self._key, runs), devices)
            for one in self._filters.values():
                shapes = start(made.drive, world, one, self._key, runs, draws)
                results: FilterResults = structs(shapes, devices, RUN_AXES)
                start(self._statistics, world.sensor, draws[0], results.estimate, results.info)
            if plan.limit_by_bound:
                start(made.bound, world, self._key, runs, draws)
            for each in compiling.values():
                each.result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _numbers(self, first: int) -> np.ndarray:
        """The numbers (B,) of the runs of a block."""
        return np.arange(first, first + self.plan.wide, dtype=jnp.result_type(int))

    def _divergence_limit(self) -> Float[np.ndarray, ""]:
        """The limit of accuracy: 5 σ [m] of the ideal spread of run 0's last position.

        In a world without noise it is what rounding can do.
        """
        plan, which = self.plan, self._numbers(0)
        draws: Draws = self.programs.draw(self._world, self._key, which)
        if plan.limit_by_bound:
            bound = self.programs.bound(self._world, self._key, which, draws)
            variance = float(first_run(bound["position"])[-1])
        else:
            found = jax.device_get(
                self.programs.jacobians(plan.scenario, *jax.tree.map(first_run, draws))
            )
            cov = final_covariance(found, np.asarray(plan.scenario.pose_cov))
            variance = float(np.trace(cov[:2, :2]))
        dtype = draws[0].pose.dtype
        reach = 1.0 + float(np.max(np.abs(np.asarray(plan.scenario.landmarks)), initial=0.0))
        rounding = 1000 * float(jnp.finfo(dtype).eps) * reach
        return np.asarray(max(FAR * max(variance, 0.0) ** 0.5, rounding), dtype)

    def block(self, first: int, runs: int) -> BlockResult:
        """The result of runs first … first + runs - 1, all within a block."""
        plan, made = self.plan, self.programs
        # The number of a run sets its place in a block, in any piece: the same bits.
        base = first // plan.wide * plan.wide
        mine = slice(first - base, first - base + runs)
        which = self._numbers(base)
        draws: Draws = jax.block_until_ready(made.draw(self._world, self._key, which))
        truth = jax.device_get(draws[0])
        valid = np.asarray(jax.device_get(draws[1].scan.valid))
        measured = valid.reshape(len(valid), -1).sum(axis=1)
        out: dict[str, dict[str, np.ndarray]] = {}
        run_0, seconds = {}, {}
        for name, one in self._filters.items():
            began = time.perf_counter()
            results: FilterResults = jax.block_until_ready(
                made.drive(self._world, one, self._key, which, draws)
            )
            seconds[name] = (time.perf_counter() - began) / plan.block
            if first == 0:
                run_0[name] = (
                    jax.tree.map(lambda leaf: leaf[0], truth),
                    jax.tree.map(lambda leaf: first_run(leaf, 1), results.estimate),
                )
            scores = self._score(results, draws[0], truth, measured, mine)
            out[name] = condense(scores, first, float(self._limit))
        out[BOUND] = {"limit": self._limit}
        if plan.bound:
            bound = jax.device_get(made.bound(self._world, self._key, which, draws))
            out[BOUND] |= condensed_sums({name: rows[mine] for name, rows in bound.items()})
        return BlockResult(out, run_0, seconds, self.compile_seconds)

    def _score(
        self,
        results: FilterResults,
        drawn: Truth,
        truth: Truth,
        measured: Int[np.ndarray, "B"],
        mine: slice,
    ) -> Score:
        """The scores of the runs mine.

        drawn: the truth on the devices, truth: on the host. measured: how many measurements.
        """
        found = jax.device_get(
            self._statistics(self._world.sensor, drawn, results.estimate, results.info)
        )
        chart_error = np.swapaxes(jax.device_get(results.own_error), 0, 1)
        trace = _on_host(results)
        given = trace, truth, found, chart_error, measured
        return score(*jax.tree.map(lambda leaf: leaf[mine], given))


def first_run(leaf: jax.Array, axis: int = 0) -> np.ndarray:
    """Run 0 of an array on the devices, copied from its shard. axis: that of the runs."""
    shard = next(one for one in leaf.addressable_shards if not one.index[axis].start)
    run: np.ndarray = np.take(np.asarray(shard.data), 0, axis)
    return run.copy()


def _on_host(results: FilterResults) -> Trace:
    """What `score` looks at itself, on the host, by run first; the rest is None."""
    absent: PyTree = None
    estimate, info = results.estimate, results.info
    by_time = (
        Estimate(estimate.pose, estimate.pose_cov, *[absent] * 4),
        info._replace(innovation=absent, innovation_cov=absent, slot=absent),
        results.information,
    )
    found: tuple[Estimate, Info, PyTree] = jax.tree.map(
        lambda leaf: np.swapaxes(leaf, 0, 1), jax.device_get(by_time)
    )
    final: MonitoredState | None = None
    if results.monitor is not None:
        final = MonitoredState(None, jax.device_get(results.monitor._replace(directions=absent)))
    return Trace(found[0], found[1], final, found[2])
