"""The report of a campaign: its files, written all or none, and a fragment for notebooks."""

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import warn

from jaxslam._public import publish
from jaxslam.consistency._tally import Tally
from jaxslam.consistency.campaign import Campaign, Comparison
from jaxslam.consistency.campaign._block import BOUND
from jaxslam.consistency.campaign._harness import summaries_of
from jaxslam.consistency.campaign._kept import add_kept
from jaxslam.consistency.campaign._pieces import missing_pieces
from jaxslam.core._numbers import is_number
from jaxslam.core.validation import InvalidField, refusals_of, require
from jaxslam.results import _report as report
from jaxslam.results import store
from jaxslam.results._files import Files, check_writable, versions, write_files
from jaxslam.verify._user_errors import describe_error

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot import Figure

PAGE, RESULT, CURVES = "report.html", "consistency.json", "consistency.csv"
"""The page; the verdicts, measures and counts; the averages of every step."""

TABLE = "measures.csv"
"""The table of the page."""

TIMES = ("seconds", "compile_seconds", "step_seconds")
"""Entries of `RESULT` that differ between computations of the same runs."""

BLOCKS = "blocks"
"""The folder of a campaign's finished blocks, beside its results."""

JUDGED = {"command": "jaxslam judge"}
"""Settings of the store of judged runs, which no command continues."""

FORMATS = ("png", "pdf", "svg")
"""Formats of the files of figures."""

_OF_A_RUN = ("errors", "map")

FIGURES = ("nees", "rmse", "cost", "coverage", "whiteness", "gained", *_OF_A_RUN)
"""The figures, by the names of their files; the last two are of run 0."""

_IN_NOTEBOOK = ("nees", "rmse")


def file_names(formats: Iterable[str], figures: Iterable[str] = FIGURES) -> list[str]:
    """The names of the files of a campaign's report, with figures in the formats."""
    kinds = list(formats)
    return [PAGE, RESULT, CURVES, TABLE, *(f"{name}.{kind}" for name in figures for kind in kinds)]


def formats_of_figures(formats: str | Iterable[str]) -> tuple[str, ...]:
    """The check of formats of figures, which returns each once."""
    expected = f"expected formats of {', '.join(FORMATS)}"
    try:
        kinds = tuple(dict.fromkeys([formats] if isinstance(formats, str) else formats))
    except TypeError:
        raise ValueError(f"{expected}, or () for none, got {formats!r}") from None
    for kind in kinds:
        if kind not in FORMATS:
            raise ValueError(f"{expected}, got {kind!r}")
    return kinds


def save_campaign(
    campaign: Campaign,
    folder: str | Path,
    figures: str | Iterable[str] = ("png",),
    overwrite: bool = False,
    command: str = "",
    seed: int | None = None,
    tell: Callable[[str], object] = warn,
) -> list[Path]:
    """Write the files of a campaign's report, and return their paths; see `Campaign.save`.

    The numbers are written before a figure is drawn, and a figure that fails is left out.

    Args:
        command: the command of the campaign, for the page and the JSON; "" if unknown.
        seed: the seed of the campaign; None if unknown.
        tell: called with a line on a figure that could not be drawn.
    """
    with refusals_of("Campaign.save"):
        formats = require("figures", figures, formats_of_figures)
        if not isinstance(folder, str | os.PathLike) or not str(folder).strip():
            raise InvalidField("folder", f"expected a path, got {folder!r}")
    folder = Path(folder)
    check_writable(folder)
    names = file_names(formats, FIGURES if campaign.first else FIGURES[: -len(_OF_A_RUN)])
    existing = [name for name in names if (folder / name).exists()]
    if existing and not overwrite:
        raise ValueError(
            f"Campaign.save: {folder / existing[0]} exists: overwrite=True replaces it, or choose "
            "another folder"
        )
    numbers: Files = {
        RESULT: report.as_json(campaign, command, seed),
        CURVES: report.as_csv(campaign),
        TABLE: report.table_csv(campaign),
    }
    # Figures of other numbers are deleted; of the same numbers they stay until they are replaced.
    stale: Iterable[str] = file_names(FORMATS)
    with contextlib.suppress(OSError, ValueError):
        if (folder / RESULT).read_text(encoding="utf-8") == numbers[RESULT]:
            stale = ()
    write_files(folder, numbers, replaces=tuple(stale))
    # Matplotlib is slow to load, and where it cannot be loaded the numbers are there.
    from jaxslam.results import _page as page
    from jaxslam.results.plot._style import encode

    encode_once = cache(encode)  # the page and a file have the same picture
    figures_of_page: dict[str, tuple[str, Figure]] = {}
    pictures: Files = {}
    for name, (caption, draw) in _drawings(campaign, seed).items():
        try:
            figure = draw()
            encode_once(figure, "png")
            files = {f"{name}.{kind}": encode_once(figure, kind) for kind in formats}
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{folder} has the numbers, and no figures") from None
        except Exception as error:
            tell(f"{name} was not drawn: {describe_error(error)}")
        else:
            figures_of_page[name] = caption, figure
            pictures |= files
    html = page.campaign_page(
        campaign,
        command,
        seed,
        versions(),
        figures_of_page,
        lambda figure: encode_once(figure, "png"),
    )
    page_and_figures = write_files(folder, {PAGE: html, **pictures})
    return [page_and_figures[0], *(folder / name for name in numbers), *page_and_figures[1:]]


def load(folder: str | Path) -> Campaign:
    """The finished campaign in a folder written by `jaxslam consistency` or `jaxslam judge`.

        campaign = jaxslam.load("out")
        jaxslam.plot.nees_figure(campaign, width=3.5).savefig("nees.pdf")

    It is read from `blocks/` and `consistency.json`, without the scenario or the filters. Run 0 of
    each filter is not kept: `Campaign.first` is empty, and its two figures need the command.

    Raises:
        ValueError: if the folder holds no campaign, or one that is not finished.
    """
    folder = Path(folder)
    if not (folder / BLOCKS).is_dir():
        reason = f"there is no campaign in {folder}: expected {BLOCKS}/ there"
        if (folder / RESULT).exists():
            reason += ", the runs, which Campaign.save does not keep"
        raise InvalidField("", reason, owner="jaxslam.load")
    kept, path = store.resume(folder / BLOCKS), folder / RESULT
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        faults, run_seconds, notes = _judgement_of(result)
        doubts, reference = _doubts_of(result, kept.campaign), reference_of(result)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        remedy = f"jaxslam consistency --resume {folder} writes them"
        if kept.settings == JUDGED:
            remedy = "judge again"
        raise ValueError(f"{path}: expected the results of a campaign: {remedy}") from error
    runs, tallies = result["runs"], {name: Tally() for name in (*doubts, BOUND)}
    if missing_pieces(add_kept(tallies, kept, runs, lambda first: True), runs, runs):
        raise ValueError(
            f"{folder}: the campaign is not finished: jaxslam consistency --resume {folder}"
        )
    _, limit, summaries = summaries_of(tallies)
    entries = ("scenario", "source", "published", "steps", "dtype")
    return Campaign(
        **{name: result[name] for name in (*entries, *TIMES)},
        runs=runs,
        divergence_limit=float(limit),
        filters={
            name: replace(summary, doubts=doubts[name], faults=faults[name])
            for name, summary in summaries.items()
        },
        run_numbers=tallies[BOUND].numbers(),
        reference=reference,
        run_seconds=run_seconds,
        notes=notes,
    )


def _doubts_of(result: Any, campaign: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """The doubts of each filter in the JSON of a report.

    Raises one of several errors if the JSON is not of a campaign of this identity.
    """
    filters, published, step_seconds = (result[key] for key in ("filters", "published", TIMES[2]))
    texts = [result[name] for name in ("scenario", "source", "dtype")]
    numbers = [*(result[name] for name in TIMES[:2]), *step_seconds.values()]
    numbers += [value for row in published.values() for value in row.values()]
    doubts = {name: tuple(entry["doubts"]) for name, entry in filters.items()}
    texts += [doubt for doubts_of_filter in doubts.values() for doubt in doubts_of_filter]
    if (
        not all(isinstance(text, str) for text in texts)
        or not all(isinstance(entry["doubts"], list) for entry in filters.values())
        or not all(map(is_number, numbers))
        or not all(type(result[name]) is int and result[name] >= 1 for name in ("runs", "steps"))
        or reference_of(result) not in ("", *doubts)
        or ", ".join(doubts) != campaign.get("filters", ", ".join(doubts))
        or str(result["steps"]) != campaign.get("steps", str(result["steps"]))
    ):
        raise ValueError("not the results of this campaign")
    return doubts


def _judgement_of(
    result: Any,
) -> tuple[dict[str, dict[str, tuple[int, ...]]], dict[str, float], tuple[str, ...]]:
    """Faults by filter, seconds of a run and notes in the JSON of a report: of judged estimators.

    Raises one of several errors if the JSON has them in another form.
    """
    faults = {
        name: {str(reason): tuple(map(int, runs)) for reason, runs in entry["faults"].items()}
        if "faults" in entry
        else {}
        for name, entry in result["filters"].items()
    }
    seconds = {str(name): float(value) for name, value in result.get("run_seconds", {}).items()}
    notes = result.get("notes", [])
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise ValueError("not the notes of a campaign")
    return faults, seconds, tuple(notes)


def reference_of(result: Any) -> str:
    """The filter with which the JSON of a report compares every other; "" for none."""
    reference: str = result.get("pairs", {}).get("reference", "")
    return reference


def notebook(campaign: Campaign) -> str:
    """The campaign as a fragment of HTML: verdicts, NEES and RMSE over the steps, all measures."""
    from jaxslam.results import _page as page  # matplotlib is slow to load
    from jaxslam.results.plot._style import png

    drawings = _drawings(campaign, None)
    figures = {}
    for name in _IN_NOTEBOOK:
        caption, draw = drawings[name]
        figures[name] = caption, draw()
    return page.fragment(campaign, figures, partial(png, dpi=110))


def comparison_in_notebook(comparison: Comparison) -> str:
    """Two filters on the same draws as a fragment of HTML."""
    from jaxslam.results import _page as page  # matplotlib is slow to load

    return page.comparison_fragment(comparison)


def _drawings(
    campaign: Campaign, seed: int | None
) -> Mapping[str, tuple[str, Callable[[], "Figure"]]]:
    """The caption of each figure, and a function that draws it, by name."""
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._landmarks import run_map_figure
    from jaxslam.results.plot._pose_errors import run_errors_figure

    bound = any("bound_position" in summary.curves for summary in campaign.filters.values())
    drawings = {
        "nees": ("NEES against time, with its 95 % band", partial(plot.nees_figure, campaign)),
        "rmse": (
            "RMSE, and the conditional Cramér-Rao bound" if bound else "RMSE",
            partial(plot.rmse_figure, campaign),
        ),
        "cost": (
            "Time of a step, error and NEES",
            partial(plot.cost_figure, campaign),
        ),
        "coverage": ("Coverage of the ellipsoids", partial(plot.coverage_figure, campaign)),
        "whiteness": ("Autocorrelation of innovations", partial(plot.whiteness_figure, campaign)),
        "gained": (
            "Information gained about a rotation of the whole frame",
            partial(plot.gained_figure, campaign),
        ),
    }
    if campaign.first:
        title = f"{campaign.scenario}, run 0" + ("" if seed is None else f" of seed {seed}")
        if len(campaign.first) == 1 < len(campaign.filters):
            title += f", {next(iter(campaign.first))}"
        drawings |= {
            "errors": (f"Errors: {title}", partial(run_errors_figure, campaign, title=title)),
            "map": (f"Maps: {title}", partial(run_map_figure, campaign, title=title)),
        }
    return drawings


publish("jaxslam", load)
