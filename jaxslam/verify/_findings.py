"""The results of a verification: findings on Jacobians, other checks, and their text."""

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import TypedDict

from jaxslam.core._table import Row, Table, text_of

_SHOWN = 3
"""number of wrong entries of a Jacobian that are printed with their values; others by name only"""
_COLUMNS = (
    "by hand: number of Jacobians with a hand-derived claim;",
    "float64, float32: largest difference of autodiff and hand-derived Jacobian, relative to the",
    "row; differences: of these and difference quotients; linearity: median linearity index.",
)


@dataclass(frozen=True)
class WrongEntry:
    """An entry of a Jacobian on which the methods differ, with the state where they differ most."""

    row: str
    """the output, with its unit"""
    column: str
    """the entry of the argument, with its unit"""
    states: int
    """number of states at which it is wrong"""
    precision: str
    """float64 or float32, in which they differ most"""
    label: str
    """name of the kind of state"""
    state: dict[str, list[float]]
    values: dict[str, float]
    """the entry at that state, by each method"""
    dissent: tuple[str, ...]
    """the methods that disagree with the others at that state"""
    far_alone: bool = False
    """True if it is wrong only at large coordinates, as if a subtraction lost digits"""

    def lines(self, samples: int) -> Iterator[str]:
        """The entry as lines of text."""
        odd = (
            f"{' and '.join(self.dissent)} {'disagrees' if len(self.dissent) == 1 else 'disagree'}"
        )
        who = f"{odd} with the others" if self.dissent else "no two agree"
        yield f"entry ({self.row}, {self.column}): {who}, at {self.states} of {samples} states"
        yield "  " + ", ".join(f"{how} {value:.12g}" for how, value in self.values.items())
        at = ", ".join(f"{k} = ({', '.join(f'{v:.6g}' for v in x)})" for k, x in self.state.items())
        yield f"  {self.precision}, {self.label}: {at}"
        if self.far_alone:
            yield "  right at all other states: what subtracts large coordinates loses digits"


class WorstState(TypedDict, total=False):
    """The state with the largest difference over its tolerance; empty without a state."""

    label: str
    """name of the kind of state"""
    entry: tuple[str, str]
    """the output and the entry of the argument, with their units"""
    state: dict[str, list[float]]


@dataclass(frozen=True)
class Finding:
    """The comparison of one Jacobian: how far its methods differ, and its wrong entries."""

    function: str
    argument: str
    passed: bool
    methods: tuple[str, ...]
    """the methods by which it was computed: jacfwd, jacrev, hand, differences"""
    absolute: float
    """largest difference among jacfwd, jacrev and hand, in float64"""
    relative: float
    """largest difference over the largest entry of the Jacobian's row at that state; without the
    rounding of autodiff, where only that is beyond the tolerance"""
    tolerance: float
    float32: float | None
    """largest relative difference in float32; None where it was not computed"""
    float32_tolerance: float
    differences: float
    """largest relative difference from the quotients, where they converge; their estimated error
    counts as rounding"""
    differences_tolerance: float
    samples: int
    no_derivative: int
    """number of samples at which the quotients do not converge and are ignored"""
    worst_state: WorstState
    wrong_entries: tuple[WrongEntry, ...]
    """every entry outside its tolerance at some state, in falling order of the number of states"""

    @property
    def name(self) -> str:
        """Function and argument, as in "observe by pose"."""
        return f"{self.function} by {self.argument}"

    @property
    def claimed(self) -> bool:
        """Whether a hand-derived Jacobian was compared with the others."""
        return "hand" in self.methods

    def lines(self) -> Iterator[str]:
        """The finding as lines of text, longer where it failed."""
        odd = f", {self.no_derivative} at a kink left out" if self.no_derivative else ""
        verdict = "ok  " if self.passed else "FAIL"
        worst = f"worst {_two_digits(self.absolute)} abs, {_two_digits(self.relative)} rel"
        if self.float32 is not None:
            worst += f", float32 {_two_digits(self.float32)}"
        worst += f", differences {_two_digits(self.differences)}"
        if not (self.samples and math.isfinite(self.absolute)):
            worst = "a derivative is not finite" if self.samples else "no value is finite"
        claim = "hand-derived" if self.claimed else "no hand-derived claim"
        if not {"jacfwd", "jacrev"} & {*self.methods}:
            claim += ", compared with differences alone"
        yield f"{verdict}  {self.name} ({claim}): {worst}; {self.samples} states{odd}"
        for entry in self.wrong_entries[:_SHOWN]:
            yield from (f"      {line}" for line in entry.lines(self.samples))
        if len(self.wrong_entries) > _SHOWN:
            rest = ", ".join(f"({e.row}, {e.column})" for e in self.wrong_entries[_SHOWN:])
            yield f"      and {rest}"


@dataclass(frozen=True)
class Check:
    """The result of a check, of a property other than a Jacobian."""

    name: str
    passed: bool
    detail: str = ""

    def __str__(self) -> str:
        """The check as a line of text."""
        detail = f": {self.detail}" if self.detail else ""
        return f"{'ok  ' if self.passed else 'FAIL'}  {self.name}{detail}"


@dataclass(frozen=True, repr=False)
class Report:
    """The report on one model; `print` shows it, and `passed` is the result."""

    model: str
    kind: str
    findings: tuple[Finding, ...] = ()
    checks: tuple[Check, ...] = ()
    linearity: float | None = None
    """median of a model's `linearity_index` over the random states, for standard deviations of 0.1
    (0.05 of [rad] and [1/m])"""
    notes: tuple[str, ...] = field(default=())
    """remarks that are not failures"""

    @property
    def passed(self) -> bool:
        """Whether nothing failed and some Jacobian was compared."""
        return bool(self.findings) and self.failures == 0

    @property
    def failures(self) -> int:
        """Number of Jacobians and other checks that failed."""
        verdicts = [f.passed for f in self.findings] + [c.passed for c in self.checks]
        return verdicts.count(False)

    def __str__(self) -> str:
        """The report as text."""
        verdict = "verified" if self.passed else f"{self.failures} FAILED"
        if self.passed and self.notes:
            verdict += f", with {len(self.notes)} note{'s' if len(self.notes) > 1 else ''}"
        unclaimed = [finding.name for finding in self.findings if not finding.claimed]
        if unclaimed:
            verdict += "; no hand-derived claim"
        if 0 < len(unclaimed) < len(self.findings):
            verdict += f" of {', '.join(unclaimed)}"
        lines = _wrap(f"{self.kind} {self.model}: {verdict}", 0)
        for finding in self.findings:
            lines += [f"  {line}" for line in finding.lines()]
        for check in self.checks:
            if not check.passed:
                lines.append(f"  {check}")
        held = "; ".join(check.name for check in self.checks if check.passed)
        if held:
            lines += _wrap(f"ok    {held}", 2)
        for note in self.notes:
            lines += _wrap(f"note  {note}", 2)
        if self.linearity is not None:
            lines.append(f"  linearity index {self.linearity:.3g}, median (3 σ of 0.1 m, 0.05 rad)")
        return "\n".join(lines)

    __repr__ = __str__

    def as_dict(self) -> dict[str, object]:
        """The report as a dictionary for JSON; numbers that are not finite are None."""
        fields = {
            "model": self.model,
            "kind": self.kind,
            "passed": self.passed,
            "jacobians": [asdict(finding) for finding in self.findings],
            "checks": [asdict(check) for check in self.checks],
            "linearity_index": self.linearity,
            "notes": self.notes,
        }
        return {key: _json_value(part) for key, part in fields.items()}


def report_table(reports: Sequence[Report]) -> str:
    """The table of reports: a line for each model with its largest differences, and a legend."""
    heads = "Jacobians", "by hand", "float64", "float32", "differences", "checks", "linearity"
    rows = [
        Row(
            report.model,
            [
                str(len(report.findings)),
                str(sum(f.claimed for f in report.findings)),
                _worst([f.relative for f in report.findings]),
                _worst([f.float32 for f in report.findings]),
                _worst([f.differences for f in report.findings]),
                str(len(report.checks)),
                None if report.linearity is None else f"{report.linearity:.3g}",
            ],
            note="ok" if report.passed else f"{report.failures} FAILED",
        )
        for report in reports
    ]
    return "\n".join([text_of(Table(["", *heads], rows), rule=True), "", *_COLUMNS])


def _wrap(text: str, indent: int) -> list[str]:
    """A sentence in lines of at most 100 characters."""
    others = " " * max(indent, 6)
    return textwrap.wrap(text, 100, initial_indent=" " * indent, subsequent_indent=others)


def _worst(values: Sequence[float | None]) -> str:
    """The largest of the values that are not None, as text."""
    present = [value for value in values if value is not None]
    return _two_digits(max(present)) if present else "-"


def _two_digits(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _json_value(value: object) -> object:
    """A value with lists for tuples, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _json_value(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(part) for part in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
