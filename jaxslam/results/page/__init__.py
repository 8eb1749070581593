"""The report of a campaign as one self-contained HTML5 file; and as a fragment for a notebook.

Figures are embedded; there are no scripts, and the page forbids the browser to load anything else.
"""

from collections.abc import Callable, Mapping
from html import escape

from jaxslam.consistency import LEVEL
from jaxslam.consistency.campaign import Campaign
from jaxslam.results.page.parts import (
    badge,
    duration,
    embedded_figure,
    measure_notes,
    measures_table,
    percentage,
    verdict_list,
    with_noun,
)
from jaxslam.results.page.style import CSS, FRAGMENT_CSS
from jaxslam.results.plot import Figure, png
from jaxslam.results.table import VERDICTS

__all__ = ["VERDICTS", "fragment", "page"]

_UPRIGHT = 5
"""With more filters, the table is printed on a landscape page of its own."""


def page(
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
        command, seed: those of the campaign; None where there was no seed.
        versions: of the software, by name.
        figures: in order, by name, each with its caption.
        draw: makes a PNG file of a figure; with a cache where the files are needed elsewhere, too.
    """
    heading = f"{campaign.scenario}: consistency of {with_noun(len(campaign.filters), 'filter')}"
    sections = {
        "Verdicts": verdict_list(campaign),
        "Measures": measures_table(campaign) + measure_notes(campaign),
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
    """The HTML that a notebook shows of a campaign: verdicts, these figures, the measures folded.

    The arguments are those of `page`. Its style applies to nothing else on the page.
    """
    return f"""<div class="jaxslam">
<style>{FRAGMENT_CSS}</style>
<p><strong>{escape(campaign.scenario)}</strong>: {_setup(campaign)}</p>
{verdict_list(campaign)}
{_figures(figures, draw)}
<details><summary>All measures</summary>
{measures_table(campaign)}
{measure_notes(campaign)}
</details>
</div>
"""


def _setup(campaign: Campaign) -> str:
    """How many runs there are, of how many steps, in which number format; as HTML."""
    runs, steps = with_noun(campaign.runs, "Monte-Carlo run"), with_noun(campaign.steps, "step")
    return escape(f"{runs} of {steps} each, in {campaign.dtype}")


def _figures(figures: Mapping[str, tuple[str, Figure]], draw: Callable[[Figure], bytes]) -> str:
    """The figures as HTML, numbered."""
    return "\n".join(
        embedded_figure(i, caption, figure, draw(figure))
        for i, (caption, figure) in enumerate(figures.values(), 1)
    )


def _conventions(campaign: Campaign) -> str:
    """The definitions of measures and verdicts as HTML."""
    meanings = "\n".join(
        f"<dt>{badge(verdict)}</dt><dd>{escape(meaning)}.</dd>"
        for verdict, (_, meaning) in VERDICTS.items()
    )
    return f"""<p><strong>NEES</strong> = eᵀP⁻¹e is <em>not</em> divided by its degrees of freedom,
which are the honest value. <strong>±</strong> is half the {percentage(LEVEL)} interval of the mean
over independent runs. A run is <strong>divergent</strong> when its final position error exceeds
{campaign.divergence_limit:.3g} m, 5 σ of the EKF with Jacobians at the truth.</p>
<p>The <strong>verdict</strong> goes by the pose NEES and by NIS / dof, averaged over time, with
intervals so wide that an honest filter of a linear problem is rejected in {percentage(1 - LEVEL)}
of campaigns. An asterisk marks a verdict with a reservation:</p>
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
