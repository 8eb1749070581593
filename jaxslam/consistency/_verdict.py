"""The verdict on a filter: two tests over the runs of a campaign, and their power.

Pose NEES and NIS test different things. The NEES compares the claimed covariance of the pose with
its error, and answers to everything; but within a run it is correlated in time, so that a run is
worth a few numbers. The NIS holds innovations against S, is nearly white, so that a run is worth as
many numbers as it has measurements, and is by far the sharper test of R.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxslam.consistency._intervals import EACH, LEVEL, percentage, spread
from jaxslam.consistency._measures.counts import DROPS, KEPT
from jaxslam.consistency._measures.nees import DOF
from jaxslam.core.types import Status
from jaxslam.math.stats import normal_quantile, truncated_chi2_mean

TESTS = {"nees_pose": "pose NEES", "nis_per_dof": "NIS / dof"}
"""The measures that are tested, and their names in messages."""

TOLERANCE = 0.01
"""An interval that lies wholly so near the honest value, relative to it, rejects nothing."""

_FAULTY = 1 - LEVEL
"""The share of runs that are not finite, or of steps whose covariance is none, beyond which the
others do not decide. A lost run lies in no ellipsoid: with more of them a 95 % ellipsoid holds the
truth in fewer than 95 % of the runs, whatever the others do."""

POWER = 0.9
"""The probability with which an effect that is called noticeable is noticed."""


class Verdict(NamedTuple):
    """The verdict on a filter, its reasons, and the deviations that it could not detect."""

    word: str
    """consistent, optimistic, pessimistic, diverged, incomplete or undecided"""
    by: tuple[str, ...] = ()
    """tests that reject, by the names of `TESTS`"""
    noticed: Mapping[str, tuple[float, float]] = {}
    """(low, high) by test: this campaign would have noticed an average of at most low (0: none) and
    of at least high (∞: none), with probability `POWER` or more"""
    doubts: tuple[str, ...] = ()
    """sentences that qualify the word"""
    honest_nis: float = 1.0
    """the NIS/dof from which on up to 1 is honest; below 1 where a gate dropped measurements"""


def judge(
    per_run: Mapping[str, np.ndarray], counts: Mapping[str, int], nis_dof: float = 0.0
) -> Verdict:
    """The verdict on a filter from the averages of each run and the counts of the campaign.

    Each run gives one average of the pose NEES over time and one of NIS/dof, and runs are
    independent. Each average over the runs has an interval (`Spread`) of level √0.95 (`EACH`), that
    of `Summary.measures`: the two tests together reject an honest filter of a linear Gaussian
    problem in 5 % of campaigns, one alone in 2.5 %. Honest is 3 for the NEES and 1 for the NIS; a
    gate drops the largest innovations, so if a share ρ failed it, all from
    `truncated_chi2_mean`(ρ) to 1 is honest.

    The first of these that holds:

    diverged: over half of the runs are not finite or divergent (an error far beyond that of the
    ideal EKF, and far beyond what the filter claims).
    optimistic: an interval lies above, covariances are claimed too small. If the tests disagree,
    the NEES decides.
    incomplete: over 5 % (`_FAULTY`) of the runs are not finite, of the steps or of the ends of runs
    have a covariance that is not symmetric or not positive definite, or of the runs have an
    estimate that is constant.
    The remaining runs may be the runs with small errors, so they excuse nothing.
    pessimistic: an interval lies below.
    incomplete: nothing was measured, or over half of what was measured, or of what was in view, was
    not used.
    undecided: under two runs have a NEES, or an average NEES of twice the honest one would not have
    been rejected either.
    consistent: neither test rejects, which proves nothing: `noticed` has the detectable averages.

    Each of these that occurs in a single run or step is counted in one of `doubts`. Accuracy is not
    honesty: a filter that is inaccurate and claims so, as dead reckoning, is consistent; a doubt
    counts the inaccurate runs if they are over half.

    An interval that lies within 1 % (`TOLERANCE`) of the honest value rejects nothing: a nonlinear
    filter is never exactly honest, and enough runs would reject any. It changes nothing where the
    interval is wider than that, as the NIS's is below some 400,000 degrees of freedom.

    Args:
        per_run: (runs,) nees_pose, nis_per_dof and unobservable, as far as present; NaN for a run
            without.
        counts: as in `Summary.counts`: runs, not_finite, and the others, of which an absent one is
            0 (of measured: all that have a status).
        nis_dof: the degrees of freedom of all NIS together.
    """
    doubts, honest_nis = doubts_on(per_run, counts, nis_dof), 1.0
    fused, rejected = counts.get("fused", 0), counts.get("rejected", 0)
    if fused and rejected and nis_dof > 0:  # as if all that failed the gate did so by their size
        honest_nis = truncated_chi2_mean(rejected / (fused + rejected), nis_dof / fused)
    runs = counts["runs"] + counts["not_finite"]
    if counts["not_finite"] + counts.get("divergent", 0) > 0.5 * runs:
        return Verdict("diverged", (), {}, doubts, honest_nis)
    tested = {name: per_run[name] for name in TESTS if np.isfinite(per_run.get(name, ())).sum() > 1}
    signs: dict[str, int] = {}
    noticed: dict[str, tuple[float, float]] = {}
    is_wide = True
    for name, values in tested.items():
        of_nees = name == "nees_pose"
        average = spread(values, EACH, skewed=of_nees)
        assert average is not None
        low, high = honest_values(honest_nis)[name]
        signs[name] = 0
        if average.low > high and average.high > high * (1 + TOLERANCE):
            signs[name] = 1
        elif average.high < low and average.low < low / (1 + TOLERANCE):
            signs[name] = -1
        # An average m is rejected beyond high·(m/μ at the lower end); the mean of which a share
        # `POWER` lies beyond that is z standard errors farther, at the same relative spread.
        margin = normal_quantile(POWER) * average.error
        least, most = low * average.below, high * max(average.above, 1 + TOLERANCE)
        noticed[name] = least / (1 + margin), most / (1 - margin) if margin < 1 else np.inf
        # Narrow enough to reject a NEES of twice the honest one.
        if of_nees and average.above <= 2:
            is_wide = False
    by = tuple(name for name, sign in signs.items() if sign)
    if by and signs[by[0]] > 0:
        word = "optimistic"
    elif is_faulty(counts):
        word = "incomplete"
    elif by:
        word = "pessimistic"
    elif _Measured.of(counts).is_starved:
        word = "incomplete"
    else:
        word = "undecided" if is_wide else "consistent"
    return Verdict(word, by, noticed, doubts, honest_nis)


def honest_values(honest_nis: float) -> dict[str, tuple[float, float]]:
    """The lowest and the highest honest value of each test."""
    return {"nees_pose": (DOF["pose"],) * 2, "nis_per_dof": (honest_nis, 1.0)}


def power_of(noticed: Mapping[str, tuple[float, float]]) -> str:
    """A phrase on the averages that the campaign rejects with probability `POWER`, or ""."""
    parts = []
    for name, (low, high) in noticed.items():
        beyond = [f"above {high:.3g}"] * bool(high < np.inf) + [f"below {low:.3g}"] * bool(low > 0)
        if beyond:
            parts.append(f"a {TESTS[name]} {' or '.join(beyond)}")
    return f"{percentage(POWER)} power to reject {', '.join(parts)}" if parts else ""


def is_faulty(counts: Mapping[str, int]) -> bool:
    """Whether over 5 % of the runs, steps or ends are none that a filter may give: see `judge`."""
    runs, steps = counts["runs"], counts.get("steps", 0)
    bad_steps = max(counts.get("asymmetric_steps", 0), counts.get("indefinite_steps", 0))
    return (
        counts["not_finite"] > _FAULTY * (runs + counts["not_finite"])
        or bad_steps > _FAULTY * steps
        or counts.get("faulty_ends", 0) > _FAULTY * runs
        or counts.get("constant", 0) > _FAULTY * runs
    )


class _Measured(NamedTuple):
    """The fate of the measurements of the finite runs, in numbers."""

    total: int
    """measurements in the logs"""
    used: int
    dropped: dict[str, int]
    """counts by reason"""
    missed: int
    """landmarks in view that have no measurement in the log"""
    nothing: bool
    """whether the logs are known to have no measurement"""
    fused: int
    """fused measurements, 0 where those of the logs are not counted"""

    @classmethod
    def of(cls, counts: Mapping[str, int]) -> "_Measured":
        """The fate of the measurements by the counts of a campaign."""
        dropped = {name: counts.get(name, 0) for name in map(_name, DROPS)}
        used = sum(counts.get(name, 0) for name in map(_name, KEPT))
        with_status = used + sum(dropped.values())
        return cls(
            total=max(counts.get("measured", 0), with_status),
            used=used,
            dropped=dropped,
            missed=counts.get("missed", 0),
            nothing=counts.get("measured") == 0,
            fused=counts.get("fused", 0) if "measured" in counts else 0,
        )

    @property
    def uses_none(self) -> bool:
        """Whether the filter uses no measurement, as dead reckoning: all are unmatched, or none
        has a status."""
        return not self.used and sum(self.dropped.values()) == self.dropped["unmatched"]

    @property
    def is_starved(self) -> bool:
        """Whether nothing was measured, or over half was not used, or had no place in the scan."""
        if self.nothing:
            return True
        if self.uses_none:
            return False
        return self.total > 2 * self.used or self.missed > self.total

    def doubts(self, nis_dof: float) -> list[str]:
        """Sentences that qualify a verdict. nis_dof: sum of the degrees of freedom of NIS."""
        doubts = list[str]()
        if self.nothing:
            doubts.append("nothing was measured in any run: only the motion was judged")
        if self.missed:
            doubts.append(
                f"{self.missed:,} landmarks in view, beside {self.total:,} measured ones, had "
                "no place in the scan: expected more places in the world"
            )
        if not self.total:
            return doubts
        ignored = self.total - self.used - sum(self.dropped.values())
        if self.uses_none:
            doubts.append(
                f"takes none of the {self.total:,} measurements (by its Info): judged by the NEES "
                "alone"
            )
        elif self.total > 2 * self.used:
            reasons = [f"{count:,} {name}" for name, count in self.dropped.items() if count]
            reasons += [f"{ignored:,} without a status in Info"] * bool(ignored)
            doubts.append(
                f"{self.total - self.used:,} of {self.total:,} measurements were "
                f"{'not used' if ignored else 'dropped'}: {', '.join(reasons)}"
            )
        else:
            if ignored:
                doubts.append(
                    f"{ignored:,} of {self.total:,} measurements have no status in Info: they may "
                    "have been ignored"
                )
            if count := self.dropped["overflow"]:
                doubts.append(
                    f"{count:,} measurements of new landmarks found the map full: expected a "
                    "larger capacity, or a filter that removes landmarks"
                )
            if self.fused and not nis_dof > 0:
                doubts.append(
                    f"{self.fused:,} fused measurements have no degrees of freedom in Info: no "
                    "NIS, judged by the NEES alone"
                )
        return doubts


def doubts_on(
    per_run: Mapping[str, np.ndarray], counts: Mapping[str, int], nis_dof: float
) -> tuple[str, ...]:
    """Sentences that qualify a verdict, from the counts and measures that `judge` takes."""
    runs, lost = counts["runs"], counts["not_finite"]
    steps, doubts = counts.get("steps", 0), list[str]()
    if lost:
        rest = f"averages of the {runs:,} finite runs" if runs else "there are no averages"
        doubts.append(f"not finite (NaN or ∞) in {lost:,} of {runs + lost:,} runs: {rest}")
    if count := counts.get("divergent", 0):
        doubts.append(
            f"divergent in {count:,} of {runs:,} runs: final position errors far beyond those of "
            "the ideal EKF, and over 5 σ of what is claimed"
        )
    for name, fault in (
        ("asymmetric_steps", "not symmetric"),
        ("indefinite_steps", "not positive definite"),
    ):
        if count := counts.get(name, 0):
            doubts.append(
                f"the pose covariance is {fault} in {count:,} of {steps:,} steps, by more than "
                "rounding: look at the filter's covariance; such a step has no pose NEES"
            )
    if count := counts.get("constant", 0):
        doubts.append(f"pose and covariance never change in {count:,} of {runs:,} runs")
    singular = counts.get("singular_steps", 0)
    explained = counts.get("asymmetric_steps", 0) + counts.get("indefinite_steps", 0)
    # A start without errors is singular for a few steps; that a run ends so is another matter.
    ends = counts.get("singular_ends", 0)
    is_mostly_singular = singular - explained > 0.5 * steps > 0
    if ends or is_mostly_singular:
        at_end = "" if is_mostly_singular else f" and at the end of {ends:,} of {runs:,} runs"
        doubts.append(
            f"the pose covariance is singular in {singular:,} of {steps:,} steps"
            f"{at_end}, which have no pose NEES: a direction is claimed to be known exactly; more "
            "runs do not help"
        )
    if 2 * (count := counts.get("inaccurate", 0)) > runs and count > counts.get("divergent", 0):
        doubts.append(
            f"inaccurate in {count:,} of {runs:,} runs: final position errors over 5 σ of the "
            "ideal EKF"
        )
    if runs:
        doubts += _Measured.of(counts).doubts(nis_dof)
    free = np.asarray(per_run.get("unobservable", ()), np.float64)
    free = free[np.isfinite(free)]
    if free.size and free.mean() < 3:
        doubts.append(
            f"unobservable directions {free.mean():.3g} instead of 3: the filter gained "
            "information on the pose of the map as a whole, which only a sensor of absolute "
            "position or heading gives; if the robot has such a sensor, compare with the filter "
            "ideal"
        )
    return tuple(doubts)


def _name(status: Status) -> str:
    return status.name.lower()
