"""The page says what the campaign says, is well-formed HTML, loads nothing, and escapes names."""

import base64
import dataclasses
from html.parser import HTMLParser

import drawn
import numpy as np
import pytest

from jaxslam import plot
from jaxslam.consistency import Average, Summary, _measures
from jaxslam.consistency.campaign import Campaign
from jaxslam.results import _campaign_tables, _page

STEPS, RUNS = 7, 30
EVIL = "<script>alert(1)</script>&\"'"
VOID = {"meta", "img", "br", "wbr", "hr", "link", "input"}


def summary(verdict, measures, lost=()):
    ones = np.ones(STEPS)
    curves = {"rmse_position": ones, "rmse_heading_deg": ones}
    for block, dof in drawn.DOF.items():
        curves |= {f"nees_{block}": dof * ones}
        curves |= {f"nees_{block}_low": 0.5 * dof * ones, f"nees_{block}_high": 1.5 * dof * ones}
    return Summary(
        verdict=verdict,
        measures=measures,
        nis_band=(0.9, 1.1),
        inside={"pose": 0.75},
        curves=curves,
        coverage={block: np.asarray(drawn.LEVELS) for block in drawn.DOF},
        autocorrelation=np.zeros(10),
        autocorrelation_band=np.full(10, 0.01),
        counts={"runs": RUNS - len(lost), "not_finite": len(lost), "divergent": 0, "rejected": 0},
        per_run={},
        not_finite_runs=list(lost),
    )


def campaign(**filters):
    return Campaign(
        scenario=f"world {EVIL}",
        source="A & B, https://doi.org/10.1/2",
        published={"good": {"rmse_position": 1.25}},
        steps=STEPS,
        runs=RUNS,
        dtype="float32",
        divergence_limit=4.5,
        filters=filters,
        seconds=200.0,
        compile_seconds=10.0,
        step_seconds={},
    )


GOOD = {
    "nees_pose": Average(3.0412, 2.9912, 3.0912),
    "rmse_position": Average(1.2, 1.1, 1.3),
    "bound_ratio_position": Average(1.0, -np.inf, np.inf),
    "unobservable": Average(3.0, 3.0, 3.0),
    "rotation_information": Average(3e-26, 2e-26, 4e-26),
    "log_likelihood": Average(-12345.6, -12445.6, -12245.6),
}


class Reader(HTMLParser):
    """Holds tags against each other; keeps text by element, and every attribute."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.words, self.rows = [], [], [], []
        self.tags = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *each) for each in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)
            if {"td", "th"} & set(self.open):
                self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def text():
    world = campaign(
        good=summary("consistent", GOOD),
        **{EVIL: summary("optimistic", {"nees_pose": Average(9.0, 8.0, 10.0)}, lost=(4, 17))},
        lost=summary("diverged", {}),
    )
    return _page.campaign_page(
        world,
        f"jaxslam consistency {EVIL}",
        1234,
        {"jax": "9.8.7"},
        {
            "nees": ("NEES & its band", plot.nees_figure(world)),
            "coverage": ("Coverage", plot.coverage_figure(world)),
        },
    )


@pytest.fixture(scope="module")
def read(text):
    reader = Reader(text)
    assert reader.open == []
    return reader


def row(read, label):
    (found,) = [cells for cells in read.rows if cells[0] == label]
    return found


def test_nothing_is_loaded_and_no_script_runs(text, read):
    assert text.startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe", "object", "base"} & set(read.tags)
    loads = [value for _, name, value in read.attributes if name in ("src", "href", "srcset")]
    assert len(loads) == 2
    assert all(value.startswith("data:image/png;base64,") for value in loads)
    assert not any(name.startswith("on") for _, name, _ in read.attributes)
    assert "@import" not in text and "url(" not in text
    (policy,) = (v for _, name, v in read.attributes if name == "content" and "default-src" in v)
    assert policy == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def test_names_are_escaped(text, read):
    assert "<script" not in text
    words = "".join(read.words)
    assert f"world {EVIL}: consistency of 3 filters" in words
    assert f"jaxslam consistency {EVIL}" in words
    assert f"{EVIL} was not finite in runs 4, 17." in words
    assert "averages of the 28 finite runs" in words


def test_filters_verdicts_and_measures_stand_in_the_table(read):
    assert read.rows[0] == ["measure", "honest", "good", EVIL, "lost"]
    assert row(read, "verdict")[1:] == ["consistent", "✓ consistent", "▲ optimistic", "✕ diverged"]
    assert row(read, "pose NEES (x, y, θ)")[1:] == ["3", "3.041 ± 0.05", "9 ± 1", "-"]
    at = read.rows.index(row(read, "position RMSE [m]"))
    assert read.rows[at][2:] == ["1.2 ± 0.1", "-", "-"]
    assert read.rows[at + 1] == ["published", "", "1.25", "-", "-"]
    assert row(read, "over conditional bound")[1:3] == ["1", "1"]
    assert row(read, "unobservable directions")[2] == "3 ± 0"
    assert row(read, "rotation information [1/rad²]")[2] == "3e-26 ± 1e-26"
    assert row(read, "log-likelihood")[2] == "-12,346 ± 100"
    assert row(read, "not finite")[2:] == ["0", "2", "0"]
    assert row(read, "finite runs")[2:] == ["30", "28", "30"]
    assert row(read, "steps in pose band")[2] == "75.0\N{NO-BREAK SPACE}%"
    labels = [cells[0] for cells in read.rows]
    assert "heading NEES" not in labels  # no filter has it
    assert "rejected" not in labels  # nothing was
    measured = [measure.title.strip() for measure in _measures.BUILT_IN if measure.key in GOOD]
    assert [label for label in labels if label in measured] == measured


def test_every_label_of_the_table_is_shown_where_it_is_measured():
    averages = {measure.key: Average(1.0, 0.5, 1.5) for measure in _measures.BUILT_IN}
    reader = Reader(
        _page.campaign_page(campaign(a=summary("undecided", averages)), "", None, {}, {})
    )
    labels = [cells[0] for cells in reader.rows]
    for measure in _measures.BUILT_IN:
        assert (measure.title.strip() in labels) == measure.row
    assert "Figures" not in reader.words
    assert "consistency of 1 filter" in "".join(reader.words)


def test_notes_of_the_measures_stand_below_them():
    of = dataclasses.replace(summary("consistent", GOOD), honest_nis=0.95)
    of.counts.update(born=3, fused=9, rejected=2)
    reader = Reader(_page.campaign_page(campaign(a=of), "", None, {}, {}))
    words = " ".join("".join(reader.words).split())
    assert "an honest NIS / dof lies between 0.950 (a) and 1" in words
    assert "initialized, measurements that started a landmark" in words
    assert row(reader, "initialized")[2] == "3"


def test_filters_in_pairs_have_a_table_each_and_notes():
    numbers = np.random.default_rng(0).normal(size=(3, RUNS))
    filters = {
        name: dataclasses.replace(summary("consistent", GOOD), per_run={"log_likelihood": row})
        for name, row in zip(("a_b", "good", EVIL), numbers, strict=True)
    }
    of = dataclasses.replace(campaign(**filters), reference="a_b")
    reader = Reader(_page.campaign_page(of, "", None, {}, {}))
    assert reader.open == []
    heads = [cells for cells in reader.rows if cells[0] == f"{RUNS} runs in pairs"]
    ends = ["difference", "better in", "narrower by"]
    assert [head[1:] for head in heads] == [["honest", n, "a_b", *ends] for n in ("good", EVIL)]
    rows = [cells for cells in reader.rows if cells[0] == "log-likelihood"]
    assert [len(cells) for cells in rows] == [5, 7, 7]
    value, low, high = of.compare(EVIL, "a_b").measures["log_likelihood"].difference
    assert rows[2][4] == f"{value:.4g} ± {(high - low) / 2:.2g}"
    space = "\N{NO-BREAK SPACE}"
    titles = [value for _, name, value in reader.attributes if name == "title"]
    assert f"95{space}% interval {low:.5g} to {high:.5g}" in titles
    words = " ".join("".join(reader.words).split())
    assert "Compared with a_b, in pairs" in words and "better in: the share of runs" in words
    notebook = Reader(of.compare("good", "a_b")._repr_html_())
    assert notebook.open == [] and notebook.rows[1][0] == "log-likelihood"


def test_parameters_and_conventions_are_in_words(read):
    words = " ".join("".join(read.words).split())
    for said in ("1234", "jax 9.8.7", "A & B, https://doi.org/10.1/2", "4.5 m", "float32"):
        assert said in words
    assert "3 min, 10.0 s of it compilation" in words
    assert "not divided by its degrees of freedom" in words
    for verdict, (_, meaning) in _campaign_tables.VERDICTS.items():
        assert verdict in words
        assert meaning in words


def test_figures_are_embedded_with_captions_and_alternative_text(read):
    words = "".join(read.words)
    assert "Figure 1. NEES & its band" in words
    assert "Figure 2. Coverage" in words
    alternative = [value for _, name, value in read.attributes if name == "alt"]
    assert "pose NEES (dof 3)" in alternative[0]
    assert "against step" in alternative[0]
    assert f"{EVIL} (optimistic)" in alternative[0]
    assert "share of truth within" in alternative[1]
    for tag, name, value in read.attributes:
        if (tag, name) == ("img", "src"):
            png = base64.b64decode(value.split(",")[1], validate=True)
            assert png.startswith(b"\x89PNG\r\n")


def test_a_narrow_screen_has_rules_of_its_own(text):
    narrow = text.split("(max-width: 40rem)")[1].split("@media")[0]
    assert "white-space: normal" in narrow  # numbers wrap, so that several filters are seen
    assert "figure { overflow-x: auto; }" in narrow  # figures keep a size that can be read
