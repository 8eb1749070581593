"""Measures of innovations: NIS, autocorrelation and log-likelihood."""

from dataclasses import dataclass

import numpy as np

from jaxslam.consistency._intervals import LEVEL, Average, positive_interval
from jaxslam.consistency._measures.measure import Measure, Runs, RunScores, Sums, ratio
from jaxslam.core.types import Status
from jaxslam.math.stats import chi2_quantile, normal_quantile


@dataclass(frozen=True, eq=False)
class Nis(Measure):
    """The NIS of a run's fused measurements over their degrees of freedom."""

    def of_runs(self, runs: Runs) -> RunScores:
        """The sum of each run, and its degrees of freedom."""
        info = runs.trace.info
        fused = info.status == Status.FUSED
        nis = np.where(fused, info.nis, 0.0).sum(axis=2, dtype=np.float64)
        dof = np.asarray(info.dof).sum(axis=2, dtype=np.float64)
        return RunScores(nis.sum(axis=1), dof.sum(axis=1), {"nis": nis, "nis_dof": dof})

    def average(self, per_run: np.ndarray, sums: Sums) -> Average | None:
        """The average over the runs and the interval that the verdict tests."""
        return positive_interval(per_run, skewed=False)

    def curves(self, sums: Sums, runs: int) -> dict[str, np.ndarray]:
        """NIS over degrees of freedom at each step."""
        return {"nis_per_dof": ratio(sums["nis"], sums["nis_dof"])}


@dataclass(frozen=True, eq=False)
class Autocorrelation(Measure):
    """The autocorrelation of whitened innovations at a lag of one step."""

    def of_runs(self, runs: Runs) -> RunScores:
        """Products and squares at lag 1; sums of all lags."""
        products = np.asarray(runs.statistics.autocorrelation)
        return RunScores(products[:, 0, 0], products[:, 0, 1], {"autocorrelation": products})


@dataclass(frozen=True, eq=False)
class LogLikelihood(Measure):
    """The log-likelihood of a run's innovations, if it has any."""

    def of_runs(self, runs: Runs) -> RunScores:
        """The sum over the steps."""
        info = runs.trace.info
        total = np.asarray(info.log_likelihood).sum(axis=1, dtype=np.float64)
        return RunScores(total, np.asarray(info.dof).any(axis=(1, 2)))


NIS = Nis("nis_per_dof", "NIS / dof", honest=1, positive=True, figure="nees", better="honest")

AUTOCORRELATION = Autocorrelation(
    "autocorrelation",
    "innovation autocorr., lag 1",
    honest=0,
    note=(
        "innovation autocorrelation",
        "correlation of whitened innovations with those of the same landmark one step later; 0 "
        "where the filter uses all that measurements say",
    ),
)

LOG_LIKELIHOOD = LogLikelihood("log_likelihood", "log-likelihood", better="larger")


def nis_band(total_dof: float) -> tuple[float, float] | None:
    """The 95 % band of NIS / dof for these degrees of freedom; None for zero."""
    if not total_dof > 0:
        return None
    tail = (1 - LEVEL) / 2
    return (
        chi2_quantile(tail, total_dof) / total_dof,
        chi2_quantile(1 - tail, total_dof) / total_dof,
    )


def autocorrelation_of(sums: Sums) -> tuple[np.ndarray, np.ndarray]:
    """The autocorrelation at each lag, and the half-width of the band of white innovations."""
    product, length, pairs = sums["autocorrelation"].T
    normal = normal_quantile(0.5 + LEVEL / 2)
    return ratio(product, length), ratio(normal, np.sqrt(pairs))
