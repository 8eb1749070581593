"""The figure of `benchmarks.mrclam`: errors of one robot in their bounds, NEES of all."""

from pathlib import Path

import numpy as np

from jaxslam.math.stats import chi2_quantile
from jaxslam.results.plot import COLORS

SHOWN = 3
"""The robot whose errors are drawn; bounds beyond what fits are cut."""
UNITS = (("x [m]", 1.0), ("y [m]", 1.0), ("heading [deg]", 180 / np.pi))


def draw(paths, out: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    axes = left.subplots(3, 1, sharex=True)
    path = paths[SHOWN]
    begin = min(each.time[0] for each in paths.values())
    for k, (name, scale) in enumerate(UNITS):
        t, bound = path.time - begin, 3 * scale * path.sigma[:, k]
        axes[k].fill_between(t, -bound, bound, color="0.85", lw=0, label="3 σ of the filter")
        axes[k].plot(t, scale * path.error[:, k], color=COLORS[0], lw=0.8, label="error")
        axes[k].axhline(0, color="0.4", lw=0.5)
        axes[k].set_ylabel(name)
        most = max(np.quantile(bound, 0.8), np.abs(scale * path.error[:, k]).max())
        axes[k].set_ylim(-1.15 * most, 1.15 * most)
    axes[0].legend(frameon=False, fontsize="small", ncols=2, loc="lower right")
    axes[2].set_xlabel("time [s]")
    left.suptitle(f"robot {SHOWN}: error of the pose", fontsize="medium")

    axes = right.subplots(len(paths), 1, sharex=True, sharey=True)
    low, high = (float(chi2_quantile(p, 3)) for p in (0.025, 0.975))
    for ax, (robot, path) in zip(axes, paths.items(), strict=True):
        ax.axhspan(low, high, color="0.85", lw=0, label="95 % of an honest filter")
        ax.axhline(3, color="0.5", lw=0.8)
        middle = float(np.median(path.nees))
        nees = np.clip(path.nees, 0.02, None)
        ax.semilogy(path.time - begin, nees, color=COLORS[1 if robot == 1 else 0], lw=0.8)
        what = "noise fitted on it" if robot == 1 else "test"
        told = f"robot {robot} ({what}), median {middle:.1f}"
        ax.set_title(told, fontsize="small", loc="left", pad=3)
        ax.margins(x=0.01)
    axes[0].set_ylim(0.03, 300)
    axes[0].legend(
        frameon=False, fontsize="small", loc="lower right", bbox_to_anchor=(1, 0.98), borderpad=0
    )
    axes[-1].set_xlabel("time [s]")
    axes[len(paths) // 2].set_ylabel("pose NEES")
    right.suptitle("all robots: NEES, right-invariant EKF", fontsize="medium")
    out.parent.mkdir(exist_ok=True)
    figure.savefig(out, dpi=130)
