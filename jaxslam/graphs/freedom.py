"""The degrees of freedom of a graph's χ²."""

from collections.abc import Mapping

from jaxslam.graphs.factor import Factor
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.model import factors_of


def degrees_of_freedom(graph: Graph, factors: Mapping[str, Factor] | None = None) -> int:
    """The residuals of all valid rows minus the free numbers of poses and points.

    At the optimum χ² of a graph whose informations are right has about this mean.
    """
    factors = factors_of("graphs.degrees_of_freedom", graph, factors)
    residuals = sum(
        int(table.valid.sum()) * len(factors[key].errors) for key, table in graph.tables.items()
    )
    free = 3 * int((~graph.fixed_pose).sum())
    return residuals - free - graph.points.shape[1] * int((~graph.fixed_point).sum())
