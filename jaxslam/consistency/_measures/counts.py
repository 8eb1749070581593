"""What a campaign counts: what became of each measurement, and the events that filters report."""

import numpy as np
from jaxtyping import Int

from jaxslam.core.types import Info, Status

KEPT = tuple(status for status in Status if status.is_kept)
"""Statuses of measurements that serve the map."""

DROPS = tuple(status for status in Status if status.is_dropped)
"""Statuses of measurements that the map does not get: the reasons."""

MEANINGS = {
    "measured": "measurements in the logs",
    "fused": "measurements that corrected the estimate",
    "born": "measurements that started a landmark",
    "sighted": "measurements kept until a landmark can be started from them",
    "rejected": "measurements too far from the prediction, which the gate dropped, or not finite",
    "overflow": "measurements of new landmarks, dropped because the map was full",
    "deferred": "measurements of landmarks that were put off to a later scan",
    "repeated": "measurements of a new landmark that was in the same scan before",
    "singular": "measurements whose innovation covariance has no inverse",
    "unmatched": "measurements that were assigned to no landmark, old or new",
    "missed": "landmarks in view for which the scan had no place",
    "singular_steps": "steps without a NEES, since the covariance of the pose has no inverse, is "
    "not symmetric or is not positive definite",
    "asymmetric_steps": "steps whose pose covariance is not symmetric, by more than rounding",
    "indefinite_steps": "steps whose pose covariance has a negative eigenvalue, beyond rounding",
    "faulty_ends": "runs whose last pose covariance is not symmetric or has a negative eigenvalue",
    "singular_ends": "runs whose last pose covariance has no inverse, but neither of these faults",
    "constant": "runs whose pose and covariance never change while the robot moves",
    "removed": "landmarks removed from the map",
    "merged": "pairs of landmarks made one",
    "reduced": "landmarks converted to points",
    "exhausted": "scans whose search for an association ended at its limit",
    "resampled": "scans after which particles were resampled by their weights",
    "underflow": "scans that left no particle a weight",
    "invalid": "particles whose pose was not finite",
    "injected": "particles drawn anywhere, to find a lost robot",
    "capped": "steps that asked for more particles than the filter can have",
}
"""Counts, by their names in `Summary.counts`. A filter may report others, without a meaning."""


def count_label(name: str) -> str:
    """The name of a count, as a user reads it."""
    return {"born": "initialized", "runs": "finite runs"}.get(name, name.replace("_", " "))


def counts_of(info: Info) -> dict[str, Int[np.ndarray, "R"]]:
    """The counts (R,) of measurements by status, and of the events that the filter reports.

    The counts of a filter come from the method `counts` of records of `Info.extra`: arrays (R, T,
    …), by name.
    """
    runs = len(info.status)
    # A number for each pair of run and status, which one bincount counts.
    at = np.asarray(info.status).reshape(runs, -1) + np.arange(runs)[:, None] * len(Status)
    became = np.bincount(at.ravel(), minlength=runs * len(Status)).reshape(runs, -1)
    counts = {status.name.lower(): became[:, status] for status in KEPT + DROPS}
    reports = [
        report.counts() for report in (info.extra or {}).values() if hasattr(report, "counts")
    ]
    if info.exhausted is not None:
        reports.append({"exhausted": info.exhausted})
    events = {name: happened for report in reports for name, happened in report.items()}
    for name in sorted(events, key=[*MEANINGS, *events].index):
        counts[name] = np.asarray(events[name]).reshape(runs, -1).sum(axis=1)
    return counts
