"""Checks of the options of Kalman-type filters, and of how their parts fit together."""

import jax
import jax.numpy as jnp

from jaxslam.core.protocols import Chart, Linearizer, Sensor
from jaxslam.core.validation import InvalidField
from jaxslam.sensors._suite import Suite


def check_iterations(linearize: Linearizer, iterations: int) -> None:
    """Raise InvalidField on several iterations with a linearizer that does not iterate."""
    if iterations > 1 and not linearize.iterates:
        raise InvalidField(
            "iterations",
            f"expected 1 with the linearizer {linearize.name}, which does not iterate, got "
            f"{iterations}",
        )


def _check_chart(sensor: Sensor, chart: Chart) -> None:
    """Raise InvalidField unless the chart acts on landmarks of the sensor's size."""
    pose, landmark = jnp.zeros(3), jnp.zeros(len(sensor.landmark))
    try:
        _, moved = jax.eval_shape(chart.retract, pose, landmark, pose, landmark)
        fits = moved.shape == landmark.shape and (chart.landmark_size != 2 or sensor.of_points)
    except (IndexError, TypeError, ValueError):
        fits = False
    if not fits and landmark.size == 0:
        raise InvalidField(
            "chart",
            f"{chart.name} acts on landmarks, and the absolute sensor {sensor.name} has none",
        )
    if not fits:
        raise InvalidField(
            "chart",
            f"{chart.name} does not act on the {landmark.shape[0]}-parameter landmarks of the "
            f"sensor {sensor.name}: choose charts.Euclidean()",
        )


def check_fit(sensor: Sensor, chart: Chart, linearize: Linearizer, iterations: int = 1) -> None:
    """Raise InvalidField unless sensor, chart, linearizer and iterations fit one another."""
    _check_chart(sensor, chart)
    if linearize.euclidean:
        unfit = [f"the Euclidean chart, not {chart.name}"] * (chart.basis is not None)
        unfit += [f"landmarks (x, y), not those of {sensor.name}"] * (not sensor.of_points)
        if isinstance(sensor, Suite) and any(part.absolute for part in sensor.parts):
            unfit += [f"a suite without absolute sensors, not {sensor.name}"]
        if unfit:
            raise InvalidField(
                "linearize",
                f"{linearize.name} needs {', and '.join(unfit)}: choose linearize.AtEstimate()",
            )
    check_iterations(linearize, iterations)
    if sensor.reduced is not None and chart.basis is not None:
        ground = jnp.zeros(len(sensor.landmark))
        if chart.basis(jnp.zeros(3), ground).landmark is not None:
            raise InvalidField(
                "chart",
                f"{chart.name} does not support the landmarks of {sensor.name}, which are "
                "converted to points, since its errors of landmarks turn with the robot",
            )
