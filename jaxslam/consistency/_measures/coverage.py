"""How far a claimed covariance is from the actual one: coverage, and Li & Zhao's noncredibility."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.consistency._measures.measure import Measure, Runs, RunScores, Sums, ratio
from jaxslam.consistency._measures.nees import DOF
from jaxslam.math._definite import is_invertible
from jaxslam.math.stats import chi2_quantile

LEVELS = tuple(np.round(np.arange(0.05, 0.96, 0.05), 2).tolist()) + (0.99,)
"""Probabilities of the coverage curves."""


@dataclass(frozen=True, eq=False)
class Credibility(Measure):
    """The noncredibility or the inclination of a filter, by `credibility`."""

    part: int = 0

    def of_snapshots(
        self,
        errors: Float[np.ndarray, "R K 3"],
        covs: Float[np.ndarray, "R K 3 3"],
        regular: Bool[np.ndarray, "R K"],
    ) -> Float[np.ndarray, "R"] | None:
        """The number of each run, by the actual covariance of all runs."""
        parts = credibility(errors, covs, regular)
        return None if parts is None else parts[self.part]


@dataclass(frozen=True, eq=False)
class Coverage(Measure):
    """The share of steps with the truth in the 95 % ellipsoid of a block of the pose."""

    block: str = ""

    def of_runs(self, runs: Runs) -> RunScores:
        """The steps within the ellipsoid, of those with a regular covariance."""
        nees = runs.nees[self.block]
        count = nees.regular.sum(axis=1)
        radii = [chi2_quantile(p, DOF[self.block]) for p in LEVELS]
        # The number of steps in each shell between two ellipsoids: a number for each pair of run
        # and shell, which one bincount counts. Summed outwards, within each ellipsoid.
        total, shells = len(nees.value), len(LEVELS) + 1
        shell = np.searchsorted(radii, np.where(nees.regular, nees.value, np.inf))
        pairs = shell + np.arange(total)[:, None] * shells
        in_shell = np.bincount(pairs.ravel(), minlength=total * shells).reshape(total, shells)
        covered = in_shell.cumsum(axis=1)[:, :-1]
        sums = {f"coverage_{self.block}": covered / np.maximum(count, 1)[:, None]}
        return RunScores(covered[:, LEVELS.index(0.95)], count, sums)


COVERAGE = tuple(
    Coverage(
        f"coverage_95_{block}",
        f"{block} in 95 % ellipsoid",
        block=block,
        honest=0.95,
        row=block == "pose",
    )
    for block in DOF
)

CREDIBILITY = (
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
    the mean of 10 log10 ρ: decibels, 0 for a credible filter, a positive inclination for an
    optimistic one. X. R. Li, Z. Zhao, "Measuring estimator's credibility: noncredibility index",
    FUSION 2006.

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
        if not is_invertible(actual):
            continue
        claimed = np.einsum("ri,ri->r", e, np.linalg.solve(covs[runs, step], e[:, :, None])[..., 0])
        fair = np.einsum("ri,ri->r", e, np.linalg.solve(actual, e.T).T)
        valid = (claimed > 0) & (fair > 0) & np.isfinite(claimed) & np.isfinite(fair)
        runs, decibels = runs[valid], 10 * np.log10(claimed[valid] / fair[valid])
        total[:, runs] += [np.abs(decibels), decibels]
        count[runs] += 1
    if not count.any():
        return None
    index, inclination = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return index, inclination


def coverage_curves(sums: Sums, per_run: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Shares, by block, of runs' steps with the truth in the ellipsoid of each of `LEVELS`."""
    return {
        block: ratio(sums[f"coverage_{block}"], np.isfinite(per_run[f"coverage_95_{block}"]).sum())
        for block in DOF
    }
