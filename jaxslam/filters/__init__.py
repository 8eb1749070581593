"""Filters: recursive estimators, all of type `Filter`."""

from jaxslam.filters.delayed.delayed_slam import DelayedSlam
from jaxslam.filters.ekf.compressed_ekf_slam import CompressedEkfSlam
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.filters.ekf.observability import Monitored
from jaxslam.filters.information.eif_slam import EifSlam
from jaxslam.filters.information.seif import Seif
from jaxslam.filters.known.dead_reckoning import DeadReckoning
from jaxslam.filters.known.localization import Localization
from jaxslam.filters.known.mapping import Mapping, StartingAt
from jaxslam.filters.map_management.closing import Closing
from jaxslam.filters.map_management.merging import Merging
from jaxslam.filters.multi_robot.team_slam import TeamSlam
from jaxslam.filters.particles.fastslam import FastSlam
from jaxslam.filters.particles.particle_localization import ParticleLocalization
from jaxslam.protocols import Filter, Wrapper

__all__ = [
    "Closing",
    "CompressedEkfSlam",
    "DeadReckoning",
    "DelayedSlam",
    "EifSlam",
    "EkfSlam",
    "FastSlam",
    "Filter",
    "Localization",
    "Mapping",
    "Merging",
    "Monitored",
    "ParticleLocalization",
    "Seif",
    "StartingAt",
    "TeamSlam",
    "Wrapper",
]
