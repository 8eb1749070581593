"""Numbers and names as text on the page."""

from html import escape

import numpy as np

from jaxslam import consistency
from jaxslam.consistency import LEVEL, Measure, lopsided


def cell(measure: Measure | None) -> str:
    """A measure as value ± half-width to two digits, or with [low, high] if that is asymmetric."""
    if measure is None:
        return "–"
    half = (measure.high - measure.low) / 2
    if not np.isfinite(measure.high) and measure.low <= 0:
        return number(measure.value, 4)
    if lopsided(measure):
        ends = (number(end, 3) if np.isfinite(end) else "∞" for end in measure[1:])
        return f"{number(measure.value, 4)} [{', '.join(ends)}]"
    if half == 0:
        return f"{number(measure.value, 4)} ± 0"
    size = max(abs(measure.value), half)
    power = 0 if 1e-3 <= size < 1e6 else int(np.floor(np.log10(size)))
    value, half = measure.value / 10.0**power, half / 10.0**power
    digits = min(max(1 - int(np.floor(np.log10(half))), 0), 6)
    text = f"{value:,.{digits}f} ± {half:,.{digits}f}"
    return (f"({text})·10<sup>{power}</sup>" if power else text).replace("-", "−")


def number(value: float, digits: int) -> str:
    """A number with some significant digits; small and large ones with a power of ten."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits}g}".replace("-", "−")
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10<sup>{int(power)}</sup>".replace("-", "−")


def interval_title(measure: Measure | None) -> str:
    """The HTML attribute that shows a measure's interval under the pointer."""
    if measure is None or not np.isfinite(measure.high):
        return ""
    return f' title="{percentage(LEVEL)} interval {measure.low:.5g} to {measure.high:.5g}"'


def sortable(value: float | None) -> str:
    """The HTML attribute of a cell by which the script sorts filters."""
    return "" if value is None or not np.isfinite(value) else f' data-v="{value:.6g}"'


def published_note(value: float | None) -> str:
    """The published value as HTML, if there is one."""
    return "" if value is None else f'<span class="published">published {number(value, 4)}</span>'


def percentage(share: float, digits: int = 0) -> str:
    """A share as a percentage, with a no-break space."""
    return consistency.percentage(share, digits).replace(" ", "\N{NO-BREAK SPACE}")


def with_noun(number: int, noun: str) -> str:
    """A number with its noun: 1 run, 2 runs."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """A duration in seconds, minutes or hours."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def breakable(name: str) -> str:
    """A name escaped for HTML, with places where it may break."""
    return escape(name).replace("_", "_<wbr>")
