"""Parts of the page as HTML: verdicts, the table of measures, figures."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from itertools import repeat

from jaxslam.consistency import DOF, LEVEL, Summary
from jaxslam.consistency.verdict import TESTS
from jaxslam.monte_carlo import Campaign
from jaxslam.results import meanings, report
from jaxslam.results.page.text import (
    breakable,
    cell,
    interval_title,
    percentage,
    published_note,
    sortable,
)
from jaxslam.results.plot import Figure, describe

VERDICTS = {
    word: (sign, meanings.VERDICTS[word])
    for word, sign in (
        ("consistent", "✓"),
        ("optimistic", "▲"),
        ("pessimistic", "▼"),
        ("diverged", "✕"),
        ("incomplete", "–"),
        ("undecided", "?"),
    )
}
"""Each verdict with its sign and its meaning."""

_ALWAYS = ("runs", "not_finite", "divergent")


def verdict_list(campaign: Campaign) -> str:
    """Name, badge and tested measures of each filter as HTML, and what qualifies the verdicts."""
    items = []
    for name, summary in campaign.filters.items():
        tests = {TESTS[key]: summary.measures[key] for key in TESTS if key in summary.measures}
        said = [f"{test} {cell(measure)}" for test, measure in tests.items()] or ["no pose NEES"]
        lines = "".join(f'<span class="why">{line}</span>' for line in said)
        label = f'<span class="name">{breakable(name)}</span>'
        items.append(f"<li>{label}{badge(summary.verdict, summary)}{lines}</li>")
    sentences = [*report.qualified(campaign), *report.not_finite(campaign)]
    notes = (f'<p class="note">{escape(sentence)}.</p>' for sentence in sentences)
    return "\n".join(['<ul class="verdicts">', *items, "</ul>", *notes])


def badge(verdict: str, summary: Summary | None = None) -> str:
    """A verdict as HTML, with the tests that rejected; grey and with an asterisk if in doubt."""
    sign, meaning = VERDICTS[verdict]
    rejected = [TESTS[test] for test in summary.by] if summary is not None else []
    doubts = summary.doubts if summary is not None else ()
    kind = "undecided" if doubts and verdict == "consistent" else verdict
    title = escape("; ".join([meaning, *doubts]))
    text = escape(verdict + f" ({', '.join(rejected)})" * bool(rejected))
    mark = f'<span aria-hidden="true">{sign}{"*" * bool(doubts)}</span>'
    return f'<span class="badge {kind}" title="{title}">{mark} {text}</span>'


def measures_table(campaign: Campaign, table: Sequence[tuple[str, str, str]]) -> str:
    """The table of measures × filters as HTML; published values below our own."""
    summaries = campaign.filters
    head = "".join(f'<th scope="col">{breakable(name)}</th>' for name in summaries)
    ranks = list(VERDICTS)
    verdicts = "".join(
        f"<td{sortable(ranks.index(s.verdict) if s.verdict in ranks else None)}>"
        f"{badge(s.verdict, s)}</td>"
        for s in summaries.values()
    )
    body = [_row("verdict", "consistent", verdicts)]
    for key, label, honest in table:
        published = [campaign.published.get(name, {}).get(key) for name in summaries]
        measures = [s.measures.get(key) for s in summaries.values()]
        if any(m is not None for m in measures) or any(p is not None for p in published):
            cells = "".join(
                f"<td{sortable(m and m.value)}{interval_title(m)}>{cell(m)}{published_note(p)}</td>"
                for m, p in zip(measures, published, strict=True)
            )
            body.append(_row(label, honest, cells))
    bands = [
        _row(
            f"NIS / dof, {percentage(LEVEL)} band",
            "",
            _cells(map(_nis_interval, summaries.values())),
        )
    ]
    first = [s.autocorrelation_band[0] for s in summaries.values()]
    white = (f"± {half:.4f}" if half < float("inf") else "–" for half in first)
    bands.append(_row(f"autocorrelation, {percentage(LEVEL)} band", "", _cells(white)))
    for block in DOF:
        inside = [s.inside.get(block) for s in summaries.values()]
        shares = ["–" if share is None else percentage(share, 1) for share in inside]
        bands.append(_row(f"steps in {block} band", percentage(LEVEL, 1), _cells(shares, inside)))
    counts = []
    for key in dict.fromkeys(key for s in summaries.values() for key in s.counts):
        found = [s.counts.get(key, 0) for s in summaries.values()]
        if key in _ALWAYS or any(found):
            label = "finite runs" if key == "runs" else meanings.count_label(key)
            counts.append(_row(label, "", _cells((f"{n:,}" for n in found), found)))
    groups = (("", body), ("Bands", bands), ("Counts", counts))
    span = len(summaries) + 2
    parts = "\n".join(
        "<tbody>"
        + (f'<tr class="group"><th colspan="{span}" scope="rowgroup">{name}</th></tr>' * bool(name))
        + "\n".join(rows)
        + "</tbody>"
        for name, rows in groups
    )
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Measures of every filter">'
        f'<table><thead><tr><th scope="col">measure</th><th scope="col">honest</th>{head}</tr>'
        f"</thead>\n{parts}</table></div>"
    )


def _row(label: str, honest: str, cells: str) -> str:
    """A row of the table as HTML."""
    kind = ' class="sub"' if label.startswith(" ") else ""
    honest = escape(honest.replace(">=", "≥").replace("<=", "≤"))
    return (
        f'<tr><th scope="row"{kind}>{escape(label.strip())}</th><td class="honest">{honest}</td>'
        f"{cells}</tr>"
    )


def _cells(texts: Iterable[str], values: Iterable[float | None] | None = None) -> str:
    """Cells of the table as HTML, with the values by which filters are sorted if there are any."""
    pairs = zip(texts, repeat(None) if values is None else values, strict=False)
    return "".join(f"<td{sortable(value)}>{text}</td>" for text, value in pairs)


def measure_notes(campaign: Campaign) -> str:
    """What must be known of the measures, as HTML."""
    return "\n".join(
        f'<p class="note"><strong>{escape(term)}</strong>: {escape(said)}.</p>'
        for term, said in meanings.notes_on(campaign)
    )


def embedded_figure(number: int, caption: str, figure: Figure, drawn: bytes) -> str:
    """A figure with its caption as HTML, the PNG file embedded."""
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    data = base64.b64encode(drawn).decode("ascii")
    return (
        f'<figure><img width="{width}" height="{height}" '
        f'alt="{escape(describe(figure))}" '
        f'src="data:image/png;base64,{data}">'
        f"<figcaption><strong>Figure {number}.</strong> {escape(caption)}</figcaption></figure>"
    )


def _nis_interval(summary: Summary) -> str:
    band = summary.nis_band
    return "–" if band is None else f"{band[0]:.4f} – {band[1]:.4f}"
