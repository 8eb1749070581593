"""Simulated worlds: scenarios, sensor faults, several robots, and the logs they record."""
