"""The models and options of `DelayedSlam`, which its steps take; three of them are records."""

import dataclasses
from typing import Literal, get_args

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._record import field, function_of, record, set_field, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Associate, Filter, Motion, Sensor
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    not_negative,
    one_of,
    or_none,
    positive,
    probability,
)
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

    capacity: int = static(default=32, check=at_least(1))
    """W; in a full table the oldest stored measurement is marginalized out"""
    spacing: Number = field(default=0.2, check=not_negative)
    """[m] least distance between the positions of stored measurements of one identity; a nearer
    measurement is `Status.DEFERRED`"""


@record
class Hypotheses:
    """Criteria by which intersections become hypotheses, and hypotheses are deleted.

    Raises:
        ValueError: on a count below 1, a spread or `same` not above 0, a negative decay, or an
            unknown distance.
    """

    capacity: int = static(default=16, check=at_least(1))
    """C; in a full table intersections are refused, and counted"""
    spread: Number = field(default=0.3, check=positive)
    """[1] largest standard deviation of an intersection relative to the sensor, over the distance,
    with which a hypothesis may begin; with a larger one it is not Gaussian"""
    distance: Distance = static(default="mahalanobis", check=one_of(*get_args(Distance)))
    """distance between intersection and hypothesis, Gaussians relative to the sensor: d² of
    "mahalanobis", or "bhattacharyya\""""
    same: Number | None = field(default=None, check=or_none(positive))
    """[1] distance from a hypothesis below which an intersection is that hypothesis; default
    the 99 % quantile of chi-square with two degrees of freedom for mahalanobis, 0.5 for
    bhattacharyya"""
    decay: Number = field(default=0.5, check=not_negative)
    """persistence lost by each measurement of its tag that does not confirm it. A hypothesis is
    deleted at 0: it survives persistence / decay outliers in a row"""
    patience: int = static(default=200, check=at_least(1))
    """scans without confirmation after which a hypothesis is deleted"""

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

    persistence: Number = field(default=4.0, check=positive)
    """least persistence: 1 of the intersection, and 1 of each confirmation"""
    lead: Number = field(default=2.0, check=not_negative)
    """least difference of its persistence to that of each hypothesis that excludes it"""
    spread: Number = field(default=0.3, check=positive)
    """[1] largest standard deviation of its position relative to the sensor, over its range"""
    per_scan: int = static(default=2, check=at_least(1))
    """largest number of promotions a scan"""


@record
class DelayedFilter(Filter):
    """The models and options of `DelayedSlam`, and what follows from them."""

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """a sensor of one bearing or one range of points"""
    capacity: int = static(check=at_least(1))
    """landmarks N"""
    _: dataclasses.KW_ONLY
    triangulation: Triangulation = field(default=None, check=or_none(instance_of(Triangulation)))
    """the intersection of stored measurements; default that of rays or of circles, by what the
    sensor measures"""
    stored: StoredMeasurements = field(
        default=StoredMeasurements(), check=instance_of(StoredMeasurements)
    )
    hypotheses: Hypotheses = field(default=Hypotheses(), check=instance_of(Hypotheses))
    promotion: Promotion = field(default=Promotion(), check=instance_of(Promotion))
    gate: Number | None = field(default=None, check=or_none(probability))
    """the probability that a correct comparison passes, by γ = χ²(1, gate); default 0.99"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """the landmark of each measurement. With `Known` only measurements of one tag intersect. With
    any different method, the measurements it declares new intersect all stored ones, and tags only
    name the landmarks"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        sensor = self.sensor
        got = f"{sensor.name} with {sensor.measurements}"
        if len(sensor.measurements) != 1 or not sensor.of_points:
            reason = "expected a sensor of one bearing or one range of points (x, y), got "
            raise InvalidField("sensor", f"{reason}{got} of {sensor.landmark}")
        triangulation = self.triangulation or triangulation_of(sensor)
        set_field(self, "triangulation", triangulation)
        if sensor.measurements != (triangulation.measurement,):
            reason = f"expected a sensor of one {triangulation.measurement}, got {got}"
            raise InvalidField("sensor", reason)
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
