"""Filters: recursive estimators, all of type `Filter`."""

from jaxslam.core.protocols import Filter, Wrapper
from jaxslam.filters.delayed.delayed_settings import Hypotheses, Promotion, StoredMeasurements
from jaxslam.filters.delayed.delayed_slam import DelayedSlam
from jaxslam.filters.ekf.compressed_ekf_slam import CompressedEkfSlam
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.filters.ekf.linear_system import LinearizedSteps
from jaxslam.filters.ekf.monitor import Monitored
from jaxslam.filters.information.eif_slam import EifSlam
from jaxslam.filters.information.seif import Seif
from jaxslam.filters.information.sparse_state import ApproximationCounts
from jaxslam.filters.known.dead_reckoning import DeadReckoning
from jaxslam.filters.known.localization import Localization
from jaxslam.filters.known.mapping import Mapping, StartingAt
from jaxslam.filters.map_management.closing import Closing
from jaxslam.filters.map_management.loop_closure import LoopSettings
from jaxslam.filters.map_management.merging import Merging
from jaxslam.filters.multi_robot.team_slam import TeamSlam
from jaxslam.filters.particles.fastslam import FastSlam
from jaxslam.filters.particles.particle_localization import ParticleLocalization
from jaxslam.filters.particles.slam_particles import ParticleInfo

__all__ = [
    "ApproximationCounts",
    "Closing",
    "CompressedEkfSlam",
    "DeadReckoning",
    "DelayedSlam",
    "EifSlam",
    "EkfSlam",
    "FastSlam",
    "Filter",
    "Hypotheses",
    "LinearizedSteps",
    "Localization",
    "LoopSettings",
    "Mapping",
    "Merging",
    "Monitored",
    "ParticleInfo",
    "ParticleLocalization",
    "Promotion",
    "Seif",
    "StartingAt",
    "StoredMeasurements",
    "TeamSlam",
    "Wrapper",
]
