"""The results of one run as text: its path and its map."""

from collections.abc import Sequence

import numpy as np

from jaxslam.core.types import Estimate
from jaxslam.results._files import csv_text

__all__ = ["map_csv", "trajectory_csv", "trajectory_tum"]


def trajectory_csv(time: np.ndarray, estimate: Estimate) -> str:
    """A path as CSV: per step time, pose and the upper triangle of its covariance."""
    header = ["time", "x", "y", "theta", "c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt"]
    rows, columns = np.triu_indices(3)
    triangle = np.asarray(estimate.pose_cov)[:, rows, columns]
    values = np.concatenate(
        [np.asarray(time)[:, None], np.asarray(estimate.pose), triangle], axis=1
    )
    # Time may be an epoch, which needs 17 digits; nine suffice for the rest.
    return csv_text(
        header, [[f"{row[0]:.17g}", *(f"{value:.9g}" for value in row[1:])] for row in values]
    )


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
        rows.append([name, *(f"{value:.9g}" for value in values)])
    return csv_text(["landmark", "x", "y", "c_xx", "c_xy", "c_yy"], rows)
