"""The figure of a graph: what is drawn, and which rows are marked."""

import numpy as np
import pytest
import small_graphs
from matplotlib.collections import LineCollection
from reference import graph as plain

from jaxslam import plot
from jaxslam.results.plot._style import describe, png


def lines(axes):
    """{label: the ends of its lines}"""
    return {
        each.get_label(): np.array(each.get_segments())
        for each in axes.collections
        if isinstance(each, LineCollection)
    }


@pytest.fixture(scope="module")
def drawn():
    graph = small_graphs.drawn(noise=0.1)
    squared = {key: np.zeros(len(table.z)) for key, table in small_graphs.drawn().tables.items()}
    squared["relative_pose"][7] = 30.0  # ten times its size
    squared["relative_position"][3] = 18.0  # nine times
    squared["bearing"][1] = 8.0  # eight times
    squared["prior"][0] = 99.0  # of one pose
    before = graph._replace(poses=graph.poses + 1.0)
    return graph, plot.graph_figure(before, graph, squared, worst=2, subtitles=("a", "b"))


def test_path_loops_and_points_are_drawn_in_both_panels(drawn):
    graph, figure = drawn
    for axes, shift in zip(figure.axes, (1.0, 0.0), strict=True):
        found = lines(axes)
        assert found["path"].shape == (7, 2, 2)
        assert found["loop edges"].shape == (3, 2, 2)
        assert found["measurements of points"].shape == (21, 2, 2)  # of both tables
        np.testing.assert_allclose(found["path"][0], graph.poses[:2, :2] + shift)
        (points,) = [line for line in axes.lines if line.get_label() == "points"]
        np.testing.assert_allclose(points.get_xydata(), graph.points)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["a", "b"]


def test_the_largest_residuals_for_their_size_are_marked(drawn):
    graph, figure = drawn
    (rings,) = [line for line in figure.axes[1].lines if "largest" in line.get_label()]
    who = graph.tables["relative_position"].who[3]
    middle = (graph.poses[who[0], :2] + graph.points[who[1]]) / 2
    expected = [graph.poses[[7, 0], :2].mean(axis=0), middle]
    np.testing.assert_allclose(rings.get_xydata(), expected)
    assert rings.get_label() == "2 largest residuals"
    assert "first pose" in describe(figure)


def test_a_graph_without_residuals_is_drawn():
    graph = small_graphs.only(small_graphs.drawn(), "relative_pose")
    assert plain.chi2(graph) < 1e-20
    figure = plot.graph_figure(graph, graph, {"relative_pose": np.zeros(10)})
    assert not any("largest" in line.get_label() for line in figure.axes[0].lines)
    assert png(figure)
