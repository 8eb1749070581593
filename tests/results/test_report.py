"""Tables, JSON and CSV say what the campaign says; files appear whole or not at all."""

import csv
import dataclasses
import io
import json

import numpy as np
import pytest
import worlds

from jaxslam import catalog
from jaxslam.consistency import Average, _measures
from jaxslam.core.types import Estimate
from jaxslam.results import _files, _report
from jaxslam.results.report import trajectory_tum

WORLD = worlds.ring()


@pytest.fixture(scope="module")
def campaign():
    candidates = {"ekf": worlds.ekf(WORLD), "other": worlds.no_cross_covariance(WORLD)}
    return worlds.campaign(WORLD, candidates, 3)


def test_the_table_shows_every_measure_and_verdict(campaign):
    text = _report.campaign_table(campaign)
    measured = {key for summary in campaign.filters.values() for key in summary.measures}
    for measure in _measures.BUILT_IN:
        assert (measure.title in text) == (measure.key in measured and measure.row)
    assert len(measured) > 10
    for name, summary in campaign.filters.items():
        assert name in text
        assert summary.verdict in text
        assert f"{summary.measures['nees_pose'].value:.4g}" in text
    assert "not divided by its dof" in text


def test_filters_follow_below_where_a_terminal_has_no_room_beside_each_other(campaign, monkeypatch):
    heads = {}
    for columns in (70, 300):
        monkeypatch.setattr("sys.stdout", io.StringIO())
        monkeypatch.setattr("sys.stdout.isatty", lambda: True)
        monkeypatch.setenv("COLUMNS", str(columns))
        lines = _report.campaign_table(campaign).splitlines()
        assert max(map(len, lines)) <= columns
        heads[columns] = [line.split() for line in lines if line.split()[:1] == ["honest"]]
    assert heads == {
        70: [["honest", "ekf"], ["honest", "other"]],
        300: [["honest", "ekf", "other"]],
    }


def test_the_notes_explain_the_gate_the_likelihood_and_the_counts(campaign):
    ekf = campaign.filters["ekf"]
    counts = ekf.counts | {"rejected": 7, "fused": ekf.counts["fused"] - 7}
    gated = dataclasses.replace(ekf, honest_nis=0.9454, counts=counts)
    table = _report.campaign_table(dataclasses.replace(campaign, filters={"a": ekf, "b": gated}))
    assert max(map(len, table.splitlines())) <= 88
    text = " ".join(table.split())
    assert "gate: a gate drops the largest innovations" in text and "0.945 (b) and 1" in text
    assert "log-likelihood: comparable only between filters that fused the same" in text
    assert "initialized, measurements that started a landmark" in text
    assert "born" not in text
    alone = _report.campaign_table(dataclasses.replace(campaign, filters={"a": ekf}))
    assert "gate:" not in alone and "log-likelihood:" not in alone


def test_measures_that_their_names_do_not_explain_have_a_note(campaign):
    ekf = campaign.filters["ekf"]
    of_many_runs = dict.fromkeys(("noncredibility", "inclination"), Average(1.0, 0.5, 1.5))
    filters = {"a": dataclasses.replace(ekf, measures=ekf.measures | of_many_runs)}
    table = _report.campaign_table(dataclasses.replace(campaign, filters=filters))
    terms = {line.split(": ")[0] for line in table.splitlines()}
    assert {"noncredibility", "inclination", "innovation autocorrelation"} <= terms
    assert "rotation information" not in terms  # this filter has none


def test_filters_of_which_the_same_is_said_share_a_sentence(campaign):
    honest = dataclasses.replace(
        campaign.filters["ekf"],
        verdict="consistent",
        noticed={"nees_pose": (1.0, 5.0), "nis_per_dof": (0.9, np.inf)},
        doubts=("a doubt",),
    )
    powerless = dataclasses.replace(honest, noticed={"nees_pose": (0.0, 6.0)})
    both = dataclasses.replace(campaign, filters={"a": honest, "b": honest, "c": powerless})
    power = "not rejected, with 90 % power to reject a pose NEES"
    assert _report.sentences_on_verdicts(both) == [
        f"{power} and a NIS / dof outside: a [1, 5] and [0.9, inf]; b [1, 5] and [0.9, inf]",
        f"{power} outside: c [0, 6]",
        "a, b, c*: a doubt",
    ]


def test_what_a_filter_does_not_estimate_has_no_number():
    """The log-likelihood of dead reckoning, the map of localization."""
    filters = {name: catalog.ALL[name](WORLD) for name in ("dead_reckoning", "localization")}
    reckoned, localized = worlds.campaign(WORLD, filters, 2).filters.values()
    assert "log_likelihood" not in reckoned.measures and "rmse_landmarks" not in localized.measures
    assert "log_likelihood" in localized.measures


def test_json_holds_the_measures_and_no_nan(campaign):
    result = json.loads(_report.as_json(campaign, "jaxslam …", 5), parse_constant=pytest.fail)
    assert result["seed"] == 5
    assert result["runs"] == 3
    for name, summary in campaign.filters.items():
        entry = result["filters"][name]
        assert entry["verdict"] == summary.verdict
        assert entry["measures"]["rmse_position"]["value"] == pytest.approx(
            summary.measures["rmse_position"].value
        )
        assert entry["counts"] == summary.counts


def test_json_holds_the_differences_from_the_reference(campaign):
    assert "pairs" not in json.loads(_report.as_json(campaign))
    compared = dataclasses.replace(campaign, reference="ekf")
    pairs = json.loads(_report.as_json(compared), parse_constant=pytest.fail)["pairs"]
    assert (pairs["reference"], pairs["level"], list(pairs["filters"])) == ("ekf", 0.95, ["other"])
    entry, comparison = pairs["filters"]["other"], campaign.compare("other", "ekf")
    assert (entry["runs"], entry["doubts"]) == (comparison.runs, list(comparison.doubts))
    for key, pair in comparison.measures.items():
        written = entry["measures"][key]
        assert tuple(written["difference"].values()) == pair.difference
        assert (written["better_in"], written["runs"]) == (pair.share, pair.runs)
        assert written["average"] - written["average_of_reference"] == pytest.approx(
            pair.difference.value, abs=1e-9
        )


def test_csv_holds_the_curves(campaign):
    rows = list(csv.DictReader(io.StringIO(_report.as_csv(campaign))))
    assert len(rows) == 2 * WORLD.steps
    curve = campaign.filters["other"].curves["nees_pose"]
    column = [r["nees_pose"] for r in rows if r["filter"] == "other"]
    assert column[0] == ""  # the covariance is singular after one step
    np.testing.assert_allclose([float(x) for x in column[1:]], curve[1:], rtol=1e-8)


def test_the_table_in_csv_has_the_doubts_below_the_verdicts(campaign):
    sound, other = (dataclasses.replace(s, doubts=()) for s in campaign.filters.values())
    doubted = dataclasses.replace(other, doubts=("not finite in 2 of 9 runs", "divergent"))
    rows = []
    for second in (other, doubted):
        part = dataclasses.replace(campaign, filters={"sound": sound, "other": second})
        rows.append(list(csv.DictReader(io.StringIO(_report.table_csv(part)))))
    assert [row["measure"] for row in rows[1][:2]] == ["verdict", "doubts"]
    told = rows[1].pop(1)
    assert (told["sound"], told["other"]) == ("", "not finite in 2 of 9 runs; divergent")
    assert rows[0] == rows[1]


def test_a_filter_that_lacks_a_curve_has_empty_cells(campaign):
    first, second = campaign.filters.values()
    less = {key: values for key, values in first.curves.items() if key != "nees_pose"}
    lacking = dataclasses.replace(second, curves=less)
    for filters in ({"whole": first, "less": lacking}, {"less": lacking, "whole": first}):
        part = dataclasses.replace(campaign, filters=filters)
        rows = list(csv.DictReader(io.StringIO(_report.as_csv(part))))
        assert set(rows[0]) == {"filter", "step", *first.curves}
        assert all(row["nees_pose"] == "" for row in rows if row["filter"] == "less")
        assert any(row["nees_pose"] for row in rows if row["filter"] == "whole")


def test_files_appear_whole_or_not_at_all(tmp_path):
    def broken(path):
        path.write_text("half")
        raise KeyboardInterrupt

    out = tmp_path / "deep" / "out"
    with pytest.raises(KeyboardInterrupt):
        _files.write_files(out, {"a.txt": "text", "b.png": broken})
    assert not list(out.glob("*")) or not out.exists()
    written = _files.write_files(out, {"a.txt": "text", "b.txt": lambda path: path.write_text("b")})
    assert [path.read_text() for path in written] == ["text", "b"]
    assert sorted(path.name for path in out.iterdir()) == ["a.txt", "b.txt"]


def test_an_unwritable_folder_is_refused_beforehand(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="not a folder"):
        _files.check_writable(tmp_path / "file" / "out")
    _files.check_writable(tmp_path / "not" / "yet" / "there")
    assert not (tmp_path / "not").exists()


def test_a_path_in_the_format_of_tum():
    pose = np.array([[1.0, -2.0, np.pi / 2], [0.25, 0.0, -3.0]])
    nothing = np.zeros((2, 0))
    text = trajectory_tum(np.array([1248272273.125, 1248272274.0]), Estimate(pose, *[nothing] * 5))
    rows = np.array([line.split() for line in text.splitlines()], float)
    assert text.startswith("1248272273.125 1 -2 0 0 0 ")
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, rtol=1e-8)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]), pose[:, 2], rtol=1e-8)
