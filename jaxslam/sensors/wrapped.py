"""The base class of sensors that change some methods of another."""

from jax import Array

from jaxslam.math.arrays import Landmark, Measurement, Point, Pose, Unmeasured
from jaxslam.protocols import Free, Sensor


class Wrapped(Sensor):
    """A sensor that holds another, with whose methods it answers unless it defines them."""

    sensor: Sensor

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.sensor.name

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.measurements

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.landmark

    @property
    def free(self) -> Free:  # type: ignore[override]
        return self.sensor.free

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return self.sensor.observe(pose, landmark)

    def residual(self, z: Measurement, z_hat: Measurement) -> Measurement:
        return self.sensor.residual(z, z_hat)

    def noise_cov(self, z: Measurement) -> Array:
        cov: Array = self.sensor.noise_cov(z)
        return cov

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return self.sensor.invert(pose, z, s)

    def position(self, landmark: Landmark) -> Point:
        return self.sensor.position(landmark)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return self.sensor.embed(pose, point)
