"""The report of a campaign as one self-contained HTML5 file, without scripts.

Figures are embedded, and the page forbids the browser to load anything else.
"""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape

from jaxslam.consistency import DOF, LEVEL, Summary, power_of
from jaxslam.consistency.verdict import TESTS
from jaxslam.monte_carlo import Campaign
from jaxslam.results.page.style import CSS, POLICY
from jaxslam.results.page.text import (
    breakable,
    cell,
    duration,
    interval_title,
    percentage,
    published_note,
    with_noun,
)
from jaxslam.results.plot import Figure, describe, png

__all__ = ["VERDICTS", "page"]

VERDICTS = {
    "consistent": ("✓", "neither interval excludes honesty, which is no proof of it"),
    "optimistic": ("▲", "an interval lies above: covariances are claimed too small"),
    "pessimistic": ("▼", "an interval lies below: covariances are claimed too large"),
    "diverged": ("✕", "over half of the runs are not finite or divergent"),
    "incomplete": ("–", "not rejected, but over half of the measurements were dropped"),
    "undecided": (
        "?",
        "fewer than two runs have a NEES, or not even twice the honest one would be rejected",
    ),
}
"""Each verdict with its sign and its meaning."""

_SHOWN = 20
"""largest number of runs listed as not finite"""

_UPRIGHT = 5
"""With more filters, the table is printed on a landscape page of its own."""

_ALWAYS = ("runs", "not_finite", "divergent")


def page(
    campaign: Campaign,
    table: Sequence[tuple[str, str, str]],
    command: str,
    seed: int | None,
    versions: Mapping[str, str],
    figures: Mapping[str, Figure],
    draw: Callable[[Figure], bytes] = png,
) -> str:
    """The HTML report of a campaign.

    Args:
        campaign: the campaign.
        table: the rows, each (key of `Summary.measures`, label, value of a consistent filter); a
            label that starts with a space is indented. Rows that no filter has are left out.
        command, seed: those of the campaign; None where there was no seed.
        versions: of the software, by name.
        figures: in order, by caption.
        draw: makes a PNG file of a figure; with a cache where the files are needed elsewhere, too.
    """
    names = list(campaign.filters)
    heading = f"{campaign.scenario}: consistency of {with_noun(len(names), 'filter')}"
    setup = f"{with_noun(campaign.runs, 'Monte-Carlo run')} of {with_noun(campaign.steps, 'step')}"
    shown = "\n".join(
        _figure(i, caption, figure, draw(figure))
        for i, (caption, figure) in enumerate(figures.items(), 1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{escape(heading)}</title>
<style>{CSS}</style>
</head>
<body>
<header>
<p class="kicker">jaxslam · consistency report</p>
<h1>{escape(heading)}</h1>
<p class="lead">{escape(setup)} each, in {escape(campaign.dtype)}; every filter on the same draws.\
</p>
</header>
<main>
<section>
<h2>Verdicts</h2>
<ul class="verdicts">
{_verdicts(campaign)}
</ul>
</section>
<section{' class="broad"' if len(names) > _UPRIGHT else ""}>
<h2>Measures</h2>
{_measures(campaign, table)}
{_lost(campaign)}
</section>
<section>
<h2>How to read it</h2>
{_conventions(campaign)}
</section>
{f"<section><h2>Figures</h2>{shown}</section>" if shown else ""}
<section>
<h2>Parameters</h2>
{_parameters(campaign, command, seed, versions)}
</section>
</main>
</body>
</html>
"""


def _verdicts(campaign: Campaign) -> str:
    """The verdicts as HTML: for each filter its name, badge, measures tested, power and doubts."""
    out = []
    for name, summary in campaign.filters.items():
        there = [key for key in TESTS if key in summary.measures]
        said = [f"{TESTS[key]} {cell(summary.measures[key])}" for key in there]
        power = power_of(summary.noticed)
        if power and summary.verdict in ("consistent", "incomplete", "undecided"):
            said.append(f"not rejected; {power}")
        said += summary.doubts
        lines = "".join(f'<span class="why">{line}</span>' for line in said or ["no pose NEES"])
        out.append(
            f'<li><span class="name">{breakable(name)}</span>{_badge(summary.verdict, summary)}'
            f"{lines}</li>"
        )
    return "\n".join(out)


def _badge(verdict: str, summary: Summary | None = None) -> str:
    """A verdict as HTML, with the tests that rejected; grey and with an asterisk if in doubt."""
    sign, meaning = VERDICTS.get(verdict, ("·", ""))
    doubts = summary.doubts if summary is not None else ()
    kind = verdict if verdict in VERDICTS else "undecided"
    if doubts and verdict == "consistent":
        sign, kind = "✓*", "undecided"
    rejected = ", ".join(TESTS[test] for test in (summary.by if summary is not None else ()))
    title = "; ".join([meaning, *doubts, *[f"by {rejected}"] * bool(rejected)])
    return (
        f'<span class="badge {kind}" title="{escape(title)}"><span aria-hidden="true">{sign}'
        f"</span> {escape(verdict)}</span>"
    )


def _measures(campaign: Campaign, table: Sequence[tuple[str, str, str]]) -> str:
    """The table of measures × filters as HTML; published values below our own."""
    summaries = campaign.filters
    head = "".join(f'<th scope="col">{breakable(name)}</th>' for name in summaries)
    verdicts = "".join(f"<td>{_badge(s.verdict, s)}</td>" for s in summaries.values())
    body = [_row("verdict", "consistent", verdicts)]
    for key, label, honest in table:
        published = [campaign.published.get(name, {}).get(key) for name in summaries]
        measures = [s.measures.get(key) for s in summaries.values()]
        if any(m is not None for m in measures) or any(p is not None for p in published):
            cells = "".join(
                f"<td{interval_title(m)}>{cell(m)}{published_note(p)}</td>"
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
        shares = [
            percentage(s.inside[block], 1) if block in s.inside else "–" for s in summaries.values()
        ]
        bands.append(_row(f"steps in {block} band", percentage(LEVEL, 1), _cells(shares)))
    counts = []
    for key in dict.fromkeys(key for s in summaries.values() for key in s.counts):
        found = [s.counts.get(key, 0) for s in summaries.values()]
        if key in _ALWAYS or any(found):
            label = "finite runs" if key == "runs" else key.replace("_", " ")
            counts.append(_row(label, "", _cells(f"{n:,}" for n in found)))
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


def _cells(texts: Iterable[str]) -> str:
    """Cells of the table as HTML."""
    return "".join(f"<td>{text}</td>" for text in texts)


def _lost(campaign: Campaign) -> str:
    """A sentence on each filter that was not finite in some runs, with their numbers, as HTML."""
    out = []
    for name, summary in campaign.filters.items():
        lost = summary.not_finite_runs
        if lost:
            numbers = ", ".join(map(str, lost[:_SHOWN])) + (", …" if len(lost) > _SHOWN else "")
            out.append(
                f'<p class="note"><strong>{escape(name)}</strong> was not finite in {len(lost):,} '
                f"of {campaign.runs:,} runs, which its figures leave out: {numbers}.</p>"
            )
    return "\n".join(out)


def _conventions(campaign: Campaign) -> str:
    """The definitions of measures and verdicts as HTML."""
    meanings = "\n".join(
        f"<dt>{_badge(verdict)}</dt><dd>{escape(meaning)}.</dd>"
        for verdict, (_, meaning) in VERDICTS.items()
    )
    published = (
        f"<p><em>Published</em> figures are those of {escape(campaign.source)}.</p>"
        if campaign.published
        else ""
    )
    return f"""<p><strong>NEES</strong> = eᵀP⁻¹e is <em>not</em> divided by its degrees of freedom,
which are the honest value: {DOF["pose"]} for the pose, {DOF["position"]} for the position,
{DOF["heading"]} for the heading. Steps with a singular P have none, and are with_noun.
<strong>±</strong> is half the {percentage(LEVEL)} interval of the mean over independent runs; hold
the pointer over a number for its ends, which stand in brackets where it is lopsided.
<strong>Honest</strong> is what a filter shows whose covariances are right. A run is
<strong>divergent</strong> when its final position error exceeds
{campaign.divergence_limit:.3g} m, 5 σ of the EKF with Jacobians at the truth.</p>
<p>The <strong>verdict</strong> goes by the pose NEES and by NIS / dof, averaged over time, one
number a run each, and their intervals over the runs, so wide that an honest filter is rejected in
{percentage(1 - LEVEL)} of campaigns. <em>Noticed</em> is what nine such campaigns in ten would
reject. An asterisk marks a verdict with a reservation:</p>
<dl class="meanings">
{meanings}
</dl>
{published}"""


def _parameters(
    campaign: Campaign, command: str, seed: int | None, versions: Mapping[str, str]
) -> str:
    """The parameters of the campaign as HTML."""
    compiling = duration(campaign.compile_seconds)
    rows = {
        "scenario": escape(campaign.scenario),
        "source": escape(campaign.source),
        "runs": f"{campaign.runs:,}",
        "steps": f"{campaign.steps:,}",
        "number format": escape(campaign.dtype),
        "seed": "–" if seed is None else str(seed),
        "command": f"<code>{escape(command)}</code>" if command else "",
        "divergence limit": f"{campaign.divergence_limit:.4g} m",
        "time": f"{duration(campaign.seconds)}, {compiling} of it compilation",
        "versions": escape(", ".join(f"{name} {number}" for name, number in versions.items())),
    }
    shown = (f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows.items() if value)
    return f'<dl class="parameters">{"".join(shown)}</dl>'


def _figure(number: int, caption: str, figure: Figure, drawn: bytes) -> str:
    """A figure with its caption as HTML, the PNG file embedded."""
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    data = base64.b64encode(drawn).decode("ascii")
    return (
        f'<figure><img width="{width}" height="{height}" alt="{escape(describe(figure))}" '
        f'src="data:image/png;base64,{data}">'
        f"<figcaption><strong>Figure {number}.</strong> {escape(caption)}</figcaption></figure>"
    )


def _nis_interval(summary: Summary) -> str:
    band = summary.nis_band
    return "–" if band is None else f"{band[0]:.4f} – {band[1]:.4f}"
