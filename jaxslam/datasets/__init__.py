"""Readers of public data sets, and of your data in CSV files (`table`); they return a `Dataset`.

`READERS` has the readers by name, for the command line; each takes a path and, for a data set of
several robots, the number of a robot. `read_graph` and `write_graph` are for files
of pose graphs, `read_map` and `write_map` for those of ROS maps.
"""

from collections.abc import Callable

from jaxslam._public import publish
from jaxslam.core._names import Named
from jaxslam.datasets._dataset import Adjustable, Dataset, Parameter
from jaxslam.datasets._evaluation import Evaluation, MapTest, evaluate
from jaxslam.datasets._g2o import read_graph, write_graph
from jaxslam.datasets._landmark_logs.line_readers import bonn, victoria_park
from jaxslam.datasets._landmark_logs.mrclam_reader import mrclam, mrclam_team
from jaxslam.datasets._landmark_logs.mrclam_robot import MRCLAM_CALIBRATION, RobotCalibration
from jaxslam.datasets._landmark_logs.plaza_reader import plaza
from jaxslam.datasets._landmark_logs.table_reader import table
from jaxslam.datasets._laser_logs.bag_messages import Topic
from jaxslam.datasets._laser_logs.carmen_reader import StampedRelations, carmen, relation_file
from jaxslam.datasets._laser_logs.laser_record import LaserLog
from jaxslam.datasets._laser_logs.rosbag_reader import BagContents, rosbag, rosbag_contents
from jaxslam.datasets._noise_fit import DatasetFit, fit
from jaxslam.datasets._recorded_path import RecordedPath, recorded_path
from jaxslam.datasets._ros_map import read_map, write_map
from jaxslam.datasets._uncertain_constants import AddedCov, consider_constants

READERS: dict[str, Callable[..., Dataset]] = Named(
    {
        "bonn": bonn,
        "mrclam": mrclam,
        "plaza": plaza,
        "table": table,
        "victoria_park": victoria_park,
    }
)


__all__ = [
    "MRCLAM_CALIBRATION",
    "READERS",
    "AddedCov",
    "Adjustable",
    "BagContents",
    "Dataset",
    "DatasetFit",
    "Evaluation",
    "LaserLog",
    "MapTest",
    "Parameter",
    "RecordedPath",
    "RobotCalibration",
    "StampedRelations",
    "Topic",
    "bonn",
    "carmen",
    "consider_constants",
    "evaluate",
    "fit",
    "mrclam",
    "mrclam_team",
    "plaza",
    "read_graph",
    "read_map",
    "recorded_path",
    "relation_file",
    "rosbag",
    "rosbag_contents",
    "table",
    "victoria_park",
    "write_graph",
    "write_map",
]

publish(__name__)
