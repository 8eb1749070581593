"""A block of runs: computed by the programs of the campaign as they are there, then condensed."""

import time
from collections import deque

import jax
import numpy as np
from jaxtyping import PyTree

from jaxslam.consistency import Score, condense, score
from jaxslam.consistency.tally import condensed_sums
from jaxslam.filters.ekf.observability import MonitoredState
from jaxslam.monte_carlo.blocks.limit import divergence_limit, first_run
from jaxslam.monte_carlo.blocks.plan import CampaignPlan, Promises, run_numbers
from jaxslam.monte_carlo.blocks.programs import FilterResults, World
from jaxslam.types import Estimate, Info, Trace, Truth

BOUND = "bound"
"""Under this name a block keeps the sums of the conditional bound, and the divergence limit."""


class BlockRunner:
    """Computes blocks; one may be begun before all programs are there, and waits for each."""

    def __init__(self, plan: CampaignPlan, promises: Promises) -> None:
        self.plan, self.promises = plan, promises
        self.first: dict[str, tuple[Truth, Estimate]] = {}
        """run 0 of each filter, once its block has run"""
        self._spent: dict[str, list[tuple[bool, float]]] = {name: [] for name in plan.filters}
        """whether nothing was being compiled, and wall seconds; of each block so far"""

    def block(self, first: int, runs: int, early: bool) -> dict[str, dict[str, np.ndarray]]:
        """The condensed scores of runs first … first + runs - 1 by filter, all within a block.

        early: begin while other programs are being compiled, and do not time that.
        """
        try:
            return self._block(first, runs, early)
        except BaseException as error:
            if first == 0:
                self.promises.give_up(error)  # nobody else finds the limit
            raise

    def _block(self, first: int, runs: int, early: bool) -> dict[str, dict[str, np.ndarray]]:
        plan, promises = self.plan, self.promises
        if not early:
            promises.complete.result()
        # A run has its place in the block by its number, in whatever piece: the same bits.
        base = first // plan.wide * plan.wide
        mine = slice(first - base, first - base + runs)
        which = run_numbers(base, plan.wide)
        world = jax.block_until_ready(promises.draw.result()(plan.key, which))
        truth = jax.device_get(world[0])
        scores: dict[str, Score] = {}
        waiting: deque[tuple[str, FilterResults, Trace]] = deque()

        def score_next() -> None:
            name, results, trace = waiting.popleft()
            scores[name] = self._score(name, results, trace, world[0], truth, mine)

        for name in plan.filters:
            results = self._drive(name, which, world)
            trace = _on_host(results)
            if first == 0:
                self.first[name] = (
                    jax.tree.map(lambda leaf: leaf[0], truth),
                    jax.tree.map(lambda leaf: first_run(leaf, 1), results.estimate),
                )
            waiting.append((name, results, trace))
            # A filter is compiled before the statistics of the one before it.
            while waiting and (len(waiting) > 1 or promises.statistics[waiting[0][0]].done()):
                score_next()
        while waiting:
            score_next()
        bound: dict[str, np.ndarray] = {}
        if plan.bound:
            bound = jax.device_get(promises.bound.result()(plan.key, which, world))
        if first == 0 and not promises.limit.done():
            promises.limit.set_result(divergence_limit(plan, promises, which, world, bound))
        limit = promises.limit.result()
        out = {name: condense(each, first, float(limit)) for name, each in scores.items()}
        out[BOUND] = {"limit": limit}
        if plan.bound:
            out[BOUND] |= condensed_sums({name: rows[mine] for name, rows in bound.items()})
        return out

    def _drive(self, name: str, which: np.ndarray, world: World) -> FilterResults:
        """The results of a filter over a block, timed."""
        drive = self.promises.drives[name].result()
        began, quiet = time.perf_counter(), self.promises.complete.done()
        results: FilterResults = jax.block_until_ready(drive(self.plan.key, which, world))
        self._spent[name].append((quiet, time.perf_counter() - began))
        return results

    def _score(
        self,
        name: str,
        results: FilterResults,
        trace: Trace,
        drawn: Truth,
        truth: Truth,
        mine: slice,
    ) -> Score:
        """The scores of the runs mine. drawn: the truth on the devices, truth: on the host."""
        summed = self.promises.statistics[name].result()
        found = jax.device_get(summed(drawn, results.estimate, results.info))
        own = np.swapaxes(jax.device_get(results.own_error), 0, 1)
        return score(*jax.tree.map(lambda leaf: leaf[mine], (trace, truth, found, own)))

    def run_seconds(self) -> dict[str, float]:
        """What one run took on one device, by filter: the median over blocks so far,
        those alone during which nothing was compiled, where there are such."""
        out = {}
        for name, all_ in self._spent.items():
            times = [seconds for quiet, seconds in all_ if quiet] or [s for _, s in all_]
            if times:
                out[name] = float(np.median(times)) / self.plan.block
        return out


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
