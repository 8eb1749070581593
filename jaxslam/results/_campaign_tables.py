"""The tables of a campaign and of two filters in pairs, and notes on their terms."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from html import escape

import numpy as np

from jaxslam.consistency import Average, PairedDifference, Summary
from jaxslam.consistency._intervals import EACH, LEVEL, is_lopsided, percentage
from jaxslam.consistency._measures import REGISTRY, Measure, measures_of
from jaxslam.consistency._measures.counts import MEANINGS, count_label
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency._verdict import TESTS
from jaxslam.consistency.campaign import Campaign, Comparison
from jaxslam.core._table import Cell, Row, Table
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


def average_text(average: Average) -> str:
    """A measure as text, with half of its interval, or with the ends of one that is lopsided."""
    value, low, high = average
    if not (np.isfinite(low) or np.isfinite(high)) or (low, high) == (0.0, np.inf):
        return short(value)
    if is_lopsided(average):
        return f"{short(value)} [{short(low, 3)}, {short(high, 3)}]".replace("inf", "∞")
    return f"{short(value)} ± {short((high - low) / 2, 2)}"


def _average(average: Average | None, level: float) -> Cell | None:
    """The cell of a measure; the pointer shows its interval, of that level."""
    if average is None:
        return None
    title = ""
    if np.isfinite(average.high):
        digits = 1 if level == EACH else 0
        title = f"{percentage(level, digits)} interval {average.low:.5g} to {average.high:.5g}"
    return Cell(average_text(average), average, title)


def _numbers(values: Iterable[float | None], text: Callable[[float], str]) -> list[Cell | None]:
    """The cells of numbers; none where there is no number."""
    return [None if value is None else Cell(text(value), [value]) for value in values]


def _honest(measure: Measure) -> str:
    return "" if measure.honest is None else f"{measure.honest:g}"


def badge(verdict: str, summary: Summary | None = None) -> str:
    """A verdict as HTML, with the tests that rejected; with doubts it has an asterisk, and is grey
    if consistent."""
    sign, meaning = VERDICTS[verdict]
    rejected = [TESTS[test] for test in summary.by] if summary is not None else []
    doubts = summary.doubts if summary is not None else ()
    kind = "undecided" if doubts and verdict == "consistent" else verdict
    title = escape("; ".join([meaning, *doubts]))
    text = escape(verdict + f" ({', '.join(rejected)})" * bool(rejected))
    mark = f'<span aria-hidden="true">{sign}{"*" * bool(doubts)}</span>'
    return f'<span class="badge {kind}" title="{title}">{mark} {text}</span>'


def short(value: float, digits: int = 4) -> str:
    """A number with some significant digits; large ones with all of the digits before the point."""
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e6 else f"{value:.{digits}g}"


def table_of(campaign: Campaign) -> Table:
    """The table of the filters, without measures that none of them has.

    A verdict has the tests that rejected, and an asterisk if it has doubts.
    """
    names, summaries = list(campaign.filters), list(campaign.filters.values())
    verdicts = []
    for summary in summaries:
        tests = [TESTS[name].removeprefix("pose ").removesuffix(" / dof") for name in summary.by]
        rejected = f" ({', '.join(tests)})" * bool(tests)
        text = summary.verdict + rejected + "*" * bool(summary.doubts)
        verdicts.append(Cell(text, html=badge(summary.verdict, summary)))
    rows = [Row("verdict", ["consistent", *verdicts])]
    for measure in measures_of(key for s in summaries for key in s.measures):
        if measure.row:
            cells = [_average(s.measures.get(measure.key), EACH) for s in summaries]
            rows.append(Row(measure.label, [_honest(measure), *cells], measure.unit))
            published = [campaign.published.get(name, {}).get(measure.key) for name in names]
            rows.append(Row("  published", ["", *_numbers(published, short)]))
    # The bands of honest filters, and the share of steps within them.
    nis = [s.nis_band and "[{:.4f}, {:.4f}]".format(*s.nis_band) for s in summaries]
    half_widths = [s.autocorrelation_band[0] for s in summaries]
    white = [f"± {half:.4f}" if np.isfinite(half) else None for half in half_widths]
    for name, bands in (("NIS / dof", nis), ("autocorrelation", white)):
        rows.append(Row(f"{name}, {percentage(LEVEL)} band", ["", *bands], group="Bands"))
    for block in DOF:
        shares = _numbers([s.inside.get(block) for s in summaries], partial(percentage, digits=1))
        honest = percentage(LEVEL, 1)
        rows.append(Row(f"steps in {block} band", [honest, *shares], group="Bands"))
    # Times, and counts that are not 0 for all filters.
    steps = {name: 1e6 * seconds for name, seconds in campaign.step_seconds.items()}
    for label, of, unit in (
        ("time of a step", steps, "µs"),
        ("wall time of a run", campaign.run_seconds, "s"),
    ):
        times = _numbers([of.get(name) for name in names], "{:.3g}".format)
        rows.append(Row(label, ["", *times], unit, group="Time and counts"))
    for key in dict.fromkeys(key for s in summaries for key in s.counts):
        counts = [s.counts.get(key) for s in summaries]
        if key not in _NEVER and (key in _ALWAYS or any(counts)):
            numbers = _numbers(counts, "{:,}".format)
            rows.append(Row(count_label(key), ["", *numbers], group="Time and counts"))
    rows = [row for row in rows if any(cell is not None for cell in row.cells[1:])]
    return Table(["measure", "honest", *names], rows, fixed=1)


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


def table_of_pairs(comparison: Comparison) -> Table:
    """The table of two filters: averages, difference, and what it says."""
    rows = []
    for key, pair in comparison.measures.items():
        measure, share, factor = REGISTRY[key], pair.share, pair.narrower
        times = f"{factor:#.3g}".rstrip(".") if factor < np.inf else "∞"  # all three digits
        cells = [
            _honest(measure),
            *_numbers([pair.first, pair.second], short),
            _average(pair.difference, LEVEL),
            *_numbers([share], percentage),
            None if np.isnan(factor) else Cell(f"{times} ×", [factor]),
        ]
        rows.append(Row(measure.label, cells, measure.unit))
    corner = f"{comparison.runs:,} run{'s' * (comparison.runs != 1)} in pairs"
    ends = "difference", "better in", "narrower by"
    return Table([corner, "honest", comparison.first, comparison.second, *ends], rows, fixed=1)


def notes_on_pairs(comparisons: Sequence[Comparison]) -> list[tuple[str, str]]:
    """Notes on the columns of `table_of_pairs`, and the doubts: terms, each with a sentence."""
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
