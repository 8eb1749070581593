"""Checks of arguments before tracing; each error is one line that states what was expected."""

from jaxslam.core._numbers import (
    check_count,
    check_covariance,
    check_gate,
    check_key,
    is_concrete,
    shape_text,
)
from jaxslam.core._validation.logs import check_log
from jaxslam.core._validation.models import (
    call_traced,
    check_associate,
    check_models,
    check_motion,
    check_parts,
    check_record,
    check_sensor,
    checked_estimate,
    same_state,
    state_and_info,
)

__all__ = [
    "call_traced",
    "check_associate",
    "check_count",
    "check_covariance",
    "check_gate",
    "check_key",
    "check_log",
    "check_models",
    "check_motion",
    "check_parts",
    "check_record",
    "check_sensor",
    "checked_estimate",
    "is_concrete",
    "same_state",
    "shape_text",
    "state_and_info",
]
