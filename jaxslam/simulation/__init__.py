"""Simulated worlds: scenarios, sensor faults, several robots, and the logs they record."""

from jaxslam.simulation import laser, scenarios, spurious, walls

__all__ = ["laser", "scenarios", "spurious", "walls"]
