"""Tables as text, Markdown, HTML and CSV: the same rows, in what each format needs."""

import csv
import io
import math
from html.parser import HTMLParser

import pytest

from jaxslam.core._table import Cell, Row, Table, csv_of, html_of, markdown_of, text_of

ROWS = [
    Row("position RMSE", ["", Cell("0.5 ± 0.1", (0.5, 0.4, 0.6)), None], "m"),
    Row("  over bound", ["1", Cell("1.02", (1.02,)), Cell("∞", (math.inf,))]),
]
TABLE = Table(["measure", "honest", "ekf", "a_b"], ROWS, fixed=1)
WIDE = Table(
    ["", "honest", *(f"filter {i}" for i in range(7))],
    [
        Row("both", ["3", *(str(i) for i in range(7))]),
        Row("first", ["", "0", *[None] * 6], note="alone"),
    ],
    fixed=1,
)
SENTENCE = "a start that is far from the truth is moved along the edges first"


class Terminal(io.StringIO):
    """Standard output that is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    def of_width(columns):
        monkeypatch.setattr("sys.stdout", Terminal())
        monkeypatch.setenv("COLUMNS", str(columns))

    return of_width


def test_labels_are_flush_left_and_cells_flush_right():
    assert text_of(TABLE, rule=True).splitlines() == [
        "measure            honest        ekf  a_b",
        "-----------------------------------------",
        "position RMSE [m]          0.5 ± 0.1    -",
        "  over bound            1       1.02    ∞",
    ]


def test_cells_that_are_flush_left_leave_no_spaces_at_the_end_of_a_line():
    rows = [Row("dropped", ["3", "none of 12"]), Row("notes", ["one\ntwo lines", "-"])]
    assert text_of(Table(["", "a", "b"], rows), align="<").splitlines() == [
        "         a          b",
        "dropped  3          none of 12",
        "notes    one        -",
        "         two lines",
    ]


def test_a_table_without_heads_has_rows_alone():
    rows = [Row("x", ["1"], note="of a note"), Row("long", ["200"])]
    assert text_of(Table((), rows)) == "x       1  of a note\nlong  200"


def test_columns_wrap_at_their_largest_number_where_there_is_no_terminal():
    first, second = text_of(WIDE, most=5).split("\n\n")
    assert first.split("\n")[0].split() == [
        "honest",
        "filter",
        "0",
        "filter",
        "1",
        "filter",
        "2",
        "filter",
        "3",
        "filter",
        "4",
    ]
    assert second.split("\n")[0].split() == ["honest", "filter", "5", "filter", "6"]
    assert second.split("\n")[1].split() == ["both", "3", "5", "6"]
    assert "alone" in second and "\n\n" not in text_of(WIDE)


@pytest.mark.parametrize("columns", [24, 33, 47, 80, 200])
def test_columns_wrap_at_the_width_of_a_terminal(terminal, columns):
    terminal(columns)
    parts = [part.split("\n") for part in text_of(WIDE, rule=True, most=2).split("\n\n")]
    # The labels and the honest value in each, every filter once, and no line beyond the edge.
    heads = [part[0].split() for part in parts]
    assert all(head[0] == "honest" for head in heads)
    numbers = [name for head in heads for name in head[1:] if name != "filter"]
    assert numbers == [str(i) for i in range(7)]
    both = [line.split() for part in parts for line in part if line.startswith("both")]
    assert [value for line in both for value in line[2:]] == numbers
    longest = max(len(line) for part in parts for line in part)
    assert longest <= columns
    fitting = max((columns - len("first  honest")) // len("  filter 0"), 1)
    assert max(len(head[1:]) // 2 for head in heads) == min(fitting, 7)


def test_a_part_has_no_row_without_a_cell_in_it(terminal):
    terminal(30)
    no_notes = WIDE._replace(rows=[row._replace(note="") for row in WIDE.rows])
    first, *others = text_of(no_notes).split("\n\n")
    assert "first" in first
    assert others and all("both" in other and "first" not in other for other in others)


@pytest.mark.parametrize("columns", [40, 60])
def test_sentences_wrap_within_their_column(terminal, columns):
    table = Table(
        (), [Row("file", ["/a/path/without/a/space/that-is-long.g2o"]), Row("note", [SENTENCE])]
    )
    terminal(columns)
    path, *sentence = text_of(table, align="<").split("\n")
    assert path.endswith("long.g2o")  # to be copied
    assert len(sentence) > 1 and max(map(len, sentence)) <= columns
    assert all(line.startswith(" " * 6) for line in sentence[1:])
    assert " ".join(line[6:] for line in sentence) == SENTENCE


def test_a_cell_stays_legible_on_a_terminal_narrower_than_its_label(terminal):
    terminal(10)
    lines = text_of(Table((), [Row("a label of this table", [SENTENCE])]), align="<").split("\n")
    assert 1 < len(lines) < 5


def test_markdown_escapes_pipes():
    rows = [Row("|e|", ["1\n2", "a|b"], "m", note="x | y"), Row("  sub", [None, "3"])]
    assert markdown_of(Table(["a|b", "c", "d"], rows)).split("\n") == [
        r"| a\|b | c | d |  |",
        "|---|---|---|---|",
        r"| \|e\| [m] | 1<br>2 | a\|b | x \| y |",
        "| sub | - | 3 |  |",
    ]


class Page(HTMLParser):
    """The cells of each row as (tag, attributes, text); what is not closed is in `open`."""

    def __init__(self, text):
        super().__init__()
        self.open, self.rows = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        if tag == "wbr":
            return
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append((tag, dict(attributes), ""))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            tag, attributes, text = self.rows[-1][-1]
            self.rows[-1][-1] = tag, attributes, text + data


def test_html_has_the_cells_of_the_rows_under_headings():
    rows = [*ROWS, Row("runs", ["", "3", "4"], group="Counts & times", note="few")]
    page = Page(html_of(TABLE._replace(rows=rows), "measures"))
    assert page.open == []
    texts = [[text for *_, text in row] for row in page.rows]
    assert texts[0] == ["measure", "honest", "ekf", "a_b", ""]
    assert texts[1] == ["position RMSE [m]", "", "0.5 ± 0.1", "-", ""]
    assert texts[2:4] == [["over bound", "1", "1.02", "∞", ""], ["Counts & times"]]
    assert texts[4] == ["runs", "", "3", "4", "few"]
    assert page.rows[2][0] == ("th", {"scope": "row", "class": "sub"}, "over bound")
    assert page.rows[2][1][1] == {"class": "fixed"} and page.rows[2][2][1] == {}
    assert page.rows[3][0][1]["colspan"] == "5"


def test_html_escapes_all_but_html():
    evil = "<script>alert(1)</script>&\"'"
    cells = [evil, Cell("", title=evil), Cell("plain", html="<b>5 %</b>"), "95 %"]
    text = html_of(Table([evil, evil, "", "", ""], [Row(evil, cells, evil, group=evil)]), evil)
    assert "<script" not in text and "<b>5 %</b>" in text and "plain" not in text
    page = Page(text)
    assert page.open == []
    assert [text for *_, text in page.rows[0][:2]] == [evil, evil]
    assert page.rows[1][0][2] == evil
    label, cell, pointed, _, percent = page.rows[2]
    assert label[2] == f"{evil} [{evil}]" and cell[2] == evil and pointed[1] == {"title": evil}
    assert percent[2] == "95\N{NO-BREAK SPACE}%"


def test_csv_has_the_numbers_of_a_cell_and_no_others():
    rows = [*ROWS, Row("verdict", ["good", 'a, "b"', Cell("5.0e-01", (0.123456789123,))])]
    table = TABLE._replace(rows=rows)
    read = list(csv.reader(io.StringIO(csv_of(table, ends=("", " low", " high")))))
    assert read == [
        ["measure", "honest", "ekf", "ekf low", "ekf high", "a_b", "a_b low", "a_b high"],
        ["position RMSE [m]", "", "0.5", "0.4", "0.6", "", "", ""],
        ["over bound", "1", "1.02", "", "", "", "", ""],
        ["verdict", "good", 'a, "b"', "", "", "0.123456789", "", ""],
    ]
    noted = [Row("x", ["1"], note="n"), Row("y", ["2"])]
    assert csv_of(Table(["", "a"], noted)) == ",a,\nx,1,n\ny,2,\n"
