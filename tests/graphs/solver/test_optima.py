"""The optima of real graphs, whose χ² GTSAM 4.3 found from several starts."""

import numpy as np
import pytest
from recordings import DATA
from reference import graph as plain

from jaxslam import graphs
from jaxslam.graphs import Ending, starts


@pytest.mark.parametrize(
    ("name", "start", "best"),
    [("ring", "given", 11.16310), ("ring", "chordal", 11.16310), ("CSAIL", "chordal", 40.55088)],
)
def test_they_are_gtsams(name, start, best):
    """Of the logarithm of the error, which is GTSAM's; to the digits that were noted."""
    path = DATA / "graphs" / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    graph = graphs.with_gauge(graphs.read(path))
    begun = starts.STARTS[start](graph)
    found = graphs.optimize(begun, {"relative_pose": graphs.RelativePoseLog()})
    assert found.status == Ending.CONVERGED
    np.testing.assert_allclose(found.chi2, best, rtol=1e-6)
    assert found.gradient < 1e-6 * found.gradient_start
    # That of the error itself lies close by, where it is not yet a minimum.
    near = plain.chi2(graph._replace(poses=np.asarray(found.graph.poses)))
    np.testing.assert_allclose(near, best, rtol=1e-3)
