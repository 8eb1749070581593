"""The result of a campaign, `Campaign`: its summaries, and how it is shown, saved and tabulated."""

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.consistency._pairs import PairedDifference, compare_runs
from jaxslam.consistency._summary import Summary
from jaxslam.core._names import Named, closest_name
from jaxslam.core._optional import loading
from jaxslam.core.types import Estimate, Truth
from jaxslam.core.validation import InvalidField


@dataclass(frozen=True, repr=False)
class Campaign:
    """The result of a campaign: its settings, and a `Summary` for each filter by name.

    `print(campaign)` is the table of verdicts and measures that the command prints, and a notebook
    shows verdicts and figures. `save` writes the whole report, `to_dataframe` has the runs.
    """

    scenario: str
    source: str
    published: dict[str, dict[str, float]]
    steps: int
    runs: int
    dtype: str
    divergence_limit: float
    """final position error beyond which a run is inaccurate [m]: 5 σ, with σ² = tr P of the
    position at the end of an EKF with Jacobians at the truth, in run 0. One whose error is also
    over 5 σ of what the filter claims is divergent"""
    filters: dict[str, Summary]
    seconds: float
    """wall time, compilation included."""
    compile_seconds: float
    """wall time until the last program was traced, and compiled or loaded, while earlier blocks may
    already run; 0 if no run was left"""
    step_seconds: dict[str, float]
    """Wall time of a step of one run on one device, by filter: the median over the blocks of this
    process, if possible those without compilation beside them. Blocks may overlap. Filters that
    this process did not time are absent."""
    first: dict[str, tuple[Truth, Estimate]] = field(default_factory=dict)
    """Run 0 by filter, host arrays; absent for filters that this process did not run. For
    landmarks other than points, the truth has their positions."""
    run_numbers: np.ndarray = field(default_factory=lambda: np.arange(0))
    """(runs,) the number of each run, in the order of `Summary.per_run`; run i has key
    fold_in(key, i)"""
    reference: str = ""
    """the filter with which table, page and files compare every other, in pairs; "": none.
    `dataclasses.replace(campaign, reference="ekf")` sets it, and `--compare`"""
    run_seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of a run, by the name of an estimator that is called or started once a run: the
    median, with its start."""
    notes: tuple[str, ...] = ()
    """texts below the table, of several lines each, as the traceback of an estimator's first
    failure"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "filters", Named(self.filters))
        if self.reference and self.reference not in self.filters:
            reason = self._unknown(self.reference)
            raise InvalidField("reference", reason, owner="Campaign")

    @property
    def size(self) -> str:
        """Runs, steps and precision, as "100 runs × 40 steps, float64"."""
        counts = (
            f"{n} {noun}" + "s" * (n != 1) for n, noun in ((self.runs, "run"), (self.steps, "step"))
        )
        return f"{' × '.join(counts)}, {self.dtype}"

    @property
    def verdicts(self) -> dict[str, str]:
        """The verdict of each filter, as printed: with an asterisk if it has doubts."""
        return Named({n: s.verdict + "*" * bool(s.doubts) for n, s in self.filters.items()})

    def __repr__(self) -> str:
        verdicts = ", ".join(f"{name}={verdict}" for name, verdict in self.verdicts.items())
        text = f"Campaign({self.scenario}, {self.size}, {verdicts})"
        return textwrap.fill(text, 100, subsequent_indent="    ", break_long_words=False)

    def __str__(self) -> str:
        from jaxslam.results import _report as report

        return report.campaign_table(self)

    def _repr_html_(self) -> str:
        """Verdicts, two figures and all measures as HTML, for a notebook."""
        from jaxslam.results import _campaign_files as campaign_files

        return campaign_files.notebook(self)

    def save(
        self,
        folder: str | Path,
        figures: Iterable[str] = ("png",),
        overwrite: bool = False,
    ) -> list[Path]:
        """Write the report into a folder, and return the paths of its files.

        They are report.html (one page with its figures embedded), consistency.json (verdicts,
        measures and counts), measures.csv (the table of them), consistency.csv (the averages of
        every step) and the figures. The numbers are written before a figure is drawn, and one that
        cannot be drawn is left out, with a warning. Two figures show run 0 of each filter; they are
        left out where this process did not compute that run (`first`).

        Args:
            folder: it is created if needed.
            figures: formats of the files of figures, of png, pdf and svg; () writes none.
            overwrite: whether files of these names that are in the folder are replaced. Figures of
                another campaign's report are then removed.
        Raises:
            ValueError: on another format, an empty name of a folder, and on the first file that is
                there already unless it may be overwritten.
            OSError: if the folder cannot be written, before anything is drawn.
        """
        from jaxslam.results import _campaign_files as campaign_files

        return campaign_files.save_campaign(self, folder, figures, overwrite)

    def compare(self, first: str, second: str) -> "Comparison":
        """The differences of two filters over the runs, first - second.

        Both have the same draws, so the difference of a run does not have their luck: its interval
        is narrower than that of two campaigns. Runs that one of the two lost are left out.

        Raises:
            ValueError: on a name that no filter has, the same name twice, and where under two runs
                are left.
        """
        for name in (first, second):
            if not isinstance(name, str) or name not in self.filters:
                raise ValueError(f"Campaign.compare: {self._unknown(name)}")
        if first == second:
            raise ValueError(f"Campaign.compare: expected two filters, got {first!r} twice")
        comparison = self._comparison(first, second)
        if comparison.runs < 2:
            raise ValueError(
                f"Campaign.compare: expected at least 2 runs that both {first} and {second} "
                f"finished, got {comparison.runs} of {self.runs}"
            )
        return comparison

    @property
    def comparisons(self) -> "list[Comparison]":
        """Comparisons of every other filter with `reference`; without measures below two runs."""
        others = (name for name in self.filters if name != self.reference)
        return [self._comparison(name, self.reference) for name in others if self.reference]

    def _comparison(self, first: str, second: str) -> "Comparison":
        pair = self.filters[first], self.filters[second]
        runs, measures, doubts = compare_runs((first, second), *pair, self.runs)
        return Comparison(
            scenario=self.scenario,
            first=first,
            second=second,
            runs=runs,
            lost={first: pair[0].not_finite_runs, second: pair[1].not_finite_runs},
            measures=measures,
            doubts=doubts,
        )

    def _unknown(self, name: object) -> str:
        """A phrase on a name that no filter has."""
        names = ", ".join(self.filters)
        return f"expected one of {names}, got {name!r}{closest_name(name, self.filters)}"

    def to_dataframe(self) -> Any:
        """A pandas DataFrame with a row for each run of each filter.

        Columns: filter; run, its number; finite, whether the filter's numbers were; and each
        measure of `Summary.per_run`, averaged over the steps of that run. Squares are in m² or
        rad², as square_position, whose mean over runs has the RMSE as its root. NaN: the run has no
        such average.

        Raises:
            ImportError: where pandas cannot be used; jaxslam does not require it.
        """
        with loading("Campaign.to_dataframe", "pandas"):
            import pandas
        return pandas.DataFrame(self._run_columns())

    def _run_columns(self) -> dict[str, np.ndarray]:
        numbers, filters = self.run_numbers, self.filters
        absent = np.full(len(numbers), np.nan)
        names = dict.fromkeys(name for s in filters.values() for name in s.per_run)
        lost = [np.isin(numbers, s.not_finite_runs) for s in filters.values()]
        columns: dict[str, np.ndarray] = {
            "filter": np.repeat(np.array(list(filters), object), len(numbers)),
            "run": np.tile(numbers, len(filters)),
            "finite": ~np.concatenate(lost),
        }
        for name in names:
            columns[name] = np.concatenate([s.per_run.get(name, absent) for s in filters.values()])
        return columns


@dataclass(frozen=True, repr=False)
class Comparison:
    """Two filters of a campaign over the same draws: `Campaign.compare`. It prints as a table."""

    scenario: str
    first: str
    second: str
    runs: int
    """number of the runs that neither lost; the others are left out"""
    lost: dict[str, list[int]]
    """numbers of the runs that a filter lost, by its name: its numbers were not finite"""
    measures: dict[str, PairedDifference]
    """by key of `Summary.measures`, in the order of tables: of each measure that both have"""
    doubts: tuple[str, ...]
    """sentences that qualify the differences"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "measures", Named(self.measures))

    def __repr__(self) -> str:
        return f"Comparison({self.scenario}, {self.first} - {self.second}, {self.runs} runs)"

    def __str__(self) -> str:
        from jaxslam.results import _report as report

        return report.comparison_text(self)

    def _repr_html_(self) -> str:
        """The table and its notes as HTML, for a notebook."""
        from jaxslam.results import _campaign_files as campaign_files

        return campaign_files.comparison_in_notebook(self)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, raised after the blocks in flight; `campaign` covers the finished runs, if any."""

    def __init__(self, campaign: Campaign | None, runs: int) -> None:
        super().__init__(f"{campaign.runs if campaign else 0} of {runs} runs done")
        self.campaign = campaign
        if campaign is not None:
            self.add_note("The field `campaign` of this exception has the finished runs.")


class Incomplete(RuntimeError):
    """The workers of an executor failed; `campaign` covers the finished runs, if any."""

    def __init__(self, message: str, campaign: Campaign | None = None) -> None:
        super().__init__(message)
        self.campaign = campaign
        if campaign is not None:
            self.add_note("The field `campaign` of this exception has the finished runs.")
