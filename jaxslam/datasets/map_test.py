"""The test of a map against a survey: the joint NEES of its landmarks, and a verdict."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PyTree

from jaxslam.consistency import LEVEL, percentage
from jaxslam.filters.ekf.coordinates.map_coordinates import cov_of_coordinates
from jaxslam.math.stats import chi2_band, chi2_quantile
from jaxslam.metrics.paths import alignment, carried
from jaxslam.protocols import Filter
from jaxslam.slots import Joint

_in_coordinates = jax.jit(cov_of_coordinates, static_argnames="square_root", inline=True)

_POINT = ("x [m]", "y [m]")
_ITERATIONS = 20


class MapTest(NamedTuple):
    """The NEES of a map, the band of an honest one, and the verdict."""

    nees: float
    """of all landmarks together, or the largest of one"""
    dof: int
    band: tuple[float, float]
    """where it is in 95 % of honest maps; (0, high) of the largest"""
    joint: bool
    """whether the covariances between landmarks were there"""

    @property
    def verdict(self) -> str:
        """The verdict: consistent (not rejected), optimistic (small covariances) or pessimistic."""
        low, high = self.band
        return (
            "optimistic" if self.nees > high else "pessimistic" if self.nees < low else "consistent"
        )

    def rows(self) -> dict[str, object]:
        """The test as rows of a summary."""
        what = f"all landmarks, {self.dof} dof" if self.joint else "the worst landmark"
        band = [float(f"{end:.4g}") for end in self.band]
        return {
            "map NEES": self.nees,
            "map NEES of": what,
            f"map NEES, {percentage(LEVEL)} of honest maps": band,
            "map verdict": self.verdict,
        }


def joint_map_cov(filter: Filter, state: PyTree) -> Float[np.ndarray, "N 2 N 2"] | None:
    """The covariance of all landmark positions together, by slots, in map coordinates.

    None of a filter whose state is no `slots.Joint` of point landmarks.
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
    degrees of freedom, whatever the correlations, which P has. In another frame the survey is moved
    by the rigid motion that makes it smallest (least squares weighted by P⁻¹), which takes 3 of
    them.

    Without P the landmarks' errors are correlated in a way that is not known. Then the largest
    eᵢᵀ Pᵢ⁻¹ eᵢ is held against its bound at level 0.95 by Bonferroni's inequality, which holds for
    any correlation, and can only reject an optimistic map. With a motion of the frame, which makes
    errors smaller on the whole, it rejects more seldom still.

    It assumes Gaussian errors, models that are linear over them, and a survey without error. One
    map is one number: a filter that passes may be inconsistent all the same.

    Args:
        points, covs: of the filter, covs each landmark's own.
        one_frame: whether the survey is in the filter's frame.
    Returns:
        None where the covariance is singular, or there are too few landmarks for the frame.
    """
    count = len(points)
    size = 2 * count - (0 if one_frame else 3)
    if size <= 0:
        return None
    joint = joint_cov is not None
    whole = np.zeros((count, 2, count, 2))
    whole[np.arange(count), :, np.arange(count)] = covs
    cov = np.asarray(whole if joint_cov is None else joint_cov, np.float64)
    cov = cov.reshape(2 * count, 2 * count)
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    if not values[0] > 1e-12 * values[-1]:
        return None
    white = vectors.T / np.sqrt(values)[:, None]
    error = points - (survey if one_frame else carried(_best_frame(points, survey, white), survey))
    if joint:
        nees = float(np.sum((white @ error.reshape(-1)) ** 2))
        return MapTest(nees, size, chi2_band(size, 1, LEVEL), True)
    each = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covs), error)
    return MapTest(float(each.max()), 2, (0.0, chi2_quantile(1 - (1 - LEVEL) / count, 2)), False)


def _best_frame(points: np.ndarray, survey: np.ndarray, white: np.ndarray) -> np.ndarray:
    """The pose (3,) of the survey's frame that makes ‖L⁻¹ (points - moved survey)‖ smallest.

    Gauss-Newton from the plain alignment; points far from the origin are no worse.
    """
    pose = alignment(survey, points)
    for _ in range(_ITERATIONS):
        at = carried(pose, survey)
        lever = at - pose[:2]
        slope = np.zeros((len(points), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = 1.0
        slope[:, 0, 2], slope[:, 1, 2] = -lever[:, 1], lever[:, 0]
        step = np.linalg.lstsq(
            white @ slope.reshape(-1, 3), white @ (points - at).reshape(-1), rcond=None
        )[0]
        pose = pose + step
        if np.abs(step).max() < 1e-12:
            break
    return pose
