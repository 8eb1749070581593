"""Figures of a filter's errors against the time of its steps."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency import DOF, Average
from jaxslam.consistency.measures import REGISTRY
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.campaigns.layout import TOGETHER, head, kinds_of, numbers_of, runs_of
from jaxslam.results.plot.campaigns.scale import mark_beyond, power, set_positive
from jaxslam.results.plot.style import (
    INK,
    PAGE,
    TEXT,
    Look,
    caption,
    curve,
    every_handle,
    look,
    ordinate,
    panels_of,
    plain,
)
from jaxslam.validation import check_record

_ERROR, _NEES = "rmse_position", "nees_pose"

_LABELS = {key: REGISTRY[key].axis for key in (_ERROR, _NEES)}

_NONE = Average(np.nan, np.nan, np.nan)

_CAP = 100.0
"""The scale of the NEES ends at so many times dof."""

_WIDE = 10.0
"""Ends of intervals set a scale up to so many times the largest value, and down to as little."""

INTERVAL = "interval"
"""`gid` of the lines of intervals, and of the arrows where they leave the scale."""


def cost_figure(campaign: Campaign, *, width: float = PAGE) -> Figure:
    """Position error and pose NEES of every filter against the time of a step.

    Error and NEES have their 95 % intervals, with an arrow where one leaves the scale. More than
    five filters are listed, a row each, with columns of time, error and NEES. A NEES over 100 times
    dof is marked at the edge. Filters that were not timed are named only. width [in].
    """
    check_record("cost_figure", "the first argument", campaign, Campaign)
    times = {name: 1e6 * campaign.step_seconds.get(name, np.nan) for name in campaign.filters}
    if len(times) > TOGETHER:
        return _listed(campaign, times, max(width, PAGE))
    figure, panels = panels_of(width, 0.4 * width + 1.4, 2)
    for axes, (key, named) in zip(panels, _LABELS.items(), strict=True):
        _scale(axes, _values(campaign, key), "y")
        for i, (name, summary) in enumerate(campaign.filters.items()):
            x, measure = times[name], summary.measures.get(key, _NONE)
            absent = "no value" if np.isfinite(x) else "not timed"
            curve(axes, i, np.array([x]), np.array([measure.value]), name, absent=absent)
            axes.lines[-1].set(markersize=7.0, linestyle="none")
            _interval(axes, x, measure, look(i)["color"], "y")
        ordinate(axes, named, 0.2 * width + 0.3)
    honest = panels[-1].axhline(DOF["pose"], color=INK, lw=0.8, zorder=1.5, label="honest")
    panels[-1].set_xlabel("time of a step [µs]")
    if np.isfinite(list(times.values())).any():
        _scale(panels[-1], np.array(list(times.values())), "x")
        for axes in panels:
            mark_beyond(axes)
    else:
        said = "no filter was timed"
        panels[0].text(0.5, 0.5, said, transform=panels[0].transAxes, ha="center", fontsize=TEXT)
    caption(figure, _title(campaign), [*every_handle(panels[:1]), honest])
    return figure


def _listed(campaign: Campaign, times: dict[str, float], width: float) -> Figure:
    """The figure with a row for each filter, by kind."""
    groups = kinds_of(list(times))
    rows = len(times) + len(groups) - 1  # an empty one between two kinds
    figure, panels = panels_of(width, 0.145 * rows + 0.9, 1, 3, share=(False, True))
    for axes in panels:
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
    _scale(panels[0], np.array(list(times.values())), "x")
    for axes, key in zip(panels[1:], _LABELS, strict=True):
        _scale(axes, _values(campaign, key), "x")
    names, heights, middle, at = [], [], [], 0
    numbers = numbers_of(list(times))
    for _, members in groups:
        middle.append(at + (len(members) - 1) / 2)
        for name in members:
            i, measures = numbers[name], campaign.filters[name].measures
            _point(panels[0], i, at, name, Average(times[name], np.nan, np.nan))
            for axes, key in zip(panels[1:], _LABELS, strict=True):
                _point(axes, i, at, name, measures.get(key, _NONE))
            names.append(plain(name))
            heights.append(at)
            at += 1
        at += 1
    panels[0].set_yticks(heights, names)
    panels[0].set_ylim(at - 1.4, -0.6)
    kinds = panels[-1].secondary_yaxis("right")
    kinds.set_yticks(middle, [kind.replace(" ", "\n") for kind, _ in groups])
    kinds.tick_params(labelsize=TEXT, length=0, pad=8)
    kinds.spines["right"].set_visible(False)
    timed = np.isfinite(list(times.values())).any()
    panels[0].set_xlabel("time of a step [µs]" if timed else "no filter was timed")
    for axes, named in zip(panels[1:], _LABELS.values(), strict=True):
        axes.set_xlabel(named)
    honest = panels[2].axvline(DOF["pose"], color=INK, lw=0.8, zorder=1.5, label="honest")
    caption(figure, f"{_title(campaign)}", [honest])
    return figure


def _point(axes: Axes, i: int, at: float, name: str, measure: Average) -> None:
    """Draw a measure with its interval at a height; beyond the scale a triangle with its value."""
    value = measure.value
    if not np.isfinite(value):
        return
    _, right = axes.get_xlim()
    style = look(i)
    _interval(axes, at, measure, style["color"], "x")
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
    axes.plot(value, at, ms=5.0, label=plain(name), **mark)


def _interval(axes: Axes, at: float, measure: Average, color: str, which: str) -> None:
    """Draw the interval of a measure along an axis (x or y); an arrow where it leaves the scale."""
    if not np.isfinite([at, measure.value, measure.low]).all():
        return
    ends = axes.get_xlim() if which == "x" else axes.get_ylim()
    shown = np.clip(measure[1:], *ends)
    style: Look = {"color": color, "gid": INTERVAL, "zorder": 2.8}
    across = np.full(2, at)
    axes.plot(*((shown, across) if which == "x" else (across, shown)), lw=1.0, **style)
    cut = (measure.low < ends[0], measure.high > ends[1])
    for end, mark, beyond in zip(ends, "<>" if which == "x" else "v^", cut, strict=True):
        if beyond:
            place = (end, at) if which == "x" else (at, end)
            axes.plot(*place, mark, ms=3.5, mew=0, clip_on=False, **style)


def _values(campaign: Campaign, key: str) -> np.ndarray:
    """What sets the scale of a measure: values and ends of intervals, not the extreme ones."""
    found = np.array([s.measures.get(key, _NONE) for s in campaign.filters.values()])
    if key == _NEES:
        found = np.minimum([*found, [DOF["pose"]] * 3], _CAP * DOF["pose"])
    values: np.ndarray = found[np.isfinite(found[:, 0]) & (found[:, 0] > 0), 0]
    if not values.size:
        return values
    ends = found[:, 1:][np.isfinite(found[:, 1:])]
    return np.concatenate([values, ends.clip(values.min() / _WIDE, _WIDE * values.max())])


def _scale(axes: Axes, values: np.ndarray, which: str) -> None:
    """Set an axis for some values, none of them on the frame."""
    there = values[np.isfinite(values) & (values > 0)]
    if there.size:
        set_positive(axes, there.min(), there.max(), which, margin=0.12, linear=3.0)


def _title(campaign: Campaign) -> str:
    what = "error and NEES, with 95 % intervals, against the time of a step"
    return f"{head(campaign)}: {what}, {runs_of(campaign)}"
