"""Localization in a grid: the particle filter, its log, and its hypotheses."""

from jaxslam.grids.localization.beam_log import beam_log
from jaxslam.grids.localization.clusters import Clusters, clusters
from jaxslam.grids.localization.localize import GridLocalization

__all__ = ["Clusters", "GridLocalization", "beam_log", "clusters"]
