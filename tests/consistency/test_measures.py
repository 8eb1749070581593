"""The consistency measures beyond NEES and NIS: each against a definition or a known answer."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import pytest
import scipy.stats
import worlds
from cases import refused
from test_consistency import STEPS, plain_nees, scored, summary_of, synthetic

from jaxslam import charts, consistency, motion, sensors, simulate
from jaxslam.consistency import _bound, _measures, _run_scores, block_nees
from jaxslam.core.types import Estimate, Info, Log, Scan, Status, Trace, Truth
from jaxslam.filters import ParticleInfo, Pruned, _ekf, _particles
from jaxslam.filters.map_management import _merging
from jaxslam.simulation.spurious import Spurious

STATUSES = [status.name.lower() for status in (*_measures.counts.KEPT, *_measures.counts.DROPS)]


def test_coverage_is_the_share_of_truth_inside_the_ellipsoids():
    trace, truth, error = synthetic(np.random.default_rng(0), runs=40)
    summary = summary_of(trace, truth)
    nees = plain_nees(error, trace.estimate.pose_cov)
    for p, share in zip(_measures.coverage.LEVELS, summary.coverage["pose"], strict=True):
        np.testing.assert_allclose(share, np.mean(nees <= scipy.stats.chi2.ppf(p, 3)), rtol=1e-12)
    inside = np.mean(nees <= scipy.stats.chi2.ppf(0.95, 3), axis=1)
    interval = scipy.stats.t.interval(0.95**0.5, 39, inside.mean(), scipy.stats.sem(inside))
    average = summary.measures["coverage_95_pose"]
    np.testing.assert_allclose(average, (inside.mean(), *interval), rtol=1e-9)
    # Honest errors: 480 independent steps at 0.95, five standard errors.
    assert abs(average.value - 0.95) < 5 * np.sqrt(0.95 * 0.05 / nees.size)


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


def test_credibility_of_what_is_not_positive_definite_is_left_out():
    """eᵀ P⁻¹ e below zero has no logarithm, and no warning either."""
    rng = np.random.default_rng(3)
    errors, covs = rng.normal(size=(20, 2, 3)), np.broadcast_to(np.eye(3), (20, 2, 3, 3)).copy()
    covs[7, 0] *= -1
    errors[8, 0] = 0
    index, _ = consistency.credibility(errors, covs, np.ones((20, 2), bool))
    assert np.isfinite(index).all()


def test_pose_nees_judges_blocks_in_common_units():
    """Of x and y in metres, a variance that is rounding next to its neighbour's counts as none."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(6, 3, 3))
    cov = root @ root.transpose(0, 2, 1)
    cov[0] = np.diag([1.0, 1e-18, 0.1])
    cov[1, 2] = cov[1, :, 2] = 0.0
    cov[2] = np.diag([0.0, 0.0, 0.2])
    error, own = rng.normal(size=(2, 6, 3))
    own[3, 1], error[4, 2] = np.nan, np.inf
    found = block_nees(rng.normal(size=(6, 3)), error, own, cov)
    regular = {name: nees.regular.tolist() for name, nees in found.items()}
    assert regular == {
        "position": [False, True, False, True, True, True],
        "pose": [False, False, False, True, False, True],
        "own": [False, False, False, False, True, True],
        "heading": [True, False, True, True, False, True],
    }
    for name, e, block in (
        ("position", error, slice(2)),
        ("pose", error, slice(3)),
        ("own", own, slice(3)),
        ("heading", error, slice(2, 3)),
    ):
        value, there = found[name]
        e, p = e[there, block], cov[there, block, block]
        expected = np.einsum("ri,ri->r", e, np.linalg.solve(p, e[..., None])[..., 0])
        np.testing.assert_allclose(value[there], expected, rtol=1e-9)
        assert not value[~there].any()


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
    return Trace(estimate, info, None, None), truth


@pytest.mark.parametrize("rho", [0.0, 0.4])
def test_the_autocorrelation_of_innovations_is_found_lag_by_lag(rho):
    trace, truth = correlated(np.random.default_rng(3), rho)
    summary = summary_of(trace, truth)
    pairs = 30 * 199 * 3 * 2
    expected = rho ** np.arange(1, _run_scores.LAGS + 1)
    # Five standard errors of a product of two normals, and of an AR(1) sum where correlated.
    spread = 5 * np.sqrt((1 + rho**2) / (1 - rho**2) / pairs)
    np.testing.assert_allclose(summary.autocorrelation, expected, atol=spread)
    products = 30 * (200 - np.arange(1, _run_scores.LAGS + 1)) * 3 * 2
    np.testing.assert_allclose(
        summary.autocorrelation_band, 1.959964 / np.sqrt(products), rtol=1e-6
    )
    measure = summary.measures["autocorrelation"]
    assert (measure.low <= 0 <= measure.high) == (rho == 0)


def test_runs_shorter_than_a_lag_have_no_autocorrelation_there():
    trace, truth, _ = synthetic(np.random.default_rng(4), runs=3)
    short = jax.tree.map(lambda leaf: leaf[:, :4], (trace, truth._replace(start=truth.pose)))
    short_truth = short[1]._replace(start=truth.start, landmarks=truth.landmarks)
    summary = summary_of(short[0], short_truth)
    assert np.isnan(summary.autocorrelation[3:]).all()


def test_landmark_nees_and_own_coordinates():
    trace, truth, _ = synthetic(np.random.default_rng(5), runs=6)
    covs = np.random.default_rng(6).normal(size=(6, STEPS, 3, 2, 2))
    covs = covs @ covs.swapaxes(-1, -2) + 0.1 * np.eye(2)
    trace = trace._replace(estimate=trace.estimate._replace(point_covs=covs))
    summary = summary_of(trace, truth)
    kept = [0, 2]  # slots with tags 2 and 0
    off = truth.landmarks[:, None, [2, 0]] - trace.estimate.points[:, :, kept]
    nees = np.einsum(
        "rtni,rtni->rtn", off, np.linalg.solve(covs[:, :, kept], off[..., None])[..., 0]
    )
    np.testing.assert_allclose(summary.measures["nees_landmarks"].value, nees.mean(), rtol=1e-9)

    chart_errors = jax.jit(
        jax.vmap(
            partial(_measures.nees.chart_error_of, charts.RightInvariant(), worlds.ring().sensor)
        )
    )
    total, steps = scored(trace, truth, chart_errors).measures["nees_own"]
    per_run = total / steps
    local = jax.jit(jax.vmap(charts.RightInvariant().local, (0, None, 0, None)))
    for run in range(6):
        xi = local(trace.estimate.pose[run], np.zeros(2), truth.pose[run], np.zeros(2))[0]
        total = 0.0
        for t in range(STEPS):
            x, y, _ = trace.estimate.pose[run, t]
            lever = np.array([[1, 0, -y], [0, 1, x], [0, 0, 1.0]])
            p_own = np.linalg.inv(lever) @ trace.estimate.pose_cov[run, t] @ np.linalg.inv(lever).T
            total += xi[t] @ np.linalg.solve(p_own, xi[t])
        np.testing.assert_allclose(per_run[run], total / STEPS, rtol=1e-7)


def test_the_bounds_obey_tichavskys_recursion():
    """Against the information form, in NumPy, where it exists: Q and P0 regular, all in view.

    Of one world the posterior bound is the conditional one; over many it is less (Jensen).
    """
    q, r = np.diag([0.05, 0.04, 0.02]) ** 2, 0.1**2 * np.eye(2)
    base = worlds.ring(steps=15)
    world = dataclasses.replace(
        base,
        motion=motion.PoseIncrement(q),
        sensor=sensors.RelativePosition(r),
        controls=np.tile([0.3, 0.05, 0.2], (15, 1)),
        pose_cov=np.diag([0.1, 0.2, 0.05]) ** 2,
        filter_options={"gate": 0.99, "births": 1},
    )

    @jax.jit
    @jax.vmap
    def draw(key):
        truth, log = simulate(world, key)
        return truth, log, consistency.conditional_bound(world, truth, log, key).pose_cov

    worlds_drawn = draw(jax.random.split(jax.random.key(2), 4))
    truths, logs, bounds = jax.tree.map(np.asarray, worlds_drawn)
    steps, least = consistency.posterior_bound(world, truths, logs)
    assert (np.linalg.eigvalsh(bounds[:, steps].mean(axis=0) - least)[1:] > 0).all()
    alone = jax.tree.map(lambda leaf: leaf[:1], (truths, logs))
    steps, alone_bound = consistency.posterior_bound(world, *alone, steps=[0, 7, 14])
    np.testing.assert_allclose(alone_bound, bounds[0, steps], rtol=1e-7, atol=1e-12)
    truth, bound = jax.tree.map(lambda leaf: leaf[0], truths), bounds[0]
    jacobians = jax.jit(partial(_bound.jacobians_at_truth, world))
    linearized = jax.device_get(jacobians(truth, jax.tree.map(lambda leaf: leaf[0], logs)))
    last = _bound.final_covariance(linearized, world.pose_cov)
    np.testing.assert_allclose(last, bound[-1], rtol=1e-4, atol=1e-9)
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
        np.testing.assert_allclose(bound[t], np.linalg.inv(j)[:3, :3], rtol=1e-6, atol=1e-12)
        old = pose


def test_what_is_called_a_bound_bounds():
    """x ~ N(0, 1), z = x³ + v: the posterior mean beats the conditional bound by far."""
    sigma = 0.01
    x = np.random.default_rng(4).normal(size=200_000)
    slope, jacobian = np.ones((len(x), 1, 1)), 3 * x[:, None, None] ** 2
    noise, prior = np.array([[sigma**2]]), np.eye(1)
    conditional = np.sqrt(np.mean(1 / (1 + jacobian**2 / sigma**2)))
    proper = np.sqrt(_bound.van_trees(slope, jacobian, noise, prior)[0, 0])
    np.testing.assert_allclose(proper, 1 / np.sqrt(1 + 27 / sigma**2), rtol=0.02)
    # The posterior mean by quadrature, of fewer draws.
    grid = np.linspace(-5, 5, 20_001)
    draws = x[:400]
    z = draws**3 + sigma * np.random.default_rng(5).normal(size=400)
    log_density = -0.5 * grid**2 - 0.5 * ((z[:, None] - grid**3) / sigma) ** 2
    density = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    mean = (density @ grid) / density.sum(axis=1)
    rmse = np.sqrt(np.mean((mean - draws) ** 2))
    np.testing.assert_allclose([proper, rmse, conditional], [0.0019, 0.066, 0.236], rtol=0.15)


@refused(
    ({"spurious": Spurious()}, "one of a single robot"),
    ({}, "leading axis"),
    told="posterior_bound: .*",
)
def test_a_posterior_bound_of_what_it_cannot_take_is_refused(change):
    world = dataclasses.replace(worlds.ring(steps=2), **change)
    truth = Truth(np.zeros((2, 3)), np.zeros((6, 2)), np.zeros(2, int), np.zeros(3))
    log = Log(np.zeros((2, 2)), Scan(np.zeros((2, 6, 2)), np.zeros((2, 6), int), np.ones((2, 6))))
    consistency.posterior_bound(world, truth, log)


def test_runs_that_are_not_finite_are_named():
    trace, truth, _ = synthetic(np.random.default_rng(7), runs=10)
    trace.estimate.pose[5, 3, 0] = np.nan
    trace.info.nis[2, 1, 0] = np.inf
    summary = summary_of(trace, truth)
    assert summary.not_finite_runs == [2, 5]
    for name in ("nees_pose", "noncredibility", "inclination"):  # by the number of the run
        assert len(summary.per_run[name]) == 10
        assert np.flatnonzero(np.isnan(summary.per_run[name])).tolist() == [2, 5]


def test_what_filters_report_of_themselves_is_counted():
    """Two runs of three steps; a record without `counts`, and a count that is not known, too."""

    class Mine(NamedTuple):
        odd: np.ndarray

        def counts(self):
            return {"odd": self.odd}

    flags = np.array([[True, False, True], [False, False, False]])
    extra = {
        "pruning": Pruned(np.stack([flags, flags], axis=2)),
        "merging": _merging.Merged(np.where(flags[..., None], [4, 5], -1)),
        "points": _ekf.map_coordinates.ToPoints(flags[..., None]),
        "particles": ParticleInfo(*[3 * flags] * 4, active=flags),
        "mine": Mine(flags),
        "other": (flags,),
    }
    trace, _, _ = synthetic(np.random.default_rng(0), runs=2)
    info = jax.tree.map(lambda leaf: leaf[:, :3], trace.info)
    totals = _measures.counts.counts_of(info._replace(extra=extra, exhausted=flags))
    events = {name: happened.tolist() for name, happened in totals.items() if name not in STATUSES}
    thrice = {key: [6, 0] for key in ("resampled", "underflow", "invalid")}
    once = {key: [2, 0] for key in ("merged", "reduced", "exhausted")}
    assert events == {"removed": [4, 0], **once, **thrice, "odd": [2, 0]}
    assert list(events) == [*(name for name in _measures.counts.MEANINGS if name in events), "odd"]
    assert (totals["fused"] == 3).all() and (totals["born"] == 0).all()


def test_poses_on_a_plane_have_no_nees():
    """Three distinct particles among many: their covariance has rank 2, whatever its null direction."""
    rng = np.random.default_rng(3)
    poses = np.array([2.0, -1.0, 1.5]) + 3e-3 * rng.normal(size=(2000, 4, 3))
    share = np.log(rng.dirichlet(np.full(4, 2.0), 2000))
    moments = jax.jit(jax.vmap(_particles.pose_particles.weighted_pose_moments))
    for distinct, expected in ((3, 0.0), (4, 1.0)):
        weight = share[:, :distinct] - np.log(np.exp(share[:, :distinct]).sum(1, keepdims=True))
        best = weight.argmax(1)
        mean, cov = map(np.asarray, moments(poses[:, :distinct], weight, best))
        error = rng.normal(size=(2000, 3))
        regular = block_nees(mean, error, error, cov)["pose"].regular
        assert regular.mean() == pytest.approx(expected, abs=0.01)


@pytest.mark.decision
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_direction_is_unobservable_below_a_share_of_what_was_measured(dtype):
    """4e-11 is what sigma points leave on `circle`, 2e-5 what the EKF gains in 120 steps."""
    gained = np.array([0.0, 4e-11, 2e-5])
    scale = np.tile(np.array([1e5, 1e5, 4e7]), (3, 1))
    information = np.zeros((3, 3, 3))
    information[:, 2, 2] = gained * scale[:, 2]
    monitor = _ekf.monitor.Monitor(
        None, information.astype(dtype), scale.astype(dtype), np.ones((3, 3))
    )
    np.testing.assert_array_equal(
        _measures.observability.unobservable_directions(monitor), [3, 3, 2]
    )
