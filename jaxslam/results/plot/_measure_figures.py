"""Figures of a campaign's filters: NEES, errors, coverage, whiteness, information gained, cost."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency import Average
from jaxslam.consistency._intervals import EACH, percentage
from jaxslam.consistency._measures import REGISTRY, in_figure
from jaxslam.consistency._measures.coverage import LEVELS
from jaxslam.consistency._measures.errors import bound_curve
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency.campaign import Campaign
from jaxslam.core.validation import instance_of, refusals_of, require
from jaxslam.results.plot._panels import (
    TOGETHER,
    add_legends,
    common_top,
    kinds_of,
    mark_beyond,
    nees_scale,
    numbers_of,
    power,
    scale_setters,
    set_positive,
    sheet,
    title_of,
)
from jaxslam.results.plot._style import (
    INK,
    PAGE,
    RULE,
    TEXT,
    Look,
    band,
    caption,
    curve,
    escape_name,
    look,
    own_settings,
    panels_of,
    step_limits,
)

_NOTHING = 1e-6
"""Information on a heading below which it counts as zero: σ of 1000 rad [1/rad²]."""

_STRIP = 0.2
"""Share of the height of a panel in which values below `_NOTHING` are drawn."""

_ASIDE = 0.12
"""Distance of two filters at the same lag [steps]."""


@own_settings()
def nees_figure(
    campaign: Campaign, *, blocks: Sequence[str] = tuple(DOF), width: float = PAGE
) -> Figure:
    """Average NEES over the steps for every filter of a campaign, with the 95 % chi-square band.

    The band is that of the filter with the most finite runs, the narrowest. More than five filters
    are drawn in a row of panels for each kind of filter of the catalog. The scale ends at 100
    times dof, or lower if the band would be too narrow to be seen; marks at the edge are of
    larger values, and the largest is written above. width [in]: `COLUMN` for a paper.
    """
    titles = [REGISTRY[f"nees_{block}"].axis for block in blocks]
    figure, rows = sheet(campaign, titles, width=width)
    step = np.arange(1, campaign.steps + 1)
    most_runs = max(campaign.filters.values(), key=lambda summary: summary.counts["runs"])
    for axes, block in zip(rows[0].panels, blocks, strict=True):
        nees_scale(axes, campaign, block)
    for row in rows:
        for axes, block in zip(row.panels, blocks, strict=True):
            low, high = (most_runs.curves[f"nees_{block}_{end}"] for end in ("low", "high"))
            band(axes, step, low, high, "95 % band")
            axes.axhline(DOF[block], color=INK, lw=0.8, zorder=1.5, label="honest")
            for name, i in row.names.items():
                summary = campaign.filters[name]
                label = f"{name} ({summary.verdict}{'*' * bool(summary.doubts)})"
                curve(axes, i, step, summary.curves[f"nees_{block}"], label, absent="no NEES")
            axes.set_xlim(step_limits(campaign.steps))
            mark_beyond(axes)
    add_legends(figure, rows, title_of(campaign, "NEES, average over"), "step")
    return figure


@own_settings()
def rmse_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """RMSE of position and heading over the steps, with the conditional Cramér-Rao bound if known.

    Other measures with the figure "rmse" have a panel, too.

    More than five filters are drawn by kind. Filters that fuse no measurement, that are inaccurate,
    or whose error is over three times the median do not set the scale: larger values have marks at
    the edge, and the largest value is written above. width [in].
    """
    summaries = list(campaign.filters.values())
    measures = [m for m in in_figure("rmse") if any(m.key in s.curves for s in summaries)]
    figure, rows = sheet(campaign, [measure.axis for measure in measures], width=width)
    step = np.arange(1, campaign.steps + 1)
    setters = scale_setters(campaign)
    nothing = np.full(campaign.steps, np.nan)
    for j, measure in enumerate(measures):
        curves = {n: s.curves.get(measure.key, nothing) for n, s in campaign.filters.items()}
        key = bound_curve(measure)
        bounds = [s.curves[key] for s in summaries if key in s.curves][:1]
        top = common_top({name: _peak(values) for name, values in curves.items()}, setters)
        top = max(top, *map(_peak, bounds), 0.0)
        for row in rows:
            axes = row.panels[j]
            axes.set(xlim=step_limits(campaign.steps), ylim=(0.0, 1.06 * top or 1.0))
            for name, i in row.names.items():
                curve(axes, i, step, curves[name], name)
            for bound in bounds:
                # A single value would be no line.
                marker = "o" if np.isfinite(bound).sum() == 1 else ""
                style: Look = {"color": INK, "lw": 2.0, "zorder": 2.5, "marker": marker}
                axes.plot(step, bound, label="conditional Cramér-Rao bound", **style)
            mark_beyond(axes)
    add_legends(figure, rows, title_of(campaign, "error, average over"), "step")
    return figure


@own_settings()
def coverage_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """Share of steps with the truth in the ellipsoid of probability p, against p.

    A consistent filter is on the diagonal; an optimistic one is below, a pessimistic one above.
    More than five filters are drawn by kind. width [in].
    """
    titles = [f"{block} (dof {dof})" for block, dof in DOF.items()]
    height = (width - 0.95) / len(DOF) + 0.44
    figure, rows = sheet(campaign, titles, width=width, height=height, across=True)
    ticks = np.linspace(0, 1, 5 if width > 5 else 3)
    for row in rows:
        for axes, block in zip(row.panels, DOF, strict=True):
            axes.plot([0, 1], [0, 1], color=INK, lw=0.8, label="honest", zorder=1.5)
            for name, i in row.names.items():
                share = campaign.filters[name].coverage[block]
                curve(axes, i, np.asarray(LEVELS), share, name)
            axes.set(xlim=(0, 1), ylim=(0, 1), xticks=ticks, yticks=ticks)
            axes.xaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_major_formatter("{x:g}")
            if not row.kind:
                axes.set(box_aspect=1, anchor="N")
    if not rows[0].kind:
        rows[0].panels[0].set_ylabel("share of truth within")
    add_legends(
        figure,
        rows,
        title_of(campaign, "share of the truth within an ellipsoid,"),
        "probability p" if width > 5 else "p",
    )
    return figure


@own_settings()
def whiteness_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """Autocorrelation of normalized innovations against the lag; 0 for a consistent filter.

    The band is that of white innovations, the widest of the filters. A filter without innovations
    is named, without a curve. Curves are shifted a little sideways, so that none hides another.
    More than five filters are drawn by kind. width [in].
    """
    figure, rows = sheet(campaign, ["autocorrelation"], width=width, height=2.4)
    summaries = campaign.filters.values()
    bands = (s.autocorrelation_band for s in summaries)
    widest = max(bands, key=lambda half_width: np.nan_to_num(half_width[0]))
    least = 1.5 * _peak(widest) or 0.1  # the band is seen
    extreme = max(least, *(_peak(np.abs(s.autocorrelation)) for s in summaries))
    for row in rows:
        (axes,) = row.panels
        axes.axhline(0.0, color=INK, lw=0.8, zorder=1.5)
        lags = np.arange(1, len(widest) + 1)
        # The band ends half a lag beside the first and the last one, so that one lag has a band.
        ends = np.concatenate([[lags[0] - 0.5], lags, [lags[-1] + 0.5]])
        wide = np.interp(ends, lags, widest)
        band(axes, ends, -wide, wide, "95 % band")
        drawn = [n for n in row.names if np.isfinite(campaign.filters[n].autocorrelation).any()]
        for name, i in row.names.items():
            values = campaign.filters[name].autocorrelation
            lags = np.arange(1, len(values) + 1)
            place = drawn.index(name) if name in drawn else 0
            aside = _ASIDE * (place - (len(drawn) - 1) / 2)
            curve(axes, i, lags + aside, values, name, absent="no innovations")
        axes.set(xticks=lags, ylim=(-1.1 * extreme, 1.1 * extreme))
    title = title_of(campaign, "whiteness of innovations,")
    add_legends(figure, rows, title, "lag [steps]")
    return figure


@own_settings()
def gained_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """Spurious information on the rotation of the whole frame over the steps; 0 is consistent.

    Only filters with an observability monitor have it; the others are named in the title. Values
    below 1e-6 / rad² (σ of 1000 rad), zeros and rounding errors alike, are drawn in a strip below
    the logarithmic axis, each filter at a different height. More than five filters are drawn by
    kind. width [in].
    """
    with refusals_of("gained_figure"):
        require("campaign", campaign, instance_of(Campaign))
    key = "rotation_information"
    curves = {name: s.curves[key] for name, s in campaign.filters.items() if key in s.curves}
    others = [name for name in campaign.filters if name not in curves]
    figure, rows = sheet(campaign, [REGISTRY[key].axis], width=width, height=2.6, only=curves)
    top = 3 * max([1.0, *(_peak(values) for values in curves.values())])
    decades = np.log10(top / _NOTHING)
    strip = decades * _STRIP / (1 - _STRIP)
    step = np.arange(1, campaign.steps + 1)
    for row in rows:
        (axes,) = row.panels
        for place, (name, i) in enumerate(row.names.items(), start=1):
            lane = _NOTHING * 10 ** (-strip * place / (len(row.names) + 1))
            values = curves[name]
            curve(axes, i, step, np.where(values < _NOTHING, lane, values), name)
        axes.axhspan(_NOTHING * 10**-strip, _NOTHING, color=RULE, alpha=0.5, lw=0, zorder=1)
        axes.axhline(_NOTHING, color=INK, lw=0.5, zorder=1.5)
        axes.set(yscale="log", xlim=step_limits(campaign.steps), ylim=(_NOTHING * 10**-strip, top))
        # Three or four powers of ten, and the strip.
        apart = max(2, int(np.ceil((decades - 1) / 4)))
        powers = np.arange(-6 + apart, -6 + decades, apart)
        axes.set_yticks(
            [_NOTHING * 10 ** (-strip / 2), *(10.0**powers)],
            ["$< 10^{-6}$", *(f"$10^{{{k:.0f}}}$" for k in powers)],
        )
        axes.set_yticks([], minor=True)
    if not curves:
        text = "no filter has an observability monitor (filters.Monitored)"
        axes.text(0.5, 0.6, text, transform=axes.transAxes, ha="center", fontsize=8)
    title = title_of(campaign, "information gained on a turn of the whole frame,")
    title += f". Not monitored: {', '.join(map(escape_name, others))}" * bool(others and curves)
    add_legends(figure, rows, title, "step")
    return figure


def _peak(values: np.ndarray) -> float:
    """The largest finite value that is not negative, or 0."""
    return float(np.max(values, initial=0.0, where=np.isfinite(values)))


_ERROR, _NEES = "rmse_position", "nees_pose"

_LABELS = {key: REGISTRY[key].axis for key in (_ERROR, _NEES)}

_NONE = Average(np.nan, np.nan, np.nan)

_CAP = 100.0
"""End of the scale of the NEES, in multiples of dof."""

_WIDE = 10.0
"""Largest factor by which ends of intervals extend a scale beyond the values."""

INTERVAL = "interval"
"""`gid` of the lines of intervals, and of the arrows where they leave the scale."""


@own_settings()
def cost_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """Time of a step, position error and pose NEES of every filter: a row each, by kind.

    Error and NEES have their 97.5 % intervals, with an arrow where one leaves the scale. A NEES
    over 100 times dof is marked at the edge. Filters that were not timed have no point. width [in];
    at least that of a page for more than five filters.
    """
    with refusals_of("cost_figure"):
        require("campaign", campaign, instance_of(Campaign))
    times = {name: 1e6 * campaign.step_seconds.get(name, np.nan) for name in campaign.filters}
    numbers, few = numbers_of(list(times)), len(times) <= TOGETHER
    groups = [("", list(times))] if few else kinds_of(list(times))
    rows = len(times) + len(groups) - 1  # an empty row between two kinds
    width = width if few else max(width, PAGE)
    figure, panels = panels_of(width, 0.145 * rows + 0.9, 1, 3, share=(False, True))
    for axes in panels:
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
    _scale(panels[0], np.array(list(times.values())))
    for axes, key in zip(panels[1:], _LABELS, strict=True):
        _scale(axes, _values(campaign, key))
    names, heights, middle, at = [], [], [], 0
    for _, members in groups:
        middle.append(at + (len(members) - 1) / 2)
        for name in members:
            i, measures = numbers[name], campaign.filters[name].measures
            _point(panels[0], i, at, name, Average(times[name], np.nan, np.nan))
            for axes, key in zip(panels[1:], _LABELS, strict=True):
                _point(axes, i, at, name, measures.get(key, _NONE))
            names.append(escape_name(name))
            heights.append(at)
            at += 1
        at += 1
    panels[0].set_yticks(heights, names)
    panels[0].set_ylim(at - 1.4, -0.6)
    if not few:
        kinds = panels[-1].secondary_yaxis("right")
        kinds.set_yticks(middle, [kind.replace(" ", "\n") for kind, _ in groups])
        kinds.tick_params(labelsize=TEXT, length=0, pad=8)
        kinds.spines["right"].set_visible(False)
    timed = np.isfinite(list(times.values())).any()
    titles = ("time of a step [µs]" if timed else "no filter was timed", *_LABELS.values())
    for axes, text in zip(panels, titles, strict=True):
        axes.set_xlabel(text if width >= PAGE else text.replace(" [", "\n[").replace(" (", "\n("))
    honest = panels[2].axvline(DOF["pose"], color=INK, lw=0.8, zorder=1.5, label="honest")
    subject = f"error and NEES, with {percentage(EACH, 1)} intervals, and the time of a step,"
    caption(figure, title_of(campaign, subject), [honest])
    return figure


def _point(axes: Axes, i: int, at: float, name: str, measure: Average) -> None:
    """Draw a measure with its interval at a height; a triangle with its value beyond the scale."""
    value = measure.value
    if not np.isfinite(value):
        return
    left, right = axes.get_xlim()
    style = look(i)
    if np.isfinite(measure.low):
        line: Look = {"color": style["color"], "gid": INTERVAL, "zorder": 2.8}
        axes.plot(np.clip(measure[1:], left, right), np.full(2, at), lw=1.0, **line)
        # An arrow where the interval leaves the scale.
        if measure.low < left:
            axes.plot(left, at, "<", ms=3.5, mew=0, clip_on=False, **line)
        if measure.high > right:
            axes.plot(right, at, ">", ms=3.5, mew=0, clip_on=False, **line)
    if value > right:
        axes.plot(right, at, ">", color=style["color"], mec=INK, mew=0.4, ms=5.0, clip_on=False)
        axes.annotate(
            power(value),
            (right, at),
            (-6, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=7,
            color=INK,
            bbox={"fc": "white", "ec": "none", "pad": 0.5},
        )
        return
    mark: Look = {key: style[key] for key in ("color", "marker", "mec", "mew")}
    axes.plot(value, at, ms=5.0, label=escape_name(name), **mark)


def _values(campaign: Campaign, key: str) -> np.ndarray:
    """The numbers that set the scale of a measure: values, and ends of intervals."""
    # Rows (value, low, high).
    averages = np.array([s.measures.get(key, _NONE) for s in campaign.filters.values()])
    if key == _NEES:  # the honest value is on the scale, too
        averages = np.minimum([*averages, [DOF["pose"]] * 3], _CAP * DOF["pose"])
    values: np.ndarray = averages[np.isfinite(averages[:, 0]) & (averages[:, 0] > 0), 0]
    if not values.size:
        return values
    ends = averages[:, 1:][np.isfinite(averages[:, 1:])]
    return np.concatenate([values, ends.clip(values.min() / _WIDE, _WIDE * values.max())])


def _scale(axes: Axes, values: np.ndarray) -> None:
    """Set the abscissa for some values, none of them on the frame."""
    shown = values[np.isfinite(values) & (values > 0)]
    if shown.size:
        set_positive(axes, shown.min(), shown.max(), "x", margin=0.12, linear=3.0)
