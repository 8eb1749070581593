"""Figures of single runs: ellipses are contours, every filter is shown, and data-set maps say where
the robot starts, what dead reckoning gives and how far the map is from a survey."""

import dataclasses

import drawn
import numpy as np
import pytest
from cases import swept

from jaxslam import plot
from jaxslam.core.types import Trace
from jaxslam.results.plot import _landmarks, _panels, _pose_errors, _style


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


def named(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def line(axes, label):
    (found,) = [each for each in axes.lines if each.get_label() == label]
    return found


def test_a_map_has_equal_aspect_units_a_start_and_an_end():
    truth, estimate = drawn.run_of("ekf")
    figure = plot.map_figure(estimate, truth=truth, title="ring")
    (axes,) = figure.axes
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    expected = {
        "true path",
        "estimated path",
        "true landmarks",
        "3 σ ellipses",
        "3 σ ellipse, pose",
        "start",
        "end",
    }
    assert expected <= set(named(figure)) and len(named(figure)) == len(set(named(figure)))
    for label, at in (("start", 0), ("end", -1)):
        np.testing.assert_array_equal(line(axes, label).get_xydata()[0], estimate.pose[at, :2])
    assert _style.png(figure, 40).startswith(b"\x89PNG")


def test_paths_that_coincide_can_all_be_seen_in_a_map():
    truth, estimate = drawn.run_of("ekf")
    others = {f"other{i}": estimate for i in range(12)}
    (axes,) = plot.map_figure(estimate, truth=truth, others=others).axes
    first = line(axes, "estimated path")
    assert first.get_linestyle() == "-"
    over = [line(axes, name) for name in others]
    assert all(each.get_zorder() > first.get_zorder() for each in over)
    assert {each.get_linestyle() for each in over} == {"--"}  # of all that are not solid
    looks = {(each.get_color(), str(each._dash_pattern)) for each in over}
    assert len(looks) == 12 and first.get_color() not in {color for color, _ in looks}


@pytest.mark.parametrize("count", swept([3, 5, 7, 11], 5))
def test_the_lowest_map_of_each_column_has_the_abscissa(count):
    figure = _landmarks.run_map_figure(drawn.campaign([f"filter{i}" for i in range(count)]))
    figure.draw_without_rendering()
    shown = [axes for axes in figure.axes if axes.axison]
    columns = 3 if count <= 9 else 4
    for i, axes in enumerate(shown):
        lowest = i + columns >= count
        assert axes.get_xlabel() == ("x [m]" if lowest else "")
        assert any(tick.label1.get_visible() for tick in axes.xaxis.get_major_ticks()) == lowest
        assert axes.get_tightbbox().y0 > 0
    boxes = [axes.get_tightbbox() for axes in shown]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[i + 1 :])


def test_maps_without_landmarks_and_with_broken_covariances_can_be_drawn():
    _, estimate = drawn.run_of("ekf")
    nothing = estimate._replace(alive=np.zeros_like(estimate.alive))
    assert _style.png(plot.map_figure(nothing), 40).startswith(b"\x89PNG")
    covs = estimate.point_covs.copy()
    covs[-1, 0] = np.nan
    figure = plot.map_figure(estimate._replace(point_covs=covs))
    assert figure.axes[0].get_title("right") == "1 without ellipse"


@pytest.mark.parametrize(("far", "whole"), [(1.1, True), (50.0, False)])
def test_dead_reckoning_is_drawn_and_does_not_set_the_scale_from_afar(far, whole):
    _, estimate = drawn.run_of("ekf")
    figure = plot.map_figure(estimate, dead_reckoning=far * estimate.pose)
    (axes,) = figure.axes
    drift = line(axes, "dead reckoning").get_xydata()
    np.testing.assert_array_equal(drift, far * estimate.pose[:, :2])
    low, high = axes.get_xlim()
    assert ((low < drift[:, 0]) & (drift[:, 0] < high)).all() == whole
    assert high - low < 15


def test_residuals_to_a_survey_are_drawn_with_what_is_claimed():
    _, estimate = drawn.run_of("ekf")
    order = [2, 0, 1]  # tags need not be in the order of slots
    moved = estimate._replace(tag=np.tile(order, (drawn.STEPS, 1)))
    survey = drawn.LANDMARKS[np.argsort(order)]
    figure = plot.map_figure(moved, true_points=survey, names=("a", "b", "c"))
    over, below = figure.axes
    assert {"surveyed landmarks", "residual", "3 σ claimed in its direction"} <= set(named(figure))
    np.testing.assert_allclose(line(below, "residual").get_ydata(), 0.1 * np.sqrt(2))
    assert [text.get_text() for text in below.get_xticklabels()] == ["a", "b", "c"]
    heights = [bar.get_height() for bar in below.patches]
    np.testing.assert_allclose(heights, 3 * np.sqrt(0.02))
    parts = [each.get_xydata() for each in over.lines if each.get_label() == "residual"]
    np.testing.assert_allclose([a - b for a, b in parts], np.full((3, 2), 0.1))
    assert below.get_xlabel() == "landmark"
    with pytest.raises(ValueError, match="map_figure: names"):
        plot.map_figure(estimate, names=("a",))


def test_errors_are_drawn_within_their_claimed_bounds():
    truth, estimate = drawn.run_of("ekf")
    turned = truth._replace(pose=truth.pose + [0, 0, 2 * np.pi])  # a full turn is no error
    figure = plot.errors_figure(estimate, turned)
    expected = ["x error [m]", "y error [m]", "heading error [°]"]
    assert [axes.get_ylabel() for axes in figure.axes] == expected
    x, _, heading = (_style.curves_of(axes)[0].get_ydata() for axes in figure.axes)
    np.testing.assert_allclose(x, -0.1)
    np.testing.assert_allclose(heading, 0.0, atol=1e-9)
    edges = figure.axes[0].collections[0].get_paths()[0].vertices[:, 1]
    np.testing.assert_allclose([edges.min(), edges.max()], [-0.3, 0.3])


def test_errors_and_maps_show_every_filter_on_scales_that_dead_reckoning_does_not_set():
    names = ["dead_reckoning", "ekf", "fej"]
    campaign = drawn.campaign(names)
    figure = _pose_errors.run_errors_figure(campaign, title="run 0")
    rows = np.array(figure.axes).reshape(3, 3)
    assert [row[0].get_ylabel().replace("\n", "") for row in rows] == names
    assert rows[0, 0].get_ylim() == rows[1, 0].get_ylim() == pytest.approx((-0.315, 0.315))
    marked = [
        any(artist.get_gid() == _panels.BEYOND for artist in axes.lines) for axes in rows[:, 0]
    ]
    assert marked == [True, False, False]
    assert rows[0, 0].get_title("right") == "↓ to −4"
    maps = _landmarks.run_map_figure(campaign, title="run 0")
    shown = [axes for axes in maps.axes if axes.axison]
    assert [axes.get_title("left") for axes in shown] == names
    assert len({axes.get_xlim() for axes in shown}) == 1
    assert np.ptp(shown[0].get_xlim()) < 10


def test_errors_far_below_the_others_have_a_scale_of_their_own():
    campaign = drawn.campaign(["ekf", "fej", "localization"])
    truth, estimate = campaign.first["localization"]
    near = truth.pose + (np.asarray(estimate.pose) - truth.pose) / 100
    close = estimate._replace(pose=near, pose_cov=np.asarray(estimate.pose_cov) / 100**2)
    first = campaign.first | {"localization": (truth, close)}
    rows = _pose_errors.run_errors_figure(dataclasses.replace(campaign, first=first)).axes
    common, narrow = rows[0].get_ylim()[1], rows[6].get_ylim()[1]
    assert narrow == pytest.approx(common / 100)
    assert {label.get_weight() for label in rows[6].get_yticklabels()} == {"bold"}


def test_a_run_of_one_filter_has_the_figure_of_one_and_none_is_refused():
    campaign = drawn.campaign(["ekf"])
    assert len(_pose_errors.run_errors_figure(campaign).axes) == 3
    assert len(_landmarks.run_map_figure(campaign).axes) == 1
    nothing = dataclasses.replace(campaign, first={})
    for draw in (_pose_errors.run_errors_figure, _landmarks.run_map_figure):
        with pytest.raises(ValueError, match=f"{draw.__name__}: campaign: it holds no run 0"):
            draw(nothing)
        with pytest.raises(ValueError, match="campaign: expected a Campaign, got"):
            draw(campaign.first["ekf"])
    with pytest.raises(
        ValueError, match="expected an Estimate, got a Trace; give its field estimate"
    ):
        plot.map_figure(Trace(campaign.first["ekf"][1], None, None, None))
