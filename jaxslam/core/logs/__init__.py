"""Logs from tables of odometry and measurements, whose streams have separate times."""

from jaxslam._public import publish
from jaxslam.core.logs._streams import Rows, Rule, divide, hold, relative
from jaxslam.core.logs._tables import Aligned

__all__ = ["Aligned", "Rows", "Rule", "divide", "hold", "relative"]

publish(__name__)
