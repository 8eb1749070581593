"""Checks of arguments before tracing; each error is one line that states what was expected."""

from jaxslam.core._numbers import (
    check_array,
    check_count,
    check_covariance,
    check_gate,
    check_positive,
    is_concrete,
)
from jaxslam.core._validation import check_record

__all__ = [
    "check_array",
    "check_count",
    "check_covariance",
    "check_gate",
    "check_positive",
    "check_record",
    "is_concrete",
]
