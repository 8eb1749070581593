"""Starts of the optimization: each a pure function from a graph to one with other values.

They are computed on the host, for concrete graphs. Fixed variables stay where they are. A part of
the graph without a fixed pose is held at the pose of its first prior (a table "prior"), or else at
the pose of its lowest id. The start decides which minimum is reached; it has no other influence on
the optimum.
"""

from collections.abc import Callable

from jaxslam._public import publish
from jaxslam.graphs._graph import Graph
from jaxslam.graphs.starts._chordal_relaxation import chordal
from jaxslam.graphs.starts._relative import Factors
from jaxslam.graphs.starts._tree import odometry, robust, spanning_tree


def identity(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph as it is."""
    return graph


STARTS: dict[str, Callable[..., Graph]] = {
    "given": identity,
    "odometry": odometry,
    "spanning_tree": spanning_tree,
    "chordal": chordal,
    "robust": robust,
}
"""The starts by name, for the command line."""

__all__ = ["STARTS", "chordal", "identity", "odometry", "robust", "spanning_tree"]

publish(__name__)
