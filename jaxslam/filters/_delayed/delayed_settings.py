"""The settings of `DelayedSlam`: three records with defaults, validated when they are created."""

from dataclasses import dataclass
from typing import Literal, get_args

from jaxslam.core._numbers import check_count, is_concrete
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Associate, Sensor
from jaxslam.filters._delayed.state import TableLayout
from jaxslam.filters._delayed.triangulation import Triangulation
from jaxslam.math._arrays import Number
from jaxslam.math.stats import chi2_quantile

Distance = Literal["mahalanobis", "bhattacharyya"]


@record
class StoredMeasurements:
    """Limits of the stored measurements: how many are kept, and which.

    Raises:
        ValueError: on a capacity below 1 or a negative spacing.
    """

    capacity: int = static(default=32)
    """W: where all slots are taken, the oldest stored measurement is marginalized out"""
    spacing: Number = 0.2
    """[m] least distance between the positions of stored measurements of one identity;
    one from nearer is `Status.DEFERRED`"""

    def __post_init__(self) -> None:
        check_count("StoredMeasurements: capacity", self.capacity)
        _check_not_negative(self, "spacing")


@record
class Hypotheses:
    """Criteria by which intersections become hypotheses, and hypotheses are deleted.

    Raises:
        ValueError: on a count below 1, a spread or `same` not above 0, a negative decay, or an
            unknown distance.
    """

    capacity: int = static(default=16)
    """C: where all slots are taken, intersections are refused, and counted"""
    spread: Number = 0.3
    """[1] the largest standard deviation of the intersection relative to the sensor, over their
    distance, with which a hypothesis may begin; with a larger one it is not Gaussian"""
    distance: Distance = static(default="mahalanobis")
    """between intersection and hypothesis as Gaussians relative to the sensor: d² of mahalanobis,
    or bhattacharyya"""
    same: Number | None = None
    """[1] an intersection at less than this distance from a hypothesis is that hypothesis; default
    the 99 % quantile of chi-square with two degrees of freedom for mahalanobis, 0.5 for
    bhattacharyya"""
    decay: Number = 0.5
    """persistence lost by each measurement of its tag that does not confirm it; deleted at 0, so
    persistence / decay outliers in a row are survived"""
    patience: int = static(default=200)
    """scans without confirmation after which a hypothesis is deleted"""

    def __post_init__(self) -> None:
        check_count("Hypotheses: capacity", self.capacity)
        check_count("Hypotheses: patience", self.patience)
        _check_positive(self, "spread", "same")
        _check_not_negative(self, "decay")
        if self.distance not in get_args(Distance):
            raise ValueError(
                f"Hypotheses: expected distance {' or '.join(get_args(Distance))}, got "
                f"{self.distance!r}"
            )

    @property
    def same_below(self) -> Number:
        """`same`, or its default."""
        if self.same is not None:
            return self.same
        return chi2_quantile(0.99, 2) if self.distance == "mahalanobis" else 0.5


@record
class Promotion:
    """Criteria by which a hypothesis becomes a landmark.

    Raises:
        ValueError: on a count below 1, a persistence or spread not above 0, or a negative lead.
    """

    persistence: Number = 4.0
    """the persistence needed: 1 of the intersection, and 1 of each confirmation"""
    lead: Number = 2.0
    """by how much its persistence must exceed that of each hypothesis that excludes it"""
    spread: Number = 0.3
    """[1] the largest standard deviation of its position relative to the sensor, over its range,
    with which it may become a landmark"""
    per_scan: int = static(default=2)
    """largest number of promotions a scan"""

    def __post_init__(self) -> None:
        check_count("Promotion: per_scan", self.per_scan)
        _check_positive(self, "persistence", "spread")
        _check_not_negative(self, "lead")


@dataclass(frozen=True, eq=False)
class DelayedSettings:
    """All settings that the steps of `DelayedSlam` take."""

    sensor: Sensor
    """of the landmarks of the table, whose third parameter it ignores"""
    triangulation: Triangulation
    layout: TableLayout
    associate: Associate
    by_tag: bool
    """identities are known: only measurements of one tag intersect"""
    gate: Number
    """a probability"""
    gamma: Number
    """the largest d² of one degree of freedom within the gate"""
    stored: StoredMeasurements
    hypotheses: Hypotheses
    promotion: Promotion


def _check_positive(record: object, *fields: str) -> None:
    for field in fields:
        value = getattr(record, field)
        if value is not None and is_concrete(value) and not value > 0:
            name = type(record).__name__
            raise ValueError(f"{name}: expected {field} above 0, got {value}")


def _check_not_negative(record: object, *fields: str) -> None:
    for field in fields:
        value = getattr(record, field)
        if is_concrete(value) and not value >= 0:
            name = type(record).__name__
            raise ValueError(f"{name}: expected {field} of at least 0, got {value}")
