"""The scenarios of the consistency family: parameters as published, worlds as described."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxslam import simulate
from jaxslam.simulation.scenarios import (
    cloister_noisy,
    explore,
    loop,
    loop_bearing,
    stationary,
)


def draw(world, seed=0):
    return simulate(world, jax.random.key(seed))


def test_loop_has_the_parameters_of_huang_et_al():
    world = loop()
    assert world.steps == 2500
    assert repr(world) == (
        "Scenario('loop', 2500 steps, 20 landmarks, unicycle, relative_position)"
    )
    np.testing.assert_array_equal(world.controls, np.tile([0.25, 0.025, 1.0], (2500, 1)))
    sigma = 0.05 * 0.25
    q = world.motion.noise_cov(np.zeros(3), world.controls[0])
    np.testing.assert_allclose(q, np.diag([sigma**2 / 2, 8 * sigma**2]))
    np.testing.assert_allclose(world.sensor.noise_cov(np.ones(2)), 0.01 * np.eye(2))
    np.testing.assert_array_equal(world.pose_cov, 1e-8 * np.eye(3))
    r = loop_bearing().sensor.noise_cov(np.array([3.0, 1.0]))
    np.testing.assert_allclose(r, np.diag([0.3**2, np.deg2rad(10) ** 2]))


@pytest.mark.parametrize("seed", range(5))
def test_loop_maps_lie_in_the_ring_and_differ(seed):
    landmarks, others = (loop(map_seed=k).landmarks for k in (seed, seed + 1))
    assert landmarks.shape == (20, 2)
    off = np.abs(np.linalg.norm(landmarks - [0.0, 10.0], axis=1) - 10.0)
    assert np.all((off >= 0.5) & (off <= 5.0))
    assert np.abs(landmarks - others).max() > 1


def test_loop_is_seen_between_its_ranges_and_no_scan_is_short_of_places():
    truth, log = draw(loop(steps=300, map_seed=3))
    assert truth.missed.sum() == 0
    seen = np.linalg.norm(log.scan.z, axis=2)[np.asarray(log.scan.valid)]
    assert np.all((seen > 0.5 - 0.5) & (seen < 5.0 + 0.5))
    # The true path is the nominal circle; the odometry is disturbed.
    np.testing.assert_allclose(
        np.linalg.norm(np.asarray(truth.pose)[:, :2] - [0, 10], axis=1), 10, atol=0.2
    )
    assert np.asarray(log.control)[:, 1].std() > 0.03


def test_the_true_start_is_drawn_from_what_the_filter_is_told():
    cov = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.16]])
    world = dataclasses.replace(stationary(steps=1), pose=(1.0, 2.0, 3.1), pose_cov=cov)
    starts = jax.jit(jax.vmap(lambda key: simulate(world, key)[0].start))(
        jax.random.split(jax.random.key(0), 4000)
    )
    off = np.asarray(starts) - [1.0, 2.0, 3.1]
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    assert np.all(np.abs(np.asarray(starts)[:, 2]) <= np.pi)
    white = np.linalg.solve(np.linalg.cholesky(cov), off.T)
    # Five standard errors of 4000 draws.
    np.testing.assert_allclose(white.mean(axis=1), 0, atol=5 / np.sqrt(4000))
    np.testing.assert_allclose(white @ white.T / 4000, np.eye(3), atol=5 * np.sqrt(2 / 4000))
    exact = draw(dataclasses.replace(world, pose_cov=np.zeros((3, 3))))[0].start
    np.testing.assert_allclose(exact, [1.0, 2.0, 3.1], atol=1e-15)


def test_a_stationary_robot_stands_still_and_an_explorer_never_returns():
    truth, log = draw(stationary(steps=20))
    np.testing.assert_allclose(truth.pose, np.tile(truth.start, (20, 1)), atol=1e-15)
    assert log.scan.valid.all()
    truth, log = draw(explore(steps=60))
    assert np.asarray(truth.pose)[-1, 0] > 40
    assert truth.missed.sum() == 0
    assert (np.asarray(log.scan.valid).sum(axis=1) > 0).all()
    first = np.asarray(log.scan.tag)[0]
    assert not np.isin(first[first >= 0], np.asarray(log.scan.tag)[-1]).any()


def test_the_noisy_cloister_has_places_enough():
    truth, _ = draw(cloister_noisy(steps=60))
    assert truth.missed.sum() == 0
