"""The settings of a Kalman-type SLAM filter, and their validation."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._numbers import check_count, check_gate, gate_quantile
from jaxslam.core.protocols import Associate, Chart, Life, Linearizer, Sensor
from jaxslam.linearize._first_order import AtEstimate
from jaxslam.math._arrays import Number
from jaxslam.sensors._suite import Suite

CorrectionOrder = Literal["sequential", "joint"]

Covariance = Literal["plain", "joseph", "square_root"]
"""P ← P - Vᵀ V; Joseph's (I-KH) P (I-KH)ᵀ + K R Kᵀ; or the update of a root X of P = X Xᵀ"""


@dataclass(frozen=True, eq=False)
class EkfSettings:
    """The models and options of a Kalman-type SLAM filter, the last argument of each step.

    A filter makes it of its fields within a trace; `dataclasses.replace` makes one for each sensor
    of a suite. The options are those of `EkfSlam`.
    """

    sensor: Sensor
    chart: Chart = field(default_factory=Euclidean)
    linearize: Linearizer = field(default_factory=AtEstimate)
    associate: Associate = field(default_factory=Known)
    correction: CorrectionOrder = "sequential"
    gate: Number | None = None
    iterations: int = 1
    covariance: Covariance = "plain"
    births: int | None = None
    """new landmarks a scan, at most; None for no limit, 0 for none at all"""
    life: Life | None = None
    """which landmarks make room for new ones"""
    absolute: bool = False
    """every valid measurement corrects the robot, for any tag"""
    reserved: PyTree = None
    """(N,) bool: slots that no new landmark may take; None for no such slots"""
    gamma: Number | None = field(init=False)
    """the largest d² within the gate for the sensor's measurements; None without a gate. It is
    computed here, once a trace, not for each measurement"""

    def __post_init__(self) -> None:
        gamma = gate_quantile(self.gate, len(self.sensor.measurements))
        object.__setattr__(self, "gamma", gamma)

    @property
    def square_root(self) -> bool:
        """Whether the state holds a root of the covariance."""
        return self.covariance == "square_root"


def check_ekf_options(
    filter: str,
    capacity: int,
    correction: str,
    gate: Number | None,
    iterations: int,
    births: int | None,
    covariance: str = "plain",
) -> None:
    """Raise ValueError, which names the filter, on invalid options."""
    for name, value in (("capacity", capacity), ("iterations", iterations), ("births", births)):
        if value is not None or name != "births":
            check_count(f"{filter}: {name}", value)
    if correction not in ("sequential", "joint"):
        raise ValueError(
            f'{filter}: expected correction "sequential" or "joint", got {correction!r}'
        )
    check_gate(filter, gate)
    check_covariance_form(filter, covariance, get_args(Covariance))


def check_covariance_form(filter: str, covariance: str, forms: tuple[str, ...]) -> None:
    """Raise ValueError unless the filter has this form of the covariance."""
    if covariance not in forms:
        expected = " or ".join(f'"{form}"' for form in forms)
        raise ValueError(f"{filter}: expected covariance {expected}, got {covariance!r}")


def check_iterations(filter: str, linearize: Linearizer, iterations: int) -> None:
    """Raise ValueError on several iterations with a linearizer that does not iterate."""
    if iterations > 1 and not linearize.iterates:
        raise ValueError(
            f"{filter}: expected iterations=1 with the linearizer {linearize.name}, which does not "
            f"iterate, got {iterations}"
        )


def _check_chart(filter: str, sensor: Sensor, chart: Chart) -> None:
    """Raise ValueError unless the chart acts on landmarks of the sensor's size."""
    pose, landmark = jnp.zeros(3), jnp.zeros(len(sensor.landmark))
    try:
        _, moved = jax.eval_shape(chart.retract, pose, landmark, pose, landmark)
        fits = moved.shape == landmark.shape and (chart.landmark_size != 2 or sensor.of_points)
    except (IndexError, TypeError, ValueError):
        fits = False
    if not fits and landmark.size == 0:
        raise ValueError(
            f"{filter}: the chart {chart.name} acts on landmarks, and the absolute sensor "
            f"{sensor.name} has none"
        )
    if not fits:
        raise ValueError(
            f"{filter}: the chart {chart.name} does not act on the {landmark.shape[0]}-parameter "
            f"landmarks of the sensor {sensor.name}: choose charts.Euclidean()"
        )


def check_settings(filter: str, settings: EkfSettings) -> None:
    """Raise ValueError unless sensor, chart, linearizer and covariance form are compatible."""
    sensor, chart, linearize = settings.sensor, settings.chart, settings.linearize
    _check_chart(filter, sensor, chart)
    if linearize.euclidean:
        unfit = [f"the Euclidean chart, not {chart.name}"] * (chart.basis is not None)
        unfit += [f"landmarks (x, y), not those of {sensor.name}"] * (not sensor.of_points)
        if isinstance(sensor, Suite) and any(part.absolute for part in sensor.parts):
            unfit += [f"a suite without absolute sensors, not {sensor.name}"]
        if unfit:
            raise ValueError(
                f"{filter}: the linearizer {linearize.name} needs {', and '.join(unfit)}: choose "
                "linearize.AtEstimate()"
            )
    check_iterations(filter, linearize, settings.iterations)
    if sensor.reduced is not None and chart.basis is not None:
        ground = jnp.zeros(len(sensor.landmark))
        if chart.basis(jnp.zeros(3), ground).landmark is not None:
            raise ValueError(
                f"{filter}: the landmarks of {sensor.name} are converted to points, which the "
                f"chart {chart.name} does not support, since its errors of landmarks turn with the "
                "robot"
            )
