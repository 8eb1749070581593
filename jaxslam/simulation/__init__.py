"""Simulated worlds: scenarios, sensor faults, several robots, and the logs they record."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxslam.simulation import laser, scenarios, spurious, walls

__all__ = ["laser", "scenarios", "spurious", "walls"]


def __getattr__(name: str) -> ModuleType:
    """A module of this folder, imported when it is first asked for."""
    if name in __all__:
        return importlib.import_module(f"jaxslam.simulation.{name}")
    raise AttributeError(f"module 'jaxslam.simulation' has no attribute {name!r}")
