"""Rooms whose walls are the landmarks, lines by distance and direction: an office, a square."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.core.record import record
from jaxslam.math.arrays import Landmark, Number, Pose
from jaxslam.sensors.line import Line
from jaxslam.simulation.laser import LaserWorld
from jaxslam.simulation.scenarios.rooms import office, square
from jaxslam.simulation.walls import Walls, exact_ranges, wall_lines
from jaxslam.simulation.worlds import Scenario

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
    if steps is not None:
        check_count(f"{name}: steps", steps)
        if steps > len(controls):
            raise ValueError(f"{name}: expected at most {len(controls)} steps, got {steps}")
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
