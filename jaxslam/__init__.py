"""jaxslam: pure-functional, differentiable 2-D landmark SLAM.

A SLAM method is a record of pure functions (`protocols`); one driver runs it over a log (`run`) and
one harness over thousands of simulated worlds (`monte_carlo`). Importing the package configures
nothing; for float64 set `jax_enable_x64` yourself, as the command line does.
"""

import importlib
from typing import Any

from jaxslam import (
    association,
    calibration,
    charts,
    consistency,
    family,
    filters,
    frames,
    life,
    linearity,
    linearize,
    motion,
    programs,
    resampling,
    scenarios,
    se2,
    sensors,
    slots,
    smoothing,
    spurious,
    stats,
    team,
)
from jaxslam.linearity import linearity_index
from jaxslam.monte_carlo import Campaign, Interrupted, monte_carlo
from jaxslam.run import run
from jaxslam.simulate import Scenario, simulate
from jaxslam.verify import verify_jacobians

__all__ = [
    "Campaign",
    "Interrupted",
    "Scenario",
    "association",
    "calibration",
    "charts",
    "consistency",
    "family",
    "filters",
    "frames",
    "life",
    "linearity",
    "linearity_index",
    "linearize",
    "monte_carlo",
    "motion",
    "programs",
    "resampling",
    "run",
    "scenarios",
    "se2",
    "sensors",
    "simulate",
    "slots",
    "smoothing",
    "spurious",
    "stats",
    "team",
    "verify_jacobians",
]

_ON_DEMAND = ("datasets", "page", "plot", "report", "store")


def __getattr__(name: str) -> Any:
    """What reads files or draws is imported when it is first asked for."""
    if name in _ON_DEMAND:
        return importlib.import_module(f"jaxslam.{name}")
    raise AttributeError(f"module 'jaxslam' has no attribute {name!r}")
