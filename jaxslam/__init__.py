"""jaxslam: pure-functional, differentiable 2-D SLAM.

A SLAM method is a record of pure functions (`jaxslam.protocols`). `run` applies it to a log, and
`monte_carlo` to thousands of simulated worlds. Importing the package does not change the
configuration of JAX; for float64 set `jax_enable_x64` yourself, as the command line does.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING

# For type checkers and editors; at run time `__getattr__` imports a name when it is asked for.
if TYPE_CHECKING:
    from jaxslam import (
        association,
        calibration,
        catalog,
        charts,
        consistency,
        datasets,
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
    from jaxslam.filters.multi_robot import team
    from jaxslam.graphs import smoothing
    from jaxslam.laser import features, grids, laser_slam, matching, topology
    from jaxslam.math import se2, stats, uncertain_poses
    from jaxslam.results import plot, report, store
    from jaxslam.results._campaign_files import load
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

_OBJECTS = {
    "Campaign": "jaxslam.consistency.campaign",
    "Incomplete": "jaxslam.consistency.campaign",
    "Interrupted": "jaxslam.consistency.campaign",
    "RecordedWorld": "jaxslam.simulation._recorded",
    "Scenario": "jaxslam.simulation._worlds",
    "TeamWorld": "jaxslam.simulation._team_world",
    "World": "jaxslam.simulation._worlds",
    "linearity_index": "jaxslam.verify.linearity",
    "load": "jaxslam.results._campaign_files",
    "monte_carlo": "jaxslam.consistency.campaign",
    "recorded_world": "jaxslam.simulation._recorded",
    "run": "jaxslam._driver",
    "simulate": "jaxslam.simulation._worlds",
    "verify_jacobians": "jaxslam.verify",
}
"""the module of each function and class"""

_MODULES = {
    "features": "jaxslam.laser.features",
    "grids": "jaxslam.laser.grids",
    "laser_slam": "jaxslam.laser.laser_slam",
    "linearity": "jaxslam.verify.linearity",
    "matching": "jaxslam.laser.matching",
    "metrics": "jaxslam.consistency.metrics",
    "plot": "jaxslam.results.plot",
    "protocols": "jaxslam.core.protocols",
    "report": "jaxslam.results.report",
    "scenarios": "jaxslam.simulation.scenarios",
    "se2": "jaxslam.math.se2",
    "slots": "jaxslam.core.slots",
    "smoothing": "jaxslam.graphs.smoothing",
    "spurious": "jaxslam.simulation.spurious",
    "stats": "jaxslam.math.stats",
    "store": "jaxslam.results.store",
    "team": "jaxslam.filters.multi_robot.team",
    "topology": "jaxslam.laser.topology",
    "types": "jaxslam.core.types",
    "uncertain_poses": "jaxslam.math.uncertain_poses",
}
"""the path of each module that is not `jaxslam.NAME`"""

_FOLDERS = ("core", "laser", "math", "results", "simulation", "verify")
"""modules that have public names and are not shown by `dir`"""


def __getattr__(name: str) -> object:
    """A public name, imported when it is first asked for."""
    if name == "__version__":
        return importlib.metadata.version("jaxslam")
    value: object
    if name in _OBJECTS:
        value = getattr(importlib.import_module(_OBJECTS[name]), name)
    elif name in __all__ or name in _FOLDERS:
        value = importlib.import_module(_MODULES.get(name, f"jaxslam.{name}"))
    else:
        raise AttributeError(f"module 'jaxslam' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return [*__all__, "__version__"]
