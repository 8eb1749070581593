"""Filters: recursive estimators, all of type `Filter`."""

from jaxslam.filters.delayed.delayed_slam import delayed_slam
from jaxslam.filters.ekf.compressed_ekf_slam import compressed_ekf_slam
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.filters.ekf.observability import monitored
from jaxslam.filters.information.eif_slam import eif_slam
from jaxslam.filters.information.seif import seif
from jaxslam.filters.known.dead_reckoning import dead_reckoning
from jaxslam.filters.known.localization import localization
from jaxslam.filters.known.mapping import mapping
from jaxslam.filters.map_management.closing import closing
from jaxslam.filters.map_management.merging import merging
from jaxslam.filters.map_management.pruning import pruning
from jaxslam.filters.multi_robot.team_slam import team_slam
from jaxslam.filters.particles.fastslam import fastslam
from jaxslam.filters.particles.particle_localization import particle_localization

__all__ = [
    "closing",
    "compressed_ekf_slam",
    "dead_reckoning",
    "delayed_slam",
    "eif_slam",
    "ekf_slam",
    "fastslam",
    "localization",
    "mapping",
    "merging",
    "monitored",
    "particle_localization",
    "pruning",
    "seif",
    "team_slam",
]
