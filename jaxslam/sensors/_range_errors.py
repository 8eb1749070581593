"""Systematic errors of a range: a scale, an offset, and a depth recorded in place of the range."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.protocols import Sensor
from jaxslam.core.validation import InvalidField, instance_of
from jaxslam.math._arrays import Landmark, Measurement, Robot, Unmeasured
from jaxslam.sensors._suite import Wrapped


@record
class Corrected(Wrapped):
    """The sensor whose recorded range has systematic errors.

    Of a landmark at range r and bearing φ it records

        scale r cos(φ - axis) + offset,    range = (scale, offset)

    where `axis` is the bearing of the optical axis of a camera that measures the depth along it;
    without an axis (None) the cosine is 1. The noise is that of the sensor at the recorded z.
    Raises ValueError on a sensor that measures no range first, or with an axis no bearing second.
    """

    sensor: Sensor = field(check=instance_of(Sensor))
    range: ArrayLike = (1.0, 0.0)
    """(scale, offset [m])"""
    axis: ArrayLike | None = None
    """[rad]"""

    def __post_init__(self) -> None:
        names = self.sensor.measurements
        if not can_correct(self.sensor) or (self.axis is not None and "bearing [rad]" not in names):
            entries = "a range" if self.axis is None else "a range and a bearing"
            reason = f"expected a sensor of {entries}, got one of {', '.join(names)}"
            raise InvalidField("sensor", reason)
        super().__post_init__()

    @property
    def equations(self) -> str:  # type: ignore[override]
        unchanged = [
            line for line in self.sensor.equations.splitlines() if not line.startswith("range = ")
        ]
        lines = [
            "scale, offset = range",
            "r = sqrt((l_x - x_s)**2 + (l_y - y_s)**2)",
            "range = scale*r + offset + n_range",
        ]
        if self.axis is not None:
            lines[2:] = [
                "phi = atan2(l_y - y_s, l_x - x_s) - theta_s",
                "range = scale*r*cos(phi - axis) + offset + n_range",
            ]
        return "\n".join(lines + unchanged) if self.sensor.equations else ""

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        z = self.sensor.observe(pose, landmark)
        scale, offset = self._line(z)
        return z.at[0].set(scale * z[0] + offset)

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
        scale, offset = self._line(z)
        return self.sensor.invert(pose, z.at[0].set((z[0] - offset) / scale), s)

    def _line(self, z: Measurement) -> tuple[Array, Array]:
        """The factor of the range, and the offset, at the bearing of z."""
        scale, offset = jnp.asarray(self.range, z.dtype)
        if self.axis is not None:
            scale = scale * jnp.cos(z[1] - jnp.asarray(self.axis, z.dtype))
        return scale, offset


def can_correct(sensor: Sensor) -> bool:
    """Whether a sensor measures a range first, which `Corrected` corrects."""
    return sensor.measurements[:1] == ("range [m]",)
