"""Lines as landmarks, against points on them; and what is for points alone says so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam
from jaxslam import charts, filters, linearize, motion, sensors
from jaxslam.core.types import Scan
from jaxslam.filters.map_management.relocalization import seen_points
from jaxslam.sensors.line import facing

NOISE = np.diag([0.02, 0.02]) ** 2
MOVES = motion.Increment(1e-4 * np.eye(2))


def points_of(line, at):
    """Points of a line at distances `at` from its foot."""
    r, alpha = line
    normal = np.array([np.cos(alpha), np.sin(alpha)])
    return r * normal + np.asarray(at)[:, None] * np.array([-normal[1], normal[0]])


def carried(frame, points):
    c, s = np.cos(frame[2]), np.sin(frame[2])
    return points @ np.array([[c, s], [-s, c]]) + frame[:2]


@pytest.mark.parametrize("line", [(2.0, 0.4), (-1.5, 3.0), (0.0, -2.0)])
def test_a_measured_line_is_that_of_the_points_in_the_robots_frame(line):
    sensor, pose = sensors.Line(NOISE), np.array([0.7, -1.2, 2.8])
    z = np.asarray(sensor.observe(pose, np.array(line)))
    there = points_of(line, [-3.0, 0.0, 5.0])
    np.testing.assert_allclose(carried(pose, points_of(z, [-3, 0, 5])), there, atol=4.0)
    # Those points satisfy n·p = r of the measured line, in the robot's frame.
    c, s = np.cos(pose[2]), np.sin(pose[2])
    local = (there - pose[:2]) @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(local @ [np.cos(z[1]), np.sin(z[1])], z[0], atol=1e-12)
    np.testing.assert_allclose(sensor.position(np.array(line)), points_of(line, [0])[0], atol=1e-15)


def test_a_carried_line_goes_through_the_carried_points():
    sensor, line, frame = sensors.Line(NOISE), np.array([1.3, -2.9]), np.array([4.0, -2.0, 1.1])
    r, alpha = np.asarray(sensor.carried(frame, line))
    points = carried(frame, points_of(line, [-2.0, 0.0, 2.0]))
    np.testing.assert_allclose(points @ [np.cos(alpha), np.sin(alpha)], r, atol=1e-12)
    # The side is kept: the normal turns with the frame.
    assert abs(np.angle(np.exp(1j * (alpha - line[1] - frame[2])))) < 1e-12


def test_nothing_happens_where_the_robot_passes_the_line_or_the_map_the_origin():
    sensor, pose = sensors.Line(NOISE), jnp.zeros(3)
    near = np.array([[-1e-9, 0.5], [0.0, 0.5], [1e-9, 0.5]])
    z = np.asarray(jax.vmap(sensor.observe, (None, 0))(pose, near))
    np.testing.assert_allclose(z, near, atol=1e-15)
    # Across the seam of the angle.
    gap = sensor.residual(jnp.array([1.0, np.pi - 0.01]), jnp.array([1.0, -np.pi + 0.01]))
    np.testing.assert_allclose(gap, [0, -0.02], atol=1e-15)


def test_both_signs_are_one_set_of_points():
    z = np.array([-1.5, 3.0])
    same = np.asarray(facing(z))
    np.testing.assert_allclose(same, [1.5, 3.0 - np.pi], atol=1e-15)
    np.testing.assert_allclose(points_of(same, [0.0]), points_of(z, [0.0]), atol=1e-12)
    np.testing.assert_array_equal(facing(same), same)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: filters.EkfSlam(MOVES, s, 4, linearize=linearize.FirstEstimate()), "line"),
        (lambda s: filters.EkfSlam(MOVES, s, 4, chart=charts.RightInvariant()), "line"),
        (lambda s: filters.Seif(MOVES, s, 4, active=2, links=2), "line"),
        (lambda s: sensors.Suite(((s, 2), (s, 2))), r"share landmarks \(x, y\)"),
        (lambda s: filters.Merging(filters.EkfSlam(MOVES, s, 4), 0.5), "cannot be merged"),
        (
            lambda s: seen_points(s, Scan(jnp.zeros((1, 2)), jnp.zeros(1, int), jnp.ones(1, bool))),
            "expected a sensor that measures points",
        ),
    ],
)
def test_what_is_for_points_refuses_lines(make, message):
    with pytest.raises(ValueError, match=message):
        make(sensors.Line(NOISE))


def test_a_line_may_stand_beside_a_compass():
    both = sensors.Suite(((sensors.Line(NOISE), 2), (sensors.Compass([[1e-4]]), 1)))
    assert not both.of_points
    filters.EkfSlam(MOVES, both, 4)
    assert jaxslam.sensors.RangeBearing(NOISE).of_points
