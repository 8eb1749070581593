"""Checks of arguments before tracing; each error is one line that states what was expected."""

from jaxslam.core._numbers import (
    check_count,
    check_covariance,
    check_key,
    is_concrete,
    shape_text,
)
from jaxslam.core._validation.logs import check_log
from jaxslam.core._validation.models import (
    check_models,
    check_motion,
    check_record,
    check_sensor,
    checked_estimate,
    motion_model,
    reworded_tracer_errors,
    same_state,
    sensor_model,
    state_and_info,
)

__all__ = [
    "check_count",
    "check_covariance",
    "check_key",
    "check_log",
    "check_models",
    "check_motion",
    "check_record",
    "check_sensor",
    "checked_estimate",
    "is_concrete",
    "motion_model",
    "reworded_tracer_errors",
    "same_state",
    "sensor_model",
    "shape_text",
    "state_and_info",
]
