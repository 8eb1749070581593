"""Results as text: a campaign's table, JSON and CSV; CSV of one run."""

from jaxslam._public import publish
from jaxslam.results._report import map_csv, trajectory_csv, trajectory_tum

__all__ = ["map_csv", "trajectory_csv", "trajectory_tum"]

publish(__name__)
