"""The figure of `benchmarks.mrclam`: errors of one robot in their bounds, NEES of all."""

from pathlib import Path

import numpy as np

from jaxslam.math.stats import chi2_quantile
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    SHADE,
    band,
    caption,
    every_handle,
    panels_of,
    png,
    titled,
)

SHOWN = 3
"""The robot whose errors are drawn; bounds beyond what fits are cut."""
UNITS = (("x [m]", 1.0), ("y [m]", 1.0), ("heading [deg]", 180 / np.pi))


def draw(paths, out: Path) -> None:
    figure, panels = panels_of(PAGE, 6.4, 3 + len(paths))
    axes = panels[:3]
    path = paths[SHOWN]
    begin = min(each.time[0] for each in paths.values())
    for k, (name, scale) in enumerate(UNITS):
        t, bound = path.time - begin, 3 * scale * path.sigma[:, k]
        band(axes[k], t, -bound, bound, "3 σ of the filter")
        axes[k].plot(t, scale * path.error[:, k], color=COLORS[0], lw=0.8, label="error")
        titled(axes[k], f"robot {SHOWN}: error of {name}")
        most = max(np.quantile(bound, 0.8), np.abs(scale * path.error[:, k]).max())
        axes[k].set_ylim(-1.15 * most, 1.15 * most)

    axes = panels[3:]
    low, high = (float(chi2_quantile(p, 3)) for p in (0.025, 0.975))
    for ax, (robot, path) in zip(axes, paths.items(), strict=True):
        ax.axhspan(low, high, fc=(SHADE, 0.35), ec=FAINT, lw=0.4, label="95 % of an honest filter")
        ax.axhline(3, color=INK, lw=0.8)
        middle = float(np.median(path.nees))
        nees = np.clip(path.nees, 0.02, None)
        ax.semilogy(path.time - begin, nees, color=COLORS[1 if robot == 1 else 0], lw=0.8)
        what = "noise fitted on it" if robot == 1 else "test"
        titled(ax, f"robot {robot} ({what}): pose NEES, median {middle:.1f}")
        ax.margins(x=0.01)
        ax.set_ylim(0.03, 300)
    axes[-1].set_xlabel("time [s]")
    caption(figure, "Right-invariant EKF on MRCLAM 6", every_handle((panels[0], axes[0])))
    out.parent.mkdir(exist_ok=True)
    out.write_bytes(png(figure))
