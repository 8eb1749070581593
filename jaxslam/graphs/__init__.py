"""Graphs of poses and points: files, factors, optimization, marginals."""

from jaxslam.graphs.factor import Factor, from_sensor, prior, relative_pose
from jaxslam.graphs.graph import Graph, Table

REGISTRY = {"prior": prior, "relative_pose": relative_pose}
"""Factories of the factors of files, by the name of their table; none has parameters."""

__all__ = ["REGISTRY", "Factor", "Graph", "Table", "from_sensor", "prior", "relative_pose"]
