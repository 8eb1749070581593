"""Worlds of exact walls for a laser: an office, a corridor, a square and a circular room."""

from collections.abc import Callable, Sequence

import numpy as np

from jaxslam.motion.unicycle import Unicycle
from jaxslam.simulation.laser import Laser, LaserWorld
from jaxslam.simulation.walls import Walls, walls

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
    made = walls(outline, *cabinets, glass={(0, east): glass} if glass else None)
    return _world("office", made, stops, beams, 8.0)


def corridor(beams: int = 180) -> LaserWorld:
    """A corridor, 40 m × 2 m, whose ends are beyond the laser's 8 m for most of the way.

    There no scan determines the position along it.
    """
    return _world("corridor", walls(_box(0, -1, 40, 1)), [(10.0, 0.2), (30.0, 0.2)], beams, 8.0)


def square(beams: int = 180) -> LaserWorld:
    """A square room of 6 m with the robot on a square path: four poses look the same."""
    stops = [(1.5, 1.5), (4.5, 1.5), (4.5, 4.5), (1.5, 4.5), (1.5, 1.5)]
    return _world("square", walls(_box(0, 0, 6, 6)), stops, beams, 10.0)


def circular_room(beams: int = 180) -> LaserWorld:
    """A round room of radius 3 m: no scan determines the rotation about its centre."""
    stops = [(-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0)]
    return _world("circular_room", walls(circles=[[0.0, 0.0, 3.0]]), stops, beams, 10.0)


ROOMS: dict[str, Callable[..., LaserWorld]] = {
    "circular_room": circular_room,
    "corridor": corridor,
    "office": office,
    "square": square,
}
"""By name; each takes the number of beams."""


def _box(left: float, low: float, right: float, high: float) -> list[tuple[float, float]]:
    return [(left, low), (right, low), (right, high), (left, high)]


def _world(
    name: str, of: Walls, stops: Sequence[tuple[float, float]], beams: int, max_range: float
) -> LaserWorld:
    turns = 2 * np.pi * np.arange(beams) / beams - np.pi
    pose, controls = _between(stops)
    return LaserWorld(
        name=name,
        walls=of,
        laser=Laser(turns, sigma=0.02, max_range=max_range, dropout=0.02),
        motion=Unicycle(np.diag([0.05, np.deg2rad(3.0)]) ** 2),
        controls=controls,
        pose=pose,
    )


def _between(stops: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
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
