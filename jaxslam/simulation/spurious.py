"""Sensor faults beyond noise: clutter, missed detections, outliers and wrong tags."""

from jaxslam._public import publish
from jaxslam.simulation._spurious import Spurious

__all__ = ["Spurious"]

publish(__name__)
