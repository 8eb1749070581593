"""Figures of maps: paths, landmarks or walls with their covariances, the truth or a survey."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike

from jaxslam.consistency.campaign import Campaign
from jaxslam.core.types import Estimate, Truth
from jaxslam.core.validation import InvalidField, instance_of, refusals_of, require
from jaxslam.results.plot._style import (
    COLORS,
    FAINT,
    HUES,
    INK,
    PAGE,
    SHADE,
    Look,
    caption,
    escape_name,
    every_handle,
    own_settings,
    panels_of,
    titled,
)
from jaxslam.simulation._wall_geometry import Walls, wall_lines

Limits = tuple[tuple[float, float], tuple[float, float]]
"""Limits of x and of y."""


def ellipses(
    means: Float[np.ndarray, "N 2"],
    covs: Float[np.ndarray, "N 2 2"],
    n_sigma: float = 3.0,
    points: int = 64,
) -> Float[np.ndarray, "N C 2"]:
    """The closed contours (N, points + 1, 2) of Mahalanobis distance n_sigma, Solà (84).

    mean + n L (cos α, sin α) with P = L Lᵀ. A positive semi-definite P gives a segment or a point;
    one that is not finite or indefinite gives NaN.
    """
    covs = np.asarray(covs, np.float64)
    finite = np.isfinite(covs).all(axis=(1, 2))
    # L of all P = [[a, b], [b, c]] at once: [[first, 0], [below, second]]. `np.linalg.cholesky`
    # refuses the whole batch for one singular P. The tolerance is the rounding of a filter in
    # float32.
    a, b, c = (np.where(finite, covs[:, i, j], 0.0) for i, j in ((0, 0), (1, 0), (1, 1)))
    tolerance = 1e-6 * np.maximum(np.abs(a), np.abs(c))
    first = np.sqrt(np.maximum(a, 0.0))
    below = np.divide(b, first, out=np.zeros_like(b), where=first > 0)
    rest = c - below**2
    bad = ~finite | (a < -tolerance) | (rest < -tolerance)
    bad |= (first == 0) & (np.abs(b) > tolerance)
    second = np.sqrt(np.maximum(rest, 0.0))
    around = np.linspace(0.0, 2 * np.pi, points + 1)
    cosine, sine = n_sigma * np.cos(around), n_sigma * np.sin(around)
    along = first[:, None] * cosine
    across = below[:, None] * cosine + second[:, None] * sine
    contours: np.ndarray = np.asarray(means, np.float64)[:, None] + np.stack(
        [along, across], axis=2
    )
    contours[bad] = np.nan
    return contours


def ellipse(
    mean: np.ndarray, cov: np.ndarray, n_sigma: float = 3.0, points: int = 64
) -> np.ndarray:
    """The closed contour (points + 1, 2) of Mahalanobis distance n_sigma: `ellipses` of one.

    n_sigma sets the size and points the smoothness. Raises ValueError if P is not 2×2, not finite
    or indefinite.
    """
    cov = np.asarray(cov, np.float64)
    with refusals_of("ellipse"):
        if cov.shape != (2, 2) or not np.all(np.isfinite(cov)):
            raise InvalidField("", f"expected a finite 2×2 covariance, got {cov}")
        contour = ellipses(np.zeros((1, 2)), cov[None], n_sigma, points)[0]
        if np.isnan(contour).all():
            raise InvalidField("", f"expected a positive semi-definite covariance, got {cov}")
    return np.asarray(np.asarray(mean) + contour)


def extent(clouds: Sequence[np.ndarray]) -> float:
    """The larger side of the bounding box of some points, or 1 if it is 0."""
    return float(np.nanmax(np.ptp(_finite_points(clouds), axis=0))) or 1.0


def square_limits(clouds: Sequence[np.ndarray]) -> Limits:
    """The limits of a square panel about some points, with a margin."""
    points = _finite_points(clouds)
    x, y = (points.min(axis=0) + points.max(axis=0)) / 2
    half = 0.56 * extent(clouds)  # a margin of 6 % on each side
    return (x - half, x + half), (y - half, y + half)


def _finite_points(clouds: Sequence[np.ndarray]) -> np.ndarray:
    """The finite points, or else the origin."""
    points = np.concatenate(clouds)
    points = points[np.isfinite(points).all(axis=1)]
    return points if len(points) else np.zeros((1, 2))


_ARROW = Path([(1.2, 0.0), (-0.6, 0.6), (-0.25, 0.0), (-0.6, -0.6), (1.2, 0.0)])

_NEAR = 1.5
"""Dead reckoning is shown in full if it enlarges the map by at most this factor."""

_OTHERS = tuple(HUES[i] for i in (3, 4, 5, 2))
_DASHES = ((0, (4, 5)), (0, (1.5, 3)), (0, (6, 3, 1.5, 3)))
"""Colours and dashes of the paths of other filters: twelve combinations, whose gaps show the path
of the first filter below."""

_UPRIGHT = 15
"""Largest number of landmarks whose names are written horizontally."""


@own_settings()
def map_figure(
    estimate: Estimate,
    *,
    truth: Truth | None = None,
    true_points: np.ndarray | None = None,
    true_path: np.ndarray | None = None,
    dead_reckoning: np.ndarray | None = None,
    others: Mapping[str, Estimate] | None = None,
    names: Sequence[object] | None = None,
    title: str = "",
    width: float = 6.0,
) -> Figure:
    """The estimated path and final map with 3 σ ellipses, and the truth if it is known.

    Args:
        estimate: with leading T, as in `Trace.estimate`.
        truth: of a simulated world whose landmarks begin with a position (for lines use
            `worlds.with_positions`); or, drawn without alignment,
        true_points: (N, 2) landmarks [m], in the order of tags if names are given, and
        true_path: (T, 2 or 3) poses, NaN where unknown.
        dead_reckoning: (T, 2 or 3) poses; parts far from the rest of the map are not shown.
        others: estimates of other filters by name; their paths and landmarks are drawn.
        names: of the landmarks, by tag. A panel below shows the distance of each landmark of the
            map from its point in true_points, with the deviation that its covariance claims
            in that direction, and lines join the two.
        width: [in].

    Raises ValueError if names are given without true_points.
    """
    with refusals_of("map_figure"):
        require("estimate", estimate, instance_of(Estimate))
        if names is not None and true_points is None:
            raise InvalidField("names", "they are those of true_points, which are missing")
    if truth is not None:
        true_path, true_points = np.asarray(truth.pose), np.asarray(truth.landmarks)[:, :2]
    heights, tall = ((1.0,), width) if names is None else ((1.0, 0.2), 1.25 * width)
    figure, panels = panels_of(width, tall, len(heights), share=(False, False), heights=heights)
    axes = panels[0]
    shown = _draw_truth(axes, true_path, true_points, "true" if names is None else "surveyed")
    shown += _draw_estimate(axes, estimate)
    if dead_reckoning is not None:
        path = np.asarray(dead_reckoning)[:, :2]
        axes.plot(*path.T, color=FAINT, lw=1.0, ls=(0, (1, 1.2)), label="dead reckoning", zorder=2)
        shown += [path] if extent([*shown, path]) < _NEAR * extent(shown) else []
    for i, (name, other_estimate) in enumerate((others or {}).items()):
        color, dashes = _OTHERS[i % len(_OTHERS)], _DASHES[i % len(_DASHES)]
        path = np.asarray(other_estimate.pose)[:, :2]
        axes.plot(*path.T, lw=1.3, label=escape_name(name), zorder=3.6, color=color, ls=dashes)
        points = np.asarray(other_estimate.points[-1])[np.asarray(other_estimate.alive[-1])]
        axes.plot(*points.T, ".", color=color, ms=3, zorder=5.2)
    _limit(axes, shown)
    if names is not None:
        _draw_residuals(axes, panels[1], estimate, np.asarray(true_points), names)
        figure.align_ylabels()
    caption(figure, title, every_handle(panels))
    return figure


@own_settings()
def run_map_figure(campaign: Campaign, *, title: str = "", width: float = PAGE) -> Figure:
    """Path and final map of run 0 of every filter of `Campaign.first`, with the truth.

    The panels show the true map and its surroundings; estimates may leave them. Raises ValueError
    if the campaign has no run 0.
    """
    with refusals_of("run_map_figure"):
        require("campaign", campaign, instance_of(Campaign))
        if not campaign.first:
            raise InvalidField("campaign", "it holds no run 0 (Campaign.first is empty)")
    if len(campaign.first) == 1:
        ((truth, estimate),) = campaign.first.values()
        return map_figure(estimate, truth=truth, title=title, width=width)
    columns = min(len(campaign.first), 3 if len(campaign.first) <= 9 else 4)
    if width < 5:
        columns = 2
    rows = -(-len(campaign.first) // columns)
    side = width / columns
    tall = side * rows + (0.7 if rows * columns == len(campaign.first) else 1.0)
    figure, panels = panels_of(width, tall, rows, columns, share=(True, True))
    for axes, (name, (truth, estimate)) in zip(panels, campaign.first.items(), strict=False):
        shown = _draw_truth(axes, np.asarray(truth.pose), np.asarray(truth.landmarks)[:, :2])
        _draw_estimate(axes, estimate)
        _limit(axes, shown)
        titled(axes, escape_name(name))
    for axes in panels[len(campaign.first) :]:
        axes.set_axis_off()
    for i, axes in enumerate(panels[: len(campaign.first)]):
        lowest = i + columns >= len(campaign.first)
        axes.tick_params(labelbottom=lowest)
        axes.set_xlabel("x [m]" if lowest else "")
        axes.set_ylabel("y [m]" if i % columns == 0 else "")
    caption(figure, title, every_handle(panels))
    # The layout of panels of one scale takes two passes; saving makes the second.
    figure.draw_without_rendering()
    return figure


def _draw_truth(
    axes: Axes, path: np.ndarray | None, points: np.ndarray | None, kind: str = "true"
) -> list[np.ndarray]:
    """Draw the true path and landmarks; returns their points."""
    shown = []
    if path is not None:
        shown.append(np.asarray(path)[:, :2])
        axes.plot(*shown[-1].T, color=INK, lw=1.0, ls=(0, (4, 2)), label="true path", zorder=3.5)
    if points is not None:
        shown.append(np.asarray(points))
        label = f"{kind} landmarks"
        axes.plot(*shown[-1].T, "x", color=INK, ms=5, mew=1.0, label=label, zorder=4)
    return shown


def _draw_estimate(axes: Axes, estimate: Estimate) -> list[np.ndarray]:
    """Draw the estimated path with its ends, and the final map; returns their points.

    Indefinite covariances are counted above the panel.
    """
    pose = np.asarray(estimate.pose)
    alive = np.asarray(estimate.alive[-1])
    points = np.asarray(estimate.points[-1])[alive]
    covs = np.asarray(estimate.point_covs[-1])[alive]
    axes.plot(*pose[:, :2].T, color=COLORS[0], lw=1.3, label="estimated path", zorder=3)
    axes.plot(*points.T, ".", color=COLORS[1], ms=4.5, label="estimated landmarks", zorder=5)
    position, position_cov = pose[-1:, :2], np.asarray(estimate.pose_cov[-1:])[:, :2, :2]
    indefinite = 0
    for means, cov, color, label in (
        (position, position_cov, COLORS[0], "3 σ ellipse, pose"),
        (points, covs, COLORS[1], "3 σ ellipses"),
    ):
        contours = ellipses(means, cov)
        good = ~np.isnan(contours).all(axis=(1, 2))
        indefinite += int((~good).sum())
        for contour in contours[good]:
            axes.plot(*contour.T, color=color, lw=0.9, label=label, zorder=3)
    if indefinite:
        axes.set_title(f"{indefinite} without ellipse", loc="right", fontsize=7, color=INK)
    ends: Look = {"ls": "none", "color": INK, "zorder": 6}
    axes.plot(*pose[0, :2], marker="o", mfc="white", mew=1.2, ms=5, label="start", **ends)
    turned = MarkerStyle(_ARROW, transform=Affine2D().rotate(np.nan_to_num(pose[-1, 2])))
    axes.plot(*pose[-1, :2], marker=turned, mec="white", mew=0.6, ms=12, label="end", **ends)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return [pose[:, :2], points]


def _draw_residuals(
    over: Axes,
    axes: Axes,
    estimate: Estimate,
    survey: np.ndarray,
    names: Sequence[object],
) -> None:
    """Draw the distance of each landmark from its surveyed point, on the map and as lengths."""
    tag = np.asarray(estimate.tag[-1])
    tagged = np.flatnonzero(np.asarray(estimate.alive[-1]) & (tag >= 0))
    tagged = tagged[np.argsort(tag[tagged])]
    points, targets = np.asarray(estimate.points[-1])[tagged], survey[tag[tagged]]
    label = "residual"
    for ends in zip(points, targets, strict=True):
        over.plot(*np.array(ends).T, color=COLORS[2], lw=1.2, label=label, zorder=4.5)
    error = points - targets
    far = np.hypot(*error.T)
    along = error / np.where(far > 0, far, 1.0)[:, None]
    covs = np.asarray(estimate.point_covs[-1])[tagged]
    claim = 3 * np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", along, covs, along), 0.0))
    at = np.arange(len(tagged))
    claimed = "3 σ claimed in its direction"
    axes.bar(at, claim, 0.7, color=SHADE, label=claimed)
    axes.plot(at, far, "D", color=COLORS[2], ms=4.5, mec="white", mew=0.4, label=label)
    axes.set_xticks(at, [escape_name(str(names[tag[i]])) for i in tagged])
    if len(tagged) > _UPRIGHT:
        axes.tick_params(axis="x", rotation=90)
    axes.grid(axis="x", visible=False)
    axes.set(xlabel="landmark", ylabel="residual [m]")
    axes.set_ylim(bottom=0.0)


def _limit(axes: Axes, clouds: Sequence[np.ndarray]) -> None:
    """Set the limits of a square panel about some points."""
    xlim, ylim = square_limits(clouds)
    axes.set(xlim=xlim, ylim=ylim)


@own_settings()
def walls_figure(
    estimate: Estimate,
    walls: Walls,
    *,
    path: ArrayLike | None = None,
    title: str = "",
    width: float = PAGE,
) -> Figure:
    """The map of an EKF of `sensors.Line`: each true wall, projected onto its estimated line.

    A segment of the walls is projected onto the line with its tag, and drawn with a band of 3 σ of
    the line. Of walls that were not measured only the true ones are drawn.

    Args:
        estimate: (T, …); the last map is drawn. Tags are the rows of the walls.
        walls: the true walls, in the frame of the map.
        path: (T, 2 or 3) the true path.
    Raises:
        ValueError: if the walls have no segments, or a tag is not one of them.
    """
    wall_of_segment = wall_lines(walls)[1]
    alive = np.asarray(estimate.alive[-1])
    tags = np.asarray(estimate.tag[-1])[alive]
    if len(tags) and not (tags.min() >= 0 and tags.max() <= wall_of_segment.max()):
        raise InvalidField(
            "", f"expected tags from 0 to {wall_of_segment.max()}, got {tags}", owner="walls_figure"
        )
    feet = np.asarray(estimate.points[-1])[alive]
    covs = np.asarray(estimate.point_covs[-1])[alive]
    ends, bands = [], []
    for tag, foot, cov in zip(tags, feet, covs, strict=True):
        r = np.hypot(*foot)
        normal = foot / r
        along = np.array([-normal[1], normal[0]])
        for segment in np.asarray(walls.segments)[wall_of_segment == tag]:
            t = segment @ along  # the ends of the segment, along the line from its foot
            projected = r * normal[None] + t[:, None] * along[None]
            # An error (dr, r dα) of the foot, in the frame of the line, moves the line by dr - t dα
            # at t.
            jacobian = normal[None] - (t / r)[:, None] * along[None]
            sigma = 3 * np.sqrt(np.einsum("ki,ij,kj->k", jacobian, cov, jacobian))
            offset = sigma[:, None] * normal[None]
            ends.append(projected)
            bands.append(np.concatenate([projected + offset, (projected - offset)[::-1]]))
    segments = np.asarray(walls.segments)
    low, high = segments.reshape(-1, 2).min(axis=0), segments.reshape(-1, 2).max(axis=0)
    inner = width - 0.6
    height = inner * (high - low)[1] / (high - low)[0] + 0.9
    figure, (axes,) = panels_of(width, min(height, 9.0), 1)
    axes.grid(visible=False)
    axes.add_collection(
        LineCollection(list(segments), color=INK, lw=2.2, alpha=0.45, label="walls")
    )
    band = "3 σ of a line"
    axes.add_collection(PolyCollection(bands, color=COLORS[1], alpha=0.25, lw=0, label=band))
    axes.add_collection(
        LineCollection(ends, color=COLORS[1], lw=0.9, label="estimated lines", zorder=3)
    )
    if path is not None:
        true_path = np.asarray(path)
        axes.plot(
            *true_path[:, :2].T, color=INK, lw=1.0, ls=(0, (4, 2)), label="true path", zorder=3.5
        )
    pose = np.asarray(estimate.pose)
    axes.plot(*pose[:, :2].T, color=COLORS[0], lw=1.2, label="estimated path", zorder=4)
    axes.plot(*pose[0, :2], "o", color=INK, mfc="white", mew=1.2, ms=5, label="start", zorder=5)
    margin = 0.03 * (high - low).max()
    axes.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
    )
    caption(figure, title, every_handle([axes]))
    return figure
