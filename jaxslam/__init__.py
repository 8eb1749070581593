"""jaxslam: pure-functional, differentiable 2-D SLAM.

A SLAM method is a record of pure functions (`jaxslam.protocols`). `run` applies it to a log, and
`monte_carlo` to thousands of simulated worlds. Importing the package does not change the
configuration of JAX; for float64 set `jax_enable_x64` yourself, as the command line does.
"""

import importlib
import importlib.metadata
from collections.abc import Callable
from types import ModuleType

from jaxslam import (
    association,
    calibration,
    catalog,
    charts,
    consistency,
    filters,
    graphs,
    life,
    linearize,
    motion,
    resampling,
    sensors,
)
from jaxslam._driver import run
from jaxslam.consistency import metrics
from jaxslam.consistency.campaign import Campaign, Incomplete, Interrupted, monte_carlo
from jaxslam.core import protocols, slots, types
from jaxslam.core._field_docs import attach_field_docs
from jaxslam.filters.multi_robot import team
from jaxslam.graphs import smoothing
from jaxslam.laser import features, grids, laser_slam, matching, topology
from jaxslam.math import se2, stats, uncertain_poses
from jaxslam.simulation import scenarios, spurious
from jaxslam.simulation._recorded import RecordedWorld, recorded_world
from jaxslam.simulation._team_world import TeamWorld
from jaxslam.simulation._worlds import Scenario, World, simulate
from jaxslam.verify import linearity, verify_jacobians
from jaxslam.verify.linearity import linearity_index

__all__ = [
    "Campaign",
    "Incomplete",
    "Interrupted",
    "RecordedWorld",
    "Scenario",
    "TeamWorld",
    "World",
    "association",
    "calibration",
    "catalog",
    "charts",
    "consistency",
    "datasets",
    "features",
    "filters",
    "graphs",
    "grids",
    "laser_slam",
    "life",
    "linearity",
    "linearity_index",
    "linearize",
    "load",
    "matching",
    "metrics",
    "monte_carlo",
    "motion",
    "plot",
    "protocols",
    "recorded_world",
    "report",
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
    "store",
    "team",
    "topology",
    "types",
    "uncertain_poses",
    "verify_jacobians",
]

_ON_DEMAND = {
    "datasets": "jaxslam.datasets",
    **{name: f"jaxslam.results.{name}" for name in ("plot", "report", "store")},
}


def __getattr__(name: str) -> ModuleType | Callable[..., Campaign] | str:
    """What reads files or plots is imported on first access."""
    if name == "load":
        from jaxslam.results._campaign_files import load

        return load
    if name == "__version__":
        return importlib.metadata.version("jaxslam")
    if name in _ON_DEMAND:
        module = importlib.import_module(_ON_DEMAND[name])
        attach_field_docs()
        return module
    raise AttributeError(f"module 'jaxslam' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, those on demand too."""
    return [*__all__, "__version__"]


attach_field_docs()
