"""The figure of a recorded robot: errors over time with the claimed bounds."""

import numpy as np

from jaxslam.consistency._recording import COMPONENTS, RecordingScores
from jaxslam.core.logs._streams import is_gap
from jaxslam.core.validation import instance_of, refusals_of, require
from jaxslam.results.plot._style import (
    COLORS,
    CURVE,
    INK,
    PAGE,
    Figure,
    caption,
    ordinate,
    own_settings,
    panels_of,
)

_HEIGHT = 1.6
"""Largest ordinate, in multiples of the larger of the 99 % quantiles of errors and bounds: a single
jump does not set the scale."""


@own_settings()
def recording_figure(scores: RecordingScores, *, title: str = "", width: float = PAGE) -> Figure:
    """Errors along, across and in heading over time, with the claimed ±2 σ where there is one.

    scores: of `consistency.judge_recording`. Lines are broken where poses are missing.
    """
    with refusals_of("recording_figure"):
        require("scores", scores, instance_of(RecordingScores))
    errors = scores.errors
    breaks = np.flatnonzero(is_gap(errors.time)) + 1
    time = np.insert(errors.time - errors.time[0], breaks, np.nan)
    scale = np.array([1.0, 1.0, np.rad2deg(1.0)])
    error, bound = (
        np.insert(part * scale, breaks, np.nan, axis=0) for part in (errors.error, 2 * errors.sigma)
    )
    figure, panels = panels_of(width, 0.5 * width + 1.2, 3)
    for k, (axes, name) in enumerate(zip(panels, COMPONENTS, strict=True)):
        is_claimed = bool(np.isfinite(bound[:, k]).any())
        if is_claimed:
            axes.fill_between(
                time,
                -bound[:, k],
                bound[:, k],
                color=COLORS[0],
                alpha=0.18,
                lw=0,
                label="±2 σ claimed",
            )
            for side in (-1, 1):
                axes.plot(time, side * bound[:, k], color=COLORS[0], lw=0.5)
        axes.plot(time, error[:, k], color=COLORS[1], lw=0.9, label="truth - estimate", gid=CURVE)
        axes.axhline(0.0, color=INK, lw=0.6)
        sizes = [np.nanquantile(np.abs(error[:, k]), 0.99)]
        if is_claimed:
            sizes.append(np.nanquantile(bound[:, k], 0.99))
        top = _HEIGHT * max(sizes) or 1.0
        axes.set_ylim(-top, top)
        ordinate(axes, f"{name} [{'°' if name == 'heading' else 'm'}]", 0.16 * width + 0.3)
    figure.align_ylabels(panels)
    panels[-1].set_xlim(0.0, max(float(np.nanmax(time)), 1e-9))
    panels[-1].set_xlabel("time [s]")
    handles = panels[0].get_legend_handles_labels()[0] or None
    caption(figure, title, handles)
    return figure
