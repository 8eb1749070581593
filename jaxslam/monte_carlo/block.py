"""A block of runs: the programs it waits for, and what is condensed of its scores."""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.consistency import Measure, Score, condense, mean_pose_nees, positive_interval, score
from jaxslam.consistency.tally import condensed_sums
from jaxslam.monte_carlo.blockwise import Library
from jaxslam.types import Estimate, Info, Trace, Truth

BOUND = "bound"
"""Under this name a block keeps the sums of the conditional bound, and the divergence limit."""


Glimpse = Callable[[str, int, Measure | None], Any]
"""(filter, runs, their mean pose NEES)."""


class Watched(NamedTuple):
    """Of a filter's final state, what a score looks at."""

    watch: Any


def numbers(first: int, runs: int) -> np.ndarray:
    """(runs,) the numbers of runs from the first on, as programs take them."""
    return np.arange(first, first + runs, dtype=jnp.result_type(int))


class Programs:
    """Of blocks of `wide` runs; run i has key fold_in(key, i).

    `compile_programs` fills in one after the other. A block may be begun before: where it needs a
    program that is not there yet, it waits.
    """

    def __init__(
        self,
        names: Sequence[str],
        key: jax.Array,
        block: int,
        devices: int,
        bound: bool,
        glimpse: Glimpse | None = None,
        dtype: Any = None,
        library: Library | None = None,
        with_first: bool = True,
    ) -> None:
        self.dtype, self.library, self.with_first = dtype, library, with_first
        self.key, self.wide, self.devices, self.bound = key, block * devices, devices, bound
        self.glimpse = glimpse
        self.draw: Future[Callable[..., Any]] = Future()
        self.drives: dict[str, Future[Callable[..., Any]]] = {name: Future() for name in names}
        self.statistics: dict[str, Future[Callable[..., Any]]] = {name: Future() for name in names}
        self.least: Future[Callable[..., Any]] = Future()
        self.first: dict[str, tuple[Truth, Estimate]] = {}
        """run 0 of each filter, once its block has run"""
        self.limit: Future[np.ndarray] = Future()
        """() [m] the divergence limit, from run 0; set by its block, where there is one"""
        self.limit_of: Callable[[Any], np.ndarray] | None = None
        """of what `least` found of a block whose first run is run 0; without a bound, of what
        `slopes` found of run 0"""
        self.slopes: Future[Callable[..., Any] | None] = Future()
        """without a bound, the Jacobians of run 0; None where `least` is to be asked"""
        self.all: Future[None] = Future()
        """nothing is being compiled any more"""
        self._quiet = threading.Event()
        self._spent: dict[str, list[tuple[bool, float]]] = {name: [] for name in names}
        """whether nothing was being compiled, and wall seconds; of each block so far"""

    def block(
        self, first: int, runs: int, early: bool, tell: bool
    ) -> dict[str, dict[str, np.ndarray]]:
        """Condensed scores of runs first … first + runs - 1 by filter, all within a block.

        early: begin while other programs are being compiled, and do not time that. tell: let
        `glimpse` know of each filter as soon as it has run.
        """
        try:
            return self._block(first, runs, early, tell)
        except BaseException as error:
            if first == 0:
                self.give_up(error)  # nobody else finds the limit
            raise

    def _block(
        self, first: int, runs: int, early: bool, tell: bool
    ) -> dict[str, dict[str, np.ndarray]]:
        if not early:
            self.all.result()
        # A run has its place in the block by its number, in whatever piece: the same bits.
        base = first // self.wide * self.wide
        mine = slice(first - base, first - base + runs)
        which = numbers(base, self.wide)
        world = jax.block_until_ready(self.draw.result()(self.key, which))
        truth = jax.device_get(world[0])
        scores: dict[str, Score] = {}
        held: list[tuple[str, Any, Trace]] = []

        def judge() -> None:
            name, driven, trace = held.pop(0)
            found = jax.device_get(
                self.statistics[name].result()(world[0], driven.estimate, driven.info)
            )
            own = np.swapaxes(jax.device_get(driven.own_error), 0, 1)
            of = jax.tree.map(lambda leaf: leaf[mine], (trace, truth, found, own))
            scores[name] = score(*of)

        for name, promised in self.drives.items():
            drive = promised.result()
            began, quiet = time.perf_counter(), self._quiet.is_set()
            driven = jax.block_until_ready(drive(self.key, which, world))
            self._spent[name].append((quiet, time.perf_counter() - began))
            trace = _looked_at(driven)
            if first == 0:
                self.first[name] = (
                    jax.tree.map(lambda leaf: leaf[0], truth),
                    jax.tree.map(_first_run, driven.estimate),
                )
            if tell and self.glimpse is not None:
                poses = truth.pose, *trace.estimate[:2]
                nees, defined = mean_pose_nees(*(np.asarray(rows)[mine] for rows in poses))
                self.glimpse(name, runs, positive_interval(nees[defined]))
            held.append((name, driven, trace))
            # A filter is compiled before the statistics of the one before it.
            while held and (len(held) > 1 or self.statistics[held[0][0]].done()):
                judge()
        while held:
            judge()
        least: dict[str, np.ndarray] = {}
        if self.bound:
            least = jax.device_get(self.least.result()(self.key, which, world))
        if first == 0 and not self.limit.done():
            self.limit.set_result(self.found_limit(which, world, least))
        limit = self.limit.result()
        out = {name: condense(each, first, float(limit)) for name, each in scores.items()}
        out[BOUND] = {"limit": limit}
        if self.bound:
            out[BOUND] |= condensed_sums({name: rows[mine] for name, rows in least.items()})
        return out

    def found_limit(self, which: np.ndarray, world: Any, least: dict[str, np.ndarray]) -> Any:
        """The divergence limit, of the block of run 0. least: what was found already, if so."""
        slopes = self.slopes.result()
        if slopes is not None:
            found = jax.device_get(slopes(*jax.tree.map(_first, world)))
        else:
            found = least or jax.device_get(self.least.result()(self.key, which, world))
        assert self.limit_of is not None
        return self.limit_of(found)

    def promises(self) -> list[Future[Any]]:
        """All that blocks may wait for."""
        return [
            self.draw,
            *self.drives.values(),
            *self.statistics.values(),
            self.least,
            self.slopes,
            self.limit,
            self.all,
        ]

    def complete(self) -> None:
        """Nothing is being compiled any more."""
        self._quiet.set()
        if not self.all.done():
            self.all.set_result(None)

    def give_up(self, error: BaseException) -> None:
        """Whoever waits for a program that is not there gets the error."""
        for promise in self.promises():
            if not promise.done():
                promise.set_exception(error)

    def run_seconds(self) -> dict[str, float]:
        """What one run took on one device, by filter: the median over blocks so far,
        those alone during which nothing was compiled, where there are such."""
        out = {}
        for name, all_ in self._spent.items():
            times = [seconds for quiet, seconds in all_ if quiet] or [s for _, s in all_]
            if times:
                out[name] = self.devices / self.wide * float(np.median(times))
        return out


def _looked_at(driven: Any) -> Trace:
    """What `score` looks at itself, on the host, by run first."""
    nothing: Any = ()
    estimate, info = driven.estimate, driven.info
    by_time = (
        Estimate(estimate.pose, estimate.pose_cov, *[nothing] * 4),
        info._replace(innovation=nothing, innovation_cov=nothing, slot=nothing),
        driven.probe,
    )
    found: tuple[Estimate, Info, Any] = jax.tree.map(
        lambda leaf: np.swapaxes(leaf, 0, 1), jax.device_get(by_time)
    )
    watch = driven.watch
    if watch:
        watch = jax.device_get(watch._replace(directions=nothing))
    return Trace(found[0], found[1], Watched(watch), found[2])


def _first_run(leaf: jax.Array) -> np.ndarray:
    """(T, …) of a block's arrays (T, runs, …), without a copy of the others."""
    shard = next(one for one in leaf.addressable_shards if not one.index[1].start)
    return np.asarray(shard.data)[:, 0].copy()


def _first(leaf: jax.Array) -> np.ndarray:
    """The same of arrays (runs, …)."""
    shard = next(one for one in leaf.addressable_shards if not one.index[0].start)
    out: np.ndarray = np.asarray(shard.data)[0].copy()
    return out
