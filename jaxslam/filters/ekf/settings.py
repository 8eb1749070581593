"""What `ekf_slam` refuses."""

import jax
import jax.numpy as jnp

from jaxslam.math.linalg import check_count, check_gate
from jaxslam.protocols import Chart, Life, Linearizer, Sensor
from jaxslam.sensors.suite import Suite


def check_numbers(
    filter: str,
    capacity: int,
    update: str,
    gate: float | None,
    iterations: int,
    births: int | None,
) -> None:
    """Counts are counts, the update is one of two, the gate positive; errors name the filter."""
    for name, value in (("capacity", capacity), ("iterations", iterations), ("births", births)):
        if value is not None or name != "births":
            check_count(f"{filter}: {name}", value)
    if update not in ("sequential", "joint"):
        raise ValueError(f'{filter}: expected update "sequential" or "joint", got {update!r}')
    check_gate(filter, gate)


def check_chart(sensor: Sensor, chart: Chart) -> None:
    """The chart acts on landmarks of the sensor's size."""
    pose, landmark = jnp.zeros(3), jnp.zeros(len(sensor.landmark))
    try:
        _, moved = jax.eval_shape(chart.retract, pose, landmark, pose, landmark)
        fits = moved.shape == landmark.shape
    except (IndexError, TypeError, ValueError):
        fits = False
    if not fits and landmark.size == 0:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} acts on landmarks, and the absolute sensor "
            f"{sensor.name} has none"
        )
    if not fits:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} does not act on the {landmark.shape[0]}-parameter "
            f"landmarks of the sensor {sensor.name}"
        )


def check_parts(
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
    iterations: int,
    joseph: bool,
    square_root: bool,
) -> None:
    """Chart, linearizer and form of the covariance go together."""
    if linearize.euclidean and (chart.basis is not None or len(sensor.landmark) != 2):
        raise ValueError(
            f"ekf_slam: the linearizer {linearize.name} is for the Euclidean chart and landmarks "
            f"(x, y), not for the chart {chart.name} and the landmarks of {sensor.name}"
        )
    if linearize.euclidean and isinstance(sensor, Suite) and any(p.absolute for p in sensor.parts):
        raise ValueError(
            f"ekf_slam: the linearizer {linearize.name} is for landmarks alone, and the suite "
            f"{sensor.name} has an absolute sensor"
        )
    if linearize.name == "unscented" and iterations > 1:
        raise ValueError("ekf_slam: the linearizer unscented does not iterate")
    if sensor.reduced is not None and chart.basis is not None:
        ground = jnp.zeros(len(sensor.landmark))
        if chart.basis(jnp.zeros(3), ground).landmark is not None:
            raise ValueError(
                f"ekf_slam: the landmarks of {sensor.name} become points, for which those of the "
                f"chart {chart.name} must not turn with the robot"
            )
    if chart.motion_apart and square_root:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} keeps the last motion apart, which has no square "
            "root here"
        )
    if joseph and square_root:
        raise ValueError("ekf_slam: Joseph's form is of a covariance, not of its square root")


def check_make_room(make_room: Life | None) -> None:
    """What makes room in a full map is a `Life` that does so."""
    if make_room is not None and (not isinstance(make_room, Life) or make_room.make_room is None):
        raise ValueError(
            "ekf_slam: expected make_room to be a Life that makes room, as of "
            f"life.existence(…, replace=True), got {make_room!r}"
        )
