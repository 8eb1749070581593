"""The campaign: blocks of runs over devices, kept as they finish, then summed up.

A run is a number: its key and its place in a block. For one size of blocks and one number of
devices its world and its filters' results are the same to the bit, for any workers, parts and
interruptions; otherwise to rounding. Only scores are kept of a block, so the blocks in flight set
the memory, for any number of runs.

On a GPU particle filters agree to rounding alone (`docs/guide/campaigns.md`).
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeVar

import jax
import numpy as np
from jax.typing import DTypeLike

from jaxslam._origin import far_origin, may_move, move_near_origin, to_map_coordinates
from jaxslam.consistency._digests import identity
from jaxslam.consistency._summary import Summary, summarize
from jaxslam.consistency._tally import Tally
from jaxslam.consistency.campaign._block import BOUND, CampaignPlan
from jaxslam.consistency.campaign._block_programs import fitting_block
from jaxslam.consistency.campaign._candidates import (
    candidate_for,
    check_dtype,
    check_noise,
    method_of,
    without_noise,
)
from jaxslam.consistency.campaign._kept import Keep, add_kept
from jaxslam.consistency.campaign._pieces import cores, in_part, missing_pieces, one_part
from jaxslam.consistency.campaign._precision import precision_doubts
from jaxslam.consistency.campaign._remote import Executor
from jaxslam.consistency.campaign._result import Campaign, Incomplete, Interrupted
from jaxslam.consistency.campaign._work import Report, Work, progress_report
from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.types import Truth
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    or_none,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.graphs.smoothing._forward_pass import LogEstimator
from jaxslam.simulation._worlds import World, run_count, with_positions

_T = TypeVar("_T")


def monte_carlo(
    scenario: World,
    filters: Mapping[str, Candidate],
    runs: int,
    key: jax.Array,
    *,
    block: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    workers: int | None = None,
    bound: bool = False,
    dtype: DTypeLike | None = None,
    keep: Keep | None = None,
    part: tuple[int, int] | None = None,
    progress: Report | Literal[False] | None = None,
    executor: Executor | None = None,
) -> Campaign:
    """Run every filter over the same `runs` worlds of a scenario and sum up its consistency.

    Where rounding comes near the noise in float32, the first runs are filtered again in float64: a
    filter whose precision decides gets a doubt with the numbers of both (`Summary.doubts`). A world
    whose origin is far from its map is computed with positions relative to the start, if neither
    world nor filters depend on where that is.

    Args:
        scenario: what to draw; see `scenarios`.
        filters: by name. A function instead of a filter is called with each run's `Truth`.
        runs: how many worlds; run i has key fold_in(key, i).
        key: a PRNG key.
        block: runs vmapped together on a device, which sets memory; default 16 on a CPU, and
            by its memory on an accelerator. Where memory does not suffice, half of it is tried,
            with a warning.
        devices: default all of `jax.local_devices()`.
        workers: blocks in flight at once; default as many as keep every core of a CPU busy (2 on an
            accelerator), and 64 with an executor.
        bound: also take the conditional Cramér-Rao bound of every run (`conditional_bound`), at
            the price of one more EKF.
        dtype: float32 or float64, of the worlds and so of the filters. With `jax_enable_x64` worlds
            are drawn in float64 and then rounded: both see the same. Default what JAX is set to.
        keep: blocks are saved there as they finish, and those found there are not run again. It
            holds one campaign: what must agree (key, scenario, models, filters, precision,
            versions) is its `identity`. More runs than it has extend it.
        part: (i, n) with 1 <= i <= n: only the blocks i - 1, i - 1 + n, … are computed, and the
            returned campaign covers them. So n independent jobs compute a
            campaign, each with a `keep` from `store.open` on one folder, with the same block and
            number of devices; without `part` the blocks are summed up, and missing blocks are
            computed.
        progress: called with (runs done, runs) after each block. Default a bar with
            rate and remaining time, only on a terminal and in a notebook; False: none.
        executor: where the blocks are computed, in place of this process: any object with the
            `submit` of `concurrent.futures`, as `ProcessPoolExecutor`, Dask's, mpi4py's. Each
            worker compiles the programs once and has one device, so results are the bits of
            `devices` of one. A block whose worker dies, fails or is late is computed again.
    Returns:
        Campaign.
    Raises:
        ValueError: on runs, block or workers below 1, more runs than are recorded, no PRNG key, no
            devices, no filters, a filter that does not fit the scenario, or a noise that is no
            covariance, before anything is traced; where `keep` holds another campaign, by every
            difference, or runs beyond the requested ones; on a part without a block.
        MemoryError: if one run a device is too much.
        Interrupted: on Ctrl-C, with the campaign so far.
        Incomplete: where an executor computes no more, with the campaign so far.
    """
    # A user's transfer guard is there for loops of the user's; a campaign moves its numbers itself.
    with jax.transfer_guard("allow"), refusals_of("monte_carlo"):
        _check(
            scenario, filters, runs, key, block, workers, devices, keep, part, progress, executor
        )
        began, runs = time.perf_counter(), int(runs)

        # Plan: what is computed, where, and how many runs at once.
        devices = jax.local_devices() if devices is None else list(devices)
        if executor is not None:
            devices = devices[:1]  # as every worker
        dtype = check_dtype(dtype)
        if workers is None and executor is not None:
            workers = 64
        elif workers is None:
            # An accelerator computes a block while the host scores the one before: 1.4 times the
            # runs a second of one block at a time on an H100, and no more with three.
            workers = -(-cores() // len(devices)) if devices[0].platform == "cpu" else 2
        size = int(block or fitting_block(scenario, filters, devices[0]))
        near, near_filters, origin = move_to_start(scenario, filters)
        plan = CampaignPlan(near, near_filters, key, devices, size, bound, dtype)
        if part is not None and (part[0] - 1) * plan.wide >= runs:
            raise InvalidField(
                "part",
                f"expected one of the {-(-runs // plan.wide)} blocks of "
                f"{plan.wide} runs that {runs} runs are, got part {part[0]} of {part[1]}",
            )

        # Load the kept blocks; the missing ones of this part remain.
        tallies = {name: Tally() for name in (*filters, BOUND)}
        finished: list[tuple[int, int]] = []
        if keep is not None:
            keep.claim(identity(scenario, filters, key, devices[0].platform, bound, dtype))
            finished = add_kept(tallies, keep, runs, lambda first: in_part(first, plan.wide, part))
        pieces = missing_pieces(finished, runs, plan.wide)
        todo = [piece for piece in pieces if in_part(piece[0], plan.wide, part)]

        # Compute. What is finished is summed up after an interruption, too.
        work = Work(workers, keep, {name: Tally() for name in tallies}, executor)
        stop: KeyboardInterrupt | Incomplete | None = None
        try:
            with progress_report(progress, plan) as report:
                work.compute(plan, todo, report)
        except (KeyboardInterrupt, Incomplete) as error:
            stop = error

        # Sum up: the kept runs first, then those of this process.
        for name, tally in work.tallies.items():
            tallies[name].merge(tally)
        campaign = None
        if tallies[BOUND].pieces():
            seconds = time.perf_counter() - began
            campaign = sum_up(plan, tallies, work, origin, seconds, compare=stop is None)
        if isinstance(stop, Incomplete):
            done = f"{campaign.runs if campaign else 0} of {runs} runs done"
            raise Incomplete(f"monte_carlo: executor: {stop}; {done}", campaign) from stop.__cause__
        if stop is not None or campaign is None:
            raise Interrupted(campaign, runs)
        return campaign


def _check(
    scenario: World,
    filters: Mapping[str, Candidate],
    runs: int,
    key: jax.Array,
    block: int | None,
    workers: int | None,
    devices: Sequence[jax.Device] | None,
    keep: Keep | None,
    part: object,
    progress: object,
    executor: object,
) -> None:
    """Raise InvalidField on arguments that `monte_carlo` does not take."""
    require("block", block, or_none(at_least(1)))
    require("workers", workers, or_none(at_least(1)))
    require("part", part, or_none(one_part))
    require("scenario", scenario, instance_of(World))
    require("runs", runs, run_count(scenario))
    require("key", key, prng_key)
    if not isinstance(filters, Mapping) or not filters:
        got = "none" if isinstance(filters, Mapping) else describe(filters)
        raise InvalidField("filters", f"expected {{name: filter}}, at least one, got {got}")
    if not is_concrete(key):
        raise InvalidField("", "it compiles its own programs: call it outside of jax.jit")
    for name, candidate in filters.items():
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise InvalidField("filters", f"expected a name for each, as 'ekf', got {name!r}")
        require(f"filter {name}", candidate, candidate_for(scenario))
    check_noise(scenario)
    if devices is not None and not isinstance(devices, Sequence):
        reason = f"expected a sequence, as jax.local_devices(), got {devices!r}"
        raise InvalidField("devices", reason)
    submits = callable(getattr(executor, "submit", None)) and not isinstance(executor, type)
    if executor is not None and not submits:
        reason = f"expected one of concurrent.futures, with a method submit, got {executor!r:.60}"
        raise InvalidField("executor", reason)
    if executor is not None and devices is not None:
        reason = "each worker of an executor uses its first device: expected none"
        raise InvalidField("devices", reason)
    if devices is not None and not devices:
        raise InvalidField("devices", "expected at least one, got none")
    if keep is not None and not all(
        callable(getattr(keep, name, None)) for name in ("claim", "save", "blocks")
    ):
        reason = f"expected jaxslam.store.open(folder) or .resume(folder), got {keep!r}"
        raise InvalidField("keep", reason)
    if not (progress is None or progress is False or callable(progress)):
        reason = f"expected a function of (runs done, runs), or False for none, got {progress!r}"
        raise InvalidField("progress", reason)


def summaries_of(tallies: dict[str, Tally]) -> tuple[int, np.ndarray, dict[str, Summary]]:
    """The number of runs, the limit of accuracy [m], and the summary of each filter."""
    finished = sum(count for _, count in tallies[BOUND].pieces())
    bound = {name: total / finished for name, total in tallies[BOUND].sums.items()} or None
    summaries = {name: summarize(tally, bound) for name, tally in tallies.items() if name != BOUND}
    return finished, tallies[BOUND].first("limit"), summaries


def sum_up(
    plan: CampaignPlan,
    tallies: dict[str, Tally],
    work: Work,
    origin: np.ndarray | None,
    seconds: float,
    compare: bool,
) -> Campaign:
    """The campaign of the runs in the tallies.

    origin: what positions are relative to. compare: whether runs may be filtered again in float64.
    """

    def in_map(tree: _T) -> _T:
        return tree if origin is None else to_map_coordinates(tree, origin)

    scenario = plan.scenario
    finished, limit, summaries = summaries_of(tallies)
    for name, doubt in precision_doubts(plan, tallies, limit.dtype, compare).items():
        summaries[name] = replace(summaries[name], doubts=(*summaries[name].doubts, doubt))
    # A filter that an exact sensor left without a covariance.
    dropped = {name: summary.counts.get("singular", 0) for name, summary in summaries.items()}
    exact = without_noise(scenario) if any(dropped.values()) else ""
    for name, count in dropped.items():
        if exact and count:
            doubt = (
                f"the sensor has {exact} without noise, so innovation covariances were singular: "
                f"{count:,} measurements were dropped and others weighted by rounding errors; give "
                "the sensor a small noise"
            )
            summaries[name] = replace(summaries[name], doubts=(*summaries[name].doubts, doubt))
    steps = max(scenario.steps, 1)
    return Campaign(
        scenario=scenario.name,
        source=scenario.source,
        published={name: dict(values) for name, values in scenario.published.items()},
        steps=scenario.steps // plan.stride,
        runs=finished,
        dtype=str(limit.dtype),
        divergence_limit=float(limit),
        filters=summaries,
        seconds=seconds,
        compile_seconds=work.compile_seconds,
        step_seconds={name: seconds / steps for name, seconds in work.run_seconds().items()},
        first={
            name: (
                in_map(jax.device_get(with_positions(scenario.sensor, truth))),
                in_map(estimate),
            )
            for name, (truth, estimate) in work.first.items()
        },
        run_numbers=tallies[BOUND].numbers(),
    )


def move_to_start(
    scenario: World, filters: Mapping[str, Candidate]
) -> tuple[World, Mapping[str, Candidate], np.ndarray | None]:
    """World and filters with positions relative to the start, and the start's (x, y) in the map.

    Unchanged, and None, where the map's origin is near, or the world or a filter depends on where
    it is.
    """
    origin = far_origin(scenario.pose, scenario.landmarks)
    if origin is None or (near := move_near_origin(scenario, origin, scenario.controls)) is None:
        return scenario, filters, None
    is_pose = len(near.motion.state) == 3
    truth = Truth(
        pose=np.tile(np.asarray(near.pose)[:3], (near.steps, 1)),
        landmarks=np.asarray(near.landmarks),
        missed=np.zeros(near.steps, int),
        start=np.asarray(near.pose),
        further=None if is_pose else np.tile(np.asarray(near.pose)[3:], (near.steps, 1)),
    )
    near_filters: dict[str, Candidate] = {}
    for name, candidate in filters.items():
        near_filter: Candidate | None
        if isinstance(candidate, Filter | LogEstimator):
            near_filter = move_near_origin(candidate, origin, scenario.controls)
        else:  # a function of the truth, which is relative
            try:
                method = method_of(candidate, truth)
            except Exception:  # it may need the truth of a run; where it is wrong, that says so
                method = None
            is_record = isinstance(method, Filter | LogEstimator)
            movable = is_record and may_move(method, origin, scenario.controls)
            near_filter = candidate if movable else None
        if near_filter is None:
            return scenario, filters, None
        near_filters[name] = near_filter
    return near, near_filters, origin
