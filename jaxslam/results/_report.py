"""A campaign as text: its table, JSON and CSV."""

import textwrap
from collections.abc import Iterable

import numpy as np

from jaxslam.consistency import Average
from jaxslam.consistency._intervals import EACH, LEVEL, percentage
from jaxslam.consistency._measures.coverage import LEVELS
from jaxslam.consistency._verdict import POWER, TESTS, TOLERANCE, honest_values
from jaxslam.consistency.campaign import Campaign, Comparison
from jaxslam.core._table import Row, csv_number, csv_of, csv_text, terminal_width, text_of
from jaxslam.results._campaign_tables import (
    VERDICTS,
    lost_runs,
    notes_on,
    notes_on_pairs,
    short,
    table_of,
    table_of_pairs,
)
from jaxslam.results._files import json_number, json_text, versions

_COLUMNS = 5
"""Largest number of filters beside each other, but on a terminal."""

_WIDTH = 88
"""Characters of a line of the notes; the narrowest table has some 80."""


def campaign_table(campaign: Campaign) -> str:
    """The campaign as text: tables of as many filters as a terminal is wide, elsewhere of five, and
    notes below."""
    table = table_of(campaign)
    table = table._replace(heads=["", *table.heads[1:]])
    pairs = [text_of(table_of_pairs(pair), rule=True) for pair in campaign.comparisons]
    text = "\n\n".join([text_of(table, rule=True, most=_COLUMNS), *pairs])
    title = f"{campaign.scenario}: {campaign.size}"
    verdicts = {summary.verdict for summary in campaign.filters.values()}
    notes = [
        "honest: the average of a consistent filter; NEES is not divided by its dof.",
        f"± or [low, high]: {percentage(EACH, 1)} interval over the runs.",
        "verdict: by two tests, whether 3 lies in the interval of the pose NEES, and 1 in that of "
        "NIS / dof, with the one that rejects. Together they reject "
        f"{percentage(1 - LEVEL)} of honest filters of a linear problem.",
        *(f"{word}: {meaning}." for word, (_, meaning) in VERDICTS.items() if word in verdicts),
        f"inaccurate: final position error over {campaign.divergence_limit:.3g} m, 5 σ of the "
        "ideal EKF; divergent: also over 5 σ of what the filter claims.",
    ]
    terms = notes_on(campaign) + notes_on_pairs(campaign.comparisons)
    notes += [f"{term}: {sentence}." for term, sentence in terms]
    notes += sentences_on_verdicts(campaign)
    notes += [f"{name} {phrase}" for name, phrase in lost_runs(campaign)]
    if campaign.dtype == "float32":
        notes.append(
            "The filters ran in float32: for float64, set jax_enable_x64 in Python, or leave out "
            "--dtype in the command."
        )
    if campaign.published:
        notes.append(
            f"published: {campaign.source}; for the scenario and the filters as in the catalog"
        )
    below = [*_wrapped(notes), *(f"\n{note}" for note in campaign.notes)]
    return "\n".join([title, "", text, "", *below])


def comparison_text(comparison: Comparison) -> str:
    """Two filters on the same draws as a text table, with notes below."""
    title = f"{comparison.scenario}: {comparison.first} - {comparison.second}"
    notes = [f"{term}: {sentence}." for term, sentence in notes_on_pairs([comparison])]
    table = text_of(table_of_pairs(comparison), rule=True)
    return "\n".join([title, "", table, "", *_wrapped(notes)])


def _wrapped(notes: Iterable[str]) -> list[str]:
    """The lines of notes below a table."""
    width = min(_WIDTH, terminal_width() or _WIDTH)
    return [line for note in notes for line in textwrap.wrap(note, width)]


def sentences_on_verdicts(campaign: Campaign) -> list[str]:
    """Sentences on the power of the tests of filters that are not rejected, and on doubts.

    Filters with the same sentence share it. A verdict with a doubt has an asterisk in the table.
    """
    powers: dict[str, list[str]] = {}
    doubts: dict[str, list[str]] = {}
    close: list[str] = []
    for name, summary in campaign.filters.items():
        for test, (low, high) in honest_values(summary.honest_nis).items():
            average = summary.measures.get(test)
            if (
                average is not None
                and (average.low > high or average.high < low)
                and test not in summary.by
                and summary.verdict != "diverged"
            ):
                close.append(
                    f"{name}: the {TESTS[test]} is not rejected, as its whole interval lies within "
                    f"{percentage(TOLERANCE)} of the honest value"
                )
        ends = {test: pair for test, pair in summary.noticed.items() if pair != (0.0, np.inf)}
        if ends and not summary.by and summary.verdict != "diverged":
            limits = " and ".join(f"[{low:.3g}, {high:.3g}]" for low, high in ends.values())
            tests = " and ".join(f"a {TESTS[test]}" for test in ends)
            powers.setdefault(tests, []).append(f"{name} {limits}")
        for doubt in summary.doubts:
            doubts.setdefault(doubt, []).append(name)
    power = f"not rejected, with {percentage(POWER)} power to reject"
    return [
        *(f"{power} {tests} outside: {'; '.join(limits)}" for tests, limits in powers.items()),
        *close,
        *(f"{', '.join(names)}*: {doubt}" for doubt, names in doubts.items()),
    ]


_SPOKEN = {"ekf": "the EKF", "right_invariant": "the right-invariant EKF", "ukf": "the UKF"}
"""How a sentence calls filters; others by their names."""


def verdict_on_twins(campaign: Campaign) -> str:
    """The verdicts of a campaign of twins of a log, as a sentence."""
    verdicts = []
    for i, (name, summary) in enumerate(campaign.filters.items()):
        text = f"{_SPOKEN.get(name, name)} {'is ' * (i == 0)}{summary.verdict}"
        nees = summary.measures.get("nees_pose")
        if summary.verdict != "consistent" and nees is not None:
            text += f" (pose NEES {short(nees.value)} [{short(nees.low)}, {short(nees.high)}])"
        verdicts.append(text)
    return f"On a robot like yours {'; '.join(verdicts)}."


def as_json(campaign: Campaign, command: str = "", seed: int | None = None) -> str:
    """The campaign without curves as JSON, with versions, seed and command; NaN is null."""
    filters = {
        name: {
            "verdict": s.verdict,
            "rejected_by": s.by,
            "noticed": {key: _finite_or_none(np.asarray(ends)) for key, ends in s.noticed.items()},
            "doubts": s.doubts,
            "measures": {
                key: dict(zip(Average._fields, _finite_or_none(average), strict=True))
                for key, average in s.measures.items()
            },
            "nis_band": s.nis_band,
            "honest_nis": s.honest_nis,
            "steps_inside_band": s.inside,
            "coverage": {block: _finite_or_none(share) for block, share in s.coverage.items()},
            "autocorrelation": _finite_or_none(s.autocorrelation),
            "autocorrelation_band": _finite_or_none(s.autocorrelation_band),
            "not_finite_runs": s.not_finite_runs,
            **({"faults": dict(s.faults)} if s.faults else {}),
            "counts": s.counts,
        }
        for name, s in campaign.filters.items()
    }
    head = {
        "scenario": campaign.scenario,
        "source": campaign.source,
        "published": campaign.published,
        "runs": campaign.runs,
        "steps": campaign.steps,
        "dtype": campaign.dtype,
        "seed": seed,
        "command": command,
        "nees_convention": "not divided by dof",
        "coverage_levels": LEVELS,
        "level": EACH,
        "divergence_limit_m": campaign.divergence_limit,
        "seconds": round(campaign.seconds, 3),
        "compile_seconds": round(campaign.compile_seconds, 3),
        "step_seconds": campaign.step_seconds,
        **({"run_seconds": campaign.run_seconds} if campaign.run_seconds else {}),
        **({"notes": campaign.notes} if campaign.notes else {}),
        "versions": versions(),
    }
    pairs = {
        "reference": campaign.reference,
        "level": LEVEL,
        "filters": {
            comparison.first: {
                "runs": comparison.runs,
                "doubts": comparison.doubts,
                "measures": {
                    key: {
                        "average": json_number(pair.first),
                        "average_of_reference": json_number(pair.second),
                        "difference": dict(
                            zip(Average._fields, _finite_or_none(pair.difference), strict=True)
                        ),
                        "better_in": pair.share,
                        "narrower_by": json_number(pair.narrower),
                        "runs": pair.runs,
                    }
                    for key, pair in comparison.measures.items()
                },
            }
            for comparison in campaign.comparisons
        },
    }
    compared = {"pairs": pairs} if campaign.reference else {}
    return json_text(head | {"filters": filters} | compared)


def table_csv(campaign: Campaign) -> str:
    """The table as CSV: a row per measure; for each filter the value and the ends of its interval.

    Verdicts and bands are text, and so are the doubts, below the verdicts, if a filter has any;
    cells without a number are empty.
    """
    table = table_of(campaign)
    rows = [Row("verdict", ["consistent", *(s.verdict for s in campaign.filters.values())])]
    doubts = ["; ".join(summary.doubts) for summary in campaign.filters.values()]
    if any(doubts):
        rows.append(Row("doubts", ["", *doubts]))
    return csv_of(table._replace(rows=[*rows, *table.rows[1:]]), ends=("", " low", " high"))


def as_csv(campaign: Campaign) -> str:
    """The curves as CSV: a row for each filter and step; cells without a number are empty."""
    keys = list(dict.fromkeys(key for s in campaign.filters.values() for key in s.curves))
    nothing = np.full(campaign.steps, np.nan)  # some filters lack a curve, as of landmarks
    rows: list[list[str]] = []
    for name, s in campaign.filters.items():
        columns = [map(csv_number, s.curves.get(key, nothing).tolist()) for key in keys]
        rows += [[name, str(step + 1), *row] for step, row in enumerate(zip(*columns, strict=True))]
    return csv_text(["filter", "step", *keys], rows)


def _finite_or_none(values: Iterable[float]) -> list[float | None]:
    """The values, with None for those that are not finite."""
    return [json_number(value) for value in values]
