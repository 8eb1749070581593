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
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.consistency.nees import DOF, Nees, block_nees, pose_error
from jaxslam.consistency.statistics import RunStatistics
from jaxslam.filters.ekf.observability import Monitor, MonitoredState
from jaxslam.math.stats import chi2_quantile
from jaxslam.types import Info, Status, Trace, Truth

LANDMARK_DOF = 2
"""of the NEES of one landmark's position."""

KEPT = (Status.FUSED, Status.BORN, Status.SIGHTED)
"""What a measurement does for the map; each is counted."""

DROPS = (
    Status.REJECTED,
    Status.OVERFLOW,
    Status.DEFERRED,
    Status.REPEATED,
    Status.SINGULAR,
    Status.UNMATCHED,
)
"""What can keep a measurement from the map; each is counted."""

EVENTS: dict[str, tuple[str | None, str]] = {
    "removed": ("pruning", "removed"),
    "merged": ("merging", "pair"),
    "reduced": ("points", "reduced"),
    "exhausted": (None, "exhausted"),
    **{
        name: ("particles", name)
        for name in ("resampled", "underflow", "invalid", "injected", "capped")
    },
}
"""What not every filter reports, and where: the record in `Info.extra`, or None for a field of
`Info`, and the field. Each is counted where it is there."""

LEVELS = tuple(np.round(np.arange(0.05, 0.96, 0.05), 2).tolist()) + (0.99,)
"""Probabilities of the coverage curves."""

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
    """what is added up over runs: (R, T) curves, (R, LEVELS) and (R, LAGS, 3) sums, (R,) drops."""


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
    info, (pose, cov) = trace.info, map(np.asarray, trace.estimate[:2])
    error = pose_error(np.asarray(truth.pose), pose)
    steps = error.shape[1]
    nees = block_nees(pose, error, error if own_error is None else own_error, cov)
    nees["landmarks"] = Nees(*(np.asarray(x, np.float64) for x in found[1:3]))
    fused = info.status == Status.FUSED
    curves = {f"nees_{block}": nees[block].value for block in DOF}
    curves |= {f"regular_{block}": nees[block].regular.astype(np.float64) for block in DOF}
    curves |= {
        "square_position": (error[..., :2] ** 2).sum(axis=2),
        "square_heading": error[..., 2] ** 2,
        "nis": np.where(fused, info.nis, 0.0).sum(axis=2, dtype=np.float64),
        "nis_dof": np.asarray(info.dof).sum(axis=2, dtype=np.float64),
    }
    measures: dict[str, tuple[PyTree, PyTree]] = dict(found.associations)
    sums: dict[str, np.ndarray] = {}
    monitor = monitor_of(trace.final)
    if monitor is not None:
        gained, dimensions = _null_space(monitor, trace.probe)
        curves["rotation_information"] = gained
        measures["rotation_information"] = gained[:, -1], 1
        measures["unobservable"] = dimensions, 1
    for block in DOF:
        count = nees[block].regular.sum(axis=1)
        covered = _covered(nees[block], DOF[block])
        sums[f"coverage_{block}"] = covered / np.maximum(count, 1)[:, None]
        sums[f"coverage_runs_{block}"] = (count > 0).astype(np.float64)
        measures[f"coverage_95_{block}"] = covered[:, LEVELS.index(0.95)], count
    for block, (value, regular) in nees.items():
        measures[f"nees_{block}"] = value.sum(axis=1), regular.sum(axis=1)
    for name in ("square_position", "square_heading"):
        measures[name] = curves[name].sum(axis=1), steps
    measures["square_landmarks"] = found.landmark_squares[:, 0], found.landmark_squares[:, 1]
    measures["nis_per_dof"] = curves["nis"].sum(axis=1), curves["nis_dof"].sum(axis=1)
    measures["log_likelihood"] = (
        info.log_likelihood.sum(axis=1, dtype=np.float64),
        curves["nis_dof"].any(axis=1),  # none without an innovation
    )
    sums["autocorrelation"] = np.asarray(found.autocorrelation)
    measures["autocorrelation"] = found.autocorrelation[:, 0, 0], found.autocorrelation[:, 0, 1]

    sums |= _counted(info)
    sums["missed"] = np.asarray(truth.missed).sum(axis=1)
    sums["singular_steps"] = steps - nees["pose"].regular.sum(axis=1)
    finite = np.array(found.finite)
    for rows in jax.tree.leaves((measures, sums, curves)):
        finite &= _finite(rows)

    at = snapshot_steps(steps)
    return Score(
        finite=finite,
        measures={
            name: (np.asarray(whole), np.broadcast_to(weight, finite.shape))
            for name, (whole, weight) in measures.items()
        },
        snapshots=(error[:, at], cov[:, at], nees["pose"].regular[:, at]),
        sums=sums | curves,
    )


def _finite(rows: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Whether every number of a run is finite, (R,); () of a number that all runs share."""
    out: np.ndarray = np.isfinite(rows)
    return out.reshape(len(out), -1).all(axis=1) if out.ndim else out


def _counted(info: Info) -> dict[str, Int[np.ndarray, "R"]]:
    """How many measurements became what, and how often each of `EVENTS` happened."""
    runs = len(info.status)
    at = np.asarray(info.status).reshape(runs, -1) + np.arange(runs)[:, None] * len(Status)
    became = np.bincount(at.ravel(), minlength=runs * len(Status)).reshape(runs, -1)
    out = {status.name.lower(): became[:, status] for status in KEPT + DROPS}
    for name in EVENTS:
        happened = _event(info, name)
        if happened is not None:
            out[name] = happened.reshape(runs, -1).sum(axis=1)
    return out


def _event(info: Info, name: str) -> np.ndarray | None:
    """How often one of `EVENTS` happened, (R, T, …); None where the filter does not report it."""
    record, field = EVENTS[name]
    holder = info if record is None else (info.extra or {}).get(record)
    found = getattr(holder, field, None)
    if found is None:
        return None
    return np.asarray(found[..., 0] >= 0 if name == "merged" else found)


def _covered(nees: Nees, dof: int) -> Int[np.ndarray, "R LEVELS"]:
    """At how many steps the truth lies in the ellipsoid of each of the probabilities `LEVELS`."""
    runs, bins = len(nees.value), len(LEVELS) + 1
    radii = [chi2_quantile(p, dof) for p in LEVELS]
    beyond = np.searchsorted(radii, np.where(nees.regular, nees.value, np.inf))
    at = beyond + np.arange(runs)[:, None] * bins
    within = np.bincount(at.ravel(), minlength=runs * bins).reshape(runs, bins)
    out: np.ndarray = within.cumsum(axis=1)[:, :-1]
    return out


def monitor_of(state: PyTree) -> Monitor | None:
    """The observability monitor in the state of a `monitored` filter; None in another state."""
    return state.monitor if isinstance(state, MonitoredState) else None


def _null_space(
    monitor: Monitor, information: Float[np.ndarray, "R T 3 3"]
) -> tuple[Float[np.ndarray, "R T"], Int[np.ndarray, "R"]]:
    """Information gained along a turn of the whole frame by each step, and the dimension of the
    unobservable subspace of the filter's linearized system.

    A direction is unobservable if what was gained along it is below 1e-9 of the same sum of squares
    with absolute values, in float32 eps^(3/4): rounding leaves 1e-32 of it, the higher moments that
    sigma points do not see 1e-10, an EKF's changing Jacobians 1e-5 after a hundred steps.
    """
    least = max(1e-9, float(np.finfo(information.dtype).eps) ** 0.75)
    scale = np.sqrt(np.where(monitor.scale > 0, monitor.scale, 1.0).astype(np.float64))
    unit = monitor.information / scale[:, :, None] / scale[:, None, :]
    regular = np.isfinite(unit).all(axis=(1, 2))
    size = np.linalg.eigvalsh(np.where(regular[:, None, None], unit, 0.0))
    gained = np.einsum("rtij,ri,rj->rt", information.astype(np.float64), monitor.turn, monitor.turn)
    return gained, (size < least).sum(axis=1)
