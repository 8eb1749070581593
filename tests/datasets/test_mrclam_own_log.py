"""A robot's systematic errors found in its own log: a log simulated with known ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from recordings import TEAM, write

from jaxslam import datasets
from jaxslam.datasets import RobotCalibration

KNOWN = RobotCalibration(
    0.0, 1.0, 0.05, 1.0, 0.0, 1.02, 0.0, 0.0, 0.0, 0.003, 0.01, 0.0, 0.01, 0.01
)
TRUE = KNOWN._replace(
    forward=1.04, outer=0.1, turn=0.94, curvature=-0.2, ahead=-0.05, yaw=0.03, axis=0.05
)
POINTS = np.array([[3.0, 1], [0, 4], [-3, 2], [-2, -3], [2, -3], [5, -1]])


def recorded(steps=900, dt=0.2, seed=0):
    """The files of a robot with the errors TRUE; of a landmark in view, each few steps."""
    rng = np.random.default_rng(seed)
    x, y, theta = 0.0, 0.0, 0.0
    odometry, seen = [], []
    for k in range(steps):
        t = 1000 + k * dt
        v = 0.15 + 0.1 * np.sin(0.1 * k * dt)
        omega = 0.5 * np.sin(0.23 * k * dt) + 0.15
        odometry.append(f"{t:.3f} {v:.9f} {omega:.9f}")
        moved = TRUE.forward * v - TRUE.outer * abs(omega)
        moved += rng.normal(0, TRUE.forward_noise / np.sqrt(dt))
        turned = (
            TRUE.turn * omega + TRUE.curvature * v + rng.normal(0, TRUE.turn_noise / np.sqrt(dt))
        )
        x, y = x + moved * dt * np.cos(theta), y + moved * dt * np.sin(theta)
        theta += turned * dt
        if k % 2 == 0:
            heading = theta + TRUE.yaw
            camera = x + TRUE.ahead * np.cos(theta), y + TRUE.ahead * np.sin(theta)
            gap = POINTS - camera
            bearing = np.angle(np.exp(1j * (np.arctan2(*gap.T[::-1]) - heading)))
            for i in np.flatnonzero(np.abs(bearing) < 0.7)[:2]:
                r = np.hypot(*gap[i]) * (1 + rng.normal(0, TRUE.range_share))
                told = r * TRUE.depth * np.cos(bearing[i] - TRUE.axis)
                phi = bearing[i] + rng.normal(0, TRUE.bearing_noise)
                seen.append(f"{t + dt:.3f} {50 + i} {told:.9f} {phi:.9f}")
    barcodes = "".join(f"{6 + i} {50 + i}\n" for i in range(len(POINTS)))
    survey = "".join(f"{6 + i} {a} {b} 0 0\n" for i, (a, b) in enumerate(POINTS))
    return {
        "Barcodes.dat": barcodes,
        "Landmark_Groundtruth.dat": survey,
        "Robot1_Odometry.dat": "\n".join(odometry) + "\n",
        "Robot1_Measurement.dat": "\n".join(seen) + "\n",
    }


def test_what_is_no_calibration_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a RobotCalibration, got"):
        datasets.mrclam(tmp_path, 1, calibration={1: KNOWN})
    for wrong, why in (
        ({"depth": 0.0}, "depth: expected a finite number above 0"),
        ({"bearing_noise": -1.0}, "bearing_noise: expected a finite number >= 0"),
        ({"axis": np.nan}, "axis: expected a finite number, got nan"),
        ({"turn": "fast"}, "turn: expected a finite number, got 'fast'"),
    ):
        with pytest.raises(ValueError, match=f"mrclam: calibration.{why}"):
            datasets.mrclam(tmp_path, 1, calibration=KNOWN._replace(**wrong))
    write(tmp_path, TEAM)
    for calibration, why in (({1: KNOWN}, "calibration: robot 2 has none"), (3, "got 3")):
        with pytest.raises(ValueError, match=why):
            datasets.mrclam_team(tmp_path, (1, 2), calibration=calibration)
    shared, each = (
        datasets.mrclam_team(tmp_path, (1, 2), calibration=calibration)
        for calibration in (KNOWN, {1: KNOWN, 2: KNOWN._replace(forward=2.0)})
    )
    np.testing.assert_array_equal(each.log.control, shared.log.control)
    u, pose = np.array([0.3, 0.2, 1.0]), np.zeros(3)
    ahead = [robot.motion.step(pose, u, np.zeros(2))[0] for robot in each.robots]
    np.testing.assert_allclose(ahead, np.array([1.0, 2.0]) * 0.3 - KNOWN.outer * 0.2, rtol=1e-6)


GROUPS = ("scale", "wheels", "mount", "axis")


@pytest.mark.sweep
def test_the_constants_of_a_simulated_robot_are_found(tmp_path):
    data = datasets.mrclam(write(tmp_path, recorded()), 1, calibration=KNOWN)
    own = datasets.fit(data, calibrate=GROUPS)
    assert own.noise_fit.converged and own.settled
    assert own.noise_fit.names == ("forward", "outer", "turn", "curvature", "ahead", "yaw", "axis")
    true = np.array([getattr(TRUE, name) for name in own.noise_fit.names])
    error = own.noise_fit.parameters - true
    assert (
        error @ np.linalg.solve(own.noise_fit.cov, error) < 20.0
    )  # 7 degrees of freedom: p = 0.006
    assert (np.abs(own.noise_fit.start - true) > 4 * own.noise_fit.error).all()  # something to find
    robot = KNOWN._replace(**own.by_name)
    assert [
        getattr(robot, name) for name in own.noise_fit.names
    ] == own.noise_fit.parameters.tolist()
    assert robot.depth == KNOWN.depth and robot.delay == KNOWN.delay
    np.testing.assert_array_equal(own.cov[1:5, 1:5], own.noise_fit.cov[:4, :4])
    assert (own.cov[5] == 0).all()  # of depth, which is held
    assert own.noise_fit.nis_per_dof[1] == pytest.approx(1.0, abs=0.15)
    # The reader with these constants gives the log and the models of the fit.
    again = datasets.mrclam(tmp_path, 1, calibration=robot)
    log, motion, sensor = data.adjustable.at(jnp.asarray(own.values))
    np.testing.assert_allclose(log.scan.z, again.log.scan.z, rtol=1e-12)
    np.testing.assert_allclose(log.control, again.log.control, rtol=1e-9, atol=1e-9)
    u = np.array([0.2, -0.3, 0.5])
    moved = motion.step(np.zeros(3), u, np.zeros(2)), again.motion.step(np.zeros(3), u, np.zeros(2))
    np.testing.assert_allclose(*moved, rtol=1e-6)
    np.testing.assert_allclose(sensor.mount, again.sensor.mount, rtol=1e-12)


def test_a_larger_world_has_the_same_log():
    """Twice the range of half the depth, seen by a camera twice as far off, and twice the travel."""
    twice = TRUE._replace(
        forward=2 * TRUE.forward, outer=2 * TRUE.outer, ahead=2 * TRUE.ahead, depth=TRUE.depth / 2
    )
    pose, point, u = np.array([0.0, 0.0, 0.3]), np.array([2.0, 1.0]), np.array([0.2, -0.3, 0.5])
    near, far = TRUE.sensor.observe(pose, point), twice.sensor.observe(pose, 2 * point)
    np.testing.assert_allclose(far, near * np.array([2.0, 1.0]), rtol=1e-6)
    recorded = [z[0] * robot.range_factor(z[1]) for z, robot in ((near, TRUE), (far, twice))]
    np.testing.assert_allclose(*recorded, rtol=1e-6)
    moved, farther = (robot.motion.step(pose, u, np.zeros(2)) for robot in (TRUE, twice))
    np.testing.assert_allclose(farther, moved * np.array([2.0, 2.0, 1.0]), rtol=1e-6)
