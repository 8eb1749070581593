"""Filters: recursive estimators, all of type `Filter`."""

from jaxslam._public import publish
from jaxslam.core.protocols import Filter, Wrapper
from jaxslam.filters._delayed.delayed_filter import Hypotheses, Promotion, StoredMeasurements
from jaxslam.filters._delayed.delayed_slam import DelayedSlam
from jaxslam.filters._ekf.compressed_ekf_slam import CompressedEkfSlam
from jaxslam.filters._ekf.ekf_settings import EkfOptions
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.filters._ekf.linear_system import (
    LinearizedSteps,
    LinearLandmarks,
    LinearMeasurements,
    Transition,
)
from jaxslam.filters._ekf.monitor import Monitored
from jaxslam.filters._information.eif_slam import EifSlam
from jaxslam.filters._information.marginals import whole_information
from jaxslam.filters._information.seif import Seif
from jaxslam.filters._information.sparse_state import ApproximationCounts
from jaxslam.filters._known.dead_reckoning import DeadReckoning
from jaxslam.filters._known.localization import Localization
from jaxslam.filters._known.mapping import Mapping, StartingAt
from jaxslam.filters._particles.fastslam import FastSlam
from jaxslam.filters._particles.particle_localization import ParticleLocalization
from jaxslam.filters._particles.slam_particles import ParticleInfo
from jaxslam.filters._reporting import Mask, Pruned, info_of, status_of, with_extra
from jaxslam.filters.map_management._closing import Closing
from jaxslam.filters.map_management._loop_closure import LoopSettings
from jaxslam.filters.map_management._merging import Managed, Merging
from jaxslam.filters.multi_robot._team_slam import TeamSlam

__all__ = [
    "ApproximationCounts",
    "Closing",
    "CompressedEkfSlam",
    "DeadReckoning",
    "DelayedSlam",
    "EifSlam",
    "EkfOptions",
    "EkfSlam",
    "FastSlam",
    "Filter",
    "Hypotheses",
    "LinearLandmarks",
    "LinearMeasurements",
    "LinearizedSteps",
    "Localization",
    "LoopSettings",
    "Managed",
    "Mapping",
    "Mask",
    "Merging",
    "Monitored",
    "ParticleInfo",
    "ParticleLocalization",
    "Promotion",
    "Pruned",
    "Seif",
    "StartingAt",
    "StoredMeasurements",
    "TeamSlam",
    "Transition",
    "Wrapper",
    "info_of",
    "status_of",
    "whole_information",
    "with_extra",
]

publish(__name__)
