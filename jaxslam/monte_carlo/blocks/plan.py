"""What a campaign computes, and the compiled programs that its blocks wait for."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxslam.monte_carlo.blocks.blockwise import Library, Program
from jaxslam.protocols import Candidate
from jaxslam.simulation.worlds import Scenario


@dataclass(frozen=True)
class CampaignPlan:
    """The settings of the programs of one campaign."""

    scenario: Scenario
    filters: Mapping[str, Candidate]
    key: jax.Array
    """run i has key fold_in(key, i)"""
    devices: Sequence[jax.Device]
    block: int
    """runs a device"""
    bound: bool = False
    """whether the conditional Cramér-Rao bound of every run is taken"""
    dtype: DTypeLike | None = None
    """of the worlds; None for that of JAX"""
    library: Library | None = None
    with_first: bool = True
    """whether run 0, which tells the divergence limit, is among the runs to compute"""

    @property
    def wide(self) -> int:
        """The number B of runs of a block, those of all devices."""
        return self.block * len(self.devices)

    @property
    def limit_by_bound(self) -> bool:
        """Whether the divergence limit comes from the conditional bound of run 0: always where that
        is computed, and in worlds whose Jacobians at the truth are not to be had."""
        world = self.scenario
        own = (world.draw, world.recorded, world.spurious)
        return self.bound or any(part is not None for part in own)


class Promises:
    """The programs of a plan, as futures: `compile_programs` fills them in, and blocks wait."""

    def __init__(self, names: Sequence[str]) -> None:
        self.draw: Future[Program] = Future()
        self.drives: dict[str, Future[Program]] = {name: Future() for name in names}
        self.statistics: dict[str, Future[Program]] = {name: Future() for name in names}
        self.bound: Future[Program] = Future()
        """filled in where the plan needs the bound, and"""
        self.jacobians: Future[Program] = Future()
        """this one where it does not"""
        self.limit: Future[np.ndarray] = Future()
        """() [m] the divergence limit, set by the block of run 0, where that is computed"""
        self.complete: Future[None] = Future()
        """done when nothing is being compiled any more"""

    def all(self) -> list[Future[Program] | Future[np.ndarray] | Future[None]]:
        """All the futures that a block may wait for."""
        by_filter = (*self.drives.values(), *self.statistics.values())
        return [self.draw, *by_filter, self.bound, self.jacobians, self.limit, self.complete]

    def give_up(self, error: BaseException) -> None:
        """Raise the error in whoever waits for a program that is not there."""
        for promise in self.all():
            if not promise.done():
                promise.set_exception(error)


def run_numbers(first: int, runs: int) -> np.ndarray:
    """The numbers (runs,) of runs from the first on, as programs take them."""
    return np.arange(first, first + runs, dtype=jnp.result_type(int))
