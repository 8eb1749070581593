"""Figures of a campaign's filters: errors, cost, coverage, whiteness, information gained."""

import numpy as np
from matplotlib.figure import Figure

from jaxslam.consistency import DOF, LEVELS
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.style import (
    INK,
    caption,
    curve,
    few_digits,
    head,
    logarithmic,
    lone_mark,
    panels_of,
    runs_of,
    span,
)

_NOTHING = 1e-6
"""Information on a heading that counts as none, σ being 1000 rad [1/rad²]."""


def bound_figure(campaign: Campaign) -> Figure:
    """RMSE of position and heading over the steps, with the conditional Cramér-Rao bound if known.

    Logarithmic where one filter's largest error is over ten times another's.
    """
    figure, panels = panels_of(7.0, 4.8, 2)
    step = np.arange(1, campaign.steps + 1)
    quantities = (("position", "position RMSE [m]"), ("heading_deg", "heading RMSE [°]"))
    for axes, (key, named) in zip(panels, quantities, strict=True):
        peaks = []
        for i, (name, summary) in enumerate(campaign.filters.items()):
            values = summary.curves[f"rmse_{key}"]
            curve(axes, i, step, values, name)
            peaks.append(np.max(values, initial=0.0, where=np.isfinite(values)))
        for summary in campaign.filters.values():
            bound = summary.curves.get(f"bound_{key}")
            if bound is not None:
                label = "conditional Cramér-Rao bound"
                axes.plot(step, bound, color=INK, lw=2.0, label=label, zorder=5, **lone_mark(bound))
                break
        axes.set(ylabel=named)
        there = [peak for peak in peaks if peak > 0]
        if there and max(there) > 10 * min(there):
            logarithmic(axes)
        else:
            axes.axhline(0.0, lw=0)
            axes.set_ylim(bottom=0.0)
    known = any("bound_position" in summary.curves for summary in campaign.filters.values())
    said = "error against the bound" if known else "error"
    caption(figure, f"{head(campaign)}: {said}, {runs_of(campaign)}")
    panels[-1].set(xlabel="step", xlim=span(campaign.steps))
    return figure


def cost_figure(campaign: Campaign) -> Figure:
    """Position error and pose NEES of every filter against the time of a step.

    Filters that were not timed appear in the legend only.
    """
    figure, panels = panels_of(7.0, 4.6, 2)
    times = [1e6 * campaign.step_seconds.get(name, np.nan) for name in campaign.filters]
    quantities = (
        ("rmse_position", "position RMSE [m]"),
        ("nees_pose", f"pose NEES (dof {DOF['pose']})"),
    )
    for axes, (key, named) in zip(panels, quantities, strict=True):
        for i, (name, summary) in enumerate(campaign.filters.items()):
            y = summary.measures[key].value if key in summary.measures else np.nan
            curve(axes, i, np.array(times[i : i + 1]), np.array([y]), name, mark=6.0)
        axes.set(ylabel=named)
        if np.isfinite(times).any():
            logarithmic(axes)
    panels[-1].axhline(DOF["pose"], color=INK, lw=0.8, zorder=1.5)
    panels[-1].set(xlabel="time of a step [µs]")
    if np.isfinite(times).any():
        if any(np.isfinite(axes.dataLim.minposx) for axes in panels):  # else there is no mark
            panels[-1].set(xscale="log")
        panels[-1].xaxis.set_major_formatter("{x:g}")
        near = np.nanmax(times) < 100 * np.nanmin(times)
        panels[-1].xaxis.set_minor_formatter(few_digits if near else "")
    else:
        said = "no filter was timed"
        panels[0].text(0.5, 0.5, said, transform=panels[0].transAxes, ha="center")
    caption(figure, f"{head(campaign)}: what a step costs, and what it gives, {runs_of(campaign)}")
    return figure


def coverage_figure(campaign: Campaign) -> Figure:
    """Share of steps with the truth in the ellipsoid of probability p, against p.

    A consistent filter is on the diagonal; an optimistic one is below, a pessimistic one above.
    """
    figure, panels = panels_of(7.0, 3.3, 1, len(DOF))
    for axes, block in zip(panels, DOF, strict=True):
        axes.plot([0, 1], [0, 1], color=INK, lw=0.8, label="honest", zorder=1.5)
        for i, (name, summary) in enumerate(campaign.filters.items()):
            curve(axes, i, np.asarray(LEVELS), summary.coverage[block], name, mark=2.2)
        ticks = np.linspace(0, 1, 5)
        axes.set(xlim=(0, 1), ylim=(0, 1), xticks=ticks, yticks=ticks, box_aspect=1)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_title(f"{block} (dof {DOF[block]})", fontsize="medium")
    panels[0].set(ylabel="share of truth within")
    panels[len(panels) // 2].set(xlabel="probability p of the ellipsoid")
    caption(figure, f"{head(campaign)}: coverage, {runs_of(campaign)}")
    return figure


def whiteness_figure(campaign: Campaign) -> Figure:
    """Autocorrelation of normalized innovations against the lag; that of a consistent filter is 0.

    The band is that of white innovations, the widest of the filters.
    """
    figure, (axes,) = panels_of(7.0, 3.4, 1)
    axes.axhline(0.0, color=INK, lw=0.8, zorder=1.5)
    extreme = 0.1
    widest = max(campaign.filters.values(), key=lambda s: np.nan_to_num(s.autocorrelation_band[0]))
    band = widest.autocorrelation_band
    every = np.arange(1, len(band) + 1)
    axes.fill_between(every, -band, band, color="#999999", alpha=0.35, lw=0, label="95 % band")
    for i, (name, summary) in enumerate(campaign.filters.items()):
        values = summary.autocorrelation
        lags = np.arange(1, len(values) + 1)
        curve(axes, i, lags, values, name, mark=3.5)
        extreme = np.max(np.abs(values), initial=extreme, where=np.isfinite(values))
        axes.set(xticks=lags)
    axes.set(xlabel="lag [steps]", ylabel="autocorrelation", ylim=(-1.1 * extreme, 1.1 * extreme))
    caption(figure, f"{head(campaign)}: whiteness of innovations, {runs_of(campaign)}")
    return figure


def gained_figure(campaign: Campaign) -> Figure:
    """Spurious information on the rotation of the whole frame over the steps; 0 is consistent.

    It is shown of filters with an observability monitor. Values below 1e-6 / rad² (σ of 1000 rad),
    zeros and rounding errors alike, are drawn in a strip below the logarithmic axis.
    """
    figure, (axes,) = panels_of(7.0, 3.6, 1)
    step = np.arange(1, campaign.steps + 1)
    key, top = "rotation_information", 1.0
    watched = [name for name, s in campaign.filters.items() if key in s.curves]
    strip = 1.0 + 0.15 * len(watched)
    for i, name in enumerate(campaign.filters):
        if name not in watched:
            continue
        values = campaign.filters[name].curves[key]
        lane = strip * (watched.index(name) + 1) / (len(watched) + 1)
        curve(axes, i, step, np.where(values < _NOTHING, _NOTHING * 10**-lane, values), name)
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
    axes.set(xlabel="step", xlim=span(campaign.steps), ylabel="information [1/rad²]")
    caption(figure, f"{head(campaign)}: learnt of a turn of the whole frame, {runs_of(campaign)}")
    return figure
