"""Ellipses are contours of Mahalanobis distance; figures carry labels, units and equal aspect."""

import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from jaxslam import plot, run, simulate
from jaxslam.monte_carlo import monte_carlo

WORLD = worlds.ring(steps=15)


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
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "x error [m]",
        "y error [m]",
        "heading error [°]",
    ]
    drawn = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, truth.pose[:, 1] - trace.estimate.pose[:, 1])


def test_nees_is_drawn_with_its_band():
    campaign = monte_carlo(WORLD, {"a": worlds.ekf(WORLD)}, 4, worlds.key())
    figure = plot.nees_figure(campaign)
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "log"]
    named = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert named[0] == "95 % band"
    assert named[1].startswith("a (")
