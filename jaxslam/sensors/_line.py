"""Distance and direction of a straight wall, a landmark that is a line and no point."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Sensor
from jaxslam.math import se2
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Point,
    Pose,
    Unmeasured,
)
from jaxslam.math.angles import wrap


@record
class Line(Sensor):
    """The sensor of straight walls: a line by the distance and the direction of its normal.

    z = (distance [m], direction [rad]) of l = (r [m], alpha [rad]), the line n·p = r with the
    normal n = (cos α, sin α). With S = pose ∘ mount = (t, θ) (Williams: features are points, lines
    and planes)

        z = (r - n·t, wrap(α - θ))        l = invert(S, z) = (z_1 + n·t, wrap(z_2 + θ))

    The sign: (r, α) and (-r, α + π) are the same set of points. Here a line has a side, as a wall
    has: n points into the wall, away from the side that it is seen from. So the two are the two
    faces of a thin wall and different landmarks, z has one value, a distance of the sensor's side
    is positive, and nothing is singular where r passes zero, in the map or as the robot passes the
    line. Whoever measures lines says on which side the robot is (`features.segments` does);
    `turn_to_positive_distance` gives z of either sign the positive distance.

    A line is no place: `carry` says how it changes with the frame (a turn by φ and a shift by t
    give α + φ and r + n·t), `position` is the point n r nearest to the map's origin, and `embed`
    is the line of which that is the point. The covariance of that point is singular where r = 0, so
    a map frame through which no wall passes shows more.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    measurements = ("distance [m]", "direction [rad]")
    landmark = ("r [m]", "alpha [rad]")
    equations = (
        "distance = l_r - x_s*cos(l_alpha) - y_s*sin(l_alpha) + n_distance\n"
        "direction = wrap(l_alpha - theta_s + n_direction)"
    )

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        frame = self.frame(pose)
        distance = landmark[0] - _distance_along(landmark[1], frame)
        return jnp.stack([distance, wrap(landmark[1] - frame[2])])

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return _line_from_frame(self.frame(pose), z)

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        c, s, across = _normal(landmark[1], frame)
        # By (x, y, θ): rows of distance and direction; 0 * c is a zero of the dtype of c.
        by_frame = jnp.stack([-c, -s, 0 * c, 0 * c, 0 * c, -jnp.ones_like(c)]).reshape(2, 3)
        by_line = jnp.eye(2, dtype=across.dtype).at[0, 1].set(-across)
        return by_frame @ self.frame_jacobian(pose), by_line

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        frame = self.frame(pose)
        c, sine, across = _normal(z[1] + frame[2], frame)
        by_frame = jnp.stack([c, sine, across, 0 * c, 0 * c, jnp.ones_like(c)]).reshape(2, 3)
        by_z = jnp.eye(2, dtype=across.dtype).at[0, 1].set(across)
        return by_frame @ self.frame_jacobian(pose), by_z, jnp.zeros((2, 0), pose.dtype)

    def position(self, landmark: Landmark) -> Point:
        return se2.rectangular(landmark)

    def embed(self, pose: Pose, point: Point) -> Landmark:
        return se2.polar(point)

    def carry(self, frame: Pose, landmark: Landmark) -> Landmark:
        return _line_from_frame(frame, landmark)


def _line_from_frame(frame: Pose, landmark: Landmark) -> Landmark:
    """A line (r, α) of a frame in the coordinates that its pose is in: (r + n·t, α + θ)."""
    alpha = landmark[1] + frame[2]
    return jnp.stack([landmark[0] + _distance_along(alpha, frame), wrap(alpha)])


def turn_to_positive_distance(z: Measurement) -> Measurement:
    """The one of (r, α) and (-r, α + π), the same set of points, with the distance r >= 0."""
    behind = z[0] < 0
    return jnp.stack([jnp.abs(z[0]), wrap(z[1] + jnp.where(behind, jnp.pi, 0.0))])


def _distance_along(alpha: Array, frame: Pose) -> Array:
    """The distance n·t along the normal n = (cos α, sin α)."""
    return jnp.cos(alpha) * frame[0] + jnp.sin(alpha) * frame[1]


def _normal(alpha: Array, frame: Pose) -> tuple[Array, Array, Array]:
    """The normal's cos α, sin α, and the derivative of n·t by α."""
    c, s = jnp.cos(alpha), jnp.sin(alpha)
    return c, s, c * frame[1] - s * frame[0]
