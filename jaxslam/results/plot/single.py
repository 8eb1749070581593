"""Figures of a single run: its map with covariance ellipses, and its errors with their bounds."""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.math.angles import wrap
from jaxslam.results.plot.style import COLORS, INK, caption, panels_of, span
from jaxslam.types import Estimate, Truth


def ellipse(
    mean: np.ndarray, cov: np.ndarray, n_sigma: float = 3.0, points: int = 64
) -> np.ndarray:
    """The closed contour (points + 1, 2) of Mahalanobis distance n_sigma, Solà (84).

    mean + n L (cos α, sin α) with P = L Lᵀ. n_sigma sets the size and points the smoothness. A
    positive semi-definite P gives a segment or a point. Raises ValueError if P is not 2×2, not
    finite or indefinite.
    """
    cov = np.asarray(cov, np.float64)
    if cov.shape != (2, 2) or not np.all(np.isfinite(cov)):
        raise ValueError(f"ellipse: expected a finite 2×2 covariance, got {cov}")
    a, b, c = cov[0, 0], cov[1, 0], cov[1, 1]
    tolerance = 1e-6 * max(abs(a), abs(c))
    first = np.sqrt(max(a, 0.0))
    below = b / first if first > 0 else 0.0
    rest = c - below**2
    if a < -tolerance or rest < -tolerance or (first == 0 and abs(b) > tolerance):
        raise ValueError(f"ellipse: expected a positive semi-definite covariance, got {cov}")
    factor = np.array([[first, 0.0], [below, np.sqrt(max(rest, 0.0))]])
    around = np.linspace(0.0, 2 * np.pi, points + 1)
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    return np.asarray(np.asarray(mean) + n_sigma * circle @ factor.T)


def map_figure(
    estimate: Estimate,
    *,
    truth: Truth | None = None,
    true_points: np.ndarray | None = None,
    n_sigma: float = 3.0,
    title: str = "",
) -> Figure:
    """The estimated path and final map with n-σ ellipses, and the truth if it is known.

    estimate has leading T, as in `Trace.estimate`; true_points (N, 2) are drawn without alignment.
    """
    figure, (axes,) = panels_of(6.0, 6.0, 1)
    if truth is not None:
        path = np.asarray(truth.pose)
        axes.plot(path[:, 0], path[:, 1], color=INK, lw=1.0, ls="--", label="true path", zorder=2)
        true_points = np.asarray(truth.landmarks)[:, :2]
    if true_points is not None:
        axes.plot(*true_points.T, "x", color=INK, ms=6, mew=1.2, label="true landmarks", zorder=4)
    pose = np.asarray(estimate.pose)
    axes.plot(pose[:, 0], pose[:, 1], color=COLORS[0], lw=1.4, label="estimated path", zorder=3)
    alive = np.asarray(estimate.alive[-1])
    points = np.asarray(estimate.points[-1])[alive]
    covs = np.asarray(estimate.point_covs[-1])[alive]
    axes.plot(*points.T, ".", color=COLORS[1], ms=5, label="estimated landmarks", zorder=5)
    named = f"{n_sigma:g} σ ellipses"
    for point, cov in zip(points, covs, strict=True):
        axes.plot(*ellipse(point, cov, n_sigma).T, color=COLORS[1], lw=0.9, label=named, zorder=3)
        named = "_"
    last = ellipse(pose[-1, :2], np.asarray(estimate.pose_cov[-1])[:2, :2], n_sigma)
    axes.plot(*last.T, color=COLORS[0], lw=0.9, zorder=3)
    _heading_mark(axes, pose[-1], _extent(pose, points))
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=3, frameon=False, fontsize="small"
    )
    return figure


def errors_figure(
    estimate: Estimate, truth: Truth, *, n_sigma: float = 3.0, title: str = ""
) -> Figure:
    """Errors of x, y and heading over the steps, with ±n σ of the filter's own covariance."""
    error = np.asarray(truth.pose) - np.asarray(estimate.pose)
    error[:, 2] = np.asarray(jax.jit(wrap)(error[:, 2]))
    cov = np.asarray(estimate.pose_cov)
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    figure, panels = panels_of(7.0, 6.0, 3)
    step = np.arange(1, len(error) + 1)
    names = ("x error [m]", "y error [m]", "heading error [°]")
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        scale = np.rad2deg(1.0) if i == 2 else 1.0
        bound = n_sigma * scale * sigma[:, i]
        axes.fill_between(
            step, -bound, bound, color=COLORS[0], alpha=0.18, lw=0, label=f"±{n_sigma:g} σ claimed"
        )
        axes.plot(step, scale * error[:, i], color=COLORS[1], lw=1.0, label="truth - estimate")
        axes.axhline(0.0, color=INK, lw=0.6)
        axes.set(ylabel=name)
    caption(figure, title)
    panels[-1].set(xlabel="step", xlim=span(len(error)))
    return figure


def _extent(*clouds: np.ndarray) -> float:
    """The larger side of the bounding box of some points, or 1 if it is 0."""
    every = np.concatenate([cloud[:, :2] for cloud in clouds])
    return float(np.ptp(every, axis=0).max()) or 1.0


def _heading_mark(axes: Axes, pose: np.ndarray, extent: float) -> None:
    """Draw a triangle at a pose, in its direction."""
    size = 0.022 * extent
    shape = size * np.array([[1.2, 0.0], [-0.6, 0.6], [-0.6, -0.6], [1.2, 0.0]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = shape @ np.array([[c, s], [-s, c]]) + pose[:2]
    axes.fill(*corners.T, color=COLORS[0], zorder=6)
