"""The results of one run as text: its path and its map."""

from collections.abc import Sequence

import numpy as np

from jaxslam.core._table import csv_text
from jaxslam.core.logs._tables import label
from jaxslam.core.types import Estimate, Info, Status

__all__ = ["innovations_csv", "map_csv", "trajectory_csv", "trajectory_tum"]


def trajectory_csv(time: np.ndarray, estimate: Estimate, further: Sequence[str] = ()) -> str:
    """A path as CSV: per step time, pose and the upper triangle of its covariance.

    further: the names of the robot's further numbers (`Motion.state[3:]`), which follow, and then
    the upper triangle of theirs.
    """
    header = ["time", "x", "y", "theta", "c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt"]
    rows, columns = np.triu_indices(3)
    triangle = np.asarray(estimate.pose_cov)[:, rows, columns]
    values = np.concatenate(
        [np.asarray(time)[:, None], np.asarray(estimate.pose), triangle], axis=1
    )
    if further:
        labels = list(map(label, further))
        rows, columns = np.triu_indices(len(labels))
        header += labels + [
            f"c_{labels[i]}_{labels[j]}" for i, j in zip(rows, columns, strict=True)
        ]
        triangle = np.asarray(estimate.further_cov)[:, rows, columns]
        values = np.concatenate([values, np.asarray(estimate.further), triangle], axis=1)
    # 17 digits: a NEES of the file is that of the filter, and time may be an epoch.
    return csv_text(header, [[f"{value:.17g}" for value in row] for row in values])


def trajectory_tum(time: np.ndarray, estimate: Estimate) -> str:
    """A path in the format of the TUM RGB-D benchmark: lines `t x y z qx qy qz qw`, no header.

    z = 0, and the quaternion (0, 0, sin θ/2, cos θ/2) turns about z.
    """
    lines = []
    for t, (x, y, theta) in zip(np.asarray(time), np.asarray(estimate.pose, float), strict=True):
        turn = f"{np.sin(theta / 2):.9g} {np.cos(theta / 2):.9g}"
        lines.append(f"{t:.17g} {x:.9g} {y:.9g} 0 0 0 {turn}\n")
    return "".join(lines)


def map_csv(estimate: Estimate, names: Sequence[int | str]) -> str:
    """A map as CSV: per landmark its name in the data set, position and covariance."""
    rows = []
    for i in np.flatnonzero(np.asarray(estimate.alive)):
        cov = np.asarray(estimate.point_covs[i])
        values = [*np.asarray(estimate.points[i]), cov[0, 0], cov[0, 1], cov[1, 1]]
        tag = int(estimate.tag[i])
        name = str(names[tag]) if tag >= 0 else ""  # without a tag it has no name
        rows.append([name, *(f"{value:.17g}" for value in values)])
    return csv_text(["landmark", "x", "y", "c_xx", "c_xy", "c_yy"], rows)


def innovations_csv(
    time: np.ndarray,
    tag: np.ndarray,
    info: Info,
    names: Sequence[int | str],
    measurements: Sequence[str],
) -> str:
    """Innovations as CSV: per measurement of a landmark in the map its time, the name of the
    landmark, ν, the upper triangle of S, whether the gate dropped it, its NIS (given those before
    it in a joint update), and the log-likelihood of its scan, at the first of the scan.

    Args:
        time: (T,)
        tag: (T, M) of `Log.scan`; the name of a measurement without a tag is empty.
        info: with leading T.
        names: of the landmarks with tags 0, 1, …
        measurements: names of the Z numbers of a measurement.
    """
    status, tag, log_likelihood = map(np.asarray, (info.status, tag, info.log_likelihood))
    nu, S, nis = map(np.asarray, (info.innovation, info.innovation_cov, info.nis))
    upper = np.triu_indices(nu.shape[2])
    labels = [name.partition("[")[0].strip() for name in measurements]
    header = ["time", "tag", *(f"nu_{label}" for label in labels)]
    header += [f"s_{labels[i]}_{labels[j]}" for i, j in zip(*upper, strict=True)]
    rows, scan = [], -1
    for t, m in np.argwhere((status == Status.FUSED) | (status == Status.REJECTED)):
        of_scan = log_likelihood[t] if t != scan else 0.0
        scan = t
        numbers = [*nu[t, m], *S[t, m][upper], status[t, m] == Status.REJECTED, nis[t, m], of_scan]
        name = str(names[tag[t, m]]) if tag[t, m] >= 0 else ""
        rows.append([f"{time[t]:.17g}", name, *(f"{float(value):.17g}" for value in numbers)])
    return csv_text([*header, "rejected", "nis", "log_likelihood"], rows)
