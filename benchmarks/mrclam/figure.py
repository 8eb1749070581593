"""The figure of `benchmarks.mrclam`: errors of one robot in their bounds, NEES of all."""

import numpy as np

from jaxslam.math.stats import chi2_quantile
from jaxslam.results.plot import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    SHADE,
    band,
    caption,
    every_handle,
    panels_of,
    titled,
)

SHOWN = 4
"""The robot whose errors are drawn; bounds beyond what fits are cut."""
UNITS = (("x [m]", 1.0), ("y [m]", 1.0), ("heading [deg]", 180 / np.pi))
FILTER, SMOOTHER = COLORS[0], COLORS[1]


def errors_and_nees(filtered, smoothed):
    """Robot -> path of the filter, and of the smoother."""
    figure, panels = panels_of(PAGE, 6.4, 3 + len(filtered))
    axes = panels[:3]
    begin = min(each.time[0] for each in filtered.values())
    path, after = filtered[SHOWN], smoothed[SHOWN]
    for k, (name, scale) in enumerate(UNITS):
        t, bound = path.time - begin, 3 * scale * path.sigma[:, k]
        band(axes[k], t, -bound, bound, "3 σ of the filter")
        axes[k].plot(t, scale * path.error[:, k], color=FILTER, lw=0.8, label="filter")
        later, narrow = after.time - begin, 3 * scale * after.sigma[:, k]
        for sign in (-1, 1):
            label = "3 σ of the smoother" if sign > 0 else None
            axes[k].plot(later, sign * narrow, color=SMOOTHER, lw=0.6, ls=(0, (3, 2)), label=label)
        error = scale * after.error[:, k]
        axes[k].plot(later, error, color=SMOOTHER, lw=0.8, label="smoother")
        titled(axes[k], f"robot {SHOWN}: error of {name}")
        most = max(np.quantile(bound, 0.8), np.abs(scale * path.error[:, k]).max())
        axes[k].set_ylim(-1.15 * most, 1.15 * most)

    axes = panels[3:]
    low, high = (float(chi2_quantile(p, 3)) for p in (0.025, 0.975))
    for ax, robot in zip(axes, filtered, strict=True):
        ax.axhspan(low, high, fc=(SHADE, 0.35), ec=FAINT, lw=0.4, label="95 % of an honest NEES")
        ax.axhline(3, color=INK, lw=0.8)
        of = filtered[robot], smoothed[robot]
        for path, color in zip(of, (FILTER, SMOOTHER), strict=True):
            nees = np.clip(path.nees, 0.02, None)
            ax.semilogy(path.time - begin, nees, color=color, lw=0.7)
        what = "noise fitted on it" if robot == 1 else "test"
        middles = ", ".join(f"{np.median(path.nees):.1f}" for path in of)
        titled(ax, f"robot {robot} ({what}): pose NEES, medians {middles}")
        ax.margins(x=0.01)
        ax.set_ylim(0.03, 300)
    axes[-1].set_xlabel("time [s]")
    title = "MRCLAM 6: right-invariant EKF, and batch_map, which knows later measurements, too"
    caption(figure, title, every_handle((panels[0], axes[0])))
    return figure
