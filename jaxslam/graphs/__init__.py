"""Graphs of poses and points: files, factors, optimization, marginals.

The cost of a graph is χ² = Σ eᵀ Ω e over the valid rows of its tables, without a factor ½; of a
relative pose e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ wrapped), without a logarithm.
"""

from jaxslam._public import publish
from jaxslam.graphs import starts
from jaxslam.graphs._checks import check_graph, with_gauge
from jaxslam.graphs._covariances import Marginals, marginals
from jaxslam.graphs._factor import (
    REGISTRY,
    Bearing,
    Factor,
    FromMotion,
    FromSensor,
    Prior,
    RelativePose,
    RelativePoseLog,
    RelativePosition,
)
from jaxslam.graphs._graph import Graph, Table, with_loops_apart
from jaxslam.graphs._log import of_log
from jaxslam.graphs._optimality import Certificate, certificate
from jaxslam.graphs._optimizer import chi2, degrees_of_freedom, optimize, squared_residuals
from jaxslam.graphs._solver.kernels import REGISTRY as KERNELS
from jaxslam.graphs._solver.kernels import (
    Cauchy,
    DynamicCovarianceScaling,
    Huber,
    Kernel,
    Truncated,
)
from jaxslam.graphs._solver.plans import Plan, plan
from jaxslam.graphs._solver.search import Ending, Solution

__all__ = [
    "KERNELS",
    "REGISTRY",
    "Bearing",
    "Cauchy",
    "Certificate",
    "DynamicCovarianceScaling",
    "Ending",
    "Factor",
    "FromMotion",
    "FromSensor",
    "Graph",
    "Huber",
    "Kernel",
    "Marginals",
    "Plan",
    "Prior",
    "RelativePose",
    "RelativePoseLog",
    "RelativePosition",
    "Solution",
    "Table",
    "Truncated",
    "certificate",
    "check_graph",
    "chi2",
    "degrees_of_freedom",
    "marginals",
    "of_log",
    "optimize",
    "plan",
    "squared_residuals",
    "starts",
    "with_gauge",
    "with_loops_apart",
]

publish(__name__)
