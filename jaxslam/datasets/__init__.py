"""Readers of public data sets and of your own (`table`), one in each file; they return a `Dataset`.

`READERS` has them by name, for the command line; each takes (path, robot). `robot` is the number of
a robot where a data set has several (None: the first one); elsewhere it must be None.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from jaxslam.datasets.bonn_reader import bonn
from jaxslam.datasets.carmen_reader import LaserLog, StampedRelations, carmen, relation_file
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.mrclam_reader import (
    MRCLAM_FITTED,
    OwnCalibration,
    mrclam,
    mrclam_calibration,
    mrclam_team,
)
from jaxslam.datasets.mrclam_robot import MRCLAM_CALIBRATION, RobotCalibration, white_noise
from jaxslam.datasets.noise_fit import DatasetFit, fit
from jaxslam.datasets.plaza_reader import plaza
from jaxslam.datasets.table_reader import table
from jaxslam.datasets.victoria_park_reader import victoria_park

Reader = Callable[[str | Path, int | None], Dataset]


def _of_one_robot(
    reader: Callable[[str | Path], Dataset], path: str | Path, robot: int | None = None
) -> Dataset:
    if robot is not None:
        raise ValueError(f"--robot: expected none, since this data set has one robot, got {robot}")
    return reader(path)


def _of_several_robots(
    reader: Callable[[str | Path, int], Dataset], path: str | Path, robot: int | None = None
) -> Dataset:
    return reader(path, 1 if robot is None else robot)


READERS: dict[str, Reader] = {
    "bonn": partial(_of_one_robot, bonn),
    "mrclam": partial(_of_several_robots, mrclam),
    "plaza": partial(_of_one_robot, plaza),
    "table": partial(_of_one_robot, table),
    "victoria_park": partial(_of_one_robot, victoria_park),
}

__all__ = [
    "MRCLAM_CALIBRATION",
    "MRCLAM_FITTED",
    "READERS",
    "Dataset",
    "DatasetFit",
    "LaserLog",
    "OwnCalibration",
    "RobotCalibration",
    "StampedRelations",
    "bonn",
    "carmen",
    "fit",
    "mrclam",
    "mrclam_calibration",
    "mrclam_team",
    "plaza",
    "relation_file",
    "table",
    "victoria_park",
    "white_noise",
]
