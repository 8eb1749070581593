"""The verdict on a filter: two tests over the runs of a campaign, and their power.

Pose NEES and NIS test different things. The NEES compares the claimed covariance of the pose with
its error, and answers to everything; but within a run it is correlated in time, so that a run is
worth a few numbers. The NIS holds innovations against S, is nearly white, so that a run is worth as
many numbers as it has measurements, and is by far the sharper test of R.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxslam.consistency._intervals import LEVEL, Spread, percentage, spread
from jaxslam.consistency._measures.counts import DROPS, KEPT
from jaxslam.consistency._measures.nees import DOF
from jaxslam.core.types import Status
from jaxslam.math.stats import normal_quantile, truncated_chi2_mean

TESTS = {"nees_pose": "pose NEES", "nis_per_dof": "NIS / dof"}
"""The measures that are tested, and their names in messages."""

_TOLERANCE = 0.01
"""An interval that lies wholly so near the honest value, relative to it, rejects nothing."""

POWER = 0.9
"""The probability with which an effect that is called noticeable is noticed."""


class Verdict(NamedTuple):
    """The verdict on a filter, its reasons, and the deviations that it could not detect."""

    word: str
    """consistent, optimistic, pessimistic, diverged, incomplete or undecided"""
    by: tuple[str, ...] = ()
    """which tests rejected, by the names of `TESTS`"""
    noticed: Mapping[str, tuple[float, float]] = {}
    """by test, (low, high): this campaign would have noticed an average of at most low (0: none)
    and of at least high (∞: none), with probability `POWER` or more"""
    doubts: tuple[str, ...] = ()
    """sentences that qualify the word"""
    honest_nis: float = 1.0
    """the NIS/dof from which on up to 1 is honest; below 1 where a gate dropped measurements"""


def judge(
    per_run: Mapping[str, np.ndarray], counts: Mapping[str, int], nis_dof: float = 0.0
) -> Verdict:
    """The verdict on a filter from the averages of each run and the counts of the campaign.

    Each run gives one average of the pose NEES over time and one of NIS/dof, and runs are
    independent. Each average over the runs has an interval (`Spread`) of such a level, √0.95 with
    two tests and 0.95 with one, that an honest filter of a linear Gaussian problem is rejected in
    5 % of campaigns. Honest is 3 for the NEES and 1 for the NIS; a gate drops the largest
    innovations, so if a share ρ failed it, all from `truncated_chi2_mean`(ρ) to 1 is honest.

    optimistic: an interval lies above, covariances are claimed too small; pessimistic: below. If
    the tests disagree, the NEES decides. consistent: neither rejects, which proves nothing:
    `noticed` has the detectable averages. undecided: under two runs have a NEES, or neither
    rejects, but an average NEES of twice the honest one would not have been rejected either.
    incomplete: neither rejects, but over half of the measurements that arrived were dropped.
    diverged: over half of the runs are not finite or divergent.

    An interval that lies within 1 % (`_TOLERANCE`) of the honest value rejects nothing: a nonlinear
    filter is never exactly honest, and enough runs would reject any. It changes nothing where the
    interval is wider than that, as the NIS's is below some 400,000 degrees of freedom.

    Args:
        per_run: (runs,) nees_pose, nis_per_dof and unobservable, those that there are; NaN for a
            run without.
        counts: runs, not_finite, divergent, and measurements by status, as in
            `Summary.counts`; an absent count is 0.
        nis_dof: the degrees of freedom of all NIS together.
    """
    doubts, honest_nis = _doubts(per_run, counts), _after_gate(counts, nis_dof)
    lost = counts["not_finite"] + counts["divergent"]
    if lost > 0.5 * (counts["runs"] + counts["not_finite"]):
        return Verdict("diverged", (), {}, doubts, honest_nis)
    tested = {name: per_run[name] for name in TESTS if np.isfinite(per_run.get(name, ())).sum() > 1}
    level = LEVEL ** (1 / max(len(tested), 1))
    signs: dict[str, int] = {}
    noticed: dict[str, tuple[float, float]] = {}
    wide = True
    for name, values in tested.items():
        of_nees = name == "nees_pose"
        found = spread(values, level, skewed=of_nees)
        assert found is not None
        honest = (DOF["pose"],) * 2 if of_nees else (honest_nis, 1.0)
        signs[name], noticed[name] = _side(found, *honest), _noticed(found, *honest)
        wide = wide and not (of_nees and found.above <= 2)
    by = tuple(name for name, sign in signs.items() if sign)
    if by:
        word = "optimistic" if signs[by[0]] > 0 else "pessimistic"
    elif wide:
        word = "undecided"
    else:
        word = "incomplete" if _starved(counts) else "consistent"
    return Verdict(word, by, noticed, doubts, honest_nis)


def power_of(noticed: Mapping[str, tuple[float, float]]) -> str:
    """A phrase on the averages that the campaign rejects with probability `POWER`, or ""."""
    parts = []
    for name, (low, high) in noticed.items():
        beyond = [f"above {high:.3g}"] * bool(high < np.inf) + [f"below {low:.3g}"] * bool(low > 0)
        if beyond:
            parts.append(f"a {TESTS[name]} {' or '.join(beyond)}")
    return f"{percentage(POWER)} power to reject {', '.join(parts)}" if parts else ""


def _side(found: Spread, low: float, high: float) -> int:
    """The sign of a rejection: 1 for an interval above the honest value, -1 for below, else 0."""
    if found.low > high and found.high > high * (1 + _TOLERANCE):
        return 1
    return -1 if found.high < low and found.low < low / (1 + _TOLERANCE) else 0


def _noticed(found: Spread, low: float, high: float) -> tuple[float, float]:
    """Averages that are noticed with probability `POWER`, of a relative spread as found.

    An average m is rejected beyond high·(m/μ at the lower end); the mean of which a share `POWER`
    lies beyond that is z standard errors farther.
    """
    margin = normal_quantile(POWER) * found.error
    least, most = low * found.below, high * max(found.above, 1 + _TOLERANCE)
    return least / (1 + margin), most / (1 - margin) if margin < 1 else np.inf


def _after_gate(counts: Mapping[str, int], nis_dof: float) -> float:
    """The NIS/dof that is honest when all that failed the gate did so by its size."""
    fused, rejected = counts.get("fused", 0), counts.get("rejected", 0)
    if not (fused and rejected and nis_dof > 0):
        return 1.0
    return truncated_chi2_mean(rejected / (fused + rejected), nis_dof / fused)


def _became(counts: Mapping[str, int]) -> tuple[int, dict[str, int]]:
    """How many measurements were used, and how many dropped by reason."""
    drops = {name: counts.get(name, 0) for name in map(_name, DROPS)}
    return sum(counts.get(name, 0) for name in map(_name, KEPT)), drops


def _starved(counts: Mapping[str, int]) -> bool:
    """Whether over half of the measurements were dropped, by a filter that takes measurements."""
    used, drops = _became(counts)
    dropped = sum(drops.values())
    takes_none = not used and dropped == drops["unmatched"]  # dead reckoning
    return dropped > used and not takes_none


def _doubts(per_run: Mapping[str, np.ndarray], counts: Mapping[str, int]) -> tuple[str, ...]:
    out = []
    if _starved(counts):
        used, drops = _became(counts)
        dropped = sum(drops.values())
        reasons = ", ".join(f"{count:,} {name}" for name, count in drops.items() if count)
        out.append(f"{dropped:,} of {used + dropped:,} measurements were dropped: {reasons}")
    elif counts.get("overflow", 0):
        out.append(
            f"{counts['overflow']:,} measurements of new landmarks found the map full: expected a "
            "larger capacity, or a filter that removes landmarks"
        )
    free = np.asarray(per_run.get("unobservable", ()), np.float64)
    free = free[np.isfinite(free)]
    if free.size and free.mean() < 3:
        out.append(
            f"unobservable directions {free.mean():.3g} instead of 3: the filter gained "
            "information on the pose of the map as a whole, which only a sensor of absolute "
            "position or heading gives; with one, the value of ideal is the honest one"
        )
    return tuple(out)


def _name(status: Status) -> str:
    return status.name.lower()
