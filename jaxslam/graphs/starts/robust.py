"""The robust start: the odometry, drawn by the loops that agree with it."""

import numpy as np

from jaxslam.graphs.graph import TRUSTED, Graph, with_loops_apart
from jaxslam.graphs.optimize import optimize
from jaxslam.graphs.solver.kernels import DynamicCovarianceScaling
from jaxslam.graphs.starts.relative import Factors, as_before, with_poses
from jaxslam.graphs.starts.tree import odometry


def robust(graph: Graph, factors: Factors | None = None) -> Graph:
    """The graph at the minimum next to its odometry with dynamic covariance scaling.

    Odometry and priors are trusted, all other rows have that kernel. A loop that contradicts
    the odometry hardly pulls, one that agrees with it does, and the next ones agree better: a start
    for graphs with false loops, unless the odometry is so poor that it contradicts the true ones.

    Agarwal et al. 2013, "Robust map optimization using dynamic covariance scaling", ICRA. Arguments
    and errors are those of `odometry` and of `graphs.optimize`.
    """
    apart = with_loops_apart(odometry(graph, factors))
    doubted = {key: DynamicCovarianceScaling() for key in apart.tables if key not in TRUSTED}
    found = optimize(apart, factors, kernel=doubted).graph
    points = as_before(graph.points, np.asarray(found.points))
    return with_poses(graph, np.array(found.poses))._replace(points=points)
