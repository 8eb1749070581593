"""Does a log look like its models? Its statistics beside those of its twins.

A posterior predictive check (Gelman, Meng & Stern, "Posterior predictive assessment of model
fitness via realized discrepancies", Statistica Sinica 6, 1996): the filter that ran over the log
runs over logs drawn from the models along the smoothed path, and whatever statistic of the log lies
beside those of the twins contradicts the models.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jax.sharding import NamedSharding
from jax.typing import DTypeLike
from jaxtyping import Float, PyTree

from jaxslam.consistency._check_sentences import Meaning
from jaxslam.consistency._intervals import LEVEL
from jaxslam.consistency._log_statistics import (
    GENERAL,
    Rates,
    Statistic,
    fused_of,
    statistics_of,
)
from jaxslam.consistency._planted_faults import (
    body_rates,
    faults_of,
    planted_logs,
    shapes_of,
)
from jaxslam.consistency.campaign._block_programs import mesh_of, programs, spec
from jaxslam.consistency.campaign._candidates import candidate_for, cast_floats, check_dtype
from jaxslam.consistency.campaign._work import Report
from jaxslam.core._record import as_record
from jaxslam.core._validation import log_of
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Info, Log, Scan, Truth
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    or_none,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.simulation._twin import Twin
from jaxslam.simulation._worlds import BLOCK

ALPHA = 1 - LEVEL
"""The corrected p-value below which a statistic contradicts the models."""

LEAST = 20
"""Least number of twins: with fewer their spread is not known."""

_LOST = 1.5
"""NIS / dof of the twins, or its inverse, from which on a filter is lost: an honest filter has 1,
and so has an EKF whose pose NEES is three times too large (*Lost in the woods*)."""

_PLANTED = 28
"""Logs with planted faults, which are one block if that is not larger than those of twins."""

Finding = Callable[[Statistic, Float[np.ndarray, "R"]], str]
"""(statistic, values of the twins) -> what it says"""


class CheckedStatistic(NamedTuple):
    """A statistic of a log beside those of its twins."""

    statistic: Statistic
    """of the log"""
    twins: Float[np.ndarray, "R"]
    """of the twins, as `Statistic.value`"""
    rank: int
    """number of twins below the log"""
    p: float
    """two-sided p-value: twice the share of twins, the log among them, that lie as far out. Beyond
    all twins that is at least 2/(R + 1), and Student's t with the spread of the twins goes on"""
    corrected: float
    """p-value corrected for the number of statistics (Holm 1979), half of the level for faults"""
    distance: float
    """from the median of the twins, in deviations of the twins on that side"""
    finding: str
    """what it says, and what it points to"""

    @property
    def contradicts(self) -> bool:
        """Whether the corrected p-value is below `ALPHA`."""
        return self.corrected < ALPHA


@dataclass(frozen=True, repr=False)
class ModelCheck:
    """The result of `check_models`: statistics of a log beside its twins, worst first.

    Of those that contradict the models the ones that name an error come before those that any error
    changes, as NIS/dof."""

    name: str
    """of the log"""
    filter: str
    twins: int
    statistics: tuple[CheckedStatistic, ...]
    left_out: int = 0
    """measurements of the log that its twins lack"""

    @property
    def findings(self) -> tuple[str, ...]:
        """What contradicts the models, worst first; () where nothing does."""
        return tuple(row.finding for row in self.statistics if row.contradicts)

    @property
    def doubt(self) -> str:
        """Why the statistics say little; "" where they do."""
        size = next((row.twins for row in self.statistics if row.statistic.name == "NIS / dof"), 1)
        median = float(np.median(size))
        if 1 / _LOST < median < _LOST:
            return ""
        return (
            f"the filter is lost on logs of its own models, with NIS / dof {median:.3g}: what fits "
            "says little; take another filter"
        )

    def __repr__(self) -> str:
        return (
            f"ModelCheck({self.name}, {self.filter}, {self.twins} twins, "
            f"{len(self.findings)} of {len(self.statistics)} statistics contradict the models)"
        )

    def __str__(self) -> str:
        head = (
            f"{self.name}, {self.filter}: {len(self.statistics)} statistics beside those of "
            f"{self.twins} twins"
        )
        lines = [head]
        if self.left_out:
            lines.append(
                f"  {self.left_out:,} measurements have no landmark in the smoothed map, and no "
                "twin; if the filter was lost there, path and map of the twins are too"
            )
        if self.doubt:
            lines.append(f"  {self.doubt}")
        rejected = [row for row in self.statistics if row.contradicts]
        if not rejected:
            return "\n".join(
                [*lines, "  nothing in these statistics contradicts the models (p > 0.05, Holm)"]
            )
        for row in rejected:
            p = "p < 0.0001" if row.corrected < 1e-4 else f"p = {row.corrected:.2g}"
            lines.append(f"  {row.finding} ({p})")
        fit = len(self.statistics) - len(rejected)
        return "\n".join([*lines, f"  the other {fit} fit (p > 0.05, Holm)"])


def check_models(
    world: Twin,
    filter: Filter,
    log: Log,
    *,
    twins: int = 100,
    key: jax.Array,
    filter_name: str = "",
    devices: Sequence[jax.Device] | None = None,
    block: int | None = None,
    dtype: DTypeLike | None = None,
    progress: Report | None = None,
) -> ModelCheck:
    """Statistics of a log and, by the same filter and code, of its twins, with p-values.

        world = jaxslam.simulation.twin(data)
        print(jaxslam.consistency.check_models(world, ekf, data.log, key=jax.random.key(0)))

    NIS/dof in all, by component, range, bearing, turn rate, landmark and time; the autocorrelation
    of the innovations; their tails; their correlation with speed, turn rate and range; the amount
    of each fault that `_planted_faults` knows, as a delay; what the gate rejects; log-likelihood.

    Twins are drawn with the noises that the models state. Of noises that were fitted to the same
    log the size of the innovations is 1 by construction, and its p-value says little.

    Args:
        world: the twin of the log, of `simulation.twin`.
        filter: with innovations in its `Info`.
        log: the log of which the world is the twin.
        twins: their number, 20 or more.
        key: a PRNG key; twin i is run i of a campaign with it.
        filter_name: for the result.
        devices, block, dtype: as of `monte_carlo`.
        progress: called with (runs done, runs) after each block.
    Raises:
        ValueError: on a log that does not fit the world, fewer twins, and a filter without
            innovations.
    """
    with refusals_of("check_models"):
        require("world", world, instance_of(Twin))
        require("filter", filter, instance_of(Filter))
        require("filter", filter, candidate_for(world))
        require("twins", twins, at_least(LEAST))
        require("key", key, prng_key)
        require("block", block, or_none(at_least(1)))
        require("log", log, log_of(len(world.motion.controls), len(world.sensor.measurements)))
        if np.shape(log.scan.tag) != np.shape(world.seen):
            got = np.shape(log.scan.tag)
            raise InvalidField(
                "log", f"expected {np.shape(world.seen)} measurement slots, got {got}"
            )
    devices = jax.local_devices() if devices is None else list(devices)
    if block is None:  # blocks of like size, none with many runs to spare
        blocks = -(-twins // (BLOCK * len(devices)))
        block = -(-twins // (blocks * len(devices)))
        block = max(block, min(-(-_PLANTED // len(devices)), BLOCK))
    runs = _Runs(world, filter, key, devices, block, check_dtype(dtype))

    # The filter over the log, and over logs in which a fault each is planted.
    faults, slips = faults_of(world)
    truth, planted = jax.device_get(planted_logs(world, faults, slips))
    recorded = jax.tree.map(lambda leaf: np.asarray(leaf)[None], log)
    logs = jax.tree.map(
        lambda log, rest: np.concatenate([log.astype(rest.dtype), rest]), recorded, planted
    )
    if world.spurious is not None:  # the slots of clutter, which the twins have
        spare = world.spurious.places
        wide: PyTree = tuple(_widen(leaf, spare) for leaf in logs.scan)
        logs = logs._replace(scan=Scan(*wide))
        truth = truth._replace(origin=_widen(truth.origin[None], spare)[0])
    infos = runs.of_logs(truth, logs)
    fused = fused_of(infos)
    with refusals_of("check_models"):
        if not fused.any():
            raise InvalidField("filter", "expected one with innovations, got none in its Info")
    count = len(logs.control)
    total = twins + count
    if progress is not None:
        progress(count, total)

    # What each fault does to the innovations tells how much of it a run has.
    innovations = np.where(fused[..., None], np.asarray(infos.innovation, np.float64), 0.0)
    covs = np.asarray(infos.innovation_cov, np.float64)[1]
    shapes = shapes_of(faults, slips, innovations[1:], np.where(fused[1, ..., None, None], covs, 0))

    # The statistics of the log, and of the twins, a block at a time.
    speed, _, turn = body_rates(world).T
    rates, time = Rates(speed, turn), np.asarray(world.time, np.float64)

    def statistics(info: Info, z: np.ndarray, valid: np.ndarray) -> list[Statistic]:
        return statistics_of(info, z, valid, world.sensor, rates, time, shapes)

    of_log = statistics(_run(infos, 0), np.asarray(logs.scan.z)[0], np.asarray(log.scan.valid))
    of_twins: list[list[Statistic]] = []
    for first in range(0, twins, runs.wide):
        some, scan = runs.of_twins(first)
        for i in range(min(runs.wide, twins - first)):
            of_twins.append(statistics(_run(some, i), scan.z[i], scan.valid[i]))
        if progress is not None:
            progress(count + len(of_twins), total)
    checked = compare(of_log, of_twins, Meaning(world, _run(infos, 0), shapes))
    return ModelCheck(
        name=world.name.removeprefix("twin of "),
        filter=filter_name or filter.name,
        twins=twins,
        statistics=checked,
        left_out=world.left_out,
    )


class _Runs:
    """A filter over logs in blocks of one size, by the programs of a campaign."""

    def __init__(
        self,
        world: Twin,
        filter: Filter,
        key: jax.Array,
        devices: Sequence[jax.Device],
        block: int,
        dtype: np.dtype | None,
    ) -> None:
        self.wide = block * len(devices)
        self._programs, self._dtype = programs(tuple(devices), dtype), dtype
        self._over_runs = NamedSharding(mesh_of(tuple(devices)), spec(0))
        everywhere = NamedSharding(mesh_of(tuple(devices)), spec(None))
        self._fixed: PyTree = jax.device_put((world, as_record(filter), key), everywhere)

    def of_twins(self, first: int) -> tuple[Info, PyTree]:
        """The infos and the scans (B, …) of a block of twins, on the host."""
        world, _, key = self._fixed
        numbers = np.arange(first, first + self.wide, dtype=jnp.result_type(int))
        truth, log = self._programs.draw(world, key, numbers)
        return self._drive(numbers, truth, log), jax.device_get(log.scan)

    def of_logs(self, truth: Truth, logs: Log) -> Info:
        """The infos (C, T, …) of C logs along one path, on the host."""
        count = len(logs.control)
        parts = []
        for first in range(0, count, self.wide):
            chosen = np.minimum(np.arange(first, first + self.wide), count - 1)
            some = jax.tree.map(lambda leaf, at=chosen: leaf[at], logs)
            truths = jax.tree.map(
                lambda leaf: np.broadcast_to(leaf, (self.wide, *leaf.shape)), truth
            )
            numbers = np.arange(self.wide, dtype=jnp.result_type(int))
            drawn = cast_floats((truths, some), self._dtype or jnp.result_type(float))
            info = self._drive(numbers, *jax.device_put(drawn, self._over_runs))
            parts.append(info)
        infos: Info = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
        return infos

    def _drive(self, numbers: np.ndarray, truth: Truth, log: Log) -> Info:
        """The infos (B, T, …) of a block."""
        world, filter, key = self._fixed
        info = self._programs.drive(world, filter, key, numbers, truth, log).info
        on_host: Info = jax.device_get(info._replace(extra=None))
        by_run: Info = jax.tree.map(lambda leaf: np.swapaxes(leaf, 0, 1), on_host)
        return by_run


def _widen(leaf: np.ndarray, spare: int) -> np.ndarray:
    """An array (C, T, M, …) with further measurement slots, which are empty."""
    empty = [(0, 0), (0, 0), (0, spare), *[(0, 0)] * (leaf.ndim - 3)]
    return np.pad(leaf, empty, constant_values=-1 if leaf.dtype.kind == "i" else 0)


def _run(infos: Info, i: int) -> Info:
    run: Info = jax.tree.map(lambda leaf: leaf[i], infos)
    return run


def compare(
    of_log: Sequence[Statistic], of_twins: Sequence[Sequence[Statistic]], finding: Finding
) -> tuple[CheckedStatistic, ...]:
    """The statistics of a log beside those of its twins, worst first.

    Among those that contradict the models the ones of `GENERAL` are last. Those that the log or a
    twin does not have are left out. finding: of a statistic and the twins' values, what it says.
    """
    rows = []
    for i, statistic in enumerate(of_log):
        scores = np.array([run[i].score for run in of_twins])
        if not (np.isfinite(statistic.score) and np.isfinite(scores).all()):
            continue
        if (scores == statistic.score).all():  # as of a gate that rejects nothing
            continue
        values = np.array([run[i].value for run in of_twins])
        rows.append((statistic, values, *two_sided(statistic.score, scores, statistic.spread)))
    # Half of the level is for the faults, which are few, and sharp.
    is_fault = np.array([statistic.family == "fault" for statistic, *_ in rows])
    others = np.maximum(is_fault.sum(), 1) / np.maximum((~is_fault).sum(), 1)
    corrected = holm(np.array([p for *_, p, _ in rows]), np.where(is_fault, 1.0, others))
    checked = [
        CheckedStatistic(statistic, values, rank, p, float(holm_p), distance, "")
        for (statistic, values, rank, p, distance), holm_p in zip(rows, corrected, strict=True)
    ]
    # An error changes the size of all innovations; what names it goes first.
    checked.sort(
        key=lambda row: (
            not row.contradicts,
            row.contradicts and row.statistic.family in GENERAL,
            row.p,
            -abs(row.distance),
        )
    )
    return tuple(row._replace(finding=finding(row.statistic, row.twins)) for row in checked)


def two_sided(
    score: float, twins: Float[np.ndarray, "R"], least: float = 0.0
) -> tuple[int, float, float]:
    """The rank of a score among those of twins, its two-sided p-value, and its distance from their
    median, in deviations.

    The rank has a p-value of at least 2/(R + 1), which no correction for tens of statistics leaves
    significant. Beyond all twins Student's t goes on, with the deviation of the twins on that side
    of their median, `least` or more: R/2 - 1 degrees of freedom.
    """
    count = len(twins)
    below, above = int((twins < score).sum()), int((twins > score).sum())
    p = min(1.0, 2 * (min(below, above) + (count - below - above) + 1) / (count + 1))
    median = float(np.median(twins))
    side = twins[twins > median] if score > median else twins[twins < median]
    deviation = float(np.sqrt(np.mean((side - median) ** 2))) if side.size else 0.0
    deviation = max(deviation, least, 1e-9 * max(abs(median), 1e-9))
    distance = (score - median) / deviation
    if below in (0, count) and above in (0, count) and below != above:
        tail = 2 * float(scipy.special.stdtr(max(count // 2 - 1, 1), -abs(distance)))
        p = min(p, tail)
    return below, p, distance


def holm(p: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"]) -> Float[np.ndarray, "S"]:
    """The p-values corrected for their number: those below α reject falsely, one or more, with
    probability at most α, which the weights divide (Holm, Scandinavian J. Statistics 6, 1979)."""
    order = np.argsort(p / weights, kind="stable")
    left = np.cumsum(weights[order][::-1])[::-1]  # of those not yet rejected
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] / weights[order] * left), 1.0)
    return corrected
