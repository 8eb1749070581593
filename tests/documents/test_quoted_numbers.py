"""Numbers that pages quote from benchmarks are those of benchmarks/records."""

import functools
import json
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from test_docs import PAGES, ROOT

from benchmarks import results

NUMBER = r"-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?"
QUOTED = rf"(?<![\w.,/-]){NUMBER}(?![\w/])"
SCALES = {"%": 100.0, "ms": 1000.0, "mm": 1000.0, "mrad": 1000.0}
UNIT = r"(%|(?:ms|mm|mrad)\b)"
AFTER = r"(?:[\s\d.,;±–\[\]()-]|\b(?:to|and|or)\b)*" + UNIT
"""a unit, after other numbers that it is of"""
CITED = r"--record --only (\w+)"
GIVEN = {
    "docs/background/limits.md": {"0.10"},  # a version of jaxlib
    "docs/guide/animation.md": {"100"},  # frames
    "docs/guide/beyond_one_machine.md": {"3.13", "2026.8", "4.1", "22.05"},  # versions
    "docs/guide/campaigns.md": {
        "200",
        "102,400",
        "256",
        "434",
        "2,000",
        "0.11",
    },  # steps, sizes, jax
    "docs/guide/choosing_a_filter.md": {"0.5", "0.1"},  # of a start, of a sensor
    "docs/guide/consistency.md": {"0.95"},  # a coverage
    "docs/guide/differentiating.md": {"200"},  # steps
    # beams, the range for none, measurements in a log
    "docs/guide/real_data.md": {"180", "360", "400", "401", "32.767", "61,086", "58,663", "13,403"},
    "docs/guide/twins.md": {"900"},  # rows of a log
    "docs/methods/association.md": {"500"},  # draws
    "docs/methods/bearings_and_ranges.md": {"2.5", "0.5"},  # standard deviations of range
    "docs/methods/graphs.md": {"100", "434", "3,300"},  # steps, sizes of graphs, a bound of χ²
    "docs/methods/information_filters.md": {"300"},  # steps
    "docs/methods/laser/grid_localization.md": {"5,000"},  # particles
    "docs/methods/laser/grids.md": {"2.37"},  # the honest median of a NEES
    "docs/methods/laser/laser_slam.md": {"910", "406", "340", "292"},  # scans of the logs
    "docs/methods/laser/lines.md": {"180"},  # beams
    "docs/methods/particles.md": {"5,000", "0.5", "99.9"},  # particles, a radius, a gate
    "docs/tutorials/learned_noise.md": {"430", "2.37"},  # measurements, the honest median of a NEES
    "docs/methods/laser/scan_matching.md": {"180", "0.05"},  # beams, the scale of a kernel
}
"""numbers beside results that are none: what a benchmark is given"""


class Quoted(NamedTuple):
    """A number in a page."""

    page: str
    names: tuple[str, ...]
    """the benchmarks that it may be of"""
    number: str
    unit: str
    """one of `SCALES`, beside the number or at the head of its column or row; or none"""
    row: str
    """the last word of the first cell of its row, as `2` of "robot 2"; none outside of tables"""


def quoted() -> Iterator[Quoted]:
    """Every fraction and every number from 100 on that is quoted from a benchmark.

    They stand in a paragraph with the benchmark's command, in a row of a table with it, and in a
    table without: then they are of the last command before, or of any of the page.
    """
    for page, text in PAGES.items():
        if page == "benchmarks/README.md":  # says what benchmarks do, not what they found
            continue
        everywhere = re.findall(r"python -m benchmarks(?: --record --only |\.)(\w+)", text)
        last: list[str] = []
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
        for block in re.split(r"\n{2,}", prose):
            table = block.startswith("|")
            inherits = table and not re.search(CITED, block)
            heads: list[str] = []
            for row in block.strip().split("\n") if table else [block]:
                cited = re.findall(CITED, row)
                last = cited or last
                same = re.search(r"\b[Ss]ame command", row)
                names = last if cited or same else (last or everywhere) if inherits else []
                plain = re.sub(r"`[^`]*`|\$[^$]*\$|\]\([^)]*\)|[\d.]+\s?·\s?10", "", row)
                cells = re.split(r"(?<!\\)\|", plain) if table else [plain]
                word = re.search(r"([\w.-]*)[`*\s]*\|", row[1:]) if heads else None
                heads = heads or cells
                for head, cell in zip(heads, cells, strict=True):
                    beside = re.findall(UNIT, head + cells[1]) if table else []
                    for found in re.finditer(QUOTED, cell) if names else ():
                        number = found[0].rstrip(",")
                        unit = re.match(AFTER, cell[found.end() :])
                        units = [unit[1]] if unit else [*beside, ""]
                        if is_result(page, number):
                            of = tuple(names)
                            yield Quoted(page, of, number, units[0], word[1] if word else "")


def is_result(page: str, number: str) -> bool:
    """Whether a number is tested: not a small integer, a year, or one that is given."""
    large = abs(float(number.replace(",", ""))) >= 100 and not re.match(r"(19|20)\d\d$", number)
    return (large or bool(re.search(r"[.e]", number))) and number not in GIVEN.get(page, ())


@functools.cache
def sections() -> dict[str, str]:
    """The record by benchmark, without dates, versions and gates."""
    out = {}
    for path in (ROOT / "benchmarks" / "records").glob("*.json"):
        record = json.loads(path.read_text(encoding="utf-8"))
        rows = [f"| {m['name']} | {m['value']} | {m['note']} |" for m in record["metrics"]]
        out[path.stem] = "\n".join([*rows, *record["printed"]])
    return out


def test_the_page_of_results_is_that_of_the_records():
    assert results.FILE.read_text(encoding="utf-8") == results.page()


@functools.cache
def recorded(names: tuple[str, ...], row: str) -> np.ndarray:
    """The numbers of some benchmarks; where a table of the record has such a row, those of it."""
    text = "\n".join(sections().get(name, "") for name in names)
    if row and re.search(rf"^\| {re.escape(row)} \|", text, re.MULTILINE):
        of = rf"^\|[^|\n]*(?<![\w.-]){re.escape(row)}(?![\w.-])[^|\n]*\|.*$"
        text = "\n".join(re.findall(of, text, re.MULTILINE))
    found = re.findall(rf"(?<![\w.]){NUMBER}", text)
    return np.array([float(number.replace(",", "")) for number in found])


def is_recorded(quote: Quoted) -> bool:
    """Whether a number is a recorded one, rounded to the digits that the page shows."""
    digits, _, power = quote.number.replace(",", "").partition("e")
    place = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    value = float(f"{digits}e{power or 0}")
    values = recorded(quote.names, quote.row)
    values = values if value < 0 else np.abs(values)
    scaled = [values]
    if quote.unit:
        share = np.abs(values) <= 1
        scaled.append(values[share | (quote.unit != "%")] * SCALES[quote.unit])
    return bool((np.abs(np.concatenate(scaled) - value) <= 0.5001 * place).any())


def test_numbers_that_a_page_quotes_are_those_of_the_record():
    """As they are; as percent where the page says %, in thousandths where it says ms or mm."""
    every = list(quoted())
    assert [quote for quote in every if not is_recorded(quote)] == []
    assert len(every) > 900


def test_a_wrong_number_is_found():
    """Mostly: a benchmark has so many numbers that one of two digits often is among them."""
    every = list(quoted())
    turned = str.maketrans("0123456789", "3456789012")
    wrong = [quote._replace(number=quote.number.translate(turned)) for quote in every]
    assert sum(map(is_recorded, wrong)) < len(every) / 5
