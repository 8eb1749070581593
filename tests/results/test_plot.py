"""Ellipses are contours of Mahalanobis distance; figures carry labels, units and equal aspect."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from jaxslam import plot, run, simulate
from jaxslam.consistency import LAGS, LEVELS
from jaxslam.results.plot.style import logarithmic, panels_of

WORLD = worlds.ring()


@pytest.mark.parametrize("n_sigma", [1.0, 3.0])
@pytest.mark.parametrize("points", [4, 33])
def test_an_ellipse_is_a_contour_of_mahalanobis_distance(n_sigma, points):
    cov = np.array([[2.0, -0.9], [-0.9, 0.5]])
    contour = plot.ellipse(np.array([3.0, -1.0]), cov, n_sigma, points)
    assert contour.shape == (points + 1, 2)
    np.testing.assert_allclose(contour[0], contour[-1], atol=1e-12)
    d = contour - [3.0, -1.0]
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", d, np.linalg.inv(cov), d), n_sigma**2)


def test_a_singular_covariance_gives_a_segment_and_a_point():
    line = plot.ellipse(np.zeros(2), np.array([[1.0, 2.0], [2.0, 4.0]]), 1.0)
    np.testing.assert_allclose(line[:, 1], 2 * line[:, 0], atol=1e-7)
    np.testing.assert_allclose(np.abs(line[:, 0]).max(), 1.0, rtol=1e-2)
    flat = plot.ellipse(np.zeros(2), np.diag([0.0, 4.0]), 1.0)
    np.testing.assert_allclose(np.abs(flat[:, 1]).max(), 2.0)
    np.testing.assert_allclose(plot.ellipse(np.ones(2), np.zeros((2, 2))), 1.0)


@pytest.mark.parametrize(
    "cov",
    [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(3), np.full((2, 2), np.nan)],
)
def test_an_ellipse_of_no_covariance_is_refused(cov):
    with pytest.raises(ValueError, match="covariance"):
        plot.ellipse(np.zeros(2), cov)


@pytest.fixture(scope="module")
def drive():
    truth, log = simulate(WORLD, worlds.key())
    return truth, run(worlds.ekf(WORLD), log, WORLD.pose, WORLD.pose_cov, worlds.key())


def test_a_map_has_equal_aspect_units_and_a_legend(drive, tmp_path):
    truth, trace = drive
    figure = plot.map_figure(trace.estimate, truth=truth, title="ring")
    (axes,) = figure.axes
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"true path", "estimated path", "true landmarks", "3 σ ellipses"} <= set(named)
    assert len(named) == len(set(named))
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_a_map_without_any_landmark_can_be_drawn(drive):
    _, trace = drive
    nothing = trace.estimate._replace(alive=jnp.zeros_like(trace.estimate.alive))
    plot.map_figure(nothing).savefig("/dev/null", format="png")


def test_errors_are_drawn_within_their_claimed_bounds(drive):
    truth, trace = drive
    figure = plot.errors_figure(trace.estimate, truth)
    assert ylabels(figure) == ["x error [m]", "y error [m]", "heading error [°]"]
    drawn = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, truth.pose[:, 1] - trace.estimate.pose[:, 1])


@pytest.fixture(scope="module")
def campaign():
    """A filter and another like it; the first as if it had been watched."""
    found = worlds.campaign(WORLD, {"a": worlds.ekf(WORLD)}, 4)
    a = found.filters["a"]
    watched = {"rotation_information": np.linspace(0.0, 9.0, WORLD.steps)}
    b = dataclasses.replace(
        a,
        verdict="pessimistic",
        curves={key: 1.1 * curve for key, curve in a.curves.items()},
        coverage={block: share**2 for block, share in a.coverage.items()},
        autocorrelation=a.autocorrelation / 2,
    )
    a = dataclasses.replace(a, curves=a.curves | watched)
    (one,) = found.step_seconds.values()
    return dataclasses.replace(
        found, filters={"a": a, "b": b}, step_seconds={"a": one, "b": 20 * one}
    )


DOF = {"pose": 3, "position": 2, "heading": 1}

CAMPAIGN_FIGURES = (
    plot.nees_figure,
    plot.bound_figure,
    plot.cost_figure,
    plot.coverage_figure,
    plot.whiteness_figure,
    plot.gained_figure,
)


def many(campaign, names):
    summaries = list(campaign.filters.values())
    filters = {name: summaries[i % 2] for i, name in enumerate(names)}
    times = list(campaign.step_seconds.values())
    step_seconds = {name: times[i % 2] for i, name in enumerate(names)}
    return dataclasses.replace(campaign, filters=filters, step_seconds=step_seconds)


def line(axes, label):
    (found,) = [drawn for drawn in axes.lines if drawn.get_label() == label]
    return found


def ylabels(figure):
    return [axes.get_ylabel() for axes in figure.axes]


def named(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_nees_is_drawn_with_its_band(campaign):
    figure = plot.nees_figure(campaign)
    assert ylabels(figure) == [f"{block} NEES (dof {dof})" for block, dof in DOF.items()]
    verdicts = [summary.verdict for summary in campaign.filters.values()]
    assert named(figure) == ["95 % band", f"a ({verdicts[0]})", f"b ({verdicts[1]})"]
    curves, most = (campaign.filters[name].curves for name in "ba")
    for axes, block in zip(figure.axes, DOF, strict=True):
        drawn = line(axes, f"b ({verdicts[1]})").get_ydata()
        np.testing.assert_array_equal(drawn, curves[f"nees_{block}"])
        (band,) = axes.collections
        heights = band.get_paths()[0].vertices[:, 1]
        assert heights.max() == np.nanmax(most[f"nees_{block}_high"])
        assert heights.min() == np.nanmin(most[f"nees_{block}_low"])
    (axes,) = plot.nees_figure(campaign, blocks=("heading",)).axes
    assert axes.get_ylabel() == "heading NEES (dof 1)"


@pytest.mark.parametrize(
    ("low", "high", "scale"), [(2.0, 8.0, "linear"), (0.5, 50.0, "log"), (3.0, 1e4, "log")]
)
def test_an_ordinate_is_logarithmic_beyond_a_decade_and_has_numbers(low, high, scale):
    _, (axes,) = panels_of(5.0, 3.0, 1)
    axes.plot([0, 1], [low, high])
    logarithmic(axes)
    assert axes.get_yscale() == scale
    bottom, top = axes.get_ylim()
    shown = []
    for axis in (axes.yaxis.major, axes.yaxis.minor):
        ticks = [tick for tick in axis.locator() if bottom <= tick <= top]
        shown += filter(None, axis.formatter.format_ticks(ticks))
    assert len(shown) >= 2


def test_errors_are_drawn_above_the_bound(campaign):
    figure = plot.bound_figure(campaign)
    assert ylabels(figure) == ["position RMSE [m]", "heading RMSE [°]"]
    assert named(figure) == ["a", "b", "conditional Cramér-Rao bound"]
    for axes, key in zip(figure.axes, ("position", "heading_deg"), strict=True):
        bound = line(axes, "conditional Cramér-Rao bound")
        np.testing.assert_array_equal(
            bound.get_ydata(), campaign.filters["a"].curves[f"bound_{key}"]
        )
        assert bound.get_linewidth() > line(axes, "a").get_linewidth()
        assert axes.get_yscale() == "linear"
        assert axes.get_ylim()[0] == 0
    there = campaign.filters["a"]
    key = "rmse_position"
    far = dataclasses.replace(there, curves=there.curves | {key: 100 * there.curves[key]})
    figure = plot.bound_figure(dataclasses.replace(campaign, filters={"a": there, "far": far}))
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "linear"]
    bare = {name: curve for name, curve in there.curves.items() if not name.startswith("bound")}
    alone = dataclasses.replace(campaign, filters={"a": dataclasses.replace(there, curves=bare)})
    assert named(plot.bound_figure(alone)) == ["a"]


def test_coverage_is_drawn_about_the_diagonal(campaign):
    figure = plot.coverage_figure(campaign)
    for axes, (block, dof) in zip(figure.axes, DOF.items(), strict=True):
        assert axes.get_title() == f"{block} (dof {dof})"
        assert axes.get_box_aspect() == 1
        np.testing.assert_array_equal(*line(axes, "honest").get_data())
        np.testing.assert_array_equal(line(axes, "a").get_xdata(), LEVELS)
        drawn = line(axes, "a").get_ydata()
        np.testing.assert_array_equal(drawn, campaign.filters["a"].coverage[block])


def test_whiteness_is_drawn_lag_by_lag_about_zero(campaign):
    figure = plot.whiteness_figure(campaign)
    (axes,) = figure.axes
    drawn = line(axes, "b")
    np.testing.assert_array_equal(drawn.get_xdata(), np.arange(1, LAGS + 1))
    np.testing.assert_array_equal(drawn.get_ydata(), campaign.filters["b"].autocorrelation)
    assert axes.get_ylim()[0] == -axes.get_ylim()[1]
    assert axes.get_xlabel() == "lag [steps]"


def test_cost_is_drawn_against_error_and_nees(campaign):
    top, bottom = plot.cost_figure(campaign).axes
    for name, summary in campaign.filters.items():
        for axes, key in ((top, "rmse_position"), (bottom, "nees_pose")):
            (x,), (y,) = line(axes, name).get_data()
            assert x == pytest.approx(1e6 * campaign.step_seconds[name])
            assert y == pytest.approx(summary.measures[key].value)
    assert bottom.get_xlabel() == "time of a step [µs]"
    # A campaign that only read its blocks has timed nothing.
    untimed = plot.cost_figure(dataclasses.replace(campaign, step_seconds={}))
    assert "no filter was timed" in [text.get_text() for text in untimed.axes[0].texts]
    untimed.canvas.draw()


def test_information_gained_is_drawn_for_watched_filters_and_zeros_are_nothing(campaign):
    there = campaign.filters["a"]
    gained = np.array([0.0, -1e-20, 1e-30, 1e-3, np.nan, *np.linspace(1, 50, WORLD.steps - 5)])
    filters = {
        name: dataclasses.replace(there, curves=there.curves | {"rotation_information": values})
        for name, values in (("learns", gained), ("honest", np.zeros(WORLD.steps)))
    } | {"b": campaign.filters["b"]}
    figure = plot.gained_figure(dataclasses.replace(campaign, filters=filters))
    assert named(figure) == ["learns", "honest"]
    (axes,) = figure.axes
    drawn = line(axes, "learns").get_ydata()
    np.testing.assert_array_equal(drawn[3:], gained[3:])
    assert axes.get_yscale() == "log"
    low, high = axes.get_ylim()
    honest = line(axes, "honest").get_ydata()
    assert np.all((drawn[:3] > low) & (drawn[:3] < 1e-6))
    assert np.all((honest > low) & (honest < 1e-6))
    assert not np.isclose(honest[0], drawn[0], rtol=0.2)  # each in its own lane
    assert high > 50
    assert "nothing" in [label.get_text() for label in axes.get_yticklabels()]
    nobody = dataclasses.replace(campaign, filters={"b": campaign.filters["b"]})
    (axes,) = plot.gained_figure(nobody).axes
    assert [text.get_text() for text in axes.texts] == ["no filter was watched"]


@pytest.mark.parametrize("draw", CAMPAIGN_FIGURES[1:])  # tests/test_nees_figure.py has the first
def test_twelve_filters_can_be_told_apart_and_nothing_overlaps(campaign, draw):
    figure = draw(many(campaign, [f"filter_number_{i}" for i in range(12)]))
    plot.png(figure, 60)
    lines = [drawn for drawn in figure.axes[0].lines if drawn.get_label().startswith("filter")]
    looks = [(drawn.get_color(), drawn.get_linestyle()) for drawn in lines]
    assert len(looks) == len(set(looks)) == (6 if draw is plot.gained_figure else 12)
    page = figure.bbox
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert box.x0 >= page.x0
    assert box.x1 <= page.x1
    for axes in figure.axes:
        drawn = axes.get_tightbbox()
        assert drawn.y1 <= box.y0 + 1
        assert drawn.y0 >= page.y0 - 1
        assert drawn.x1 <= page.x1 + 1


@pytest.mark.parametrize("draw", CAMPAIGN_FIGURES)
def test_filters_without_a_number_and_single_steps_can_be_drawn(campaign, draw):
    there = campaign.filters["a"]
    lost = dataclasses.replace(
        there,
        curves={name: np.full_like(curve, np.nan) for name, curve in there.curves.items()},
        coverage={block: np.full_like(share, np.nan) for block, share in there.coverage.items()},
        autocorrelation=np.full(LAGS, np.nan),
        counts=there.counts | {"runs": 0},
        measures={},
    )
    once = dataclasses.replace(there, curves={n: curve[2:3] for n, curve in there.curves.items()})
    for steps, filters in (
        (WORLD.steps, {"$lost_": lost}),
        (WORLD.steps, {"_a$": lost, "b": there}),
        (1, {"a": once}),
    ):
        times = dict.fromkeys(filters, 1e-4)
        tiny = dataclasses.replace(campaign, steps=steps, filters=filters, step_seconds=times)
        figure = draw(tiny)
        assert plot.png(figure, 40).startswith(b"\x89PNG")
        said = plot.describe(figure)
        for name in filters:
            assert name in said


def test_a_figure_is_described_in_words(campaign, drive):
    said = plot.describe(plot.coverage_figure(campaign))
    assert "share of truth within" in said
    assert "against probability p of the ellipsoid" in said
    assert "Drawn: honest, a, b." in said
    truth, trace = drive
    assert "true path" in plot.describe(plot.map_figure(trace.estimate, truth=truth))
