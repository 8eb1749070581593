"""NEES of many filters: a row of panels for each kind, the honest band in each; numbers made up."""

import dataclasses

import numpy as np
import pytest

from jaxslam import plot
from jaxslam.catalog import ALL, KINDS
from jaxslam.consistency import DOF, LAGS, LEVELS
from jaxslam.consistency.summary import Summary
from jaxslam.monte_carlo import Campaign
from jaxslam.results.plot.nees import kinds_of

STEPS, RUNS = 200, 32


def summary(factor, seed):
    rng = np.random.default_rng(seed)
    curves = {}
    for block, dof in DOF.items():
        noise = rng.chisquare(RUNS * dof, STEPS) / RUNS
        curves[f"nees_{block}"] = noise * np.exp(np.log(factor) * np.linspace(0, 1, STEPS))
        curves[f"nees_{block}_low"] = np.full(STEPS, 0.7 * dof)
        curves[f"nees_{block}_high"] = np.full(STEPS, 1.3 * dof)
    fields = {field.name: {} for field in dataclasses.fields(Summary)}
    fields |= {"verdict": "optimistic" if factor > 1.3 else "consistent", "nis_band": None}
    fields |= {"counts": {"runs": RUNS}, "not_finite_runs": [], "curves": curves}
    fields |= {"autocorrelation": np.zeros(LAGS), "autocorrelation_band": np.ones(LAGS)}
    fields |= {"coverage": {block: np.asarray(LEVELS) for block in DOF}}
    return Summary(**fields)


def campaign(names):
    factors = {"fastslam1": 1e27, "fastslam2": 1e3, "ekf": 4.0, "seif": 12.0, "iterated": 3.8}
    filters = {name: summary(factors.get(name, 1.1), i) for i, name in enumerate(names)}
    fields = {field.name: 0 for field in dataclasses.fields(Campaign)}
    fields |= {"scenario": "cloister", "steps": STEPS, "runs": RUNS, "filters": filters}
    return Campaign(**fields)


def rows_of(figure):
    """[(kind, its panels, the names in its legend)]."""
    columns = len(DOF) + 1
    grid = np.array(figure.axes).reshape(-1, columns)
    return [
        (row[0].get_ylabel(), row[:-1], [text.get_text() for text in row[-1].get_legend().texts])
        for row in grid
    ]


def test_every_filter_of_the_family_has_one_kind():
    named = [name for names in KINDS.values() for name in names]
    assert sorted(named) == sorted(ALL) and max(map(len, KINDS.values())) <= 5


def test_kinds_keep_their_order_and_others_come_last_in_fives():
    names = [*(f"mine{i}" for i in range(7)), "fastslam2", "ukf", "ekf"]
    assert kinds_of(names) == [
        ("Kalman filter", ["ekf"]),
        ("unscented", ["ukf"]),
        ("particles", ["fastslam2"]),
        ("others", [f"mine{i}" for i in range(5)]),
        ("others", ["mine5", "mine6"]),
    ]


def test_all_filters_are_drawn_in_small_multiples_with_the_band_in_each():
    found = campaign(list(ALL))
    figure = plot.nees_figure(found)
    rows = rows_of(figure)
    assert [kind for kind, *_ in rows] == list(KINDS)
    assert [axes.get_title() for axes in figure.axes[:3]] == [
        f"{block} NEES (dof {dof})" for block, dof in DOF.items()
    ]
    for (_, names), (_, panels, told) in zip(KINDS.items(), rows, strict=True):
        assert [label.split(" (")[0] for label in told] == list(names)
        for axes, (block, dof) in zip(panels, DOF.items(), strict=True):
            (band,) = axes.collections
            heights = band.get_paths()[0].vertices[:, 1]
            low, high = axes.get_ylim()
            np.testing.assert_allclose([heights.min(), heights.max()], [0.7 * dof, 1.3 * dof])
            # Seen: a tenth of the panel's height at least, whatever one filter does.
            assert low < heights.min() and heights.max() < high <= 130 * dof
            assert np.log(heights.max() / heights.min()) > 0.08 * np.log(high / low)
            lines = {line.get_label().split(" (")[0]: line for line in axes.lines}
            for name in names:
                drawn = found.filters[name].curves[f"nees_{block}"]
                np.testing.assert_array_equal(lines[name].get_ydata(), np.minimum(drawn, 100 * dof))


def test_nothing_of_it_overlaps_and_names_are_told():
    figure = plot.nees_figure(campaign(list(ALL)))
    assert plot.png(figure, 60).startswith(b"\x89PNG")
    page = figure.bbox
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for box in boxes:
        assert page.x0 - 1 <= box.x0 and box.x1 <= page.x1 + 1
        assert page.y0 - 1 <= box.y0 and box.y1 <= page.y1 + 1
    for i, a in enumerate(boxes):
        assert not any(a.shrunk(0.98, 0.98).overlaps(b.shrunk(0.98, 0.98)) for b in boxes[i + 1 :])
    said = plot.describe(figure)
    assert all(name in said for name in ALL)


@pytest.mark.parametrize("count", [1, 5])
def test_up_to_five_share_their_panels(count):
    figure = plot.nees_figure(campaign([f"mine{i}" for i in range(count)]))
    assert len(figure.axes) == len(DOF) and len(figure.legends) == 1
