"""The filters that `jaxslam run` runs on a data set, by their names in the catalog."""

import argparse
import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxslam.association.rules import Known
from jaxslam.catalog import ALL, CANONICAL, SMOOTHERS, on_given_poses
from jaxslam.cli.common import pick
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.types import Log, Truth
from jaxslam.datasets import Dataset
from jaxslam.datasets.table.models import association_options
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.simulation.worlds import Scenario

NAMES = tuple(name for name in ALL if name not in ("ideal", "batch_map"))
"""Those that run on a data set: no truth is needed, and no whole log at once."""


def with_options(data: Dataset, options: argparse.Namespace) -> Dataset:
    """The data set with the gate and the association that the command asks for."""
    if options.gate is None and options.associate is None:
        return data
    if options.associate is None and data.filter_options.get("associate") is not None:
        raise ValueError("--gate: expected --associate beside it, since the tags are not used")
    try:
        size = len(data.sensor.measurements)
        own = association_options(options.associate or "known", options.gate, size)
    except ValueError as problem:
        raise ValueError(f"--{problem}") from problem
    asked = [name for name in ("gate", "associate") if getattr(options, name) is not None]
    assumed = (
        line for line in data.assumed if not line.startswith(tuple(f"[filter] {n}" for n in asked))
    )
    plain: EkfOptions = {"gate": None, "associate": Known()}
    mine = data.filter_options | plain | own
    return dataclasses.replace(data, filter_options=mine, assumed=tuple(assumed))


def chosen_filters(data: Dataset, asked: str) -> dict[str, Filter]:
    """The filters of a comma-separated list of names.

    Raises ValueError on names that are unknown or occur twice, and on a filter that needs what the
    data set does not have: the truth at every step, a map in the frame of the start, or tags.
    """
    names = [name.strip() for name in asked.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise ValueError(f"--filters: expected different names with commas between, got {asked!r}")
    slots = np.zeros((data.capacity, len(data.sensor.landmark)))
    world = Scenario(
        name=data.name,
        motion=data.motion,
        sensor=data.sensor,
        landmarks=slots,
        controls=data.log.control,
        places=data.log.scan.tag.shape[1],
        filter_options=data.filter_options,
    )
    if own := next((name for name in names if ".py" in name), None):
        raise ValueError(
            f"--filters: {own}: `jaxslam run` takes filters of the catalog; give your own to "
            "`jaxslam.run` in Python"
        )
    known = {name: ALL[name] for name in ALL if name in NAMES or name in names}
    known["mapping"] = on_given_poses
    return {name: _filter(name, pick("filters", name, known)(world), data) for name in names}


def on_true_poses(data: Dataset) -> tuple[Log, int]:
    """The log with true poses as controls, for mapping; and how many measurements it leaves out,
    made where the pose is not known. The control there is the last known pose."""
    assert data.true_path is not None
    known = np.ones(data.steps, bool) if data.true_at is None else data.true_at
    scan = data.log.scan
    kept = np.asarray(scan.valid) & known[:, None]
    latest = np.maximum.accumulate(np.where(known, np.arange(data.steps), int(np.argmax(known))))
    lost = int(np.sum(scan.valid)) - int(kept.sum())
    return Log(jnp.asarray(data.true_path[latest]), scan._replace(valid=kept)), lost


def _filter(name: str, candidate: Candidate, data: Dataset) -> Filter:
    if data.filter_options.get("associate") is not None and (
        name in CANONICAL or name == "localization"
    ):
        raise ValueError(f"--filters: {name} needs the tag of every measurement")
    if name == "mapping" and data.true_path is None:
        raise ValueError("--filters: mapping needs the true path of the robot")
    if isinstance(candidate, Filter):
        return candidate
    if name in SMOOTHERS:
        raise ValueError(
            f"--filters: {name} takes a whole log at once, which `jaxslam run` does not: call "
            f"jaxslam.graphs.smoothing.{name} from Python"
        )
    if name == "ideal" or not data.one_frame or data.landmarks is None:
        needs = (
            "the true path of a simulation"
            if name == "ideal"
            else ("a map, landmarks.csv, in the frame of the start")
        )
        raise ValueError(f"--filters: {name} needs {needs}")
    nothing = np.zeros(0)
    made = candidate(Truth(nothing, data.landmarks, nothing, nothing))
    assert isinstance(made, Filter)
    return made
