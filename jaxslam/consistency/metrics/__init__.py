"""Errors of paths and maps against a reference, one set of measures for every data set and
estimator: absolute and relative errors of a path, errors of relations, alignment, map entropy and
correlation. On the host, by NumPy in float64.
"""

from jaxslam._public import publish
from jaxslam.consistency.metrics._paths import PathErrors, align_map, alignment, ate, map_entropy
from jaxslam.consistency.metrics._relative_poses import (
    Errors,
    MeanAndStd,
    Relations,
    Statistics,
    benchmark_figures,
    given,
    relation_errors,
    relations,
    revisits,
    rpe,
    statistics,
    summary,
)

__all__ = [
    "Errors",
    "MeanAndStd",
    "PathErrors",
    "Relations",
    "Statistics",
    "align_map",
    "alignment",
    "ate",
    "benchmark_figures",
    "given",
    "map_entropy",
    "relation_errors",
    "relations",
    "revisits",
    "rpe",
    "statistics",
    "summary",
]

publish(__name__)
