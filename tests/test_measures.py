"""The consistency measures beyond NEES and NIS: each against a definition or a known answer."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
import worlds
from test_consistency import STEPS, plain_nees, summed, synthetic

from jaxslam import charts, consistency, motion, sensors
from jaxslam.simulate import simulate
from jaxslam.types import Estimate, Info, Status, Trace, Truth


def test_coverage_is_the_share_of_truth_inside_the_ellipsoids():
    trace, truth, error = synthetic(np.random.default_rng(0), runs=40)
    summary = consistency.summarize(summed(trace, truth))
    nees = plain_nees(error, trace.estimate.pose_cov)
    for p, share in zip(consistency.LEVELS, summary.coverage["pose"], strict=True):
        np.testing.assert_allclose(share, np.mean(nees <= scipy.stats.chi2.ppf(p, 3)), rtol=1e-12)
    inside = np.mean(nees <= scipy.stats.chi2.ppf(0.95, 3), axis=1)
    interval = scipy.stats.t.interval(0.95, 39, inside.mean(), scipy.stats.sem(inside))
    found = summary.measures["coverage_95_pose"]
    np.testing.assert_allclose(found, (inside.mean(), *interval), rtol=1e-9)
    # Honest errors: 480 independent steps at 0.95, five standard errors.
    assert abs(found.value - 0.95) < 5 * np.sqrt(0.95 * 0.05 / nees.size)


@pytest.mark.parametrize("claimed", [1.0, 0.1, 10.0])
def test_credibility_is_the_ratio_in_decibels(claimed):
    """A covariance c times the actual one has log10 ρ = -log10 c, but for what Σ is estimated to."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 3, 3))
    cov = root @ root.transpose(0, 2, 1) + np.eye(3)
    errors = np.einsum("kij,rkj->rki", np.linalg.cholesky(cov), rng.normal(size=(3000, 4, 3)))
    regular = np.ones((3000, 4), bool)
    index, inclination = consistency.credibility(
        errors, np.broadcast_to(claimed * cov, (3000, 4, 3, 3)), regular
    )
    np.testing.assert_allclose(inclination.mean(), -10 * np.log10(claimed), atol=0.15)
    expected = abs(10 * np.log10(claimed))
    assert abs(index.mean() - expected) < 0.3
    assert np.all(index >= np.abs(inclination) - 1e-12)


def test_credibility_leaves_out_what_it_must():
    rng = np.random.default_rng(2)
    errors, covs = rng.normal(size=(20, 3, 3)), np.broadcast_to(np.eye(3), (20, 3, 3, 3)).copy()
    regular = np.ones((20, 3), bool)
    regular[:, 0], regular[4] = False, False
    covs[:, 0] = 0
    covs[4] = np.nan
    index, inclination = consistency.credibility(errors, covs, regular)
    assert np.isnan(index[4])
    kept = np.arange(20) != 4
    assert np.isfinite(index[kept]).all()
    alone = consistency.credibility(errors[kept, 1:], covs[kept, 1:], regular[kept, 1:])
    np.testing.assert_allclose(inclination[kept], alone[1])
    assert consistency.credibility(errors[:6], covs[:6], regular[:6]) is None


def correlated(rng, rho, runs=30, steps=200, slots=3):
    """A trace whose whitened innovations are AR(1) sequences, one a landmark, places shuffled."""
    white = np.zeros((runs, steps, slots, 2))
    shocks = rng.normal(size=white.shape)
    white[:, 0] = shocks[:, 0]
    for t in range(1, steps):
        white[:, t] = rho * white[:, t - 1] + np.sqrt(1 - rho**2) * shocks[:, t]
    root = np.array([[0.5, 0.0], [0.2, 0.1]])
    slot = np.argsort(rng.random((runs, steps, slots)), axis=2)
    nu = np.take_along_axis(white, slot[..., None], axis=2) @ root.T
    status = np.full((runs, steps, slots), Status.FUSED)
    info = Info(
        nis=np.full((runs, steps, slots), 2.0),
        dof=np.full((runs, steps, slots), 2),
        innovation=nu,
        innovation_cov=np.broadcast_to(root @ root.T, (runs, steps, slots, 2, 2)),
        slot=slot,
        status=status,
        log_likelihood=np.zeros((runs, steps)),
    )
    eye3 = np.broadcast_to(np.eye(3), (runs, steps, 3, 3))
    estimate = Estimate(
        pose=np.zeros((runs, steps, 3)),
        pose_cov=eye3,
        points=np.zeros((runs, steps, slots, 2)),
        point_covs=np.broadcast_to(np.eye(2), (runs, steps, slots, 2, 2)),
        alive=np.ones((runs, steps, slots), bool),
        tag=np.broadcast_to(np.arange(slots), (runs, steps, slots)),
    )
    pose = 0.1 * np.ones((runs, steps, 3))
    truth = Truth(pose, np.ones((runs, slots, 2)), np.zeros((runs, steps), int), pose[:, 0])
    return Trace(estimate, info, (), ()), truth


@pytest.mark.parametrize("rho", [0.0, 0.4])
def test_the_autocorrelation_of_innovations_is_found_lag_by_lag(rho):
    trace, truth = correlated(np.random.default_rng(3), rho)
    summary = consistency.summarize(summed(trace, truth))
    pairs = 30 * 199 * 3 * 2
    expected = rho ** np.arange(1, consistency.LAGS + 1)
    # Five standard errors of a product of two normals, and of an AR(1) sum where correlated.
    spread = 5 * np.sqrt((1 + rho**2) / (1 - rho**2) / pairs)
    np.testing.assert_allclose(summary.autocorrelation, expected, atol=spread)
    products = 30 * (200 - np.arange(1, consistency.LAGS + 1)) * 3 * 2
    np.testing.assert_allclose(
        summary.autocorrelation_band, 1.959964 / np.sqrt(products), rtol=1e-6
    )
    measure = summary.measures["autocorrelation"]
    assert (measure.low <= 0 <= measure.high) == (rho == 0)


def test_runs_shorter_than_a_lag_have_no_autocorrelation_there():
    trace, truth, _ = synthetic(np.random.default_rng(4), runs=3)
    short = jax.tree.map(lambda leaf: leaf[:, :4], (trace, truth._replace(start=truth.pose)))
    short_truth = short[1]._replace(start=truth.start, landmarks=truth.landmarks)
    summary = consistency.summarize(summed(short[0], short_truth))
    assert np.isnan(summary.autocorrelation[3:]).all()


def test_landmark_nees_and_own_coordinates():
    trace, truth, _ = synthetic(np.random.default_rng(5), runs=6)
    covs = np.random.default_rng(6).normal(size=(6, STEPS, 3, 2, 2))
    covs = covs @ covs.swapaxes(-1, -2) + 0.1 * np.eye(2)
    trace = trace._replace(estimate=trace.estimate._replace(point_covs=covs))
    summary = consistency.summarize(summed(trace, truth))
    kept = [0, 2]  # slots with tags 2 and 0
    off = truth.landmarks[:, None, [2, 0]] - trace.estimate.points[:, :, kept]
    nees = np.einsum(
        "rtni,rtni->rtn", off, np.linalg.solve(covs[:, :, kept], off[..., None])[..., 0]
    )
    np.testing.assert_allclose(summary.measures["nees_landmarks"].value, nees.mean(), rtol=1e-9)

    @jax.jit
    def own(trace, truth):
        def one(trace, truth):
            sensor = worlds.ring().sensor
            error = consistency.own_error_of(charts.right_invariant(), sensor, trace, truth)
            return consistency.score(trace, truth, sensor, error)

        return jax.vmap(one)(trace, truth)

    total, steps = own(*jax.tree.map(jnp.asarray, (trace, truth))).measures["nees_own"]
    found = total / steps
    local = jax.jit(jax.vmap(charts.right_invariant().local, (0, None, 0, None)))
    for run in range(6):
        xi = local(trace.estimate.pose[run], np.zeros(2), truth.pose[run], np.zeros(2))[0]
        total = 0.0
        for t in range(STEPS):
            x, y, _ = trace.estimate.pose[run, t]
            lever = np.array([[1, 0, -y], [0, 1, x], [0, 0, 1.0]])
            p_own = np.linalg.inv(lever) @ trace.estimate.pose_cov[run, t] @ np.linalg.inv(lever).T
            total += xi[t] @ np.linalg.solve(p_own, xi[t])
        np.testing.assert_allclose(found[run], total / STEPS, rtol=1e-7)


def test_the_bound_obeys_tichavskys_recursion():
    """Against the information form, in NumPy, where it exists: Q and P0 regular, all in view."""
    q, r = np.diag([0.05, 0.04, 0.02]) ** 2, 0.1**2 * np.eye(2)
    base = worlds.ring(steps=15)
    world = dataclasses.replace(
        base,
        motion=motion.pose_increment(q),
        sensor=sensors.relative_position(r),
        controls=np.tile([0.3, 0.05, 0.2], (15, 1)),
        pose_cov=np.diag([0.1, 0.2, 0.05]) ** 2,
        filter_options={"gate": 9.0, "births": 1},
    )
    truth, log = jax.jit(partial(simulate, world))(jax.random.key(2))
    bound = jax.jit(
        lambda truth, log: consistency.posterior_bound(world, truth, log, jax.random.key(0))
    )(truth, log)
    n = 3 + 12
    j = np.zeros((n, n))  # the map is unknown beforehand: no information
    j[:3, :3] = np.linalg.inv(world.pose_cov)
    old = np.asarray(truth.start)
    by_pose_at = jax.jit(jax.jacfwd(world.motion.step, argnums=(0, 2)))
    by_state = jax.jit(jax.jacfwd(world.sensor.observe, argnums=(0, 1)))
    for t, pose in enumerate(np.asarray(truth.pose)):
        _, by_noise = by_pose_at(old, world.controls[t], np.zeros(3))
        lever = pose[:2] - old[:2]
        f = np.eye(3)
        f[:2, 2] = [-lever[1], lever[0]]
        q_inverse = np.linalg.inv(by_noise @ q @ by_noise.T)
        # The robot moves, the map stays: eliminate the old pose from (old, new, map).
        d11 = j[:3, :3] + f.T @ q_inverse @ f
        d12 = np.concatenate([-f.T @ q_inverse, j[:3, 3:]], axis=1)
        d22 = np.zeros((n, n))
        d22[:3, :3], d22[3:, 3:] = q_inverse, j[3:, 3:]
        j = d22 - d12.T @ np.linalg.solve(d11, d12)
        for i, landmark in enumerate(np.asarray(truth.landmarks)):
            by_pose, by_landmark = by_state(pose, landmark)
            h = np.zeros((2, n))
            h[:, :3], h[:, 3 + 2 * i : 5 + 2 * i] = by_pose, by_landmark
            j = j + h.T @ np.linalg.solve(r, h)
        np.testing.assert_allclose(
            bound.pose_cov[t], np.linalg.inv(j)[:3, :3], rtol=1e-6, atol=1e-12
        )
        old = pose


def test_runs_that_are_not_finite_are_named():
    trace, truth, _ = synthetic(np.random.default_rng(7), runs=8)
    trace.estimate.pose[5, 3, 0] = np.nan
    trace.info.nis[2, 1, 0] = np.inf
    summary = consistency.summarize(summed(trace, truth))
    assert summary.not_finite_runs == [2, 5]
    assert np.isnan(summary.per_run["nees_pose"][[2, 5]]).all()
    assert np.isfinite(summary.per_run["nees_pose"][[0, 1, 3, 4, 6, 7]]).all()
