"""What a campaign shows and writes of itself: the table, a line, a notebook's fragment, files, rows.

The campaign's numbers are made up; nothing is compiled but for the errors of run 0.
"""

import dataclasses
import json
import sys
import types

import broken
import matplotlib
import numpy as np
import pytest
from test_page import EVIL, GOOD, RUNS, STEPS, Reader, campaign, summary

from jaxslam import plot, results
from jaxslam.consistency import Average
from jaxslam.core.types import Estimate, Truth
from jaxslam.results import _campaign_files, _report
from jaxslam.results.plot import _style

FIGURES = {*_campaign_files.FIGURES}
NUMBERS = {"consistency.json", "consistency.csv", "measures.csv"}


def run_zero():
    """The truth and the estimate of a run of `STEPS` steps with two landmarks."""
    pose = np.cumsum(np.full((STEPS, 3), 0.1), axis=0)
    truth = Truth(pose, np.ones((2, 2)), np.zeros(STEPS, int), np.zeros(3))
    covs = np.tile(0.01 * np.eye(3), (STEPS, 1, 1))
    points, alive = np.ones((STEPS, 2, 2)), np.ones((STEPS, 2), bool)
    tags = np.tile(np.arange(2), (STEPS, 1))
    return truth, Estimate(
        pose + 0.01, covs, points, np.tile(covs[:, None, :2, :2], (1, 2, 1, 1)), alive, tags
    )


@pytest.fixture(scope="module")
def campaign_of_two():
    per_run = {"nees_pose": np.arange(3.0), "square_position": np.ones(3)}
    good = dataclasses.replace(summary("consistent", GOOD), per_run=per_run)
    mapping = summary("optimistic", {"rmse_landmarks": Average(1.0, 0.9, 1.1)})
    optimistic = dataclasses.replace(
        mapping, per_run={"nees_pose": np.array([5.0, np.nan, 7.0])}, not_finite_runs=[4]
    )
    return dataclasses.replace(
        campaign(good=good, other=optimistic),
        first={"other": run_zero()},
        run_numbers=np.array([0, 4, 5]),
    )


def test_printed_it_is_the_table_and_in_a_line_its_verdicts(campaign_of_two):
    assert str(campaign_of_two) == _report.campaign_table(campaign_of_two)
    size = f"{RUNS} runs × {STEPS} steps, float32"
    assert " ".join(repr(campaign_of_two).split()) == (
        f"Campaign(world {EVIL}, {size}, good=consistent, other=optimistic)"
    )
    assert (
        repr(campaign_of_two.filters["good"])
        == "Summary(consistent, nees_pose=3.041, rmse_position=1.2)"
    )
    single = dataclasses.replace(campaign_of_two, runs=1, steps=1)
    assert "1 run × 1 step, float32" in repr(single) and "1 run × 1 step, float32" in str(single)
    many = dataclasses.replace(
        campaign_of_two, filters={f"f{i}": campaign_of_two.filters["good"] for i in range(20)}
    )
    assert max(map(len, repr(many).splitlines())) <= 100


def test_a_notebook_shows_verdicts_figures_and_measures_and_little_weighs(campaign_of_two):
    text = campaign_of_two._repr_html_()
    read = Reader(text)
    assert read.open == []
    assert not {"script", "html", "body", "link"} & set(read.tags)
    assert "<script" not in text
    assert "✓ consistent" in "".join(read.words)
    assert "▲ optimistic" in "".join(read.words)
    assert read.tags.count("img") == 2
    assert [row[0] for row in read.rows if row[0].startswith("pose NEES")]
    assert len(text) < 400_000
    style = text.partition("<style>")[2].partition("</style>")[0].strip()
    assert style.startswith(".jaxslam {") and style.endswith("}")
    assert style.count("{") == style.count("}")


def test_the_report_is_written_as_the_command_writes_it(campaign_of_two, tmp_path):
    out = tmp_path / "deep" / "out"
    paths = campaign_of_two.save(str(out), figures=("png", "pdf", "svg"))
    names = {path.name for path in out.iterdir()}
    assert (
        names
        == {path.name for path in paths}
        == {*_campaign_files.file_names(("png", "pdf", "svg"))}
    )
    assert {path.stem for path in out.glob("*.pdf")} == FIGURES
    heads = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    for kind, head in heads.items():
        assert all(path.read_bytes().startswith(head) for path in out.glob(f"*.{kind}"))
    assert json.loads((out / "consistency.json").read_text())["seed"] is None
    page = Reader((out / "report.html").read_text())
    assert page.open == [] and page.tags.count("img") == len(FIGURES)


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made, and not drawn."""
    monkeypatch.setattr(_style, "encode", lambda figure, kind, *_: kind.encode())


def test_files_are_those_asked_for_and_without_run_0_its_figures_are_left_out(
    campaign_of_two, tmp_path, undrawn
):
    only = campaign_of_two.save(tmp_path / "bare", figures=())
    names = ["report.html", "consistency.json", "consistency.csv", "measures.csv"]
    assert [path.name for path in only] == names
    elsewhere = dataclasses.replace(campaign_of_two, first={})
    kept = {path.stem for path in elsewhere.save(tmp_path / "no run 0", "svg")}
    assert FIGURES - kept == {"errors", "map"}


def test_what_exists_is_not_overwritten_unasked_and_nothing_half_written_stays(
    campaign_of_two, tmp_path, undrawn, monkeypatch
):
    mine = tmp_path / "consistency.csv"
    mine.write_text("mine")
    with pytest.raises(
        ValueError, match=r"^Campaign.save: .*consistency.csv exists: overwrite=True"
    ):
        campaign_of_two.save(tmp_path, figures=())
    assert [path.name for path in tmp_path.iterdir()] == [mine.name]
    assert mine.read_text() == "mine"
    campaign_of_two.save(tmp_path, figures=(), overwrite=True)
    assert mine.read_text() != "mine"
    with pytest.raises(ValueError, match="expected formats of png, pdf, svg, got 'gif'"):
        campaign_of_two.save(tmp_path / "new", figures=("png", "gif"))

    def broken(figure, kind):
        if kind == "svg":  # the page's own are there
            raise KeyboardInterrupt
        return b""

    monkeypatch.setattr(_style, "encode", broken)
    with pytest.raises(KeyboardInterrupt, match="has the numbers, and no figures"):
        campaign_of_two.save(tmp_path / "new", figures=("svg",))
    assert {path.name for path in (tmp_path / "new").iterdir()} == NUMBERS


def test_a_figure_that_fails_is_left_out_and_told(campaign_of_two, tmp_path, undrawn, monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("no LaTeX\nin many lines")

    monkeypatch.setattr(plot, "rmse_figure", fails)
    with pytest.warns(UserWarning, match=r"^rmse was not drawn: .*RuntimeError: no LaTeX$"):
        paths = campaign_of_two.save(tmp_path, "pdf")
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in paths}
    assert {path.stem for path in paths if path.suffix == ".pdf"} == FIGURES - {"rmse"}
    assert {path.name for path in paths} > {*NUMBERS, "report.html"}


def test_the_numbers_are_there_where_matplotlib_cannot_be_loaded(
    campaign_of_two, tmp_path, monkeypatch
):
    monkeypatch.delattr(results, "_page", raising=False)
    monkeypatch.setitem(sys.modules, "jaxslam.results._page", None)
    with pytest.raises(ImportError):
        campaign_of_two.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == NUMBERS


def test_a_folder_that_cannot_be_used_is_refused_before_anything_is_drawn(
    campaign_of_two, tmp_path, monkeypatch
):
    monkeypatch.setattr(_campaign_files, "_drawings", lambda *a: pytest.fail("drawn"))
    monkeypatch.chdir(tmp_path)
    for folder in ("", " ", None):
        with pytest.raises(ValueError, match=r"^Campaign\.save: folder: expected a path, got"):
            campaign_of_two.save(folder)
    with pytest.raises(
        ValueError, match=r"^Campaign.save: figures: expected formats of .*, got None"
    ):
        campaign_of_two.save("out", figures=None)
    assert not [*tmp_path.iterdir()]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OSError, match=r"^results cannot be written to file: .*file is not a fold"):
        campaign_of_two.save("file")


def test_figures_of_another_campaign_do_not_stay_beside_the_report(
    campaign_of_two, tmp_path, undrawn
):
    (tmp_path / "mine.png").write_text("mine")
    campaign_of_two.save(tmp_path, "pdf")
    campaign_of_two.save(tmp_path, "svg", overwrite=True)  # the same campaign
    assert {path.suffix for path in tmp_path.glob("map.*")} == {".pdf", ".svg"}
    another = dataclasses.replace(campaign_of_two, first={}, scenario="another")
    paths = another.save(tmp_path, "png", overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in paths} | {
        "mine.png"
    }


def test_a_figure_is_the_same_bytes_each_time(campaign_of_two):
    for kind in ("pdf", "svg"):
        first, again = (_style.encode(plot.nees_figure(campaign_of_two), kind) for _ in range(2))
        assert first == again


OTHER_SETTINGS = {
    "text.usetex": True,
    "font.family": "no such font",
    "font.size": 30.0,
    "axes.formatter.use_locale": True,
    "axes.grid": True,
    "lines.linewidth": 9.0,
    "image.origin": "lower",
    "legend.frameon": True,
    "savefig.bbox": "tight",
    "savefig.transparent": True,
    "svg.hashsalt": "mine",
}


def test_a_figure_does_not_depend_on_the_users_settings_and_leaves_them(campaign_of_two):
    def drawn():
        map_figure = plot.map_figure(run_zero()[1], title="$x$ and 1.5")
        return _style.encode(plot.nees_figure(campaign_of_two), "svg"), _style.encode(
            map_figure, "png"
        )

    usual = drawn()
    with matplotlib.rc_context(OTHER_SETTINGS):
        before = dict(matplotlib.rcParams)
        assert drawn() == usual
        assert dict(matplotlib.rcParams) == before


def test_a_data_frame_has_a_row_for_each_run_of_each_filter(campaign_of_two, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", types.SimpleNamespace(DataFrame=dict))
    columns = campaign_of_two.to_dataframe()
    assert list(columns) == ["filter", "run", "finite", "nees_pose", "square_position"]
    assert list(columns["filter"]) == ["good"] * 3 + ["other"] * 3
    assert list(columns["run"]) == [0, 4, 5] * 2
    assert list(columns["finite"]) == [True] * 4 + [False, True]
    np.testing.assert_array_equal(columns["nees_pose"], [0, 1, 2, 5, np.nan, 7])
    np.testing.assert_array_equal(columns["square_position"], [1] * 3 + [np.nan] * 3)


def test_pandas_takes_it(campaign_of_two):
    pandas = broken.optional("pandas")
    frame = campaign_of_two.to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.groupby("filter").nees_pose.mean().to_dict() == {"good": 1.0, "other": 6.0}


def test_without_pandas_a_line_says_so(campaign_of_two, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(
        ImportError, match="to_dataframe: pandas is not installed: pip install pandas"
    ):
        campaign_of_two.to_dataframe()
