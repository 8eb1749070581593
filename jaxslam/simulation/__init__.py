"""Simulated worlds: scenarios, sensor faults, several robots, and the logs they record."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxslam.simulation import laser, scenarios, spurious, walls
    from jaxslam.simulation._twin import Twin, twin

__all__ = ["Twin", "laser", "scenarios", "spurious", "twin", "walls"]


def __getattr__(name: str) -> object:
    """A public name of this folder, imported when it is first asked for."""
    if name in ("Twin", "twin"):
        return getattr(importlib.import_module("jaxslam.simulation._twin"), name)
    if name in __all__:
        return importlib.import_module(f"jaxslam.simulation.{name}")
    raise AttributeError(f"module 'jaxslam.simulation' has no attribute {name!r}")
