"""The report of a campaign as one self-contained HTML5 file; and as a fragment for a notebook.

Figures are embedded. The page has no scripts, and forbids the browser to load anything else.
"""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files

from jaxslam.consistency._intervals import EACH, LEVEL, percentage
from jaxslam.consistency._verdict import TESTS
from jaxslam.consistency.campaign import Campaign, Comparison
from jaxslam.core._table import html_of, unbroken, with_word_breaks
from jaxslam.results import _campaign_tables as tables
from jaxslam.results import _report as report
from jaxslam.results._campaign_tables import VERDICTS, average_text, badge, table_of, table_of_pairs
from jaxslam.results.plot import Figure
from jaxslam.results.plot._style import describe, png


def _text(name: str) -> str:
    """A file of this package."""
    return files("jaxslam.results").joinpath("css", name).read_text(encoding="utf-8").strip()


_LIGHT, _DARK, _PARTS = map(_text, ("light.css", "dark.css", "parts.css"))

CSS = f""":root {{ {_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
{_PARTS}
{_text("page.css")}
"""

FRAGMENT_CSS = f"""
.jaxslam {{ {_LIGHT}
  padding: .2rem 1rem 1rem; background: var(--back); color: var(--ink);
  font: 14px/1.5 system-ui, sans-serif; & * {{ box-sizing: border-box; }}
  summary {{ cursor: pointer; }}
{_PARTS}
figure {{ margin: 1rem 0; }} }}"""
"""Rules nested below one class, with light colours alone: figures are light, too."""


_UPRIGHT = 5
"""Largest number of filters whose table is printed upright; with more it has a landscape page."""


def campaign_page(
    campaign: Campaign,
    command: str,
    seed: int | None,
    versions: Mapping[str, str],
    figures: Mapping[str, tuple[str, Figure]],
    draw: Callable[[Figure], bytes] = png,
) -> str:
    """The HTML report of a campaign.

    Args:
        campaign: the campaign.
        command: the command of the campaign.
        seed: the seed of the campaign; None if unknown.
        versions: versions of the software, by name.
        figures: caption and figure by name, in order.
        draw: returns a figure as a PNG file; a cached function if the files are needed elsewhere.
    """
    heading = f"{campaign.scenario}: consistency of {with_noun(len(campaign.filters), 'filter')}"
    sections = {
        "Verdicts": verdict_list(campaign),
        "Measures": measures_table(campaign) + measure_notes(campaign),
        f"Compared with {with_word_breaks(campaign.reference)}, in pairs": pairs_tables(
            campaign.comparisons
        ),
        "How to read it": _conventions(campaign),
        "Figures": _figures(figures, draw),
        "Parameters": _parameters(campaign, command, seed, versions),
    }
    broad = {"Measures": ' class="broad"'} if len(campaign.filters) > _UPRIGHT else {}
    main = "\n".join(
        f"<section{broad.get(title, '')}>\n<h2>{title}</h2>\n{content}\n</section>"
        for title, content in sections.items()
        if content
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{escape(heading)}</title>
<style>{CSS}</style>
</head>
<body>
<header>
<p class="kicker">jaxslam · consistency report</p>
<h1>{escape(heading)}</h1>
<p class="lead">{_setup(campaign)}; every filter on the same draws.</p>
</header>
<main>
{main}
</main>
</body>
</html>
"""


def fragment(
    campaign: Campaign,
    figures: Mapping[str, tuple[str, Figure]],
    draw: Callable[[Figure], bytes] = png,
) -> str:
    """The campaign as HTML for a notebook: verdicts, figures, and the measures folded.

    See `campaign_page` for the arguments. The style of the fragment does not apply to the rest of
    the notebook.
    """
    return f"""<div class="jaxslam">
<style>{FRAGMENT_CSS}</style>
<p><strong>{escape(campaign.scenario)}</strong>: {_setup(campaign)}</p>
{verdict_list(campaign)}
{_figures(figures, draw)}
<details><summary>All measures</summary>
{measures_table(campaign)}
{measure_notes(campaign)}
{pairs_tables(campaign.comparisons)}
</details>
</div>
"""


def comparison_fragment(comparison: Comparison) -> str:
    """Two filters on the same draws as HTML for a notebook."""
    title = escape(f"{comparison.scenario}: {comparison.first} − {comparison.second}")
    return f"""<div class="jaxslam">
<style>{FRAGMENT_CSS}</style>
<p><strong>{title}</strong></p>
{pairs_tables([comparison])}
</div>
"""


def _setup(campaign: Campaign) -> str:
    """The numbers of runs and steps and the number format, as HTML."""
    runs, steps = with_noun(campaign.runs, "Monte-Carlo run"), with_noun(campaign.steps, "step")
    return escape(f"{runs} of {steps} each, in {campaign.dtype}")


def _figures(figures: Mapping[str, tuple[str, Figure]], draw: Callable[[Figure], bytes]) -> str:
    """The figures as HTML, numbered, with the PNG files embedded."""
    out = []
    for i, (caption, figure) in enumerate(figures.values(), 1):
        width, height = (round(96 * inches) for inches in figure.get_size_inches())
        data = base64.b64encode(draw(figure)).decode("ascii")
        out.append(
            f'<figure><img width="{width}" height="{height}" alt="{escape(describe(figure))}" '
            f'src="data:image/png;base64,{data}">'
            f"<figcaption><strong>Figure {i}.</strong> {escape(caption)}</figcaption></figure>"
        )
    return "\n".join(out)


def _conventions(campaign: Campaign) -> str:
    """The definitions of measures and verdicts as HTML."""
    level, rejected = unbroken(percentage(EACH, 1)), unbroken(percentage(1 - LEVEL))
    meanings = "\n".join(
        f"<dt>{badge(verdict)}</dt><dd>{escape(meaning)}.</dd>"
        for verdict, (_, meaning) in VERDICTS.items()
    )
    return f"""<p><strong>NEES</strong> = eᵀP⁻¹e is <em>not</em> divided by its degrees of freedom,
which are the honest value. <strong>±</strong> is half the {level} interval of the mean
over independent runs. A run is <strong>inaccurate</strong> when its final position error exceeds
{campaign.divergence_limit:.3g} m, 5 σ of the EKF with Jacobians at the truth, and
<strong>divergent</strong> when it also exceeds 5 σ of what the filter claims.</p>
<p>The <strong>verdict</strong> goes by the intervals of the pose NEES and of NIS / dof, averaged
over time: together they reject an honest filter of a linear problem in {rejected}
of campaigns. An asterisk marks a verdict with a doubt:</p>
<dl class="meanings">
{meanings}
</dl>"""


def _parameters(
    campaign: Campaign, command: str, seed: int | None, versions: Mapping[str, str]
) -> str:
    """The parameters of the campaign as HTML."""
    compiling = duration(campaign.compile_seconds)
    rows = {
        "scenario": campaign.scenario,
        "source": campaign.source,
        "runs": f"{campaign.runs:,}",
        "steps": f"{campaign.steps:,}",
        "number format": campaign.dtype,
        "seed": "–" if seed is None else str(seed),
        "command": command,
        "divergence limit": f"{campaign.divergence_limit:.4g} m",
        "time": f"{duration(campaign.seconds)}, {compiling} of it compilation",
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
    }
    shown = (f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in rows.items() if value)
    return f'<dl class="parameters">{"".join(shown)}</dl>'


def verdict_list(campaign: Campaign) -> str:
    """Name, badge and tested measures of each filter, and notes on the verdicts, as HTML."""
    items = []
    for name, summary in campaign.filters.items():
        tested = [key for key in TESTS if key in summary.measures]
        values = [f"{TESTS[key]} {average_text(summary.measures[key])}" for key in tested]
        if tested and summary.not_finite_runs:
            values.append(f"averages of the {summary.counts['runs']:,} finite runs")
        lines = "".join(f'<span class="why">{line}</span>' for line in values or ["no pose NEES"])
        label = f'<span class="name">{with_word_breaks(name)}</span>'
        items.append(f"<li>{label}{badge(summary.verdict, summary)}{lines}</li>")
    lost = (f"{name} {phrase}" for name, phrase in tables.lost_runs(campaign))
    sentences = [*report.sentences_on_verdicts(campaign), *lost]
    notes = [f'<p class="note">{escape(sentence)}.</p>' for sentence in sentences]
    notes += [f"<pre>{escape(text)}</pre>" for text in campaign.notes]
    return "\n".join(['<ul class="verdicts">', *items, "</ul>", *notes])


def measures_table(campaign: Campaign) -> str:
    """The table of measures × filters as HTML."""
    return html_of(table_of(campaign), "Measures of every filter")


def pairs_tables(comparisons: Sequence[Comparison]) -> str:
    """A table of measures for each comparison, and notes below them, as HTML."""
    parts = [
        html_of(table_of_pairs(pair), f"{pair.first} and {pair.second} in pairs")
        for pair in comparisons
    ]
    return "\n".join([*parts, _notes(tables.notes_on_pairs(comparisons))])


def measure_notes(campaign: Campaign) -> str:
    """The notes on the measures, as HTML."""
    return _notes(tables.notes_on(campaign))


def _notes(notes: Iterable[tuple[str, str]]) -> str:
    """Terms, each with a sentence, as HTML."""
    return "\n".join(
        f'<p class="note"><strong>{escape(term)}</strong>: {escape(sentence)}.</p>'
        for term, sentence in notes
    )


def with_noun(number: int, noun: str) -> str:
    """A number with its noun: 1 run, 2 runs."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """A duration in seconds, minutes or hours."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
