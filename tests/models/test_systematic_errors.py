"""Models with systematic errors of odometry and ranges, their noises, and the delay of a log."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import motion, sensors
from jaxslam.calibration import delayed
from jaxslam.core.types import Log
from jaxslam.motion import WhiteNoise
from jaxslam.sensors import RangeBearingNoise

Q, R = np.diag([0.04, 0.09]), np.diag([0.01, 0.0004])
NONE = np.zeros(2)


def robot(x, y, theta):
    """The homogeneous matrix of a pose."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def test_odometry_with_all_errors_moves_as_the_equations_say():
    """By matrices: turned into the direction of travel, moved by (u', ω'), turned back."""
    model = motion.Corrected(motion.Unicycle(Q), (1.1, 0.9), (0.05, -0.2), 0.3)
    v, omega, dt = 0.4, -0.5, 0.2
    after = model.step(np.array([1.0, 2.0, 0.7]), np.array([v, omega, dt]), NONE)
    travel, turn = 1.1 * v - 0.05 * abs(omega), 0.9 * omega - 0.2 * v
    whole = robot(1, 2, 0.7) @ robot(0, 0, 0.3) @ robot(travel * dt, 0, turn * dt)
    whole = whole @ robot(0, 0, -0.3)
    np.testing.assert_allclose(after[:2], whole[:2, 2], rtol=1e-6)
    np.testing.assert_allclose(after[2], np.arctan2(whole[1, 0], whole[0, 0]), rtol=1e-6)


@pytest.mark.parametrize(
    "model",
    [
        motion.Unicycle(Q),
        motion.Velocity(np.eye(3)),
        motion.Increment(Q),
        motion.PoseIncrement(np.eye(3)),
    ],
)
def test_odometry_without_errors_is_that_of_the_model(model):
    rng = np.random.default_rng(1)
    pose, u = rng.normal(size=3), np.abs(rng.normal(size=len(model.controls)))
    w = rng.normal(size=len(model.noises))
    plain = motion.Corrected(model)
    np.testing.assert_allclose(plain.step(pose, u, w), model.step(pose, u, w), atol=1e-6)
    assert plain.controls == model.controls and plain.name == model.name
    slope = jax.jacfwd(
        lambda heading: motion.Corrected(model, heading=heading).step(pose, 0 * u, w)
    )
    assert np.isfinite(slope(0.0)).all()  # without motion, where |ω| has a corner


def test_a_left_increment_has_the_scale_of_travel():
    model = motion.Corrected(motion.PoseIncrement(np.eye(3)), (2.0, 1.0), (0.1, 0.0))
    np.testing.assert_allclose(
        model.control(jnp.array([1.0, 0.5, -0.2])), [1.98, 1.0, -0.2], rtol=1e-6
    )


def test_a_recorded_depth_is_observed_and_inverted():
    plain = sensors.RangeBearing(R, mount=(0.2, 0.0, 0.1))
    model = sensors.Corrected(plain, (1.5, -0.1), 0.05)
    pose, point = np.array([0.3, -0.2, 0.4]), np.array([2.0, 1.5])
    r, bearing = plain.observe(pose, point)
    z = model.observe(pose, point)
    np.testing.assert_allclose(z, [1.5 * r * np.cos(bearing - 0.05) - 0.1, bearing], rtol=1e-6)
    np.testing.assert_allclose(model.invert(pose, z, jnp.zeros(0)), point, rtol=1e-5)
    straight = sensors.Corrected(plain, (1.5, -0.1)).observe(pose, point)
    np.testing.assert_allclose(straight, [1.5 * r - 0.1, bearing], rtol=1e-6)
    np.testing.assert_allclose(model.noise_cov(z), R, rtol=1e-6)


def test_models_that_cannot_be_corrected_are_refused():
    with pytest.raises(
        ValueError, match="Corrected: motion: expected a motion model with controls v and"
    ):
        motion.Corrected(motion.Odometry(np.eye(3)))
    with pytest.raises(
        ValueError, match="Corrected: sensor: expected a sensor of a range, got one of bea"
    ):
        sensors.Corrected(sensors.BearingOnly(np.eye(1)))
    with pytest.raises(
        ValueError, match="Corrected: sensor: expected a sensor of a range and a bearing"
    ):
        sensors.Corrected(sensors.RangeOnly(np.eye(1)), axis=0.0)


def test_white_noise_does_not_depend_on_how_time_is_cut():
    """The variance of Δt·w over an interval is that of its halves added; none, and finite, at 0."""
    noise_cov = WhiteNoise(0.2, 0.3, 0.5)
    added = np.diag([0.04, 0.09 + 0.25**2])

    def gained(dt):
        return dt**2 * noise_cov(jnp.zeros(3), jnp.array([1.0, -0.5, dt]))

    np.testing.assert_allclose(gained(1.0), added, rtol=1e-6)
    np.testing.assert_allclose(gained(0.3) + gained(0.7), added, rtol=1e-6)
    np.testing.assert_array_equal(noise_cov(jnp.zeros(3), jnp.zeros(3)), np.zeros((2, 2)))
    slope = jax.jacfwd(noise_cov, argnums=1)(jnp.zeros(3), jnp.zeros(3))
    assert np.isfinite(slope).all()


def test_the_noise_across_the_line_of_sight_falls_with_the_range():
    noise_cov = RangeBearingNoise(0.1, 0.02, share=0.05, across=0.3)
    expected = np.diag([0.1**2 + 0.2**2, 0.02**2 + 0.09 / 16.09])
    np.testing.assert_allclose(noise_cov(jnp.array([4.0, 1.0])), expected, rtol=1e-6)
    for across in (0.3, 0.0):
        at_sensor = RangeBearingNoise(0.1, 0.02, across=across)
        np.testing.assert_allclose(
            at_sensor(jnp.zeros(2)), np.diag([0.01, 0.0004 + (across > 0)]), rtol=1e-6
        )
        assert np.isfinite(jax.jacfwd(at_sensor)(jnp.zeros(2))).all()


def test_a_delay_moves_the_robot_to_where_it_was():
    """Against integrals of a velocity that is constant between rows, by dense sums."""
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.05, 0.15, 50)) + 1e9
    dt = np.diff(time, prepend=time[0])
    u = np.column_stack([rng.normal(size=(50, 2)), dt])
    u[0, :2] = 0
    log = Log(u, None)
    controls = motion.Unicycle.controls
    found = delayed(log, time, controls, 0.07).control
    since = time - time[0]
    fine = np.linspace(0.0, since[-1], 200_001)
    step = fine[1]
    rate = u[np.clip(np.searchsorted(since, fine[:-1] + step / 2), 0, 49), :2]
    travelled = np.concatenate([np.zeros((1, 2)), np.cumsum(rate * step, axis=0)])
    for column in range(2):
        at = np.interp(since - 0.07, fine, travelled[:, column])
        np.testing.assert_allclose(found[1:, column] * dt[1:], np.diff(at), atol=1e-4)
    np.testing.assert_allclose(delayed(log, time, controls, 0.0).control, u, atol=1e-4)
    slope = jax.jacfwd(lambda delay: delayed(log, time, controls, delay).control)(0.0)
    assert np.isfinite(slope).all()
    increments = ("forward [m]", "left [m]", "turn [rad]", "dt [s]")
    shifted = delayed(Log(np.column_stack([u[:, :2], 0 * dt, dt]), None), time, increments, 0.07)
    for column in range(2):
        at = np.interp(time - 0.07, time, np.cumsum(u[:, column]))
        np.testing.assert_allclose(shifted.control[1:, column], np.diff(at), atol=1e-5)
    with pytest.raises(ValueError, match="a delay needs odometry with an interval, dt"):
        delayed(log, time, motion.Increment.controls, 0.1)
