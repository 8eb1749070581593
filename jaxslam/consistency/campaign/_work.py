"""The missing blocks of a campaign, computed several at once, and the bar of progress."""

import contextlib
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxslam.consistency._tally import Tally
from jaxslam.consistency.campaign._block import BOUND, BlockRunner, CampaignPlan
from jaxslam.consistency.campaign._flight import TRIES, Flight, out_of_memory
from jaxslam.consistency.campaign._kept import Keep, add_block, flatten
from jaxslam.consistency.campaign._pieces import missing_pieces
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.consistency.campaign._remote import Executor, compute_block, pack
from jaxslam.core.types import Estimate, Truth

Report = Callable[[int, int], None]
"""(runs done, runs), called after each block."""


@dataclass
class Work:
    """Computes the missing blocks of a campaign, and keeps count."""

    workers: int
    """blocks in flight at once, beside one that waits"""
    keep: Keep | None
    tallies: dict[str, Tally]
    """the results of this process, by filter"""
    executor: Executor | None = None
    compile_seconds: float = 0.0
    first: dict[str, tuple[Truth, Estimate]] = field(default_factory=dict)
    spent: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """wall time of a run in each finished block, by filter [s]"""

    def run_seconds(self) -> dict[str, float]:
        """The time of one run on one device, by filter: the median over finished blocks."""
        return {name: float(np.median(times)) for name, times in self.spent.items()}

    def compute(
        self, plan: CampaignPlan, todo: Sequence[tuple[int, int]], report: Report | None
    ) -> None:
        """Add the pieces (first, runs) to the tallies, in blocks of half the size each time that
        memory does not suffice."""
        while todo:
            before = self.tallies[BOUND].pieces()
            queue = [
                piece
                for first, count in todo
                for piece in missing_pieces([(0, first), *before], first + count, plan.wide)
            ][::-1]
            try:
                if self.executor is not None:
                    start = partial(self.executor.submit, compute_block, pack(plan))
                    self._compute_queue(Flight(start, TRIES), queue, todo, report)
                    return
                runner = BlockRunner(plan)
                runner.compile()
                # XLA uses the cores; threads of the BLAS below its LAPACK would only spin.
                with threadpool_limits(1, "blas"), ThreadPoolExecutor(self.workers) as pool:
                    submit: Any = pool.submit
                    self._compute_queue(Flight(partial(submit, runner.block)), queue, todo, report)
                return
            except (jax.errors.JaxRuntimeError, MemoryError) as error:
                if not out_of_memory(error):
                    raise
                if plan.block == 1:
                    raise MemoryError(
                        "monte_carlo: out of memory with one run on each device (block=1): use "
                        "fewer steps, landmarks or filters at a time"
                    ) from error
                half = plan.block // 2
                warnings.warn(
                    f"monte_carlo: out of memory with block={plan.block}; continuing with "
                    f"block={half}",
                    stacklevel=3,
                )
                plan = replace(plan, block=half)

    def _compute_queue(
        self,
        flight: Flight,
        queue: list[tuple[int, int]],
        todo: Sequence[tuple[int, int]],
        report: Report | None,
    ) -> None:
        """Compute the pieces of a queue, last first, and add them to the tallies.

        After an error, or Ctrl-C, blocks in flight are finished and kept.
        """
        finished = sum(count for _, count in self.tallies[BOUND].pieces())
        total = sum(count for _, count in todo)
        stop: BaseException | None = None
        while flight or (queue and stop is None):
            try:
                while queue and stop is None and len(flight) <= self.workers:
                    flight.start(queue.pop())
                for (first, count), result in flight.collect():
                    if stop is not None and isinstance(result, BaseException):
                        continue
                    if isinstance(result, BaseException):
                        raise result
                    if self.keep is not None:
                        self.keep.save(first, flatten(result.scores, self.tallies), count)
                    add_block(self.tallies, first, count, result.scores)
                    self.first |= result.first
                    for name, seconds in result.seconds.items():
                        self.spent[name].append(seconds)
                    self.compile_seconds = max(self.compile_seconds, result.compile_seconds)
                    finished += count
                    if report is not None:
                        report(finished, total)
            except BaseException as error:
                if stop is not None:
                    raise
                stop = error
                flight.cancel()
        if stop is not None:
            raise stop


@contextlib.contextmanager
def progress_report(
    progress: Report | Literal[False] | None, plan: CampaignPlan
) -> Iterator[Report | None]:
    """A context with the function that reports progress, None for no report.

    progress: the user's function; False for none; None for a bar, on a terminal or in a notebook.
    """
    if progress is not None:
        yield progress or None
        return
    count = len(plan.filters)
    bar = Progress(f"{plan.scenario.name}, {count} filter{'s' * (count > 1)}")
    if not bar.shown:
        yield None
        return
    with bar:
        yield bar
