"""Checks of the options of Kalman-type filters, and of how their parts fit together."""

import jax
import jax.numpy as jnp

from jaxslam.core.protocols import Chart, Linearizer, Sensor
from jaxslam.sensors._suite import Suite


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


def check_fit(
    filter: str, sensor: Sensor, chart: Chart, linearize: Linearizer, iterations: int = 1
) -> None:
    """Raise ValueError unless sensor, chart, linearizer and iterations fit one another."""
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
    check_iterations(filter, linearize, iterations)
    if sensor.reduced is not None and chart.basis is not None:
        ground = jnp.zeros(len(sensor.landmark))
        if chart.basis(jnp.zeros(3), ground).landmark is not None:
            raise ValueError(
                f"{filter}: the landmarks of {sensor.name} are converted to points, which the "
                f"chart {chart.name} does not support, since its errors of landmarks turn with the "
                "robot"
            )
