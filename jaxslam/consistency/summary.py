"""`summarize` returns the `Summary` of one filter: averages, bands, intervals and a verdict.

Called by `monte_carlo.campaign` on the tally of each filter; reports and plots read the summaries.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import PyTree

from jaxslam.consistency.credibility import credibility
from jaxslam.consistency.intervals import LEVEL, Measure, interval, positive_interval
from jaxslam.consistency.nees import DOF
from jaxslam.consistency.score import DROPS, EVENTS, KEPT
from jaxslam.consistency.tally import SHOTS, Tally
from jaxslam.consistency.verdict import judge
from jaxslam.math.stats import chi2_quantile, chi2_quantiles, normal_quantile

NORMAL = normal_quantile(0.5 + LEVEL / 2)

COUNTS = tuple(status.name.lower() for status in (*KEPT, *DROPS)) + (
    *("missed", "singular_steps"),
    *EVENTS,
)
"""The sums that are reported as counts."""

_IN_REPR = ("nees_pose", "nis_per_dof", "rmse_position")

POSITIVE = ("nees", "nis", "square", "noncredibility")
"""How the names of measures begin that cannot be negative."""


@dataclass(frozen=True, repr=False)
class Summary:
    """The consistency of one filter over the runs of a campaign."""

    verdict: str
    """consistent, optimistic, pessimistic, diverged, incomplete or undecided; see `judge`."""
    measures: dict[str, Measure]
    """Each with its interval over the runs; names without a number (nothing to average) are absent.

    NEES, none divided by its dof: nees_pose (3), nees_position (2), nees_heading (1) in (x, y, θ),
    nees_own (3) of the pose in the filter's own error coordinates, nees_landmarks (2) averaged over
    landmarks and steps. nis_per_dof (1). coverage_95_pose, _position, _heading: share of steps with
    the truth in the 95 % ellipsoid. noncredibility and inclination [dB] (0). autocorrelation of
    innovations at lag 1 (0). rmse_position [m], rmse_heading_deg [°], rmse_landmarks [m] (final
    map, unaligned; none of a known map); bound_ratio_position and _heading: those over the
    conditional Cramér-Rao bound (about 1 at best; see `conditional_bound`). unobservable (3) and
    rotation_information [1/rad²] (0): the dimension of the filter's unobservable subspace, and what
    it has learnt of a turn of the whole frame. log_likelihood (mean a run; none without an
    innovation). In a world with spurious data: precision and
    recall of associations, and false_landmarks; see `associations`.
    """
    nis_band: tuple[float, float] | None
    """95 % band of nis_per_dof from the summed degrees of freedom; None without a measurement."""
    inside: dict[str, float]
    """share of steps whose average NEES lies in its band, by block; 0.95 is honest."""
    curves: dict[str, np.ndarray]
    """(T,) averages over runs: nees_* with *_low and *_high bands (NaN where no run has one),
    rmse_position, rmse_heading_deg, nis_per_dof, rotation_information, and runs_* that count."""
    coverage: dict[str, np.ndarray]
    """by block: share of runs' steps with the truth in the ellipsoid of each of `LEVELS`."""
    autocorrelation: np.ndarray
    """(LAGS,) of whitened innovations at lags of 1, 2, … steps; NaN without pairs."""
    autocorrelation_band: np.ndarray
    """(LAGS,) half-width of the 95 % band about 0 in which that of white innovations lies,
    1.96/√(products of numbers in it) (Bar-Shalom 2001, 5.4.2)."""
    counts: dict[str, int]
    """runs (finite), not_finite, divergent, singular_steps, dropped measurements by reason, and,
    of filters that have them, landmarks removed, merged and reduced, and searches exhausted."""
    per_run: dict[str, np.ndarray]
    """(runs,) each run's own average of each measure, NaN where it has none: squares, radians."""
    not_finite_runs: list[int]
    """the numbers of the runs that are not finite; run i has key fold_in(key, i)."""
    by: tuple[str, ...] = ()
    """the measures that spoke against the filter, nees_pose and nis_per_dof, if any did"""
    noticed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """by measure, the averages (at most, at least) that such a campaign notices nine times in ten:
    what "consistent" says, which means not rejected"""
    doubts: tuple[str, ...] = ()
    """sentences that qualify the verdict: most measurements dropped, directions lost"""
    honest_nis: float = 1.0
    """nis_per_dof from here on up to 1 is honest: below 1 where a gate dropped measurements"""

    def __repr__(self) -> str:
        there = (name for name in _IN_REPR if name in self.measures)
        shown = (f"{name}={self.measures[name].value:.4g}" for name in there)
        return f"Summary({', '.join([self.verdict, *shown, *self.doubts])})"


def summarize(tally: Tally, bound: Mapping[str, np.ndarray] | None = None) -> Summary:
    """The averages, bands and verdict of one filter, from its tally (host numbers, float64).

    bound: position [m²] and heading [rad²], (T,) each, the mean conditional bound over the runs.
    """
    sums, finite = tally.sums, tally.flags("finite")
    runs = int(finite.sum())
    curves: dict[str, np.ndarray] = {}
    inside: dict[str, float] = {}
    coverage: dict[str, np.ndarray] = {}
    for block, dof in DOF.items():
        count = sums[f"regular_{block}"]
        mean = _ratio(sums[f"nees_{block}"], count)
        low, high = _bands(count, dof)
        curves |= {f"nees_{block}": mean, f"nees_{block}_low": low, f"nees_{block}_high": high}
        curves[f"runs_{block}"] = count
        has = count > 0
        if has.any():
            inside[block] = float(np.mean((mean >= low)[has] & (mean <= high)[has]))
        coverage[block] = _ratio(sums[f"coverage_{block}"], sums[f"coverage_runs_{block}"])
    curves["rmse_position"] = np.sqrt(_ratio(sums["square_position"], np.asarray(runs)))
    curves["rmse_heading_deg"] = np.rad2deg(
        np.sqrt(_ratio(sums["square_heading"], np.asarray(runs)))
    )
    curves["nis_per_dof"] = _ratio(sums["nis"], sums["nis_dof"])
    if "rotation_information" in sums:
        curves["rotation_information"] = _ratio(sums["rotation_information"], np.asarray(runs))

    per_run = tally.measures()
    shot = credibility(*tally.snapshots())
    if shot is not None:
        looked_at = np.flatnonzero(finite & (tally.numbers() < SHOTS))
        for name, values in zip(("noncredibility", "inclination"), shot, strict=True):
            per_run[name] = np.full(len(finite), np.nan)
            per_run[name][looked_at] = values
    measures: dict[str, Measure] = {}
    for name, values in per_run.items():
        bounded = name.startswith(POSITIVE)
        skewed = name != "nis_per_dof"
        measure = positive_interval(values, skewed=skewed) if bounded else interval(values)
        if measure is not None:
            measures |= _as_reported(name, measure)
    for name, key, one in (
        ("position", "rmse_position", 1.0),
        ("heading", "rmse_heading_deg", np.rad2deg(1.0)),
    ):
        # The bound is averaged over all runs, so it is no yardstick where some were lost.
        if bound is not None and finite.all() and key in measures and bound[name].mean() > 0:
            least = one * np.sqrt(bound[name].mean())
            measures[f"bound_ratio_{name}"] = Measure(*(x / least for x in measures[key]))
            curves[key.replace("rmse", "bound")] = one * np.sqrt(bound[name])
    total_dof = float(np.sum(sums["nis_dof"]))
    nis_band = None
    if total_dof > 0:
        share = float(np.sum(sums["nis"])) / total_dof
        by_runs = measures["nis_per_dof"]
        scale = share / by_runs.value if by_runs.value > 0 else 1.0
        measures["nis_per_dof"] = Measure(share, scale * by_runs.low, scale * by_runs.high)
        tail = (1 - LEVEL) / 2
        nis_band = (
            chi2_quantile(tail, total_dof) / total_dof,
            chi2_quantile(1 - tail, total_dof) / total_dof,
        )
    counts = {
        "runs": runs,
        "not_finite": int((~finite).sum()),
        "divergent": int(tally.flags("divergent").sum()),
    }
    counts |= {name: int(value) for name, value in sums.items() if name in COUNTS}
    verdict = judge(per_run, counts, total_dof)
    return Summary(
        verdict=verdict.word,
        by=verdict.by,
        noticed=verdict.noticed,
        doubts=verdict.doubts,
        honest_nis=verdict.honest_nis,
        measures=measures,
        nis_band=nis_band,
        inside=inside,
        curves=curves,
        coverage=coverage,
        autocorrelation_band=_ratio(NORMAL, np.sqrt(sums["autocorrelation"][:, 2])),
        autocorrelation=_ratio(sums["autocorrelation"][:, 0], sums["autocorrelation"][:, 1]),
        counts=counts,
        per_run=per_run,
        not_finite_runs=tally.numbers()[~finite].tolist(),
    )


def _as_reported(name: str, measure: Measure) -> dict[str, Measure]:
    """Mean squares become roots, as do the ends of their intervals; radians become degrees."""
    kind, _, what = name.partition("_")
    if kind != "square":
        return {name: measure}
    unit = np.rad2deg(1.0) if what == "heading" else 1.0
    name = "rmse_heading_deg" if what == "heading" else f"rmse_{what}"
    return {name: Measure(*(unit * float(np.sqrt(value)) for value in measure))}


def _ratio(total: PyTree, count: np.ndarray) -> np.ndarray:
    safe = np.where(count > 0, count, 1.0)
    return np.where(count > 0, np.asarray(total, np.float64) / safe, np.nan)


def _bands(count: np.ndarray, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided chi-square band of the mean of count χ²_dof variables, step by step."""
    tail = (1 - LEVEL) / 2
    safe = np.maximum(count, 1)
    edges = [chi2_quantiles(p, dof * safe) / safe for p in (tail, 1 - tail)]
    low, high = (np.where(count > 0, edge, np.nan) for edge in edges)
    return low, high
