"""Filters: recursive estimators behind the one `Filter` protocol."""

from jaxslam.filters.compressed_ekf_slam import compressed_ekf_slam
from jaxslam.filters.dead_reckoning import dead_reckoning
from jaxslam.filters.delayed_slam import delayed_slam
from jaxslam.filters.eif_slam import eif_slam
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.filters.eseif import eseif
from jaxslam.filters.fastslam import fastslam
from jaxslam.filters.localization import localization
from jaxslam.filters.mapping import mapping
from jaxslam.filters.particle_localization import particle_localization
from jaxslam.filters.seif import seif
from jaxslam.filters.team_slam import team_slam

__all__ = [
    "compressed_ekf_slam",
    "dead_reckoning",
    "delayed_slam",
    "eif_slam",
    "ekf_slam",
    "eseif",
    "fastslam",
    "localization",
    "mapping",
    "particle_localization",
    "seif",
    "team_slam",
]
