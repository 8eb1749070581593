"""The share of a place's walls that the beams of a scan would pass through."""

import jax
import numpy as np
import pytest
from ring_of_rooms import ranges_of

from jaxslam.laser.laser_slam.odometry.reference import _seen_through
from jaxslam.laser.matching import Points
from jaxslam.math import numpy_poses as poses

CORNERS = np.array([(-2.0, -2.5), (4.0, -2.5), (4.0, 1.5), (1.0, 1.5), (1.0, 3.0), (-2.0, 3.0)])
WALLS = np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1)
BEAMS = 360


def seen(pose, walls=WALLS, beams=BEAMS):
    """The points of a scan, in its own frame."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ranges = ranges_of(np.asarray(pose, float), angles, walls)
    return Points(np.float32(ranges[:, None] * rays), np.float32(rays), np.ones(beams, bool))


@pytest.fixture(scope="module")
def through():
    program = jax.jit(_seen_through)

    def of(scan, pose, reference=None):
        whole = seen((0.0, 0.0, 0.0)) if reference is None else reference
        return float(program(whole, scan, np.asarray(pose, np.float32)))

    return of


@pytest.mark.parametrize("pose", [(0, 0, 0), (0.7, -0.4, 2.0), (-1.2, 1.5, -3.0), (3.0, 1.0, 0.4)])
def test_nothing_from_where_the_scan_was_taken(through, pose):
    assert through(seen(pose), pose) < 0.02


@pytest.mark.parametrize("shift", [(0.1, 0.0, 0.0), (-0.1, 0.1, 0.03)])
def test_little_beside_it(through, shift):
    pose = np.array([0.5, 0.2, 1.0])
    assert through(seen(pose), poses.compose(pose, np.array(shift))) < 0.05


@pytest.mark.parametrize("pose", [(4.8, 0.2, 0.0), (0.5, -3.3, 0.0), (-2.8, 0.2, 0.0)])
def test_much_from_behind_a_wall(through, pose):
    """The wall stands 0.8 m off, before what the scan met there."""
    assert through(seen((0.5, 0.2, 0.0)), pose) > 0.2


def test_more_the_farther_a_pose_is_shifted_through_a_wall(through):
    scan = seen((0.0, 0.0, 0.0))
    shares = [through(scan, (x, 0.0, 0.0)) for x in (0.0, 1.0, 2.5)]
    assert shares[0] < 0.02 < shares[1] < shares[2]


def test_walls_behind_those_of_the_scan_are_not_in_view(through):
    """A box that was not there before hides what stands behind it, and is passed by none."""
    box = np.array([(1.0, -0.5), (1.5, -0.5), (1.5, 0.5), (1.0, 0.5)])
    more = np.concatenate([WALLS, np.stack([box, np.roll(box, -1, axis=0)], axis=1)])
    assert through(seen((0.0, 0.0, 0.0), more), (0.0, 0.0, 0.0)) == 0.0
    # The other way round: what the reference has there, the scan passes through.
    share = through(seen((0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), seen((0.0, 0.0, 0.0), more))
    turn = 2 * np.arctan(0.5)  # as its front is seen
    assert share == pytest.approx(turn / (2 * np.pi), rel=0.2)


def test_beams_that_met_nothing_pass_through_nothing(through):
    scan = seen((0.0, 0.0, 0.0))
    none = scan._replace(valid=np.zeros(BEAMS, bool))
    assert through(none, (0.0, 0.0, 0.0)) == through(none, (6.0, 0.0, 0.0)) == 0.0
    # Points of the reference that are not valid count nothing.
    nothing = scan._replace(valid=np.zeros(BEAMS, bool))
    assert through(scan, (6.5, 0.0, 0.0), nothing) == 0.0
