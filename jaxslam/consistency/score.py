"""`score` returns what each run says of a filter, the numbers that a campaign adds up or keeps.

Called by `monte_carlo.block` on the results of a block of runs; `tally.condense` takes what
it returns.

A run's error is compared with the covariance the filter claims for it. With e = truth - estimate,
heading wrapped, NEES = eᵀ P⁻¹ e has mean dof for an honest filter; it is *not* divided by dof
anywhere here. While P is singular (a start with P0 = 0, or a deviation that is rounding; see
`block_nees`) there is no NEES: such steps are left out, and counted, never filled with 0.
(Bar-Shalom, Li, Kirubarajan 2001, 5.4; Bailey et al. 2006.)
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxslam.consistency.measures import REGISTRY
from jaxslam.consistency.measures.counts import counted
from jaxslam.consistency.measures.measure import Nees, Runs, RunStatistics
from jaxslam.consistency.measures.nees import block_nees, pose_error
from jaxslam.types import Trace, Truth

SNAPSHOTS = 25
"""Steps of each run at which error and covariance are kept as they are."""


class Score(NamedTuple):
    """The scores of a filter in R runs; those of a run that is not finite mean nothing."""

    finite: Bool[np.ndarray, "R"]
    """every number of the run is finite."""
    measures: dict[str, tuple[np.ndarray, np.ndarray]]
    """each run's own averages: what is averaged, and over how much; there is none over 0."""
    snapshots: tuple[np.ndarray, np.ndarray, np.ndarray]
    """pose error (R, K, 3), its covariance (R, K, 3, 3), whether that is regular (R, K)."""
    sums: dict[str, np.ndarray]
    """what is added up over runs: counts (R,), and (R, …) of measures."""


def snapshot_steps(steps: int) -> np.ndarray:
    """The steps (K,) of the snapshots, the last among them."""
    return np.unique(np.round(np.linspace(0, steps - 1, SNAPSHOTS)).astype(int))


def score(
    trace: Trace,
    truth: Truth,
    found: RunStatistics,
    own_error: Float[np.ndarray, "R T 3"] | None = None,
) -> Score:
    """The scores of R runs, by NumPy in float64; every array is the host's and has leading R.

    Args:
        trace: of the estimate only poses and their covariances are looked at, of the final state
            its observability monitor (`monitor_of`), and where it has one, of `probe` the
            information of that after each step (R, T, 3, 3).
        found: `run_statistics` of each run.
        own_error: the pose errors in the filter's own coordinates (see `own_error_of`), by default
            those in (x, y, θ).
    """
    pose, cov = map(np.asarray, trace.estimate[:2])
    error = pose_error(np.asarray(truth.pose), pose)
    steps = error.shape[1]
    nees = block_nees(pose, error, error if own_error is None else own_error, cov)
    landmarks = found.landmark_nees, found.regular_landmarks
    nees["landmarks"] = Nees(*(np.asarray(x, np.float64) for x in landmarks))
    sums: dict[str, np.ndarray] = {
        **counted(trace.info),
        "missed": np.asarray(truth.missed).sum(axis=1),
        "singular_steps": steps - nees["pose"].regular.sum(axis=1),
    }
    runs = Runs(truth, trace, found, error, nees)
    measures: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    finite = np.array(found.finite)
    for measure in REGISTRY.values():
        each = measure.of_runs(runs)
        if each is None:
            continue
        total, weight = np.asarray(each.total), np.broadcast_to(each.weight, finite.shape)
        measures[measure.column] = total, weight
        sums |= each.sums
    for rows in jax.tree.leaves((measures, sums)):
        finite &= np.isfinite(rows).reshape(len(rows), -1).all(axis=1)
    at = snapshot_steps(steps)
    return Score(
        finite=finite,
        measures=measures,
        snapshots=(error[:, at], cov[:, at], nees["pose"].regular[:, at]),
        sums=sums,
    )
