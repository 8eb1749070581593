"""Errors of the path and the map of a filter, by the truth and the survey of a data set.

The map is tested by the joint NEES of its landmarks, with a verdict.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PyTree

from jaxslam.consistency import metrics
from jaxslam.consistency._intervals import LEVEL, percentage
from jaxslam.consistency._measures.nees import block_nees, pose_error
from jaxslam.consistency.metrics._paths import alignment, transform
from jaxslam.core.protocols import Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate
from jaxslam.datasets._dataset import Dataset
from jaxslam.filters._ekf.map_coordinates import cov_of_coordinates
from jaxslam.math._definite import is_invertible
from jaxslam.math.stats import chi2_band, chi2_quantile

_in_coordinates = jax.jit(cov_of_coordinates, static_argnames="square_root", inline=True)

_POINT = ("x [m]", "y [m]")
_MAX_ITERATIONS = 20
"""Largest number of Gauss-Newton steps of `_best_frame`."""


class MapTest(NamedTuple):
    """The NEES of a map, the band of an honest one, and the verdict."""

    nees: float
    """the NEES of all landmarks together, or the largest NEES of a single landmark"""
    dof: int
    band: tuple[float, float]
    """the interval of 95 % of honest maps; (0, high) for the largest"""
    joint: bool
    """whether the covariances between landmarks are known"""

    @property
    def verdict(self) -> str:
        """The verdict: consistent (not rejected), optimistic (small covariances) or pessimistic."""
        low, high = self.band
        return (
            "optimistic" if self.nees > high else "pessimistic" if self.nees < low else "consistent"
        )

    def rows(self) -> dict[str, object]:
        """The test as rows of a summary."""
        band = [float(f"{end:.4g}") for end in self.band]
        return {
            "map NEES": self.nees,
            "map NEES of": (
                f"all landmarks, {self.dof} dof" if self.joint else "the worst landmark"
            ),
            f"map NEES, {percentage(LEVEL)} of honest maps": band,
            "map verdict": self.verdict,
        }


def joint_map_cov(filter: Filter, state: PyTree) -> Float[np.ndarray, "N 2 N 2"] | None:
    """The covariance of all landmark positions together, by slots, in map coordinates.

    None unless the state of the filter is a `slots.Joint` of point landmarks.
    """
    if not isinstance(state, Joint) or filter.landmark != _POINT:
        return None
    cov = np.asarray(_in_coordinates(state, filter.chart, square_root=filter.square_root))
    count = state.landmarks.shape[0]
    return cov[3:, 3:].reshape(count, 2, count, 2)


def judge_map(
    points: Float[np.ndarray, "n 2"],
    survey: Float[np.ndarray, "n 2"],
    covs: Float[np.ndarray, "n 2 2"],
    joint_cov: Float[np.ndarray, "n 2 n 2"] | None,
    one_frame: bool,
) -> MapTest | None:
    """The test of n landmarks at one time against their surveyed positions.

    With e = points - survey and the joint covariance P, eᵀ P⁻¹ e of an honest map is χ² with 2n
    degrees of freedom. In another frame the survey is first moved by the rigid motion that
    minimizes it (least squares weighted by P⁻¹), which takes 3 of them.

    Without P the correlation of the landmarks' errors is unknown. Then the largest eᵢᵀ Pᵢ⁻¹ eᵢ is
    compared with its bound at level 0.95 by Bonferroni's inequality, which holds for any
    correlation and can only reject an optimistic map. A motion of the frame reduces the errors, so
    the test then rejects even less often.

    It assumes Gaussian errors, models that are linear over them, and an exact survey. One map gives
    one number: an inconsistent filter may pass.

    Args:
        points: estimated positions.
        survey: surveyed positions.
        covs: covariance of each position.
        joint_cov: covariance of all positions together; None if unknown.
        one_frame: whether the survey is in the filter's frame.
    Returns:
        None if the covariance is singular, or the landmarks are too few to find the frame.
    """
    count = len(points)
    size = 2 * count - (0 if one_frame else 3)
    if size <= 0:
        return None
    joint = joint_cov is not None
    separate = np.zeros((count, 2, count, 2))
    separate[np.arange(count), :, np.arange(count)] = covs
    dtype = np.asarray(covs if joint_cov is None else joint_cov).dtype
    cov = np.asarray(separate if joint_cov is None else joint_cov, np.float64)
    cov = cov.reshape(2 * count, 2 * count)  # rows and columns by landmark, then by coordinate
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    # In the precision of the filter an eigenvalue 0 of an n × n matrix comes out as up to n eps of
    # the largest one, here n = 2 count; the factor 10 is a margin.
    if not values[0] > 20 * count * np.finfo(dtype).eps * values[-1]:
        return None
    white = vectors.T / np.sqrt(values)[:, None]  # white P whiteᵀ = 1
    error = points - (
        survey if one_frame else transform(_best_frame(points, survey, white), survey)
    )
    if joint:
        nees = float(np.sum((white @ error.reshape(-1)) ** 2))
        return MapTest(nees, size, chi2_band(size, 1, LEVEL), True)
    nees_of_each = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covs), error)
    bound = chi2_quantile(1 - (1 - LEVEL) / count, 2)
    return MapTest(float(nees_of_each.max()), 2, (0.0, bound), False)


def _best_frame(points: np.ndarray, survey: np.ndarray, white: np.ndarray) -> np.ndarray:
    """The pose (3,) of the survey's frame that minimizes ‖L⁻¹ (points - moved survey)‖, P = L Lᵀ.

    Gauss-Newton from the unweighted alignment; points may be far from the origin.
    """
    pose = alignment(survey, points)
    for _ in range(_MAX_ITERATIONS):
        moved = transform(pose, survey)
        lever = moved - pose[:2]
        jacobian = np.zeros((len(points), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -lever[:, 1], lever[:, 0]
        step = np.linalg.lstsq(
            white @ jacobian.reshape(-1, 3), white @ (points - moved).reshape(-1), rcond=None
        )[0]
        pose = pose + step
        if np.abs(step).max() < 1e-12:
            break
    return pose


SPAN = 1.0
"""Time over which relative errors of a path are measured [s]."""


class Evaluation(NamedTuple):
    """The errors of a filter as far as they are known, and the truth in the frame of the map."""

    errors: dict[str, float]
    """errors by name with unit, as printed"""
    points: Float[np.ndarray, "N 2"] | None
    """surveyed landmarks [m]"""
    path: Float[np.ndarray, "K 3"] | None
    """true poses of the K rows that have one"""
    map_test: MapTest | None
    """the test of the map by the survey; None without a survey or a regular covariance"""


def evaluate(
    data: Dataset,
    path: Estimate,
    last: Estimate,
    map_cov: Float[np.ndarray, "N 2 N 2"] | None = None,
) -> Evaluation:
    """The errors of a path and its last map, as far as the data set has the truth.

    In one frame: ATE (RMSE of the positions), RMSE of the heading, RPE (RMSE of the translation
    from each row to the first at least `SPAN` later, in the frame of the former), mean and median
    NEES of the pose where its covariance is regular; RMSE and mean NEES of the landmarks with a
    tag, each landmark by its covariance alone. In different frames path and map are each compared
    after the rigid motion that fits best, and the pose has no NEES. `map_test` has the verdict on
    the map.

    Args:
        path: estimate of every row, pose (T, 3) and pose_cov (T, 3, 3).
        last: estimate after the last row, with the map.
        map_cov: joint covariance of the landmarks of `last`, as from `joint_map_cov`.
    """
    errors, true_path = _path_errors(data, path)
    map_errors, points, map_test = _map_errors(data, last, map_cov)
    return Evaluation(errors | map_errors, points, true_path, map_test)


def _path_errors(
    data: Dataset, path: Estimate
) -> tuple[dict[str, float], Float[np.ndarray, "K 3"] | None]:
    """The errors of a path, and the true path in the frame of the map, if it is known."""
    is_known = np.ones(data.steps, bool) if data.true_at is None else np.asarray(data.true_at)
    if data.true_path is None or not is_known.any():
        return {}, None
    after = "" if data.one_frame else " after alignment"
    pose, cov = np.asarray(path.pose)[is_known], np.asarray(path.pose_cov)[is_known]
    true_path = np.asarray(data.true_path)[is_known]
    if not np.isfinite(pose).all():  # the filter failed
        return {f"ATE{after} [m]": np.nan, f"heading RMSE{after} [°]": np.nan}, true_path
    ate = metrics.ate(pose, true_path, align=not data.one_frame)
    true_path = transform(ate.frame, true_path)
    errors = {
        f"ATE{after} [m]": metrics.statistics(ate.translation).rmse,
        f"heading RMSE{after} [°]": metrics.statistics(np.rad2deg(ate.rotation)).rmse,
    }
    rpe = metrics.rpe(true_path, pose, seconds=SPAN, time=np.asarray(data.time)[is_known])
    if len(rpe.translation):
        errors[f"RPE over {SPAN:g} s [m]"] = metrics.statistics(rpe.translation).rmse
    error = pose_error(true_path, pose)
    nees, regular = block_nees(pose, error, error, cov)["pose"]
    if data.one_frame and regular.any():
        errors["pose NEES, mean (3 is honest)"] = float(nees[regular].mean())
        errors["pose NEES, median (2.37 is honest)"] = float(np.median(nees[regular]))
    return errors, true_path


def _map_errors(
    data: Dataset, last: Estimate, map_cov: Float[np.ndarray, "N 2 N 2"] | None
) -> tuple[dict[str, float], Float[np.ndarray, "L 2"] | None, MapTest | None]:
    """The errors of a map, the survey in the frame of the map, and the test of the map."""
    named = np.asarray(last.alive) & (np.asarray(last.tag) >= 0)
    if data.landmarks is None or not named.any():
        return {}, None, None
    after = "" if data.one_frame else " after alignment"
    survey = np.asarray(data.landmarks, np.asarray(last.points).dtype)
    tag, points = np.asarray(last.tag)[named], np.asarray(last.points)[named]
    if not np.isfinite(points).all():
        rmse = np.nan
    elif data.one_frame:
        rmse = metrics.statistics(np.linalg.norm(points - survey[tag], axis=1)).rmse
    else:
        rmse = metrics.align_map(last, data.landmarks)[1]
        survey = transform(metrics.alignment(survey[tag], points), survey)
    errors = {f"map RMSE{after} [m]": rmse}
    gap = (survey[tag] - points)[:, :, None]
    covs = np.asarray(last.point_covs)[named]
    finite = np.isfinite(covs).all(axis=(1, 2)) & np.isfinite(points).all(axis=1)
    regular = finite & is_invertible(np.where(finite[:, None, None], covs, 0))
    map_test = None
    if regular.all():
        slots = np.flatnonzero(named)
        joint_cov = None if map_cov is None else map_cov[slots][:, :, slots]
        surveyed = np.asarray(data.landmarks)[tag]  # `judge_map` finds the frame by P
        map_test = judge_map(points.astype(np.float64), surveyed, covs, joint_cov, data.one_frame)
    if regular.any():
        gap, covs = gap[regular], covs[regular]
        square = np.swapaxes(gap, 1, 2) @ np.linalg.solve(covs, gap)
        honest = "(2 is honest)" if data.one_frame else "(honest: below 2)"
        errors[f"landmark NEES{after} {honest}"] = float(square.mean())
    return errors, survey, map_test
