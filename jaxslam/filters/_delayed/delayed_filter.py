"""The models and options of `DelayedSlam`, which its steps take; three of them are records."""

import dataclasses
from typing import Literal, get_args

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core._numbers import check_count, is_concrete
from jaxslam.core._record import hold_function, record, set_field, static
from jaxslam.core.protocols import Associate, Filter, Motion, Sensor
from jaxslam.filters._delayed.state import SIZE, TableLayout
from jaxslam.filters._delayed.triangulation import Triangulation, triangulation_of
from jaxslam.math._arrays import Number
from jaxslam.math.stats import chi2_quantile
from jaxslam.sensors._suite import on_ground

Distance = Literal["mahalanobis", "bhattacharyya"]


@record
class StoredMeasurements:
    """Limits of the stored measurements: how many are kept, and which.

    Raises:
        ValueError: on a capacity below 1 or a negative spacing.
    """

    capacity: int = static(default=32)
    """W; in a full table the oldest stored measurement is marginalized out"""
    spacing: Number = 0.2
    """[m] least distance between the positions of stored measurements of one identity; a nearer
    measurement is `Status.DEFERRED`"""

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
    """C; in a full table intersections are refused, and counted"""
    spread: Number = 0.3
    """[1] largest standard deviation of an intersection relative to the sensor, over the distance,
    with which a hypothesis may begin; with a larger one it is not Gaussian"""
    distance: Distance = static(default="mahalanobis")
    """distance between intersection and hypothesis, Gaussians relative to the sensor: d² of
    "mahalanobis", or "bhattacharyya\""""
    same: Number | None = None
    """[1] distance from a hypothesis below which an intersection is that hypothesis; default
    the 99 % quantile of chi-square with two degrees of freedom for mahalanobis, 0.5 for
    bhattacharyya"""
    decay: Number = 0.5
    """persistence lost by each measurement of its tag that does not confirm it. A hypothesis is
    deleted at 0: it survives persistence / decay outliers in a row"""
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
    """least persistence: 1 of the intersection, and 1 of each confirmation"""
    lead: Number = 2.0
    """least difference of its persistence to that of each hypothesis that excludes it"""
    spread: Number = 0.3
    """[1] largest standard deviation of its position relative to the sensor, over its range"""
    per_scan: int = static(default=2)
    """largest number of promotions a scan"""

    def __post_init__(self) -> None:
        check_count("Promotion: per_scan", self.per_scan)
        _check_positive(self, "persistence", "spread")
        _check_not_negative(self, "lead")


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


@record
class DelayedFilter(Filter):
    """The models and options of `DelayedSlam`, and what follows from them."""

    motion: Motion
    sensor: Sensor
    """a sensor of one bearing or one range of points"""
    capacity: int = static()
    """landmarks N"""
    _: dataclasses.KW_ONLY
    triangulation: Triangulation = None  # type: ignore[assignment]
    """the intersection of stored measurements; default that of rays or of circles, by what the
    sensor measures"""
    stored: StoredMeasurements = StoredMeasurements()
    hypotheses: Hypotheses = Hypotheses()
    promotion: Promotion = Promotion()
    gate: Number | None = None
    """the probability that a correct comparison passes, by γ = χ²(1, gate); default 0.99"""
    associate: Associate = Known()
    """the landmark of each measurement. With `Known` only measurements of one tag intersect. With
    any different method, the measurements it declares new intersect all stored ones, and tags only
    name the landmarks"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        name, sensor = type(self).__name__, self.sensor
        validation.check_models(name, self.motion, sensor)
        validation.check_parts(name, associate=self.associate)
        hold_function(self, "associate", "prediction, scan")
        if len(sensor.measurements) != 1 or not sensor.of_points:
            raise ValueError(
                f"{name}: expected a sensor of one bearing or one range of points (x, y), got "
                f"{sensor.name} with {sensor.measurements} of {sensor.landmark}"
            )
        validation.check_count(f"{name}: capacity", self.capacity)
        validation.check_gate(name, self.gate)
        triangulation = self.triangulation or triangulation_of(sensor)
        set_field(self, "triangulation", triangulation)
        kinds = {
            "triangulation": Triangulation,
            "stored": StoredMeasurements,
            "hypotheses": Hypotheses,
            "promotion": Promotion,
        }
        for field, kind in kinds.items():
            validation.check_record(name, field, getattr(self, field), kind)
        if sensor.measurements != (triangulation.measurement,):
            raise ValueError(
                f"{name}: expected a sensor of one {triangulation.measurement}, got "
                f"{sensor.name} with {sensor.measurements}"
            )
        super().__post_init__()

    @property
    def layout(self) -> TableLayout:
        """The number of slots of each kind in the table."""
        return TableLayout(self.capacity, self.hypotheses.capacity, self.stored.capacity)

    @property
    def sensor_of_table(self) -> Sensor:
        """The sensor of the landmarks in the table, whose third parameter it ignores."""
        return on_ground(self.sensor, SIZE)

    @property
    def by_tag(self) -> bool:
        """Identities are known: only measurements of one tag intersect."""
        return isinstance(self.associate, Known)

    @property
    def probability(self) -> Number:
        """The gate, or its default."""
        return 0.99 if self.gate is None else self.gate

    @property
    def gamma(self) -> Number:
        """The largest d² of one degree of freedom within the gate."""
        return chi2_quantile(self.probability, 1)
