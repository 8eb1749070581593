"""The rows of the table of a campaign, shared by text, HTML and CSV, and notes on its terms."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from jaxslam.consistency import Average, PairedDifference, Summary
from jaxslam.consistency._intervals import EACH, LEVEL, is_lopsided, percentage
from jaxslam.consistency._measures import REGISTRY, measures_of
from jaxslam.consistency._measures.counts import MEANINGS, count_label
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency._verdict import TESTS
from jaxslam.consistency.campaign import Campaign, Comparison
from jaxslam.math.stats import normal_quantile

VERDICTS = {
    "consistent": ("✓", "neither test rejects, which is not a proof"),
    "optimistic": (
        "▲",
        "the interval of pose NEES or of NIS / dof lies above the honest value: covariances are "
        "claimed too small",
    ),
    "pessimistic": (
        "▼",
        "the interval of pose NEES or of NIS / dof lies below the honest value: covariances are "
        "claimed too large",
    ),
    "diverged": ("✕", "over half of the runs are divergent or not finite"),
    "incomplete": (
        "–",
        f"not optimistic, but over {percentage(1 - LEVEL)} of the runs are not finite or of the "
        "covariances are not valid, or over half of the measurements were not used; a doubt says "
        "which",
    ),
    "undecided": (
        "?",
        "too few runs have a NEES, or their NEES differ too much, to reject even a pose NEES of "
        "6: take more runs, unless a doubt says that the pose has no NEES",
    ),
}
"""The sign and the meaning of each verdict."""

_ALWAYS = ("runs", "not_finite", "divergent")
"""Counts that are shown even if they are 0."""

_NEVER = ("steps",)
"""Counts that only doubts show."""


class Figure(NamedTuple):
    """A cell without an interval."""

    text: str
    value: float | None = None
    """the number in CSV, where the text is not written"""


Cell: TypeAlias = Summary | Average | Figure | None
"""A summary shows its verdict."""


class Row(NamedTuple):
    """A row of the table, with a cell per filter."""

    label: str
    """a label that starts with a space belongs to the row above"""
    honest: str
    """the value of a consistent filter, if known"""
    cells: Sequence[Cell]
    published: Sequence[float | None] = ()
    """published value of each filter; empty if no filter has one"""
    group: str = ""
    """heading above the rows, on a page"""
    level: float = EACH
    """level of the intervals"""


def cell_text(cell: Cell) -> str:
    """A cell as text: a verdict with the tests that rejected, and an asterisk if it has doubts."""
    if cell is None:
        return "-"
    if isinstance(cell, Summary):
        tests = [TESTS[name].removeprefix("pose ").removesuffix(" / dof") for name in cell.by]
        rejected = f" ({', '.join(tests)})" * bool(tests)
        return cell.verdict + rejected + "*" * bool(cell.doubts)
    if not isinstance(cell, Average):
        return cell.text
    value, low, high = cell
    if not (np.isfinite(low) or np.isfinite(high)) or (low, high) == (0.0, np.inf):
        return short(value)
    if is_lopsided(cell):
        return f"{short(value)} [{short(low, 3)}, {short(high, 3)}]".replace("inf", "∞")
    return f"{short(value)} ± {short((high - low) / 2, 2)}"


def short(value: float, digits: int = 4) -> str:
    """A number with some significant digits; large ones with all of the digits before the point."""
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e6 else f"{value:.{digits}g}"


def rows_of(campaign: Campaign, names: Sequence[str]) -> list[Row]:
    """The rows of the table of some filters, without measures that none of them has."""
    summaries = [campaign.filters[name] for name in names]
    rows = [Row("verdict", "consistent", summaries)]
    for measure in measures_of(key for s in summaries for key in s.measures):
        if not measure.row:
            continue
        cells = [s.measures.get(measure.key) for s in summaries]
        published = [campaign.published.get(name, {}).get(measure.key) for name in names]
        has_published = any(value is not None for value in published)
        if has_published or any(cell is not None for cell in cells):
            honest = "" if measure.honest is None else f"{measure.honest:g}"
            rows.append(Row(measure.title, honest, cells, published if has_published else ()))
    # The bands of honest filters, and the share of steps within them.
    nis = [s.nis_band and Figure("[{:.4f}, {:.4f}]".format(*s.nis_band)) for s in summaries]
    half_widths = [s.autocorrelation_band[0] for s in summaries]
    white = [Figure(f"± {half:.4f}") if np.isfinite(half) else None for half in half_widths]
    for name, bands in (("NIS / dof", nis), ("autocorrelation", white)):
        if any(band is not None for band in bands):
            rows.append(Row(f"{name}, {percentage(LEVEL)} band", "", bands, group="Bands"))
    for block in DOF:
        shares = [s.inside.get(block) for s in summaries]
        figures = [None if p is None else Figure(percentage(p, 1), p) for p in shares]
        rows.append(Row(f"steps in {block} band", percentage(LEVEL, 1), figures, group="Bands"))
    # The time of a step, and counts that are not 0 for all filters.
    times = [campaign.step_seconds.get(name) for name in names]
    if any(times):
        figures = [None if t is None else Figure(f"{1e6 * t:.3g}", 1e6 * t) for t in times]
        rows.append(Row("time of a step [µs]", "", figures, group="Time and counts"))
    runs = [campaign.run_seconds.get(name) for name in names]
    if any(runs):
        figures = [None if t is None else Figure(f"{t:.3g}", t) for t in runs]
        rows.append(Row("wall time of a run [s]", "", figures, group="Time and counts"))
    for key in dict.fromkeys(key for s in summaries for key in s.counts):
        numbers = [s.counts.get(key) for s in summaries]
        if key not in _NEVER and (key in _ALWAYS or any(numbers)):
            figures = [None if n is None else Figure(f"{n:,}", n) for n in numbers]
            rows.append(Row(count_label(key), "", figures, group="Time and counts"))
    return rows


def notes_on(campaign: Campaign) -> list[tuple[str, str]]:
    """Notes on the measures of this campaign: terms, each with a sentence."""
    summaries = campaign.filters
    keys = {key for summary in summaries.values() for key in summary.measures}
    notes = [measure.note for measure in measures_of(keys) if measure.note and measure.key in keys]
    lowest: dict[str, list[str]] = {}
    for name, summary in summaries.items():
        if summary.honest_nis < 1:
            lowest.setdefault(f"{summary.honest_nis:.3f}", []).append(name)
    if lowest:
        limits = [f"{least} ({', '.join(names)})" for least, names in lowest.items()]
        notes.append(
            (
                "gate",
                "a gate drops the largest innovations: an honest NIS / dof lies between "
                f"{', '.join(limits)} and 1; the verdict uses this range, the band does not",
            )
        )
    likely = [s for s in summaries.values() if "log_likelihood" in s.measures]
    if len({s.counts.get("fused") for s in likely}) > 1:
        notes.append(
            (
                "log-likelihood",
                "comparable only between filters that fused the same measurements; their numbers "
                "differ here",
            )
        )
    occurring = {name for s in summaries.values() for name, count in s.counts.items() if count}
    terms = [
        f"{count_label(name)}, {meaning}" for name, meaning in MEANINGS.items() if name in occurring
    ]
    return notes + [("counts, over all runs", "; ".join(terms))] * bool(terms)


def lost_runs(campaign: Campaign) -> list[tuple[str, str]]:
    """The filters that were not finite in some runs, or for another reason have no judged estimate
    there, each with a phrase that lists the runs."""
    phrases = []
    for name, summary in campaign.filters.items():
        if summary.faults:
            reasons = (f"{why} in {_listed(runs)}" for why, runs in summary.faults.items())
            phrases.append((name, f"is not judged in some runs: {'; '.join(reasons)}"))
        elif summary.not_finite_runs:
            phrases.append((name, f"was not finite in {_listed(summary.not_finite_runs)}"))
    return phrases


def heads_of_pairs(comparison: Comparison) -> list[str]:
    """The heads of the cells of `rows_of_pairs`."""
    return [comparison.first, comparison.second, "difference", "better in", "narrower by"]


def rows_of_pairs(comparison: Comparison) -> list[Row]:
    """The rows of the table of two filters, with a cell per head of `heads_of_pairs`."""
    rows = []
    for key, pair in comparison.measures.items():
        measure, share, factor = REGISTRY[key], pair.share, pair.narrower
        times = f"{factor:#.3g}".rstrip(".") if factor < np.inf else "∞"  # all three digits
        cells: tuple[Cell, ...] = (
            Figure(short(pair.first), pair.first),
            Figure(short(pair.second), pair.second),
            pair.difference,
            None if share is None else Figure(percentage(share), share),
            None if np.isnan(factor) else Figure(f"{times} ×", factor),
        )
        honest = "" if measure.honest is None else f"{measure.honest:g}"
        rows.append(Row(measure.title, honest, cells, level=LEVEL))
    return rows


def notes_on_pairs(comparisons: Sequence[Comparison]) -> list[tuple[str, str]]:
    """Notes on the columns of `rows_of_pairs`, and the doubts: terms, each with a sentence."""
    shown: dict[str, PairedDifference] = {}
    doubts = []
    for comparison in comparisons:
        shown |= comparison.measures
        term = f"{comparison.first} - {comparison.second}"
        doubts += [(term, doubt) for doubt in comparison.doubts]
    if not shown:
        return doubts
    measures = [REGISTRY[key] for key in shown]
    larger = [m.label.split(": ")[-1] for m in measures if m.better == "larger"]
    runs = min(pair.runs for pair in shown.values())
    half = min(normal_quantile(0.5 + LEVEL / 2) * 0.5 / np.sqrt(runs), 0.5)  # of a fair coin
    jackknife = ", of an RMSE by the jackknife" if "rmse_position" in shown else ""
    return [
        (
            "difference",
            "the first filter minus the second, run by run on the same draws; ± is half its "
            f"{percentage(LEVEL)} interval, by Student's t over the runs{jackknife}",
        ),
        (
            "better in",
            "the share of runs in which the first has the smaller error"
            + f" or the larger {', '.join(larger)}" * bool(larger)
            + f", ties counted half; of {runs:,} runs, {percentage(0.5 - half)} to "
            f"{percentage(0.5 + half)} may be chance. NEES and NIS have no share: a filter is "
            "honest on average, not in a run",
        ),
        (
            "narrower by",
            "how many times wider the interval of two campaigns of as many runs would be, each on "
            "draws of its own; for the same width they need the square of it times as many runs",
        ),
        *doubts,
    ]


def _listed(numbers: Sequence[int]) -> str:
    """The first twenty numbers of runs, as "runs 1, 2"."""
    listed = ", ".join(map(str, numbers[:20])) + (", …" if len(numbers) > 20 else "")
    return f"run{'s' * (len(numbers) != 1)} {listed}"
