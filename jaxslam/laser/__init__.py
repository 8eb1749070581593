"""Laser scans: grids and rays, matching, laser SLAM, segments, topological maps."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxslam.laser import features, grids, laser_slam, matching, topology

__all__ = ["features", "grids", "laser_slam", "matching", "topology"]


def __getattr__(name: str) -> ModuleType:
    """A module of this folder, imported when it is first asked for."""
    if name in __all__:
        return importlib.import_module(f"jaxslam.laser.{name}")
    raise AttributeError(f"module 'jaxslam.laser' has no attribute {name!r}")
