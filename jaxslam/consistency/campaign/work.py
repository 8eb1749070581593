"""The missing blocks of a campaign, computed several at once, and the bar of progress."""

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxslam.consistency import Tally
from jaxslam.consistency.campaign.block import BOUND, BlockRunner, CampaignPlan
from jaxslam.consistency.campaign.kept import Keep, add_block, flat
from jaxslam.consistency.campaign.pieces import missing
from jaxslam.consistency.campaign.progress import Progress
from jaxslam.core.types import Estimate, Truth


@dataclass
class Work:
    """Computes the missing blocks of a campaign, and keeps count."""

    workers: int
    keep: Keep | None
    progress: Callable[[int, int], None] | None
    tallies: dict[str, Tally]
    """the results of this process, by filter"""
    compile_seconds: float = 0.0
    run_seconds: dict[str, float] = field(default_factory=dict)
    first: dict[str, tuple[Truth, Estimate]] = field(default_factory=dict)

    def in_blocks_that_fit(self, plan: CampaignPlan, todo: Sequence[tuple[int, int]]) -> None:
        """Compute the pieces, in blocks of half the size each time that memory does not suffice."""
        while True:
            try:
                return self.go(plan, todo)
            except (jax.errors.JaxRuntimeError, MemoryError) as error:
                if not (isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)):
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

    def go(self, plan: CampaignPlan, todo: Sequence[tuple[int, int]]) -> None:
        """Add those of the pieces that are not yet there to the tallies."""
        if not todo:
            return
        before = self.tallies[BOUND].pieces()
        queue = [
            piece
            for first, count in todo
            for piece in missing([(0, first), *before], first + count, plan.wide)
        ][::-1]
        runner = BlockRunner(plan)
        self.compile_seconds += runner.compile_seconds
        finished = sum(count for _, count in before)
        total = sum(count for _, count in todo)
        flight: dict[Future[dict[str, dict[str, np.ndarray]]], tuple[int, int]] = {}
        stop: BaseException | None = None
        # XLA uses the cores; additional threads of the BLAS below its LAPACK would only spin.
        with threadpool_limits(1, "blas"), ThreadPoolExecutor(self.workers) as pool:
            while flight or (queue and stop is None):
                try:
                    while queue and stop is None and len(flight) <= self.workers:
                        first, count = queue.pop()
                        flight[pool.submit(runner.block, first, count)] = first, count
                    for future in wait(flight, return_when=FIRST_COMPLETED).done:
                        first, count = flight.pop(future)
                        if stop is not None and (future.cancelled() or future.exception()):
                            continue
                        found = future.result()
                        if self.keep is not None:
                            self.keep.save(first, flat(found, self.tallies), count)
                        add_block(self.tallies, first, count, found)
                        finished += count
                        if self.progress is not None:
                            self.progress(finished, total)
                except BaseException as error:
                    if stop is not None:
                        raise
                    stop = error  # blocks in flight are finished and kept
                    for future in flight:
                        future.cancel()
        self.run_seconds = runner.run_seconds()
        self.first |= runner.first
        if stop is not None:
            raise stop


@contextlib.contextmanager
def shown_progress(work: Work, plan: CampaignPlan, wanted: bool) -> Iterator[None]:
    """A context with an optional progress bar on a terminal or in a notebook."""
    count = len(plan.filters)
    bar = Progress(f"{plan.scenario.name}, {count} filter{'s' * (count > 1)}") if wanted else None
    if bar is None or not bar.shown:
        yield
        return
    work.progress = bar
    with bar:
        yield
