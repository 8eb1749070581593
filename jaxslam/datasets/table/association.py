"""The association method of a table by name, and its gate by probability."""

from collections.abc import Callable

import numpy as np

from jaxslam.association import (
    GlobalNearest,
    JointCompatibility,
    Known,
    MaximumLikelihood,
    Nearest,
)
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.math import stats
from jaxslam.protocols import Associate

GATE = 0.99
"""Default probability of the gate of an association."""

NEW_GATE = 0.9999
"""Probability beyond which a measurement is of a new landmark."""

METHODS: dict[str, Callable[..., Associate]] = {
    "nearest": Nearest,
    "global_nearest": GlobalNearest,
    "maximum_likelihood": MaximumLikelihood,
    "joint": JointCompatibility,
    "known": Known,
}


def association_options(method: object, gate: object, size: int) -> EkfOptions:
    """Options of `EkfSlam` for a method by name and a gate by probability.

    Raises ValueError, "associate: …" or "gate: …", on a name that is none and a gate that is no
    probability. Known identities need no gate (None); other methods take `GATE`.

    Args:
        method: one of `METHODS`.
        gate: the probability that a correct measurement passes.
        size: numbers of a measurement.
    """
    probability = None if gate is None else _probability(gate)
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"associate: expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "known":
        return {} if probability is None else {"gate": stats.chi2_quantile(probability, size)}
    inner = GATE if probability is None else probability
    beyond = stats.chi2_quantile(max(inner, NEW_GATE), size)
    limit = inner if method == "joint" else stats.chi2_quantile(inner, size)
    return {"associate": METHODS[method](limit, beyond)}


def _probability(gate: object) -> float:
    """The probability that a gate is given by; ValueError where it is none."""
    if not isinstance(gate, int | float) or isinstance(gate, bool) or not 0 < gate < 1:
        raise ValueError(f"gate: expected a probability between 0 and 1, got {gate!r}")
    return gate


def is_number(value: object) -> bool:
    """Whether a value of a file is a finite number."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )
