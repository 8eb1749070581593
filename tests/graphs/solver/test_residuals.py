"""Squared residuals and degrees of freedom against plain NumPy."""

import numpy as np
import small_graphs
from reference import graph as plain

from jaxslam import graphs


def test_squared_residuals_are_those_of_the_equations():
    graph = small_graphs.drawn(noise=0.5)
    table = graph.tables["relative_pose"]._replace(valid=np.arange(10) != 4)
    graph = graph._replace(tables=graph.tables | {"relative_pose": table})
    found = graphs.squared_residuals(graph)
    assert {key: len(rows) for key, rows in found.items()} == {
        key: len(table.z) for key, table in graph.tables.items()
    }
    assert found["relative_pose"][4] == 0
    total = sum(np.asarray(rows).sum() for rows in found.values())
    np.testing.assert_allclose(total, plain.chi2(graph), rtol=1e-13)


def test_degrees_of_freedom():
    graph = small_graphs.drawn(fixed_point=np.array([True, False, False]))
    # 10 relative poses, 16 relative positions, 5 bearings, a prior; 7 poses and 2 points are free.
    assert graphs.degrees_of_freedom(graph) == 30 + 32 + 5 + 3 - 21 - 4
