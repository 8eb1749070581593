"""`summarize` returns the `Summary` of one filter: averages, bands, intervals and a verdict.

Called by `monte_carlo` on the tally of each filter; reports and plots read the summaries.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxslam.consistency._intervals import Average
from jaxslam.consistency._measures import measures_of
from jaxslam.consistency._measures.coverage import coverage_curves
from jaxslam.consistency._measures.errors import over_bound
from jaxslam.consistency._measures.innovations import autocorrelation_of, nis_band
from jaxslam.consistency._measures.nees import inside_bands
from jaxslam.consistency._tally import SHOTS, Tally
from jaxslam.consistency._verdict import judge
from jaxslam.core._names import Named

_IN_REPR = ("nees_pose", "nis_per_dof", "rmse_position")


@dataclass(frozen=True, repr=False)
class Summary:
    """The consistency of one filter over the runs of a campaign."""

    verdict: str
    """consistent, optimistic, pessimistic, diverged, incomplete or undecided; see `judge`."""
    measures: dict[str, Average]
    """Each with its interval over the runs; names without a number (nothing to average) are absent.

    NEES, none divided by its dof: nees_pose (3), nees_position (2), nees_heading (1) in (x, y, θ),
    nees_own (3) of the pose in the error coordinates of the filter, nees_landmarks (2) averaged
    over landmarks and steps. nis_per_dof (1). coverage_95_pose, _position, _heading: share of steps
    with the truth in the 95 % ellipsoid. noncredibility and inclination [dB] (0). autocorrelation
    of innovations at lag 1 (0). rmse_position [m], rmse_heading_deg [°], rmse_landmarks [m] (final
    map, unaligned; none of a known map); bound_ratio_position and _heading: those over the
    conditional Cramér-Rao bound (about 1 at best; see `conditional_bound`). unobservable (3) and
    rotation_information [1/rad²] (0): the dimension of the filter's unobservable subspace, and what
    it has learnt of a turn of the whole frame. log_likelihood (mean a run; none without an
    innovation). In a world with spurious data: precision and recall of associations, and
    false_landmarks; see `associations`. Of a motion with further numbers in its state, as v or a
    bias: nees_of_v, nees_of_bias (1), and nees_further (1), of all together over how many they are.
    """
    nis_band: tuple[float, float] | None
    """95 % band of nis_per_dof from the summed degrees of freedom; None without a measurement."""
    inside: dict[str, float]
    """share of steps whose average NEES lies in its band, by block; 0.95 is honest."""
    curves: dict[str, np.ndarray]
    """(T,) averages over runs: nees_* with *_low and *_high bands (NaN where no run has one),
    rmse_position, rmse_heading_deg, nis_per_dof, rotation_information, and runs_* that count."""
    coverage: dict[str, np.ndarray]
    """share, by block, of runs' steps with the truth in the ellipsoid of each of `LEVELS`"""
    autocorrelation: np.ndarray
    """(LAGS,) of whitened innovations at lags of 1, 2, … steps; NaN without pairs."""
    autocorrelation_band: np.ndarray
    """(LAGS,) half-width of the 95 % band about 0 for white innovations, 1.96/√(number of products)
    (Bar-Shalom 2001, 5.4.2)."""
    counts: dict[str, int]
    """runs (finite), not_finite, inaccurate, divergent, steps, measured (measurements in the logs),
    used and dropped measurements by `Status`, missed, singular_steps, asymmetric_steps,
    indefinite_steps, faulty_ends, singular_ends, constant, and, of filters that have them,
    landmarks removed, merged and reduced, and searches exhausted. All but the first three are of
    the finite runs."""
    per_run: dict[str, np.ndarray]
    """(runs,) the average of each measure in each run, NaN without one: squares, radians."""
    not_finite_runs: list[int]
    """the numbers of the runs that are not finite; run i has key fold_in(key, i)."""
    by: tuple[str, ...] = ()
    """measures that reject the filter, of nees_pose and nis_per_dof"""
    noticed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """averages (at most, at least), by measure, that such a campaign notices nine times in ten:
    what "consistent" says, which means not rejected"""
    doubts: tuple[str, ...] = ()
    """sentences that qualify the verdict, the gravest first (see `judge`), and last whether the
    precision of the arithmetic decides"""
    honest_nis: float = 1.0
    """nis_per_dof from here on up to 1 is honest: below 1 where a gate dropped measurements"""
    faults: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """numbers of the runs without a judged estimate, by reason, as "ends early": of an estimator
    from elsewhere (`judge_estimator`), all of `not_finite_runs`"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "measures", Named(self.measures))

    def __repr__(self) -> str:
        present = (name for name in _IN_REPR if name in self.measures)
        shown = (f"{name}={self.measures[name].value:.4g}" for name in present)
        return f"Summary({', '.join([self.verdict, *shown, *self.doubts])})"


def summarize(tally: Tally, bound: Mapping[str, np.ndarray] | None = None) -> Summary:
    """The averages, bands and verdict of one filter, from its tally (host numbers, float64).

    bound: position [m²] and heading [rad²], (T,) each, the mean conditional bound over the runs.
    """
    sums, finite = tally.sums, tally.flags("finite")
    runs, per_run = int(finite.sum()), tally.measures()
    registered, snapshots = measures_of(per_run), tally.snapshots()
    of_snapshots = np.flatnonzero(finite & (tally.numbers() < SHOTS))
    measures: dict[str, Average] = {}
    curves: dict[str, np.ndarray] = {}
    for measure in registered:
        shot = measure.of_snapshots(*snapshots)
        if shot is not None:
            per_run[measure.column] = np.full(len(finite), np.nan)
            per_run[measure.column][of_snapshots] = shot
        if measure.column in per_run:
            average = measure.average(per_run[measure.column], sums)
            if average is not None:
                measures[measure.key] = average
        curves |= measure.curves(sums, runs)
    # The bound is averaged over all runs, so it does not apply if some were lost.
    if bound is not None and finite.all():
        ratios, bounds = over_bound(measures, bound)
        measures, curves = measures | ratios, curves | bounds
    total_dof = float(np.sum(sums["nis_dof"]))
    autocorrelation, band = autocorrelation_of(sums)
    counts = {
        "runs": runs,
        "not_finite": int((~finite).sum()),
        "inaccurate": int(tally.flags("inaccurate").sum()),
        "divergent": int(tally.flags("divergent").sum()),
    }
    counts |= {name: int(value) for name, value in sums.items() if value.ndim == 0}
    verdict = judge(per_run, counts, total_dof)
    return Summary(
        verdict=verdict.word,
        by=verdict.by,
        noticed=verdict.noticed,
        doubts=verdict.doubts,
        honest_nis=verdict.honest_nis,
        measures=measures,
        nis_band=nis_band(total_dof),
        inside=inside_bands(curves),
        curves=curves,
        coverage=coverage_curves(sums, per_run),
        autocorrelation=autocorrelation,
        autocorrelation_band=band,
        counts=counts,
        per_run=per_run,
        not_finite_runs=tally.numbers()[~finite].tolist(),
    )
