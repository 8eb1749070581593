"""Figures a paper could print: maps, errors, and what a campaign shows. The only module that draws.

Figures are made without pyplot, so there is no global state and no window; save one with
`figure.savefig(path)`.
"""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Figure  # others name the type, and import only this module

from jaxslam.angles import wrap
from jaxslam.consistency import DOF, LEVELS
from jaxslam.monte_carlo import Campaign
from jaxslam.types import Estimate, Truth

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""A palette that colour-blind readers can tell apart (Okabe & Ito)."""

_INK = "#333333"

_HUES, _DASHES, _MARKS = 6, ("-", (0, (4, 1.6)), (0, (1, 1.2))), ("o", "s", "^")
"""Filters take six of the colours in turn, then again with other dashes and markers."""

_NOTHING = 1e-6
"""[1/rad²] information on a heading of which one has learnt nothing: σ is 1000 rad."""


def ellipse(
    mean: np.ndarray, cov: np.ndarray, n_sigma: float = 3.0, points: int = 64
) -> np.ndarray:
    """The contour (points + 1, 2) of Mahalanobis distance n_sigma, Solà (84), closed.

    mean + n L (cos α, sin α) with P = L Lᵀ. n_sigma sets the size and points the smoothness. A
    positive semi-definite P gives a segment or a point. Raises ValueError if P is not 2×2, not
    finite or indefinite.
    """
    cov = np.asarray(cov, np.float64)
    if cov.shape != (2, 2) or not np.all(np.isfinite(cov)):
        raise ValueError(f"expected a finite 2×2 covariance, got {cov}")
    a, b, c = cov[0, 0], cov[1, 0], cov[1, 1]
    tolerance = 1e-6 * max(abs(a), abs(c))
    first = np.sqrt(max(a, 0.0))
    below = b / first if first > 0 else 0.0
    rest = c - below**2
    if a < -tolerance or rest < -tolerance or (first == 0 and abs(b) > tolerance):
        raise ValueError(f"expected a positive semi-definite covariance, got {cov}")
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
    """The estimated path and final map with n-σ ellipses, over the truth where there is one.

    estimate has leading T, as in `Trace.estimate`; true_points (N, 2) are drawn as they stand.
    """
    figure, (axes,) = _figure(6.0, 6.0, 1)
    if truth is not None:
        path = np.asarray(truth.pose)
        axes.plot(path[:, 0], path[:, 1], color=_INK, lw=1.0, ls="--", label="true path", zorder=2)
        true_points = np.asarray(truth.landmarks)[:, :2]
    if true_points is not None:
        axes.plot(*true_points.T, "x", color=_INK, ms=6, mew=1.2, label="true landmarks", zorder=4)
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
    """Errors of x, y and heading over the steps, within ±n σ of the filter's own covariance."""
    error = np.asarray(truth.pose) - np.asarray(estimate.pose)
    error[:, 2] = np.asarray(wrap(error[:, 2]))
    cov = np.asarray(estimate.pose_cov)
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    figure, panels = _figure(7.0, 6.0, 3)
    step = np.arange(1, len(error) + 1)
    names = ("x error [m]", "y error [m]", "heading error [°]")
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        scale = np.rad2deg(1.0) if i == 2 else 1.0
        bound = n_sigma * scale * sigma[:, i]
        axes.fill_between(
            step, -bound, bound, color=COLORS[0], alpha=0.18, lw=0, label=f"±{n_sigma:g} σ claimed"
        )
        axes.plot(step, scale * error[:, i], color=COLORS[1], lw=1.0, label="truth - estimate")
        axes.axhline(0.0, color=_INK, lw=0.6)
        axes.set(ylabel=name)
    _caption(figure, title)
    panels[-1].set(xlabel="step", xlim=_span(len(error)))
    return figure


def nees_figure(campaign: Campaign, *, blocks: Sequence[str] = tuple(DOF)) -> Figure:
    """Average NEES over the steps for every filter of a campaign, with the 95 % chi-square band.

    The band is that of the filter with the most finite runs, the narrowest.
    """
    figure, panels = _figure(7.0, 1.9 * len(blocks) + 0.8, len(blocks))
    step = np.arange(1, campaign.steps + 1)
    most = max(campaign.filters.values(), key=lambda summary: summary.counts["runs"]).curves
    for axes, block in zip(panels, blocks, strict=True):
        low, high = most[f"nees_{block}_low"], most[f"nees_{block}_high"]
        axes.fill_between(
            step, low, high, color="#999999", alpha=0.45, lw=0, label="95 % band", zorder=1
        )
        axes.axhline(DOF[block], color=_INK, lw=0.6, zorder=1.5)
        for i, (name, summary) in enumerate(campaign.filters.items()):
            label = f"{name} ({summary.verdict})"
            _curve(axes, i, step, summary.curves[f"nees_{block}"], label)
        axes.set(ylabel=f"{block} NEES (dof {DOF[block]})")
        _logarithmic(axes)
    _caption(figure, f"{_head(campaign)}: NEES, average over {_runs(campaign)}")
    panels[-1].set(xlabel="step", xlim=_span(campaign.steps))
    return figure


def bound_figure(campaign: Campaign) -> Figure:
    """RMSE of position and heading over the steps for every filter, above the posterior Cramér-Rao
    bound where the campaign has one.

    Logarithmic where one filter's largest error is over ten times another's.
    """
    figure, panels = _figure(7.0, 4.8, 2)
    step = np.arange(1, campaign.steps + 1)
    quantities = (("position", "position RMSE [m]"), ("heading_deg", "heading RMSE [°]"))
    for axes, (key, named) in zip(panels, quantities, strict=True):
        peaks = []
        for i, (name, summary) in enumerate(campaign.filters.items()):
            curve = summary.curves[f"rmse_{key}"]
            _curve(axes, i, step, curve, name)
            peaks.append(np.max(curve, initial=0.0, where=np.isfinite(curve)))
        for summary in campaign.filters.values():
            bound = summary.curves.get(f"bound_{key}")
            if bound is not None:
                label = "Cramér-Rao bound"
                axes.plot(step, bound, color=_INK, lw=2.0, label=label, zorder=5, **_lone(bound))
                break
        axes.set(ylabel=named)
        there = [peak for peak in peaks if peak > 0]
        if there and max(there) > 10 * min(there):
            _logarithmic(axes)
        else:
            axes.axhline(0.0, lw=0)
            axes.set_ylim(bottom=0.0)
    _caption(figure, f"{_head(campaign)}: error against the bound, {_runs(campaign)}")
    panels[-1].set(xlabel="step", xlim=_span(campaign.steps))
    return figure


def coverage_figure(campaign: Campaign) -> Figure:
    """How often the truth lies in the ellipsoid of probability p, against p, for every filter.

    On the diagonal a filter is honest; below it is optimistic, above pessimistic.
    """
    figure, panels = _figure(7.0, 3.3, 1, len(DOF))
    for axes, block in zip(panels, DOF, strict=True):
        axes.plot([0, 1], [0, 1], color=_INK, lw=0.8, label="honest", zorder=1.5)
        for i, (name, summary) in enumerate(campaign.filters.items()):
            _curve(axes, i, np.asarray(LEVELS), summary.coverage[block], name, mark=2.2)
        ticks = np.linspace(0, 1, 5)
        axes.set(xlim=(0, 1), ylim=(0, 1), xticks=ticks, yticks=ticks, box_aspect=1)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_title(f"{block} (dof {DOF[block]})", fontsize="medium")
    panels[0].set(ylabel="share of truth within")
    panels[len(panels) // 2].set(xlabel="probability p of the ellipsoid")
    _caption(figure, f"{_head(campaign)}: coverage, {_runs(campaign)}")
    return figure


def whiteness_figure(campaign: Campaign) -> Figure:
    """Autocorrelation of whitened innovations against the lag for every filter; 0 is honest.

    The band is that of white innovations, the widest of the filters.
    """
    figure, (axes,) = _figure(7.0, 3.4, 1)
    axes.axhline(0.0, color=_INK, lw=0.8, zorder=1.5)
    extreme = 0.1
    widest = max(campaign.filters.values(), key=lambda s: np.nan_to_num(s.autocorrelation_band[0]))
    band = widest.autocorrelation_band
    every = np.arange(1, len(band) + 1)
    axes.fill_between(every, -band, band, color="#999999", alpha=0.35, lw=0, label="95 % band")
    for i, (name, summary) in enumerate(campaign.filters.items()):
        values = summary.autocorrelation
        lags = np.arange(1, len(values) + 1)
        _curve(axes, i, lags, values, name, mark=3.5)
        extreme = np.max(np.abs(values), initial=extreme, where=np.isfinite(values))
        axes.set(xticks=lags)
    axes.set(xlabel="lag [steps]", ylabel="autocorrelation", ylim=(-1.1 * extreme, 1.1 * extreme))
    _caption(figure, f"{_head(campaign)}: whiteness of innovations, {_runs(campaign)}")
    return figure


def gained_figure(campaign: Campaign) -> Figure:
    """Information wrongly gained along a turn of the whole frame over the steps; 0 is honest.

    Of the filters that were watched. Below 1e-6 / rad² (σ of 1000 rad, nothing) a curve runs in a
    strip of its own under the logarithmic axis, exact zeros and rounding alike.
    """
    figure, (axes,) = _figure(7.0, 3.6, 1)
    step = np.arange(1, campaign.steps + 1)
    key, top = "rotation_information", 1.0
    watched = [name for name, s in campaign.filters.items() if key in s.curves]
    strip = 1.0 + 0.15 * len(watched)
    for i, name in enumerate(campaign.filters):
        if name not in watched:
            continue
        values = campaign.filters[name].curves[key]
        lane = strip * (watched.index(name) + 1) / (len(watched) + 1)
        _curve(axes, i, step, np.where(values < _NOTHING, _NOTHING * 10**-lane, values), name)
        top = np.max(values, initial=top, where=np.isfinite(values))
    if not watched:
        axes.text(0.5, 0.6, "no filter was watched", transform=axes.transAxes, ha="center")
    axes.axhspan(_NOTHING * 10**-strip, _NOTHING, color="#999999", alpha=0.2, lw=0, zorder=1)
    last = int(np.ceil(np.log10(top)))
    powers = range(-6, last + 1, 2 if last < 8 else 4)
    axes.set(yscale="log", ylim=(_NOTHING * 10**-strip, 3 * top))
    axes.set_yticks(
        [_NOTHING * 10 ** (-strip / 2), *(10.0**k for k in powers)],
        ["nothing", *(f"$10^{{{k}}}$" for k in powers)],
    )
    axes.set_yticks([], minor=True)
    axes.set(xlabel="step", xlim=_span(campaign.steps), ylabel="information [1/rad²]")
    _caption(figure, f"{_head(campaign)}: learnt of a turn of the whole frame, {_runs(campaign)}")
    return figure


def png(figure: Figure, dpi: float = 180) -> bytes:
    """The figure as a PNG file, dpi dots an inch."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()


def describe(figure: Figure) -> str:
    """What the figure shows, in a sentence, for those who cannot see it."""
    panels = [" ".join(filter(None, (a.get_title(), a.get_ylabel()))) for a in figure.axes]
    across = next(filter(None, (a.get_xlabel() for a in figure.axes)), "")
    legends = [*figure.legends, *filter(None, (a.get_legend() for a in figure.axes))]
    named = [text.get_text() for legend in legends for text in legend.get_texts()]
    said = f"{'; '.join(filter(None, panels))} against {across}"
    return (f"{said}. Drawn: {', '.join(named)}." if named else f"{said}.").replace(r"\$", "$")


def _figure(width: float, height: float, rows: int, columns: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=columns > 1, squeeze=False)
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#dddddd", lw=0.5)
        axes.set_axisbelow(True)
    return figure, list(grid.flat)


def _curve(
    axes: Axes, i: int, x: np.ndarray, y: np.ndarray, label: str, *, mark: float = 0.0
) -> None:
    """The line of filter number i; marks of that size in points, and where a line needs them."""
    dashes = _DASHES[i // _HUES % len(_DASHES)]
    marks: dict[str, Any] = {"marker": _MARKS[i // _HUES % len(_MARKS)], "ms": mark or 3.0}
    axes.plot(
        x,
        y,
        color=COLORS[i % _HUES],
        ls=dashes,
        lw=1.2,
        label=_plain(label),
        zorder=3 + 0.01 * i,
        **(marks if mark else _lone(y)),
    )


def _lone(y: np.ndarray) -> dict[str, Any]:
    """A marker for curves of a single number, which have no line."""
    return {"marker": "o", "ms": 3.0} if np.isfinite(y).sum() == 1 else {}


def _plain(name: str) -> str:
    """A name as it stands: no mathematics in it, and not hidden from the legend."""
    name = name.replace("$", r"\$")
    return f" {name}" if name.startswith("_") else name


def _head(campaign: Campaign) -> str:
    return _plain(campaign.scenario)


def _runs(campaign: Campaign) -> str:
    return f"{campaign.runs:,} run{'s' if campaign.runs != 1 else ''}"


def _logarithmic(axes: Axes) -> None:
    """A logarithmic ordinate with plain numbers; minor ticks have some where decades are few."""
    axes.set_yscale("log", nonpositive="mask")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(_few_digits if high < 100 * low else "")


def _caption(figure: Figure, title: str) -> None:
    """Title and legend above the panels, clear of the curves; the figure grows with its rows."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    width = 72 * figure.get_figwidth()
    columns = 1
    for more in range(2, min(len(labels), 6) + 1):
        parts = np.array_split(np.array([len(label) for label in labels]), more)
        if sum(4.4 * part.max() + 40 for part in parts) < width:
            columns = more
    figure.set_figheight(figure.get_figheight() + 0.17 * (-(-len(labels) // columns) - 1))
    legend = figure.legend(
        handles,
        labels,
        loc="outside upper left",
        title=title or None,
        alignment="left",
        frameon=False,
        ncols=columns,
        fontsize=8,
        title_fontsize=10.5,
        columnspacing=1.4,
        handlelength=2.4,
    )
    for line in legend.get_lines():
        line.set_linewidth(1.6)


def _few_digits(x: float, _: float) -> str:
    """Minor ticks of a logarithmic axis: 2 and 5 of each decade."""
    return f"{x:g}" if f"{x:.0e}"[0] in "25" else ""


def _span(steps: int) -> tuple[float, float]:
    """The first to the last step, and room for a single one."""
    return (1, steps) if steps > 1 else (0.5, 1.5)


def _extent(*clouds: np.ndarray) -> float:
    """The larger side of the box around some points, or 1 where it has no size."""
    every = np.concatenate([cloud[:, :2] for cloud in clouds])
    return float(np.ptp(every, axis=0).max()) or 1.0


def _heading_mark(axes: Axes, pose: np.ndarray, extent: float) -> None:
    """A triangle where the robot ends, pointing ahead."""
    size = 0.022 * extent
    shape = size * np.array([[1.2, 0.0], [-0.6, 0.6], [-0.6, -0.6], [1.2, 0.0]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = shape @ np.array([[c, s], [-s, c]]) + pose[:2]
    axes.fill(*corners.T, color=COLORS[0], zorder=6)
