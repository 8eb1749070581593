"""Figures of a filter's errors against the time of its steps."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency import DOF, Average
from jaxslam.consistency.campaign import Campaign
from jaxslam.consistency.measures import REGISTRY
from jaxslam.core.validation import check_record
from jaxslam.results.plot.campaigns.layout import TOGETHER, head, kinds_of, numbers_of, runs_of
from jaxslam.results.plot.campaigns.scale import power, set_positive
from jaxslam.results.plot.style import (
    INK,
    PAGE,
    TEXT,
    Look,
    caption,
    look,
    panels_of,
    plain,
)

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
    """Time of a step, position error and pose NEES of every filter: a row each, by kind.

    Error and NEES have their 95 % intervals, with an arrow where one leaves the scale. A NEES over
    100 times dof is marked at the edge. Filters that were not timed have no point. width [in]; of
    more than five filters that of a page at least.
    """
    check_record("cost_figure", "the first argument", campaign, Campaign)
    times = {name: 1e6 * campaign.step_seconds.get(name, np.nan) for name in campaign.filters}
    numbers, few = numbers_of(list(times)), len(times) <= TOGETHER
    groups = [("", list(times))] if few else kinds_of(list(times))
    rows = len(times) + len(groups) - 1  # an empty one between two kinds
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
            names.append(plain(name))
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
    said = ("time of a step [µs]" if timed else "no filter was timed", *_LABELS.values())
    for axes, text in zip(panels, said, strict=True):
        axes.set_xlabel(text if width >= PAGE else text.replace(" [", "\n[").replace(" (", "\n("))
    honest = panels[2].axvline(DOF["pose"], color=INK, lw=0.8, zorder=1.5, label="honest")
    what = "error and NEES, with 95 % intervals, and the time of a step"
    caption(figure, f"{head(campaign)}: {what}, {runs_of(campaign)}", [honest])
    return figure


def _point(axes: Axes, i: int, at: float, name: str, measure: Average) -> None:
    """Draw a measure with its interval at a height; beyond the scale a triangle with its value."""
    value = measure.value
    if not np.isfinite(value):
        return
    _, right = axes.get_xlim()
    style = look(i)
    _interval(axes, at, measure, style["color"])
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


def _interval(axes: Axes, at: float, measure: Average, color: str) -> None:
    """Draw the interval of a measure at a height; an arrow where it leaves the scale."""
    if not np.isfinite([measure.value, measure.low]).all():
        return
    ends = axes.get_xlim()
    style: Look = {"color": color, "gid": INTERVAL, "zorder": 2.8}
    axes.plot(np.clip(measure[1:], *ends), np.full(2, at), lw=1.0, **style)
    cut = (measure.low < ends[0], measure.high > ends[1])
    for end, mark, beyond in zip(ends, "<>", cut, strict=True):
        if beyond:
            axes.plot(end, at, mark, ms=3.5, mew=0, clip_on=False, **style)


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


def _scale(axes: Axes, values: np.ndarray) -> None:
    """Set the abscissa for some values, none of them on the frame."""
    there = values[np.isfinite(values) & (values > 0)]
    if there.size:
        set_positive(axes, there.min(), there.max(), "x", margin=0.12, linear=3.0)
