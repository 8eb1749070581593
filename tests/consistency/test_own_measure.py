"""A measure that a user adds by a function and a line: in the summary, the tables and the files."""

import csv
import io
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused

import jaxslam
from jaxslam import filters, plot, store
from jaxslam.consistency import Measure, _measures, register

WORLD = worlds.ring()
RECKONING = {"reckoning": filters.DeadReckoning(WORLD.motion, WORLD.sensor)}


def claimed_sigma(truth, trace):
    cov = trace.estimate.pose_cov
    sigma = jnp.sqrt(cov[:, 0, 0] + cov[:, 1, 1])
    return jnp.where(jnp.arange(len(sigma)) < 3, jnp.nan, sigma)


def farthest(truth, trace):
    return jnp.hypot(*(truth.pose - trace.estimate.pose)[:, :2].T).max()


@pytest.fixture
def registered():
    register(Measure("claimed", "claimed σ", claimed_sigma, unit="m", positive=True, figure="rmse"))
    register(Measure("farthest", "farthest", farthest, honest=0.25, note=("far", "largest error")))
    yield
    del _measures.REGISTRY["claimed"], _measures.REGISTRY["farthest"]


def test_a_measure_of_ones_own_is_everywhere(registered, tmp_path):
    keep = store.open(tmp_path / "blocks")
    options = {"block": 4, "bound": False, "keep": keep}
    campaign = jaxslam.monte_carlo(WORLD, RECKONING, 6, worlds.key(), **options)
    summary = campaign.filters["reckoning"]
    per_run, claimed = summary.per_run, summary.curves["claimed"]
    assert np.isnan(claimed[:3]).all() and np.isfinite(claimed[3:]).all()
    truth, estimate = campaign.first["reckoning"]
    sigma = np.sqrt(estimate.pose_cov[3:, 0, 0] + estimate.pose_cov[3:, 1, 1])
    np.testing.assert_allclose(per_run["claimed"][0], sigma.mean())
    far = np.hypot(*(truth.pose - estimate.pose)[:, :2].T).max()
    np.testing.assert_allclose(per_run["farthest"][0], far)
    average = summary.measures["claimed"]
    np.testing.assert_allclose([average.value, np.nanmean(claimed)], per_run["claimed"].mean())
    assert average.low > 0

    campaign.save(tmp_path, figures=())
    text, html = str(campaign), (tmp_path / "report.html").read_text()
    assert re.search(rf"claimed σ \[m\] +{average.value:.4g} ", text)
    assert re.search(r"farthest +0.25 ", text) and "far: largest error." in text
    assert "claimed σ [m]" in html and "<strong>far</strong>: largest error." in html
    rows = {row["measure"]: row for row in _rows((tmp_path / "measures.csv").read_text())}
    assert float(rows["claimed σ [m]"]["reckoning low"]) == pytest.approx(average.low, rel=1e-8)
    assert rows["farthest"]["honest"] == "0.25" and rows["verdict"]["reckoning"] == summary.verdict
    assert "claimed" in _rows((tmp_path / "consistency.csv").read_text())[0]
    assert "claimed" in campaign._run_columns()
    written = json.loads((tmp_path / "consistency.json").read_text())
    assert written["filters"]["reckoning"]["measures"]["claimed"]
    assert plot.rmse_figure(campaign).axes[-1].get_ylabel() == "claimed σ [m]"

    jaxslam.monte_carlo(WORLD, RECKONING, 6, worlds.key(), **options)
    del _measures.REGISTRY["claimed"]
    with pytest.raises(ValueError, match=r"measure claimed: .* there, absent here"):
        jaxslam.monte_carlo(WORLD, RECKONING, 6, worlds.key(), **options)
    again = jaxslam.load(tmp_path).filters["reckoning"]  # without the file that registers it
    np.testing.assert_array_equal(again.curves["claimed"], claimed)
    assert again.measures["claimed"].value == average.value
    _measures.REGISTRY["claimed"] = Measure("claimed", "claimed σ", claimed_sigma)


def _rows(text):
    return list(csv.DictReader(io.StringIO(text)))


@refused(
    (Measure("nees_pose", "mine", farthest), "'nees_pose' is the key of a measure of jaxslam"),
    (Measure("square_heading", "mine", farthest), "'square_heading' is the key"),
    (Measure("removed", "mine", farthest), "'removed' is the key"),
    (Measure("mine", "mine"), "measure 'mine' has no of_run"),
    told="register: ",
)
def test_a_measure_that_cannot_be_registered_is_refused(measure):
    register(measure)


def test_a_measure_of_another_shape_is_refused(registered):
    register(Measure("farthest", "farthest", lambda truth, trace: truth.pose))
    with pytest.raises(ValueError, match=r"measure farthest: expected .* 100 steps, got .*100, 3"):
        worlds.campaign(WORLD, RECKONING, 2)
