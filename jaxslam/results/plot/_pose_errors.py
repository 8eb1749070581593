"""Figures of run 0: the errors of filters with their claimed bounds."""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency.campaign import Campaign
from jaxslam.core.types import Estimate, Truth
from jaxslam.core.validation import InvalidField, instance_of, refusals_of, require
from jaxslam.results.plot._panels import common_top, mark_beyond, scale_setters
from jaxslam.results.plot._style import (
    COLORS,
    CURVE,
    INK,
    PAGE,
    caption,
    escape_name,
    ordinate,
    own_settings,
    panels_of,
    step_limits,
    titled,
)

_QUANTITIES = ("x error [m]", "y error [m]", "heading error [°]")

_SHORT = ("x [m]", "y [m]", "θ [°]")
"""The quantities in a narrow figure."""

_NARROW = 5.0
"""Width below which a figure is narrow [in]."""

_SMALL = 0.1
"""Errors and bounds below this share of a common scale have a separate scale."""


@own_settings()
def errors_figure(
    estimate: Estimate, truth: Truth, *, title: str = "", width: float = PAGE
) -> Figure:
    """Errors of x, y and heading over the steps, with ±3 σ of the filter's covariance."""
    with refusals_of("errors_figure"):
        require("estimate", estimate, instance_of(Estimate))
    error, bound = _errors(estimate, truth)
    figure, panels = panels_of(width, 0.55 * width + 1.4, 3)
    for i, (axes, name) in enumerate(zip(panels, _QUANTITIES, strict=True)):
        _draw(axes, error[:, i], bound[:, i])
        ordinate(axes, name, 0.18 * width + 0.3)
    caption(figure, title)
    panels[-1].set_xlabel("step")
    return figure


@own_settings()
def run_errors_figure(campaign: Campaign, *, title: str = "", width: float = PAGE) -> Figure:
    """Errors of run 0 of every filter of `Campaign.first`, one row each, as in `errors_figure`.

    The scales are equal, except for panels that would use less than a tenth of the common scale:
    these have a separate one, with bold numbers. Filters that do not set a scale (`rmse_figure`)
    leave the panels at an arrow. Raises ValueError if the campaign has no run 0.
    """
    with refusals_of("run_errors_figure"):
        require("campaign", campaign, instance_of(Campaign))
        if not campaign.first:
            raise InvalidField("campaign", "it holds no run 0 (Campaign.first is empty)")
    if len(campaign.first) == 1:
        ((truth, estimate),) = campaign.first.values()
        return errors_figure(estimate, truth, title=title, width=width)
    # Errors and bounds by filter, each (T, 3).
    curves = {n: _errors(estimate, truth) for n, (truth, estimate) in campaign.first.items()}
    setters = scale_setters(campaign)
    peaks = {
        name: np.max(np.abs(both), axis=(0, 1), where=np.isfinite(both), initial=0.0)
        for name, both in curves.items()
    }
    tops = [common_top({name: peak[i] for name, peak in peaks.items()}, setters) for i in range(3)]
    figure, panels = panels_of(width, 0.8 * len(curves) + 0.8, len(curves), 3)
    for i, axes in enumerate(panels[:3]):
        name = _QUANTITIES[i] if width > _NARROW else _SHORT[i]
        titled(axes, f"{name}\n")  # above what `mark_beyond` writes
        if width < _NARROW:
            axes.locator_params(axis="x", nbins=2, min_n_ticks=1)
    for j, (name, (error, bound)) in enumerate(curves.items()):
        for i, axes in enumerate(panels[3 * j : 3 * j + 3]):
            peak, common = peaks[name][i], tops[i]
            top = peak if 0 < peak < _SMALL * common else common
            axes.set_ylim(-1.05 * top or -1.0, 1.05 * top or 1.0)
            if top != common:
                axes.set_yticks([-top, 0.0, top], [f"−{top:.2g}", "0", f"{top:.2g}"], weight="bold")
            _draw(axes, error[:, i], bound[:, i])
            mark_beyond(axes)
        words = escape_name(name).replace("_", "_ ")  # a name may break after _
        wrapped = textwrap.wrap(words, 12, break_long_words=False)
        lines = [line.replace("_ ", "_") for line in wrapped]
        panels[3 * j].set_ylabel("\n".join(lines), rotation=0, ha="right", va="center")
    for axes in panels[-3:]:
        axes.set_xlabel("step")
    caption(figure, title)
    return figure


def _errors(estimate: Estimate, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """The errors (T, 3), truth minus estimate, and 3 σ, in metres and degrees."""
    error = np.asarray(truth.pose) - np.asarray(estimate.pose)
    error[:, 2] = np.mod(error[:, 2] + np.pi, 2 * np.pi) - np.pi  # in [-π, π)
    variance = np.diagonal(np.asarray(estimate.pose_cov), axis1=1, axis2=2)
    scale = np.array([1.0, 1.0, np.rad2deg(1.0)])
    return scale * error, 3 * scale * np.sqrt(np.maximum(variance, 0.0))


def _draw(axes: Axes, error: np.ndarray, bound: np.ndarray) -> None:
    """Draw errors over the steps within their bounds."""
    step = np.arange(1, len(error) + 1)
    label = "±3 σ claimed"
    axes.fill_between(step, -bound, bound, color=COLORS[0], alpha=0.18, lw=0, label=label)
    axes.plot(step, bound, step, -bound, color=COLORS[0], lw=0.5)
    label = "truth - estimate"
    axes.plot(step, error, color=COLORS[1], lw=0.9, label=label, gid=CURVE)
    axes.axhline(0.0, color=INK, lw=0.6)
    axes.set_xlim(step_limits(len(error)))
