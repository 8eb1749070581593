"""The picture of a grid: what is occupied, free and unknown, where the cells are, and a scan."""

import io

import numpy as np
import pytest
from PIL import Image

from jaxslam import grids, plot
from jaxslam.core.types import Beams


def png(figure, dpi):
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()


GRID = grids.Grid(
    np.array([[2.0, -2.0, 0.0], [2.0, 2.0, -1.0]]), np.array([1.0, 2.0, np.pi / 2]), np.float64(0.5)
)


def named(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_cells_stand_where_they_are_and_unknown_ones_are_told_apart():
    figure = plot.grid_figure(GRID, title="a map")
    mesh = figure.axes[0].collections[0]
    assert named(figure) == ["occupied", "free", "in between", "unknown"]
    shown = mesh.get_array().reshape(2, 3)
    np.testing.assert_array_equal(np.ma.getmaskarray(shown), GRID.log_odds == 0)
    np.testing.assert_allclose(shown[0, 0], 1 / (1 + np.exp(-2)))
    corners = mesh.get_coordinates()
    np.testing.assert_allclose(corners[0, 3], [1.0, 3.5], atol=1e-12)  # x of the grid is up
    np.testing.assert_allclose(corners[2, 0], [0.0, 2.0], atol=1e-12)
    assert png(figure, dpi=20)


def test_a_wide_map_has_its_labels_within_the_page():
    log_odds = np.tile([2.0, -2.0, 0.5, 0.0], (31, 23))
    wide = grids.Grid(log_odds, np.array([-40.0, -8.0, 0.0]), np.float64(1.0))
    figure = plot.grid_figure(wide, poses=[[0, 0], [1, 1]], title="wide")
    shown = Image.open(io.BytesIO(png(figure, dpi=110))).convert("L")
    assert np.asarray(shown)[-1].min() == 255, "a label is cut by the lower edge"


def test_a_scan_and_a_path_are_drawn_and_dropouts_are_not():
    beams = Beams(np.array([1.0, 2.0]), np.array([0.0, 1.0]), np.array([True, False]))
    figure = plot.grid_figure(GRID, poses=[[0, 0, 0], [1, 1, np.pi / 2]], beams=beams)
    (ends,) = [line for line in figure.axes[0].lines if line.get_label() == "beams"]
    np.testing.assert_allclose(ends.get_xydata(), [[1, 2]], atol=1e-12)
    assert {"path", "end", "beams"} <= set(named(figure))
    with pytest.raises(ValueError, match="grid_figure: beams are from the last of poses"):
        plot.grid_figure(GRID, beams=beams)


def test_a_field_has_a_scale():
    figure = plot.grid_figure(grids.Field(*GRID), label="distance [m]")
    assert figure.axes[1].get_ylabel() == "distance [m]"
    assert png(figure, dpi=20)
