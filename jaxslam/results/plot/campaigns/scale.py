"""Scales that one extreme filter does not set, and the marks of what lies beyond them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from jaxslam.consistency import DOF
from jaxslam.consistency.campaign import Campaign
from jaxslam.results.plot.style import INK, curves_of

_FAR = 3.0
"""A filter whose curve rises above so many times the median does not set a scale."""

_NEES = (1 / 10, 10.0, 100.0)
"""lowest end of a scale of NEES, and least and greatest upper end, in multiples of dof"""

_BAND = 0.06
"""share of the height of a panel that the 95 % band fills at least, where the scale allows it"""

_POWERS = 6
"""a logarithmic axis has a label at every power of ten if they are at most so many"""

BEYOND = "beyond"
"""`gid` of the marks of what lies beyond an axis."""

_NO_MARK = "", " ", "None", "none"
"""what Matplotlib calls the mark of a line without marks"""

_PLACES = 12
"""number of marks along an edge"""


def scale_setters(campaign: Campaign) -> list[str]:
    """The filters that set the scale of errors: those that fused measurements and do not diverge.

    All filters where there are none such.
    """
    names = [
        name
        for name, summary in campaign.filters.items()
        if summary.counts.get("fused", 0) > 0 and summary.verdict != "diverged"
    ]
    return names or list(campaign.filters)


def common_top(peaks: dict[str, float], setters: list[str]) -> float:
    """The largest of the peaks that are at most three times the median peak of the setters.

    0 without a finite peak.
    """
    there = {name: peak for name, peak in peaks.items() if np.isfinite(peak)}
    mine = sorted(peak for name, peak in there.items() if name in setters) or sorted(there.values())
    if not mine:
        return 0.0
    limit = _FAR * mine[len(mine) // 2]
    return max(peak for peak in there.values() if peak <= limit)


def nees_scale(axes: Axes, campaign: Campaign, block: str) -> None:
    """Set the ordinate for the NEES of a block, the 95 % band visible.

    It shows the values of all filters within 0.1 to 100 times dof, and less above where the band is
    narrow; logarithmic over more than a decade.
    """
    dof = DOF[block]

    def every(end: str) -> np.ndarray:
        curves = (summary.curves[f"nees_{block}{end}"] for summary in campaign.filters.values())
        found = np.concatenate([np.ravel(values) for values in curves])
        return found[np.isfinite(found) & (found > 0)]

    values, below, above = every(""), every("_low"), every("_high")
    shown = np.concatenate([values, below, above, [dof / 1.5, dof * 1.5]])
    low = max(shown.min(), _NEES[0] * dof)
    decades = np.log(np.median(above) / np.median(below)) / _BAND if below.size else np.inf
    cap = dof * np.clip(low / dof * np.exp(min(decades, 50.0)), _NEES[1], _NEES[2])
    set_positive(axes, low, min(shown.max(), cap))


def set_positive(
    axes: Axes,
    low: float,
    high: float,
    which: str = "y",
    *,
    margin: float = 0.06,
    linear: float = 10.0,
) -> None:
    """Set an axis (x or y) for numbers from low to high, with a margin as a share of the length.

    It is logarithmic if the largest is over `linear` times the smallest, with labels at 1, 2 and 5
    of each decade, or 1 and 3, or 1 alone, as there is room.
    """
    axis = axes.yaxis if which == "y" else axes.xaxis
    set_limits = axes.set_ylim if which == "y" else axes.set_xlim
    if high <= linear * low:
        room = margin * (high - low) or 0.1 * high
        set_limits(max(low - room, 0.0), high + room)
        return
    axes.set(**{f"{which}scale": "log"})
    room = (high / low) ** margin
    set_limits(low / room, high * room)
    length, label = (axes.bbox.height, 11) if which == "y" else (axes.bbox.width, 28)  # [pt]
    length *= 72 / axes.figure.dpi
    axis.set_major_locator(LogLocator(numticks=int(np.clip(length / label, 2, _POWERS))))
    axis.set_major_formatter(_short)
    decade = length / np.log10(high / low)
    digits = next((d for d in ("25", "3") if np.log10(int(d[0])) * decade > label), "")
    if digits:
        axis.set_minor_formatter(lambda x, _: _short(x) if f"{x:.0e}"[0] in digits else "")
    else:
        axis.set_minor_locator(NullLocator())


def _short(x: float, _: float = 0.0) -> str:
    return f"{x:g}" if 1e-3 <= abs(x) < 1e5 else power(x)


def power(x: float) -> str:
    """A positive number to two digits, with a power of ten where it is large or small."""
    if 1e-3 <= x < 1e4:
        return f"{x:.2g}" if x < 100 else f"{x:.0f}"
    mantissa, exponent = f"{x:.0e}".split("e")
    times = "" if mantissa == "1" else rf"{mantissa}\cdot "
    return f"${times}10^{{{int(exponent)}}}$"


def mark_beyond(axes: Axes) -> None:
    """Mark what lies beyond the ends of the ordinate, with the marks of the curves at the edges.

    Each filter has its own places; a curve without marks has arrows. The greatest value is written
    above the panel, the least one only if the axis goes below 0. Call it when the limits are set.
    """
    low, high = axes.get_ylim()
    left, right = axes.get_xlim()
    curves, largest, least = curves_of(axes), -np.inf, np.inf
    for i, line in enumerate(curves):
        x, y = (np.asarray(part, float) for part in line.get_data())
        order = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        if not order.size:
            continue
        x, y = x[order], y[order]
        places = x
        if len(x) > _PLACES:
            offset = (i + 0.5) / max(len(curves), 1)
            places = np.interp((np.arange(_PLACES) + offset) / _PLACES, [0, 1], [left, right])
        near = np.abs(x[:, None] - places).argmin(axis=0)
        own = str(line.get_marker())
        for out, edge, arrow in ((y > high, 1.0, "$\u2191$"), (y < low, 0.0, "$\u2193$")):
            if not out.any():
                continue
            at = np.unique(near[out[near]])
            at = at if at.size else np.flatnonzero(out)[:1]
            axes.plot(
                x[at],
                np.full(len(at), edge),
                marker=arrow if own in _NO_MARK else own,
                linestyle="none",
                transform=axes.get_xaxis_transform(),
                color=line.get_color(),
                mec=INK,
                mew=0.4,
                ms=4.5,
                clip_on=False,
                zorder=6,
                gid=BEYOND,
            )
        largest = max(largest, y.max())
        least = min(least, y.min())
    said = [f"↑ to {power(largest)}"] if largest > high else []
    said += [f"↓ to −{power(-least)}"] if least < low < 0 else []
    if said:
        axes.set_title(", ".join(said), loc="right", fontsize=7, color=INK)
