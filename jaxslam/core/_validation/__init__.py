"""Checks of logs and models before tracing, and of the results of a user's filter, during it."""

from jaxslam.core._validation.logs import log_of
from jaxslam.core._validation.models import (
    check_models,
    checked_estimate,
    is_user_file,
    motion_model,
    reworded_tracer_errors,
    same_state,
    sensor_model,
    state_and_info,
)

__all__ = [
    "check_models",
    "checked_estimate",
    "is_user_file",
    "log_of",
    "motion_model",
    "reworded_tracer_errors",
    "same_state",
    "sensor_model",
    "state_and_info",
]
