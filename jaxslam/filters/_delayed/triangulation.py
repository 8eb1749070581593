"""Triangulation of a landmark from two measurements: intersections of rays or circles.

A *stored measurement* is a measurement as a variable of the state, s = (x, y, q) (3,): the
sensor's position and the measurement, in the map's frame. A bearing gives the ray from (x, y) in
the direction q [rad], a range the circle of radius q [m] about it.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import field, record
from jaxslam.core.protocols import Component, Sensor
from jaxslam.math import se2
from jaxslam.math._arrays import Number
from jaxslam.math.angles import wrap

Stored = Float[Array, "3"]
"""a stored measurement s = (x, y, q)"""
Point = Float[Array, "2"]
"""(x, y) [m]"""
_Solutions = tuple[Float[Array, "A 2"], Bool[Array, "A"]]
"""points, and the mask of those that exist"""


class Triangulation(Component):
    """The triangulation of one type of sensor, for pairs of stored measurements; a subclass is a
    record."""

    measurement: str
    """the measurement of the sensor, with its unit"""

    def __post_init__(self) -> None:
        methods = ("store", "intersect", "residual", "mirror_solutions")
        self._check(Triangulation, dict.fromkeys(methods, ""))

    def store(self, sensor: Sensor, pose: Float[Array, "3"], z: Float[Array, "1"]) -> Stored:
        """The measurement as a variable of the map."""
        raise NotImplementedError

    def intersect(self, a: Stored, b: Stored) -> _Solutions:
        """The A points in which two can intersect, and the mask of those that exist: without an
        intersection, or where it is badly conditioned, the point is finite and has no meaning."""
        raise NotImplementedError

    def residual(self, s: Stored, point: Point) -> Float[Array, ""]:
        """The measurement minus its prediction from a point, zero for the true point without noise
        [rad or m]."""
        raise NotImplementedError

    def mirror_solutions(self, a: Stored, b: Stored, point: Point) -> Float[Array, "B 2"]:
        """The A - 1 further points that two measurements of a landmark at a point allow."""
        raise NotImplementedError


def _acute(value: Number) -> Number:
    """The check of an angle in (0, π/2)."""
    if is_concrete(value) and not 0 < np.asarray(value) < np.pi / 2:
        raise ValueError(f"expected an angle in (0, π/2), got {value}")
    return value


@record
class Rays(Triangulation):
    """Triangulation of bearings: rays p + t (cos q, sin q), t > 0, intersect in at most one point.

    With δ = p' - p and c = sin(q' - q), the lengths are t = δ × d'/c and t' = δ × d/c. The
    intersection lies in front of both sensors, where the rays cross at an angle of at least
    `parallax`.

    The sensor's mounting is computed from its `invert`, for any prior of the range.

    Raises ValueError on a parallax out of range.
    """

    parallax: Number = field(default=0.1, check=_acute)
    """[rad] in (0, π/2)"""
    measurement = "bearing [rad]"

    def store(self, sensor: Sensor, pose: Float[Array, "3"], z: Float[Array, "1"]) -> Stored:
        # Two points of the ray: of the unmeasured numbers s = 0 and 1.
        start = sensor.invert(pose, z, jnp.zeros(1, z.dtype))[:2]
        ahead = sensor.invert(pose, z, jnp.ones(1, z.dtype))[:2] - start
        return jnp.concatenate([start, jnp.arctan2(ahead[1], ahead[0])[None]])

    def intersect(self, a: Stored, b: Stored) -> _Solutions:
        toward_a, toward_b = _unit(a[2]), _unit(b[2])
        delta = b[:2] - a[:2]
        sine = _cross(toward_a, toward_b)
        crossing = jnp.abs(sine) >= jnp.sin(self.parallax)
        safe = jnp.where(crossing, sine, 1.0)
        # 1 in place of a small sine: lengths and their derivatives stay finite where none cross.
        along_a, along_b = _cross(delta, toward_b) / safe, _cross(delta, toward_a) / safe
        point = a[:2] + along_a * toward_a
        return point[None], (crossing & (along_a > 0) & (along_b > 0))[None]

    def residual(self, s: Stored, point: Point) -> Float[Array, ""]:
        return wrap(s[2] - se2.polar(point - s[:2])[1])

    def mirror_solutions(self, a: Stored, b: Stored, point: Point) -> Float[Array, "B 2"]:
        return jnp.zeros((0, 2), point.dtype)


@record
class Circles(Triangulation):
    """Triangulation of ranges: circles |x - p| = q intersect in two mirrored points.

    With δ = p' - p, d = |δ|, a = (d² + q² - q'²)/(2d) and h² = q² - a², the points are
    p + (a δ ± h δ^⊥)/d. The circles must cross at an angle φ, sin φ = d h/(q q'), of at least
    `angle` from tangency, where h is undetermined.

    Raises ValueError on an angle out of range.
    """

    angle: Number = field(default=0.3, check=_acute)
    """[rad] in (0, π/2)"""
    measurement = "range [m]"

    def store(self, sensor: Sensor, pose: Float[Array, "3"], z: Float[Array, "1"]) -> Stored:
        # The sensor, wherever it is mounted, is halfway between the ends of a diameter.
        ends = [sensor.invert(pose, z, jnp.full(1, s, z.dtype))[:2] for s in (0.0, np.pi)]
        return jnp.concatenate([0.5 * (ends[0] + ends[1]), z])

    def intersect(self, a: Stored, b: Stored) -> _Solutions:
        delta = b[:2] - a[:2]
        square = (delta**2).sum()
        apart = (square > 0) & (a[2] > 0) & (b[2] > 0)
        safe = jnp.where(apart, square, 1.0)
        share = 0.5 * (safe + a[2] ** 2 - b[2] ** 2) / safe  # a/d
        height2 = jnp.where(apart, a[2] ** 2 / safe - share**2, 0.0)  # h²/d²
        # sin φ = d h/(q q'), compared by squares to avoid roots of negative numbers
        size = jnp.where(apart, (a[2] * b[2]) ** 2, 1.0)
        crossing = apart & (height2 > 0) & (safe**2 * height2 >= jnp.sin(self.angle) ** 2 * size)
        height = jnp.sqrt(jnp.where(crossing, height2, 1.0))
        across = jnp.stack([-delta[1], delta[0]])
        points = (a[:2] + share * delta)[None] + jnp.stack([height * across, -height * across])
        return points, jnp.stack([crossing, crossing])

    def residual(self, s: Stored, point: Point) -> Float[Array, ""]:
        return s[2] - se2.polar(point - s[:2])[0]

    def mirror_solutions(self, a: Stored, b: Stored, point: Point) -> Float[Array, "B 2"]:
        # The two intersections are mirrored about the line of the centres.
        axis = b[:2] - a[:2]
        square = (axis**2).sum()
        offset = point - a[:2]
        along = (offset @ axis) / jnp.where(square > 0, square, 1.0)
        mirrored = a[:2] + 2 * along * axis - offset
        return jnp.where(square > 0, mirrored, point)[None]


def triangulation_of(sensor: Sensor) -> Triangulation:
    """`Circles` for a sensor of ranges, else `Rays`."""
    return Circles() if sensor.measurements == (Circles.measurement,) else Rays()


def _unit(angle: Float[Array, ""]) -> Point:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _cross(a: Point, b: Point) -> Float[Array, ""]:
    return a[0] * b[1] - a[1] * b[0]
