"""Nearest-neighbour association of each measurement on its own."""

from typing import Literal

from jaxslam.association.gates import check_gates, far_from_all, mutual
from jaxslam.protocols import Associate, Association, Prediction
from jaxslam.types import Scan


def nearest(
    gate: float,
    new_gate: float | None = None,
    *,
    ambiguous: Literal["nearest", "leave"] = "nearest",
) -> Associate:
    """Individual compatibility nearest neighbour (ICNN; Neira & Tardós 2001, section II).

    A pair is compatible if d² = νᵀ S⁻¹ ν <= gate. A measurement is associated with the landmark
    of its least d² if it is also the nearest of that landmark's measurements. One with no landmark
    within new_gate is new; one between the gates, or whose landmark has a nearer measurement, is
    ignored (the two gates of Bailey, "Mobile robot localisation and mapping in extensive outdoor
    environments", 2002, section 2.3). Tags are not used.

    Args:
        gate: of squared Mahalanobis distance, 0 (nothing is compatible but a perfect match) to
            infinity; `stats.chi2_quantile` gives it by probability.
        new_gate: at least the gate; the same by default.
        ambiguous: "leave" ignores a measurement that is compatible with several landmarks, and
            several that are compatible with one.
    Raises:
        ValueError: on a negative gate, a new_gate below it, or an unknown policy.
    """
    beyond = check_gates("nearest", gate, new_gate)
    if ambiguous not in ("nearest", "leave"):
        raise ValueError(f'nearest: expected ambiguous "nearest" or "leave", got {ambiguous!r}')

    def associate(prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        compatible = pairs.possible & (pairs.distance <= gate)
        allowed = compatible
        if ambiguous == "leave":
            allowed = compatible & (compatible.sum(axis=1) == 1)[:, None]
            allowed = allowed & (compatible.sum(axis=0) == 1)[None, :]
        slot = mutual(pairs.distance, allowed)
        return Association(slot, far_from_all(pairs, scan, beyond) & (slot < 0))

    return associate
