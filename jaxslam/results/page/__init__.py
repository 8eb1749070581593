"""The report of a campaign as one self-contained HTML5 file; and as a fragment, without scripts.

Figures are embedded, and the page forbids the browser to load anything else. Its script (`live.js`)
draws the figures that have curves again, to be explored, from the numbers of `curves.py`; on paper
and without JavaScript the page shows the static figures.
"""

from collections.abc import Callable, Mapping
from html import escape

from jaxslam.consistency import DOF, LEVEL
from jaxslam.monte_carlo import Campaign
from jaxslam.results.files import html_page
from jaxslam.results.page import curves
from jaxslam.results.page.parts import (
    badge,
    duration,
    embedded_figure,
    lost_runs,
    measure_notes,
    measures_table,
    percentage,
    verdict_list,
    with_noun,
)
from jaxslam.results.page.style import CSS, FRAGMENT_CSS, SCRIPT, policy
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
    film: str = "",
) -> str:
    """The HTML report of a campaign.

    Args:
        campaign: the campaign.
        command, seed: those of the campaign; None where there was no seed.
        versions: of the software, by name.
        figures: in order, by name, each with its caption. Those of the names of `curves.py` are
            drawn by the script, too.
        draw: makes a PNG file of a figure; with a cache where the files are needed elsewhere, too.
        film: a fragment of HTML above the figures. It is not escaped; its scripts run if they stand
            in it, in elements without attributes.
    """
    heading = f"{campaign.scenario}: consistency of {with_noun(len(campaign.filters), 'filter')}"
    shown = _figures(figures, draw)
    data = curves.embedded_curves(campaign)
    scripts = f"""<script type="application/json" id="curves">{data.text}</script>
<script>{SCRIPT}</script>"""
    body = f"""<header>
<p class="kicker">jaxslam · consistency report</p>
<h1>{escape(heading)}</h1>
<p class="lead">{escape(_setup(campaign))} each, in {escape(campaign.dtype)}; every filter on the
same draws.</p>
</header>
<main>
<section>
<h2>Verdicts</h2>
<ul class="verdicts">
{verdict_list(campaign)}
</ul>
</section>
<section{' class="broad"' if len(campaign.filters) > _UPRIGHT else ""}>
<h2>Measures</h2>
{measures_table(campaign)}
{measure_notes(campaign)}
{lost_runs(campaign)}
</section>
<section>
<h2>How to read it</h2>
{_conventions(campaign)}
</section>
{f"<section><h2>Film</h2>{film}</section>" if film else ""}
{f"<section><h2>Figures</h2>{shown}</section>" if shown else ""}
<section>
<h2>Parameters</h2>
{_parameters(campaign, command, seed, versions, data)}
</section>
</main>
{scripts}"""
    return html_page(heading, policy(film + scripts), CSS, body)


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
<p><strong>{escape(campaign.scenario)}</strong>: {escape(_setup(campaign))} each, in
{escape(campaign.dtype)}</p>
<ul class="verdicts">
{verdict_list(campaign)}
</ul>
{_figures(figures, draw)}
<details><summary>All measures</summary>
{measures_table(campaign)}
{measure_notes(campaign)}
</details>
{lost_runs(campaign)}
</div>
"""


def _setup(campaign: Campaign) -> str:
    """How many runs there are, and of how many steps."""
    runs = with_noun(campaign.runs, "Monte-Carlo run")
    return f"{runs} of {with_noun(campaign.steps, 'step')}"


def _figures(figures: Mapping[str, tuple[str, Figure]], draw: Callable[[Figure], bytes]) -> str:
    """The figures as HTML, numbered."""
    return "\n".join(
        embedded_figure(i, name, caption, figure, draw(figure))
        for i, (name, (caption, figure)) in enumerate(figures.items(), 1)
    )


def _conventions(campaign: Campaign) -> str:
    """The definitions of measures and verdicts as HTML."""
    meanings = "\n".join(
        f"<dt>{badge(verdict)}</dt><dd>{escape(meaning)}.</dd>"
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
<strong>±</strong> is half the {percentage(LEVEL)} interval of the mean over independent runs; hold
the pointer over a number for its ends, which stand in brackets where it is lopsided.
<strong>Honest</strong> is what a filter shows whose covariances are right. A run is
<strong>divergent</strong> when its final position error exceeds
{campaign.divergence_limit:.3g} m, 5 σ of the EKF with Jacobians at the truth.</p>
<p>The <strong>verdict</strong> goes by the pose NEES and by NIS / dof, averaged over time, one
number a run each, and their intervals over the runs, so wide that an honest filter of a linear
problem is rejected in {percentage(1 - LEVEL)} of campaigns. What it has the power to reject, nine
such campaigns in ten would. An asterisk marks a verdict with a reservation:</p>
<dl class="meanings">
{meanings}
</dl>
{published}"""


def _parameters(
    campaign: Campaign,
    command: str,
    seed: int | None,
    versions: Mapping[str, str],
    data: curves.Curves,
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
        "curves on this page": f"{len(data.text.encode()) / 1e3:,.0f} kB, four digits, "
        + (
            "every step"
            if data.each == 1
            else f"least and greatest of each {data.each} steps (consistency.csv has every step)"
        ),
        "versions": escape(", ".join(f"{name} {number}" for name, number in versions.items())),
    }
    shown = (f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows.items() if value)
    return f'<dl class="parameters">{"".join(shown)}</dl>'
