"""A campaign as one page: a self-contained HTML5 file that opens from disk, without scripts.

Nothing in it is loaded from anywhere: figures are embedded, and the page forbids the rest.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from jaxslam.consistency import DOF, LEVEL, Measure, Summary
from jaxslam.monte_carlo import Campaign
from jaxslam.plot import Figure, describe, png

VERDICTS = {
    "consistent": ("✓", f"{DOF['pose']} lies in the interval of the mean pose NEES"),
    "optimistic": ("▲", "the interval lies above: covariances are claimed too small"),
    "pessimistic": ("▼", "the interval lies below: covariances are claimed too large"),
    "diverged": ("✕", "over half of the runs are not finite or divergent"),
    "undecided": ("?", "fewer than two runs have a NEES"),
}
"""Each verdict with its sign and its meaning."""

_SHOWN = 20
"""of the numbers of runs that were not finite."""

_UPRIGHT = 5
"""With more filters, the table is printed on a page of its own, across."""

_ALWAYS = ("runs", "not_finite", "divergent")


def page(
    campaign: Campaign,
    table: Sequence[tuple[str, str, str]],
    command: str,
    seed: int | None,
    versions: Mapping[str, str],
    figures: Mapping[str, Figure],
) -> str:
    """The whole campaign as the text of one HTML file.

    Args:
        campaign: what to show.
        table: rows in order, each (key of `Summary.measures`, label, what an honest filter shows);
            a label that starts with a space is indented. Rows that no filter has are left out.
        command, seed: how to run it again; None where there was no seed.
        versions: of what computed it, by name.
        figures: by caption, in order.
    """
    names = list(campaign.filters)
    heading = f"{campaign.scenario}: consistency of {_count(len(names), 'filter')}"
    setup = f"{_count(campaign.runs, 'Monte-Carlo run')} of {_count(campaign.steps, 'step')}"
    shown = "\n".join(
        _figure(i, caption, figure) for i, (caption, figure) in enumerate(figures.items(), 1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{escape(heading)}</title>
<style>{_CSS}</style>
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
    """One line a filter: name, badge, and the pose NEES it was judged by."""
    out = []
    for name, summary in campaign.filters.items():
        nees = summary.measures.get("nees_pose")
        said = f"pose NEES {_cell(nees)}" if nees else "no pose NEES"
        out.append(
            f'<li><span class="name">{_broken(name)}</span>{_badge(summary.verdict)}'
            f'<span class="why">{said}</span></li>'
        )
    return "\n".join(out)


def _badge(verdict: str) -> str:
    sign, meaning = VERDICTS.get(verdict, ("·", ""))
    kind = verdict if verdict in VERDICTS else "undecided"
    return (
        f'<span class="badge {kind}" title="{escape(meaning)}"><span aria-hidden="true">{sign}'
        f"</span> {escape(verdict)}</span>"
    )


def _measures(campaign: Campaign, table: Sequence[tuple[str, str, str]]) -> str:
    """Measures × filters; published figures under our own."""
    summaries = campaign.filters
    head = "".join(f'<th scope="col">{_broken(name)}</th>' for name in summaries)
    verdicts = "".join(f"<td>{_badge(s.verdict)}</td>" for s in summaries.values())
    body = [_row("verdict", "consistent", verdicts)]
    for key, label, honest in table:
        published = [campaign.published.get(name, {}).get(key) for name in summaries]
        measures = [s.measures.get(key) for s in summaries.values()]
        if any(m is not None for m in measures) or any(p is not None for p in published):
            cells = "".join(
                f"<td{_interval(m)}>{_cell(m)}{_published(p)}</td>"
                for m, p in zip(measures, published, strict=True)
            )
            body.append(_row(label, honest, cells))
    bands = [_row(f"NIS / dof, {_share(LEVEL)} band", "", _cells(map(_band, summaries.values())))]
    for block in DOF:
        shares = [
            _share(s.inside[block], 1) if block in s.inside else "–" for s in summaries.values()
        ]
        bands.append(_row(f"steps in {block} band", _share(LEVEL, 1), _cells(shares)))
    counts = []
    for key in next(iter(summaries.values())).counts:
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
    kind = ' class="sub"' if label.startswith(" ") else ""
    honest = escape(honest.replace(">=", "≥").replace("<=", "≤"))
    return (
        f'<tr><th scope="row"{kind}>{escape(label.strip())}</th><td class="honest">{honest}</td>'
        f"{cells}</tr>"
    )


def _cells(texts: Iterable[str]) -> str:
    return "".join(f"<td>{text}</td>" for text in texts)


def _lost(campaign: Campaign) -> str:
    """A sentence on each filter that was not finite in some runs, with the numbers of those."""
    out = []
    for name, summary in campaign.filters.items():
        lost = summary.not_finite_runs
        if lost:
            numbers = ", ".join(map(str, lost[:_SHOWN])) + (", …" if len(lost) > _SHOWN else "")
            out.append(
                f'<p class="note"><strong>{escape(name)}</strong> was not finite in {len(lost):,} '
                f"of {campaign.runs:,} runs: {numbers}.</p>"
            )
    return "\n".join(out)


def _conventions(campaign: Campaign) -> str:
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
{DOF["heading"]} for the heading. Steps with a singular P have none, and are counted.
<strong>±</strong> is half the {_share(LEVEL)} interval of the mean over independent runs
(Student’s t); hold the pointer over a number for its ends. <strong>Honest</strong> is what a filter
shows whose covariances are right. A run is <strong>divergent</strong> when its final position
error exceeds {campaign.divergence_limit:.3g} m, 5 σ of the EKF with Jacobians at the truth.</p>
<p>The <strong>verdict</strong> goes by the pose NEES averaged over time, one number a run, and its
{_share(LEVEL)} interval over the runs:</p>
<dl class="meanings">
{meanings}
</dl>
{published}"""


def _parameters(
    campaign: Campaign, command: str, seed: int | None, versions: Mapping[str, str]
) -> str:
    rows = {
        "scenario": escape(campaign.scenario),
        "source": escape(campaign.source),
        "runs": f"{campaign.runs:,}",
        "steps": f"{campaign.steps:,}",
        "number format": escape(campaign.dtype),
        "seed": "–" if seed is None else str(seed),
        "command": f"<code>{escape(command)}</code>" if command else "",
        "divergence limit": f"{campaign.divergence_limit:.4g} m",
        "time": f"{_time(campaign.seconds)}, {_time(campaign.compile_seconds)} of it compilation",
        "versions": escape(", ".join(f"{name} {number}" for name, number in versions.items())),
    }
    shown = (f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows.items() if value)
    return f'<dl class="parameters">{"".join(shown)}</dl>'


def _figure(number: int, caption: str, figure: Figure) -> str:
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    data = base64.b64encode(png(figure)).decode("ascii")
    return (
        f'<figure><img width="{width}" height="{height}" alt="{escape(describe(figure))}" '
        f'src="data:image/png;base64,{data}">'
        f"<figcaption><strong>Figure {number}.</strong> {escape(caption)}</figcaption></figure>"
    )


def _cell(measure: Measure | None) -> str:
    """value ± half-width, to two digits of the half-width."""
    if measure is None:
        return "–"
    half = (measure.high - measure.low) / 2
    if not np.isfinite(half):
        return _number(measure.value, 4)
    if half == 0:
        return f"{_number(measure.value, 4)} ± 0"
    size = max(abs(measure.value), half)
    if not 1e-3 <= size < 1e6:
        return f"{_number(measure.value, 2)} ± {_number(half, 2)}"
    digits = min(max(1 - int(np.floor(np.log10(half))), 0), 6)
    return f"{measure.value:,.{digits}f} ± {half:,.{digits}f}".replace("-", "−")


def _number(value: float, digits: int) -> str:
    """So many significant digits; tiny and huge ones as a power of ten."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits}g}".replace("-", "−")
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10<sup>{int(power)}</sup>".replace("-", "−")


def _interval(measure: Measure | None) -> str:
    if measure is None or not np.isfinite(measure.low):
        return ""
    return f' title="{_share(LEVEL)} interval {measure.low:.5g} to {measure.high:.5g}"'


def _published(value: float | None) -> str:
    return "" if value is None else f'<span class="published">published {_number(value, 4)}</span>'


def _band(summary: Summary) -> str:
    band = summary.nis_band
    return "–" if band is None else f"{band[0]:.4f} – {band[1]:.4f}"


def _broken(name: str) -> str:
    """Escaped, with places where a long name may break."""
    return escape(name).replace("_", "_<wbr>")


def _share(share: float, digits: int = 0) -> str:
    """As a percentage, with a space that does not break."""
    return f"{100 * share:.{digits}f}\N{NO-BREAK SPACE}%"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

_CSS = """
:root { color-scheme: light dark; --ink: #1c2330; --soft: #5b6577; --line: #dfe3ea; --back: #fff;
  --card: #f7f8fa; --accent: #0b5a8f; --good: #0a6b47; --good-bg: #dcf3e8; --over: #9c3b00;
  --over-bg: #fde6d6; --under: #22508f; --under-bg: #dfe9f8; --bad: #a3123a; --bad-bg: #fbdfe6;
  --none: #4d5566; --none-bg: #e8eaef; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ef; --soft: #9aa5b8; --line: #333b49;
  --back: #14181f; --card: #1b212b; --accent: #7cc0f0; --good: #7fdcb2; --good-bg: #123a2b;
  --over: #ffb284; --over-bg: #47250f; --under: #a4c6fb; --under-bg: #1b2f50; --bad: #ff9db4;
  --bad-bg: #4a1524; --none: #c0c7d4; --none-bg: #2b323e; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 2.5rem 1.5rem 4rem; background: var(--back);
  color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans",
  "DejaVu Sans", sans-serif; }
header { border-bottom: 2px solid var(--ink); padding-bottom: 1.1rem; }
.kicker { margin: 0; color: var(--accent); font-size: .8rem; font-weight: 600;
  letter-spacing: .08em; text-transform: uppercase; }
h1 { margin: .2rem 0 .3rem; font-size: 1.9rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { margin: 2.4rem 0 .8rem; font-size: 1.2rem; }
.lead { margin: 0; color: var(--soft); }
p { max-width: 46rem; }
.note { margin: .6rem 0 0; color: var(--soft); font-size: .9rem; }
sup { line-height: 0; }
code { font: .86em/1.5 ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace;
  overflow-wrap: anywhere; }
.verdicts { display: grid; grid-template-columns: repeat(auto-fill, minmax(19rem, 1fr));
  gap: .6rem; margin: 0; padding: 0; list-style: none; }
.verdicts li { display: grid; grid-template-columns: 1fr auto; gap: .1rem .8rem;
  align-items: center; padding: .6rem .8rem; background: var(--card);
  border: 1px solid var(--line); border-radius: .5rem; }
.name { font-weight: 600; overflow-wrap: anywhere; }
.why { grid-column: 1 / -1; color: var(--soft); font-size: .86rem;
  font-variant-numeric: tabular-nums; }
.badge { display: inline-block; padding: .08rem .55rem; border-radius: 1rem; font-size: .82rem;
  font-weight: 600; white-space: nowrap; color: var(--none); background: var(--none-bg); }
.consistent { color: var(--good); background: var(--good-bg); }
.optimistic { color: var(--over); background: var(--over-bg); }
.pessimistic { color: var(--under); background: var(--under-bg); }
.diverged { color: var(--bad); background: var(--bad-bg); }
.scroll { overflow-x: auto; border-top: 2px solid var(--ink); border-bottom: 2px solid var(--ink); }
table { border-collapse: separate; border-spacing: 0; width: 100%; font-size: .86rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: .34rem .7rem; text-align: right; white-space: nowrap; vertical-align: top;
  border-bottom: 1px solid var(--line); }
th:first-child { position: sticky; left: 0; text-align: left; font-weight: 500;
  background: var(--back); }
thead th { vertical-align: bottom; font-weight: 600; border-bottom: 1px solid var(--ink); }
thead th:first-child, thead th:nth-child(2) { font-weight: 500; color: var(--soft); }
tbody:last-child tr:last-child > * { border-bottom: 0; }
tbody tr:hover > * { background: var(--card); }
tr th.sub { padding-left: 1.6rem; color: var(--soft); }
tbody tr.group th { padding-top: 1rem; font-size: .76rem; font-weight: 600; color: var(--soft);
  letter-spacing: .06em; text-transform: uppercase; background: var(--back); }
.honest { color: var(--soft); }
.published { display: block; color: var(--soft); font-size: .92em; font-style: italic; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .35rem 1.1rem; margin: 0; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 0 0 2rem; break-inside: avoid; }
img { display: block; max-width: 100%; height: auto; padding: .6rem; background: #fff;
  border: 1px solid var(--line); border-radius: .5rem; }
figcaption { max-width: 46rem; margin-top: .5rem; color: var(--soft); font-size: .9rem; }
figcaption strong { color: var(--ink); }
@page broad { size: landscape; margin: 10mm; }
@media print { :root { color-scheme: light; --ink: #000; --soft: #444; --line: #ccc; --back: #fff;
    --card: #fff; --accent: #000; --good: #0a6b47; --over: #9c3b00; --under: #22508f;
    --bad: #a3123a; --none: #4d5566; --good-bg: #fff; --over-bg: #fff; --under-bg: #fff;
    --bad-bg: #fff; --none-bg: #fff; font-size: 12px; }
  body { max-width: none; padding: 0; font-size: 1rem; } .scroll { overflow: visible; }
  table { font-size: .82rem; } th, td { padding: .15rem .3rem; white-space: normal; }
  th:first-child { position: static; } tr th.sub { padding-left: .9rem; } h2 { break-after: avoid; }
  .badge { padding: 0; } td .badge { font-size: inherit; } .broad { page: broad; }
  .broad table { font-size: .72rem; } tr, li { break-inside: avoid; } }
"""
