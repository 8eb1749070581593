"""Nearest-neighbour association of each measurement on its own."""

from typing import Literal

from jaxslam.association.gates import check_gates, far_from_all, mutual
from jaxslam.core.record import record, static
from jaxslam.math.arrays import Number
from jaxslam.protocols import Association, Prediction
from jaxslam.types import Scan


@record
class Nearest:
    """Individual compatibility nearest neighbour (ICNN; Neira & Tardós 2001, section II).

    A pair is compatible if d² = νᵀ S⁻¹ ν <= gate. A measurement is associated with the landmark
    of its least d² if it is also the nearest of that landmark's measurements. One with no landmark
    within new_gate is new; one between the gates, or whose landmark has a nearer measurement, is
    ignored (the two gates of Bailey, "Mobile robot localisation and mapping in extensive outdoor
    environments", 2002, section 2.3). Tags are not used.

    Raises ValueError on a negative gate, a new_gate below it, or an unknown policy.
    """

    gate: Number
    """of squared Mahalanobis distance, 0 (nothing is compatible but a perfect match) to infinity;
    `stats.chi2_quantile` gives it by probability"""
    new_gate: Number | None = None
    """at least the gate; the same by default"""
    ambiguous: Literal["nearest", "leave"] = static(default="nearest", kw_only=True)
    """"leave" ignores a measurement that is compatible with several landmarks, and several that are
    compatible with one"""

    def __post_init__(self) -> None:
        check_gates("Nearest", self.gate, self.new_gate)
        if self.ambiguous not in ("nearest", "leave"):
            raise ValueError(
                f'Nearest: expected ambiguous "nearest" or "leave", got {self.ambiguous!r}'
            )

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        allowed = compatible = pairs.possible & (pairs.distance <= self.gate)
        if self.ambiguous == "leave":
            allowed = compatible & (compatible.sum(axis=1) == 1)[:, None]
            allowed = allowed & (compatible.sum(axis=0) == 1)[None, :]
        slot = mutual(pairs.distance, allowed)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))
