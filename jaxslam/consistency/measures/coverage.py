"""Coverage: how often the truth lies in the ellipsoid of a probability that a filter claims."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxslam.consistency.measures.measure import Measure, Nees, Runs, RunScores, Sums, ratio
from jaxslam.consistency.measures.nees import DOF
from jaxslam.math.stats import chi2_quantile

LEVELS = tuple(np.round(np.arange(0.05, 0.96, 0.05), 2).tolist()) + (0.99,)
"""Probabilities of the coverage curves."""


@dataclass(frozen=True, eq=False)
class Coverage(Measure):
    """The share of steps with the truth in the 95 % ellipsoid of a block of the pose."""

    block: str = ""

    def of_runs(self, runs: Runs) -> RunScores:
        """The steps within the ellipsoid, of those with a regular covariance."""
        nees = runs.nees[self.block]
        count = nees.regular.sum(axis=1)
        covered = _covered(nees, DOF[self.block])
        sums = {f"coverage_{self.block}": covered / np.maximum(count, 1)[:, None]}
        return RunScores(covered[:, LEVELS.index(0.95)], count, sums)


MEASURES = tuple(
    Coverage(
        f"coverage_95_{block}",
        f"{block} in 95 % ellipsoid",
        block=block,
        honest=0.95,
        row=block == "pose",
    )
    for block in DOF
)


def coverage_curves(sums: Sums, per_run: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """By block, the share of runs' steps with the truth in the ellipsoid of each of `LEVELS`."""
    return {
        block: ratio(sums[f"coverage_{block}"], np.isfinite(per_run[f"coverage_95_{block}"]).sum())
        for block in DOF
    }


def _covered(nees: Nees, dof: int) -> Int[np.ndarray, "R LEVELS"]:
    """At how many steps the truth lies in the ellipsoid of each of the probabilities `LEVELS`."""
    runs, bins = len(nees.value), len(LEVELS) + 1
    radii = [chi2_quantile(p, dof) for p in LEVELS]
    beyond = np.searchsorted(radii, np.where(nees.regular, nees.value, np.inf))
    at = beyond + np.arange(runs)[:, None] * bins
    within = np.bincount(at.ravel(), minlength=runs * bins).reshape(runs, bins)
    out: np.ndarray = within.cumsum(axis=1)[:, :-1]
    return out
