"""The noncredibility of Li & Zhao: how far a claimed covariance is from the actual one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.consistency.measures.measure import Measure


@dataclass(frozen=True, eq=False)
class Credibility(Measure):
    """One of the two numbers of `credibility`."""

    part: int = 0

    def of_snapshots(
        self,
        errors: Float[np.ndarray, "R K 3"],
        covs: Float[np.ndarray, "R K 3 3"],
        regular: Bool[np.ndarray, "R K"],
    ) -> Float[np.ndarray, "R"] | None:
        """It of each run, by the actual covariance of all."""
        found = credibility(errors, covs, regular)
        return None if found is None else found[self.part]


MEASURES = (
    Credibility(
        "noncredibility",
        "noncredibility",
        part=0,
        unit="dB",
        honest=0,
        positive=True,
        note=(
            "noncredibility",
            "mean of 10 |log10 ρ|, with ρ the NEES over that by the actual covariance of the "
            "errors; a covariance wrong by a factor of 2 has 3 dB",
        ),
    ),
    Credibility(
        "inclination",
        "inclination",
        part=1,
        unit="dB",
        honest=0,
        note=(
            "inclination",
            "mean of 10 log10 ρ; above 0 where covariances are claimed too small, below 0 where "
            "too large",
        ),
    ),
)


def credibility(
    errors: Float[np.ndarray, "runs K n"],
    covs: Float[np.ndarray, "runs K n n"],
    regular: Bool[np.ndarray, "runs K"],
) -> tuple[Float[np.ndarray, "runs"], Float[np.ndarray, "runs"]] | None:
    """Each run's noncredibility index and inclination, NaN for a run without one.

    At each step, with the actual mean square error Σ = mean over runs of e eᵀ and the ratio
    ρ = (eᵀ P⁻¹ e)/(eᵀ Σ⁻¹ e) of a run, the index is the mean of 10 |log10 ρ| and the inclination
    that of 10 log10 ρ: decibels, 0 for a credible filter, a positive inclination for an optimistic
    one. X. R. Li, Z. Zhao, "Measuring estimator's credibility: noncredibility index", FUSION 2006.

    Args:
        covs: as claimed.
        regular: whether that covariance has an inverse; the others are left out, and so is one
            that is not positive definite all the same, or an error of 0.
    Returns:
        None unless some step has at least 2n + 2 runs: Σ is made of them.
    """
    size = errors.shape[2]
    total, count = np.zeros((2, errors.shape[0])), np.zeros(errors.shape[0])
    for step in range(errors.shape[1]):
        runs = np.flatnonzero(regular[:, step])
        if len(runs) < 2 * size + 2:
            continue
        e = errors[runs, step]
        actual = e.T @ e / len(runs)
        if np.linalg.matrix_rank(actual) < size:
            continue
        claimed = np.einsum("ri,ri->r", e, np.linalg.solve(covs[runs, step], e[:, :, None])[..., 0])
        fair = np.einsum("ri,ri->r", e, np.linalg.solve(actual, e.T).T)
        there = (claimed > 0) & (fair > 0) & np.isfinite(claimed) & np.isfinite(fair)
        runs, decibels = runs[there], 10 * np.log10(claimed[there] / fair[there])
        total[:, runs] += [np.abs(decibels), decibels]
        count[runs] += 1
    if not count.any():
        return None
    index, inclination = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return index, inclination
