"""Rooms with exact walls: laser worlds, and worlds whose landmarks are the lines of the walls."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core._record import record
from jaxslam.core.validation import InvalidField, at_least, or_none, refusals_of, require
from jaxslam.math._arrays import Landmark, Number, Pose
from jaxslam.motion._unicycle import Unicycle
from jaxslam.sensors._line import Line
from jaxslam.simulation._wall_geometry import Walls, exact_ranges, wall_lines
from jaxslam.simulation._worlds import Scenario
from jaxslam.simulation.laser import Laser, LaserWorld
from jaxslam.simulation.walls import make_walls

_SPEED, TURN, _STEP = 0.5, np.deg2rad(45.0), 0.25
"""Speed [m/s], rate of turn [rad/s] and interval [s] of the robot in these worlds."""


def office(beams: int = 180, glass: float = 0.0) -> LaserWorld:
    """A corridor of 12 m with six rooms, doors of 1 m, two cabinets; the robot visits three rooms.

    Rooms that are nearly alike: a robot that may be anywhere has several hypotheses. Laser all
    around, σ = 2 cm, 8 m, 2 % dropouts.

    glass: the share of beams that pass the east end of the corridor, a wall of glass; there is
    nothing behind it.
    """
    lower = [(0.0, 3.6, 1.8), (3.8, 7.8, 5.0), (8.0, 12.0, 10.2)]
    upper = [(0.0, 4.6, 2.6), (4.8, 8.2, 7.2), (8.4, 12.0, 9.6)]
    outline: list[tuple[float, float]] = [(0.0, 3.2)]
    for left, right, door in lower:  # (x from, x to, middle of the door)
        outline += [(door - 0.5, 3.2), (door - 0.5, 3.0), (left, 3.0), (left, 0.0), (right, 0.0)]
        outline += [(right, 3.0), (door + 0.5, 3.0), (door + 0.5, 3.2)]
    east = len(outline)
    outline += [(12.0, 3.2), (12.0, 5.0)]
    for left, right, door in reversed(upper):
        outline += [(door + 0.5, 5.0), (door + 0.5, 5.2), (right, 5.2), (right, 8.0), (left, 8.0)]
        outline += [(left, 5.2), (door - 0.5, 5.2), (door - 0.5, 5.0)]
    outline += [(0.0, 5.0)]
    cabinets = [_box(6.6, 0.6, 7.4, 1.4), _box(0.6, 6.9, 1.5, 7.4)]
    stops = [(0.8, 4.1), (1.8, 4.1), (1.8, 1.5), (1.8, 4.1), (7.2, 4.1), (7.2, 6.6), (7.2, 4.1)]
    stops += [(10.2, 4.1), (10.2, 1.5), (10.2, 4.1), (0.8, 4.1)]
    walls = make_walls(outline, *cabinets, glass={(0, east): glass} if glass else None)
    return _world("office", walls, stops, beams, 8.0)


def corridor(beams: int = 180) -> LaserWorld:
    """A corridor, 40 m × 2 m, whose ends are beyond the laser's 8 m for most of the way.

    There no scan determines the position along it.
    """
    return _world(
        "corridor", make_walls(_box(0, -1, 40, 1)), [(10.0, 0.2), (30.0, 0.2)], beams, 8.0
    )


def square(beams: int = 180) -> LaserWorld:
    """A square room of 6 m with the robot on a square path: four poses look the same."""
    stops = [(1.5, 1.5), (4.5, 1.5), (4.5, 4.5), (1.5, 4.5), (1.5, 1.5)]
    return _world("square", make_walls(_box(0, 0, 6, 6)), stops, beams, 10.0)


def circular_room(beams: int = 180) -> LaserWorld:
    """A round room of radius 3 m: no scan determines the rotation about its centre."""
    stops = [(-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0)]
    return _world("circular_room", make_walls(circles=[[0.0, 0.0, 3.0]]), stops, beams, 10.0)


ROOMS: dict[str, Callable[..., LaserWorld]] = {
    "circular_room": circular_room,
    "corridor": corridor,
    "office": office,
    "square": square,
}
"""Rooms by name; each takes the number of beams."""


def _box(left: float, low: float, right: float, high: float) -> list[tuple[float, float]]:
    return [(left, low), (right, low), (right, high), (left, high)]


def _world(
    name: str, walls: Walls, stops: Sequence[tuple[float, float]], beams: int, max_range: float
) -> LaserWorld:
    turns = 2 * np.pi * np.arange(beams) / beams - np.pi
    pose, controls = _drive_to(stops)
    return LaserWorld(
        name=name,
        walls=walls,
        laser=Laser(turns, sigma=0.02, max_range=max_range, dropout=0.02),
        motion=Unicycle(np.diag([0.05, np.deg2rad(3.0)]) ** 2),
        controls=controls,
        pose=pose,
    )


def _drive_to(stops: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """The pose at the first stop, and controls (v, ω, Δt) that turn and drive to the others."""
    places = np.asarray(stops, float)
    legs = np.diff(places, axis=0)
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    pose, heading, rows = np.array([*places[0], headings[0]]), headings[0], []
    for leg, towards in zip(legs, headings, strict=True):
        turn = (towards - heading + np.pi) % (2 * np.pi) - np.pi
        heading = towards
        for size, speed, row in ((turn, TURN, 1), (np.hypot(*leg), _SPEED, 0)):
            count = int(np.ceil(abs(size) / (speed * _STEP) - 1e-9))
            control = np.zeros((count, 3))
            if count:
                control[:, row], control[:, 2] = size / (count * _STEP), _STEP
            rows.append(control)
    return pose, np.concatenate(rows)


BEAMS, _HITS, _SLANT = 120, 5, np.sin(np.deg2rad(10.0))
"""A wall is measured where at least `_HITS` of so many beams all around meet it within the laser's
range, at 10° or more to its surface."""

NOISE = np.diag([0.02, np.deg2rad(0.5)]) ** 2


def office_lines(steps: int | None = None) -> Scenario:
    """A robot maps the walls of `office` as lines: once along the corridor and into three rooms.

    σ = 0.02 m and 0.5° of a wall; the odometry has σ = 0.05 m/s and 3 °/s, the robot none. P0 = 0;
    joint correction. The map's frame is that of the start, so no line passes its origin. Parameters
    ours.

    Args:
        steps: of the drive, as many as it has; fewer are its beginning.
    """
    return _lines("office_lines", office(), steps, places=17)


def square_lines(steps: int | None = None) -> Scenario:
    """A robot on a square path maps the four walls of `square` as lines; see `office_lines`."""
    return _lines("square_lines", square(), steps, places=4)


def _lines(name: str, world: LaserWorld, steps: int | None, places: int) -> Scenario:
    controls = np.asarray(world.controls)
    with refusals_of(name):
        require("steps", steps, or_none(at_least(1)))
        if steps is not None and steps > len(controls):
            raise InvalidField("steps", f"expected at most {len(controls)}, got {steps}")
    controls = controls[:steps]
    walls = from_start(world)
    return Scenario(
        name=name,
        motion=world.motion,
        sensor=Line(NOISE),
        landmarks=wall_lines(walls)[0],
        controls=controls,
        noise_on="odometry",
        visible=_MetByBeams(walls, world.laser.max_range),
        places=places,
        filter_options={"correction": "joint"},
        source="parameters ours",
    )


def from_start(world: LaserWorld) -> Walls:
    """The walls of a room without circles, in the frame of the robot's start."""
    x, y, theta = np.asarray(world.pose, np.float64)
    c, s = np.cos(theta), np.sin(theta)
    segments = (np.asarray(world.walls.segments) - [x, y]) @ np.array([[c, -s], [s, c]])
    return Walls(segments, np.zeros((0, 3)))


@record
class _MetByBeams:
    """The field of view of a laser that needs some beams on a wall to measure it."""

    walls: Walls
    max_range: Number

    def __call__(self, pose: Pose, landmark: Landmark) -> jax.Array:
        angles = jnp.asarray(2 * np.pi * np.arange(BEAMS) / BEAMS, pose.dtype)
        ranges = exact_ranges(self.walls, pose, angles, self.max_range)
        heading = pose[2] + angles
        e = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
        normal = jnp.stack([jnp.cos(landmark[1]), jnp.sin(landmark[1])])
        off = (pose[None, :2] + ranges[:, None] * e) @ normal - landmark[0]
        met = (ranges < self.max_range) & (jnp.abs(off) < 1e-3) & (e @ normal > _SLANT)
        return jnp.asarray(met.sum() >= _HITS)
