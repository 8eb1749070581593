"""Readers of public data sets, and of your data in CSV files (`table`); they return a `Dataset`.

`READERS` has them by name, for the command line; each takes a path, and, for a data set of several
robots, the number of one.
"""

from collections.abc import Callable

from jaxslam.datasets.carmen_reader import StampedRelations, carmen, relation_file
from jaxslam.datasets.dataset import Adjustable, Dataset, Parameter
from jaxslam.datasets.laser_record import LaserLog
from jaxslam.datasets.line_readers import bonn, victoria_park
from jaxslam.datasets.mrclam_reader import mrclam, mrclam_team
from jaxslam.datasets.mrclam_robot import MRCLAM_CALIBRATION, RobotCalibration
from jaxslam.datasets.noise_fit import DatasetFit, fit
from jaxslam.datasets.plaza_reader import plaza
from jaxslam.datasets.rosbag_reader import BagContents, rosbag, rosbag_contents
from jaxslam.datasets.table_reader import table
from jaxslam.datasets.uncertain_constants import Added, considered

READERS: dict[str, Callable[..., Dataset]] = {
    "bonn": bonn,
    "mrclam": mrclam,
    "plaza": plaza,
    "table": table,
    "victoria_park": victoria_park,
}

__all__ = [
    "MRCLAM_CALIBRATION",
    "READERS",
    "Added",
    "Adjustable",
    "BagContents",
    "Dataset",
    "DatasetFit",
    "LaserLog",
    "Parameter",
    "RobotCalibration",
    "StampedRelations",
    "bonn",
    "carmen",
    "considered",
    "fit",
    "mrclam",
    "mrclam_team",
    "plaza",
    "relation_file",
    "rosbag",
    "rosbag_contents",
    "table",
    "victoria_park",
]
