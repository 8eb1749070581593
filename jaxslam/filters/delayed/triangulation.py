"""Where two measurements that see a landmark in part meet: rays of bearings, circles of ranges.

A *sighting* is such a measurement as a variable of the map, s = (x, y, q) (3,): where the sensor
was, and what it saw, in the map's frame. A bearing gives the ray from (x, y) in the direction q
[rad], a range the circle of radius q [m] about it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.linalg import is_concrete
from jaxslam.protocols import Sensor

Array = jax.Array


@dataclass(frozen=True, eq=False)
class Meeting:
    """How the sightings of one kind of sensor locate a landmark, two of them at a time."""

    name: str
    count: int
    """A, in how many points two sightings can meet."""
    sight: Callable[[Array, Array], Array]
    """(pose, z) -> s (3,), the measurement as a variable of the map."""
    meet: Callable[[Array, Array], tuple[Array, Array]]
    """(s, s') -> points (A, 2) and whether each is one, (A,) bool: where it is not, or badly
    conditioned, the point is finite and without meaning."""
    miss: Callable[[Array, Array], Array]
    """(s, point (2,)) -> (): what was seen less what that point would have been seen as, zero for
    the true point of a perfect sensor."""
    twins: Callable[[Array, Array, Array], Array]
    """(s, s', point (2,)) -> (A - 1, 2): where else a landmark could be that two sightings see
    there."""


def rays(sensor: Sensor, *, parallax: float = 0.1) -> Meeting:
    """Bearings: p + t (cos q, sin q), t > 0. Two rays meet in at most one point.

    With δ = p' - p and c = sin(q' - q), the lengths are t = δ × d'/c and t' = δ × d/c. A meeting
    lies in front of both sensors, and the rays cross at an angle of at least `parallax`.

    Args:
        sensor: a bearing z (1,) of points, as `sensors.bearing_only`; where it is mounted is read
            from its `invert`, of which the prior of the range plays no part.
        parallax: [rad] in (0, π/2).
    Raises:
        ValueError: on another sensor, or a parallax out of range.
    """
    _check("rays", sensor, "bearing [rad]", parallax)
    least = float(np.sin(parallax)) if is_concrete(parallax) else jnp.sin(parallax)

    def sight(pose: Array, z: Array) -> Array:
        start = sensor.invert(pose, z, jnp.zeros(1, z.dtype))
        ahead = sensor.invert(pose, z, jnp.ones(1, z.dtype)) - start
        return jnp.concatenate([start, jnp.arctan2(ahead[1], ahead[0])[None]])

    def meet(a: Array, b: Array) -> tuple[Array, Array]:
        toward_a, toward_b = _unit(a[2]), _unit(b[2])
        delta = b[:2] - a[:2]
        sine = _cross(toward_a, toward_b)
        crossing = jnp.abs(sine) >= least
        safe = jnp.where(crossing, sine, 1.0)
        along_a, along_b = _cross(delta, toward_b) / safe, _cross(delta, toward_a) / safe
        point = a[:2] + along_a * toward_a
        return point[None], (crossing & (along_a > 0) & (along_b > 0))[None]

    def miss(s: Array, point: Array) -> Array:
        return wrap(s[2] - se2.polar(point - s[:2])[1])

    def twins(a: Array, b: Array, point: Array) -> Array:
        return jnp.zeros((0, 2), point.dtype)

    return Meeting("rays", 1, sight, meet, miss, twins)


def circles(sensor: Sensor, *, angle: float = 0.3) -> Meeting:
    """Ranges: |x - p| = q. Two circles meet in two points, mirrored in the line of their centres.

    With δ = p' - p, d = |δ|, a = (d² + q² - q'²)/(2d) and h² = q² - a², the points are
    p + (a δ ± h δ^⊥)/d. The circles must cross at an angle φ, sin φ = d h/(q q'), of at least
    `angle` from touching: where they touch, h is all noise.

    Args:
        sensor: a range z (1,) of points, as `sensors.range_only`.
        angle: [rad] in (0, π/2).
    Raises:
        ValueError: on another sensor, or an angle out of range.
    """
    _check("circles", sensor, "range [m]", angle)
    least = float(np.sin(angle)) if is_concrete(angle) else jnp.sin(angle)

    def sight(pose: Array, z: Array) -> Array:
        # The sensor is halfway between the ends of a diameter.
        ends = [sensor.invert(pose, z, jnp.full(1, s, z.dtype)) for s in (0.0, np.pi)]
        return jnp.concatenate([0.5 * (ends[0] + ends[1]), z])

    def meet(a: Array, b: Array) -> tuple[Array, Array]:
        delta = b[:2] - a[:2]
        square = (delta**2).sum()
        apart = (square > 0) & (a[2] > 0) & (b[2] > 0)
        safe = jnp.where(apart, square, 1.0)
        share = 0.5 * (safe + a[2] ** 2 - b[2] ** 2) / safe  # a/d
        rest = jnp.where(apart, a[2] ** 2 / safe - share**2, 0.0)  # h²/d²
        # sin φ = d h/(q q'), compared by squares so that nothing is rooted below zero
        size = jnp.where(apart, (a[2] * b[2]) ** 2, 1.0)
        crossing = apart & (rest > 0) & (safe**2 * rest >= least**2 * size)
        height = jnp.sqrt(jnp.where(crossing, rest, 1.0))
        across = jnp.stack([-delta[1], delta[0]])
        points = (a[:2] + share * delta)[None] + jnp.stack([height * across, -height * across])
        return points, jnp.stack([crossing, crossing])

    def miss(s: Array, point: Array) -> Array:
        return s[2] - se2.polar(point - s[:2])[0]

    def twins(a: Array, b: Array, point: Array) -> Array:
        axis = b[:2] - a[:2]
        square = (axis**2).sum()
        offset = point - a[:2]
        along = (offset @ axis) / jnp.where(square > 0, square, 1.0)
        mirrored = a[:2] + 2 * along * axis - offset
        return jnp.where(square > 0, mirrored, point)[None]

    return Meeting("circles", 2, sight, meet, miss, twins)


def meeting_of(sensor: Sensor) -> Meeting:
    """`rays` or `circles`, by what the sensor measures; ValueError where it is neither."""
    if sensor.measurements == ("range [m]",):
        return circles(sensor)
    return rays(sensor)


def _check(name: str, sensor: Sensor, measurement: str, angle: float) -> None:
    if sensor.measurements != (measurement,) or len(sensor.landmark) != 2:
        raise ValueError(
            f"{name}: expected a sensor of one {measurement} of points (x, y), got {sensor.name} "
            f"with {sensor.measurements} of {sensor.landmark}"
        )
    if is_concrete(angle) and not 0 < angle < np.pi / 2:
        raise ValueError(f"{name}: expected an angle in (0, π/2), got {angle}")


def _unit(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _cross(a: Array, b: Array) -> Array:
    return a[0] * b[1] - a[1] * b[0]
