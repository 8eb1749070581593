"""The filters of `jaxslam run`: filters of the catalog for which a data set has the data."""

import argparse
import dataclasses
import inspect
from typing import Any

import numpy as np

from jaxslam._cli.common import pick
from jaxslam.association._rules import Known
from jaxslam.catalog import ALL, KINDS, SMOOTHERS, on_given_poses
from jaxslam.core.protocols import Candidate, Filter, Motion, Sensor
from jaxslam.core.types import Truth
from jaxslam.core.validation import InvalidField
from jaxslam.datasets import READERS, Dataset
from jaxslam.datasets._landmark_logs.table_settings import association_options
from jaxslam.simulation._worlds import Scenario

NAMES = tuple(name for name in ALL if name not in ("ideal", "batch_map"))
"""Filters for a data set: those that need neither the truth nor the whole log at once."""


def read_dataset(dataset: str, path: str, robot: int | None) -> Dataset:
    """The data set of a reader by name. robot: its number, of a data set of several."""
    reader = pick("dataset", dataset, READERS)
    if robot is None:
        return reader(path)
    if "robot" not in inspect.signature(reader).parameters:
        raise ValueError(f"--robot: expected none, since this data set has one robot, got {robot}")
    return reader(path, robot)


def with_options(data: Dataset, options: argparse.Namespace) -> Dataset:
    """The data set with the gate and the association of the command."""
    if options.gate is None and options.associate is None:
        return data
    if options.associate is None and data.filter_options.get("associate") is not None:
        raise ValueError("--gate: expected --associate, too, since the tags are not used")
    try:
        association = association_options(options.associate or "known", options.gate)
    except InvalidField as problem:
        raise ValueError(f"--{problem.field}: {problem.reason}") from problem
    # A default that an option replaces is not reported as taken.
    replaced = tuple(
        f"[filter] {name}" for name in ("gate", "associate") if getattr(options, name) is not None
    )
    assumed = tuple(line for line in data.assumed if not line.startswith(replaced))
    plain: dict[str, Any] = {"gate": None, "associate": Known()}
    return dataclasses.replace(
        data, filter_options=data.filter_options | plain | association, assumed=assumed
    )


def chosen_filters(
    data: Dataset, text: str, models: tuple[Motion, Sensor] | None = None
) -> dict[str, Filter]:
    """The filters of a comma-separated list of names, with the models of the data set or others.

    Raises ValueError on unknown or repeated names, and on a filter that needs what the data set
    does not have: the truth at every step, a map in the frame of the start, or tags.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise ValueError(f"--filters: expected different names with commas between, got {text!r}")
    motion, sensor = models or (data.motion, data.sensor)
    # The catalog builds filters for a world: this one has the models and the size of the data set.
    world = Scenario(
        name=data.name,
        motion=motion,
        sensor=sensor,
        landmarks=np.zeros((data.capacity, len(data.sensor.landmark))),
        controls=data.log.control,
        pose=data.pose,
        pose_cov=data.pose_cov,
        places=data.log.scan.tag.shape[1],
        filter_options=data.filter_options,
    )
    if user := next((name for name in names if ".py" in name), None):
        raise ValueError(
            f"--filters: {user}: `jaxslam run` takes filters of the catalog; give your own to "
            "`jaxslam.run` in Python"
        )
    factories = {name: ALL[name] for name in ALL if name in NAMES or name in names}
    factories["mapping"] = on_given_poses
    return {name: _filter_of(name, pick("filters", name, factories)(world), data) for name in names}


def _filter_of(name: str, candidate: Candidate, data: Dataset) -> Filter:
    """The filter of a candidate of the catalog; ValueError if the data set lacks what it needs."""
    if data.filter_options.get("associate") is not None and (
        name in KINDS["information"] or name == "localization"
    ):
        raise ValueError(f"--filters: {name} needs the tag of every measurement")
    if name == "mapping" and data.rows_without_truth == data.steps:
        raise ValueError("--filters: mapping needs the true path of the robot")
    if isinstance(candidate, Filter):
        return candidate
    if name in SMOOTHERS:
        raise ValueError(
            f"--filters: {name} takes a whole log at once: call "
            f"jaxslam.graphs.smoothing.{name} from Python"
        )
    # What is left are functions of the truth: of its path, or of its landmarks alone.
    if name == "ideal":
        raise ValueError("--filters: ideal needs the true path of a simulation")
    if not data.one_frame or data.landmarks is None:
        raise ValueError(f"--filters: {name} needs a map, landmarks.csv, in the frame of the start")
    no_path = np.zeros(0)
    filter = candidate(Truth(no_path, data.landmarks, no_path, no_path))
    assert isinstance(filter, Filter)
    return filter
