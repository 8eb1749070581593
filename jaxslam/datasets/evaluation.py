"""A filter's path and map against the truth and the survey of a data set."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam import metrics
from jaxslam.consistency.measures.nees import block_nees, pose_error
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.map_test import MapTest, judge_map
from jaxslam.types import Estimate

SPAN = 1.0
"""Time over which relative errors of a path are taken [s]."""


class Evaluation(NamedTuple):
    """The errors of a filter, as far as they are known, and the truth in the frame of its map."""

    errors: dict[str, float]
    """by name with unit, as printed"""
    points: Float[np.ndarray, "N 2"] | None
    """surveyed landmarks [m]"""
    path: Float[np.ndarray, "K 3"] | None
    """true poses, of the rows in which they are known"""
    map_test: MapTest | None
    """the map against the survey; None without one, or a regular covariance"""


def evaluate(
    data: Dataset,
    path: Estimate,
    last: Estimate,
    map_cov: Float[np.ndarray, "N 2 N 2"] | None = None,
) -> Evaluation:
    """The errors of a path and of its last map, as far as the data set has a truth.

    In one frame: ATE (RMSE of the positions), RMSE of the heading, RPE (RMSE of the translation
    from each row to the first at least `SPAN` later, in the frame of the former), mean and median
    NEES of the pose where its covariance is regular; RMSE and mean NEES of the landmarks with a
    tag, each landmark by its own covariance. In frames of their own path and map are compared after
    the rigid motion that fits each best, and the pose has no NEES. `map_test` has the verdict on
    the map.

    Args:
        path: pose (T, 3) and pose_cov (T, 3, 3).
        last: the map.
        map_cov: the joint covariance of its landmarks, as of `map_test.joint_map_cov`.
    """
    errors: dict[str, float] = {}
    after = "" if data.one_frame else " after alignment"
    true = points = test = None
    known = np.ones(data.steps, bool) if data.true_at is None else np.asarray(data.true_at)
    if data.true_path is not None and known.any():
        pose, cov = np.asarray(path.pose)[known], np.asarray(path.pose_cov)[known]
        true = np.asarray(data.true_path)[known]
    if true is not None and not np.isfinite(pose).all():  # the filter failed
        errors |= {f"ATE{after} [m]": np.nan, f"heading RMSE{after} [°]": np.nan}
    elif true is not None:
        of_path = metrics.ate(pose, true, align=not data.one_frame)
        true = metrics.carried(of_path.frame, true)
        errors[f"ATE{after} [m]"] = metrics.statistics(of_path.translation).rmse
        turn = np.rad2deg(of_path.rotation)
        errors[f"heading RMSE{after} [°]"] = metrics.statistics(turn).rmse
        of_steps = metrics.rpe(true, pose, seconds=SPAN, time=np.asarray(data.time)[known])
        if len(of_steps.translation):
            errors[f"RPE over {SPAN:g} s [m]"] = metrics.statistics(of_steps.translation).rmse
        error = pose_error(true, pose)
        nees, regular = block_nees(pose, error, error, cov)["pose"]
        if data.one_frame and regular.any():
            errors["pose NEES, mean (3 is honest)"] = float(nees[regular].mean())
            errors["pose NEES, median (2.37 is honest)"] = float(np.median(nees[regular]))
    named = np.asarray(last.alive) & (np.asarray(last.tag) >= 0)
    if data.landmarks is not None and named.any():
        points = np.asarray(data.landmarks, np.asarray(last.points).dtype)
        tag, found = np.asarray(last.tag)[named], np.asarray(last.points)[named]
        if not np.isfinite(found).all():
            rmse = np.nan
        elif data.one_frame:
            rmse = metrics.statistics(np.linalg.norm(found - points[tag], axis=1)).rmse
        else:
            rmse = metrics.align_map(last, data.landmarks)[1]
            frame = metrics.alignment(points[tag], found)
            points = metrics.carried(frame, points)
        errors[f"map RMSE{after} [m]"] = rmse
        gap = (points[tag] - found)[:, :, None]
        covs = np.asarray(last.point_covs)[named].astype(np.float64)
        finite = np.isfinite(covs).all(axis=(1, 2)) & np.isfinite(found).all(axis=1)
        regular = finite & (np.linalg.eigvalsh(np.where(finite[:, None, None], covs, 0))[:, 0] > 0)
        if regular.all():
            survey, among = np.asarray(data.landmarks)[tag], np.flatnonzero(named)
            joint = None if map_cov is None else map_cov[among][:, :, among]
            test = judge_map(found.astype(np.float64), survey, covs, joint, data.one_frame)
        if regular.any():
            gap, covs = gap[regular], covs[regular]
            square = np.swapaxes(gap, 1, 2) @ np.linalg.solve(covs, gap)
            honest = "(2 is honest)" if data.one_frame else "(honest: below 2)"
            errors[f"landmark NEES{after} {honest}"] = float(square.mean())
    return Evaluation(errors, points, true, test)
