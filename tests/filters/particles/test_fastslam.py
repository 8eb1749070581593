"""FastSLAM: against plain NumPy, against the EKF where that is right, and at its limits."""

import dataclasses
from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept
from reference.plane import from_frame

from jaxslam import association, life, motion, resampling, run, sensors
from jaxslam.core.types import Scan, Status
from jaxslam.filters import FastSlam
from jaxslam.filters._particles import pose_particles, slam_particles
from jaxslam.math.stats import sigma_gate

KEY = jax.random.key(5)
MOUNT = np.array([0.1, -0.05, 0.3])  # of worlds.ring
R = np.diag([0.05, 0.02]) ** 2


STEPS, COUNT = 6, 2000
"""of the runs, which share a program for each proposal"""
RING = worlds.ring(100)
RING = dataclasses.replace(
    RING, controls=RING.controls[:STEPS], pose_cov=np.diag([0.05, 0.05, 0.02]) ** 2
)
STILL = dataclasses.replace(
    RING, motion=motion.Increment(np.zeros((2, 2))), pose_cov=np.zeros((3, 3))
)
"""with a robot that moves exactly as told"""


def of(world=RING, count=COUNT, capacity=6, **options):
    return FastSlam(world.motion, world.sensor, capacity, count, **options)


def drive(filter, log, world=RING, key=KEY):
    return run(filter, log, world.pose, world.pose_cov, key)


@cache
def driven(world="ring", proposal="measurement", **options):
    """Of one world, trace, truth and log."""
    world = {"ring": RING, "still": STILL}[world]
    truth, log = worlds.draw(world)
    filter = of(world, proposal=proposal, **options)
    return jax.device_get(drive(filter, log, world)), truth, log


@jax.jit
def updated(filter, state, scan):
    """One update, by a program that filters of one structure share."""
    return filter.update(state, scan, KEY)


PROPOSALS = pytest.mark.parametrize("proposal", swept(["motion", "measurement"], "measurement"))


# --- against plain NumPy ------------------------------------------------------------------------


def mapped_by_hand(poses, log):
    """Per-landmark EKFs from a known path, range and bearing: {tag: (mean, cov)}, log-likelihood."""
    maps, log_likelihood = {}, 0.0
    for pose, z, tags, valid in zip(poses, *map(np.asarray, log.scan), strict=True):
        eye = from_frame(pose, MOUNT[:2])
        heading = pose[2] + MOUNT[2]
        for (r, b), tag, there in zip(z, tags, valid, strict=True):
            if not there:
                continue
            a = heading + b
            if tag not in maps:
                g = np.array([[np.cos(a), -r * np.sin(a)], [np.sin(a), r * np.cos(a)]])
                maps[tag] = eye + r * np.array([np.cos(a), np.sin(a)]), g @ R @ g.T
                continue
            mean, cov = maps[tag]
            dx, dy = mean - eye
            d2 = dx**2 + dy**2
            h = np.array([[dx / d2**0.5, dy / d2**0.5], [-dy / d2, dx / d2]])
            nu = np.array([r - d2**0.5, b - (np.arctan2(dy, dx) - heading)])
            nu[1] = (nu[1] + np.pi) % (2 * np.pi) - np.pi
            total = h @ cov @ h.T + R
            gain = cov @ h.T @ np.linalg.inv(total)
            maps[tag] = mean + gain @ nu, cov - gain @ total @ gain.T
            log_likelihood -= 0.5 * (
                nu @ np.linalg.solve(total, nu) + np.log(np.linalg.det(2 * np.pi * total))
            )
    return maps, log_likelihood


@PROPOSALS
def test_particles_without_process_noise_map_from_the_known_path(proposal):
    """All are as one."""
    trace, truth, log = driven("still", proposal)
    np.testing.assert_allclose(trace.estimate.pose, truth.pose, atol=1e-12)
    maps, log_likelihood = mapped_by_hand(np.asarray(truth.pose), log)
    assert len(maps) == 6
    for slot, tag in enumerate(trace.final.tag[0]):
        for each in (trace.final.landmarks[0, slot], trace.estimate.points[-1, slot]):
            np.testing.assert_allclose(each, maps[tag][0], atol=1e-9)
        np.testing.assert_allclose(trace.final.covs[0, slot], maps[tag][1], atol=1e-9)
    np.testing.assert_allclose(trace.info.log_likelihood.sum(), log_likelihood, atol=1e-8)
    np.testing.assert_allclose(trace.estimate.pose_cov, 0, atol=1e-24)
    assert not np.any(trace.info.extra["particles"].resampled)


def weighted(**fields):
    """A state in which no particle has lost anything."""
    count = len(fields["pose"])
    zero = np.zeros(count, np.int32)
    return slam_particles.SlamParticles(**fields, lost=zero, invalid=zero.astype(bool))


def random_particles(rng, count=7, capacity=3):
    """A state of random numbers."""
    log_weight = np.log(rng.dirichlet(np.ones(count)))
    roots = rng.normal(size=(count, capacity, 2, 2))
    pose = rng.normal(size=(count, 3)) * 0.2 + [0, 0, np.pi]  # across the seam
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return weighted(
        pose=pose,
        pose_cov=np.zeros((count, 3, 3)),
        log_weight=log_weight,
        landmarks=rng.normal(size=(count, capacity, 2)),
        covs=roots @ roots.transpose(0, 1, 3, 2),
        alive=np.ones((count, capacity), bool),
        tag=np.tile(np.arange(capacity, dtype=np.int32), (count, 1)),
        best=np.int32(np.argmax(log_weight)),
    )


def test_moments_of_the_pose_against_plain_arithmetic():
    state = random_particles(np.random.default_rng(0))
    w = np.exp(state.log_weight)
    assert np.ptp(state.pose[:, 2]) > 6  # a plain mean of headings would be far off
    mean, cov = jax.jit(slam_particles.slam_pose_moments)(state)
    circle = np.angle((w * np.exp(1j * state.pose[:, 2])).sum())
    theta = circle + w @ np.angle(np.exp(1j * (state.pose[:, 2] - circle)))
    np.testing.assert_allclose(mean, [*(w @ state.pose[:, :2]), theta], atol=1e-12)
    d = state.pose - np.asarray(mean)
    d[:, 2] = np.angle(np.exp(1j * d[:, 2]))
    share = (w**2).sum()
    wanted = (1 + share) / (1 - share) * np.einsum("p,pi,pj->ij", w, d, d)
    np.testing.assert_allclose(cov, wanted, rtol=1e-10)


def test_the_covariance_is_the_mean_square_of_truth_minus_mean():
    """Monte-Carlo over samples of 6 from one Gaussian, the truth being a seventh draw."""
    rng = np.random.default_rng(1)
    root = np.diag([0.3, 0.1, 0.05])
    draws = rng.normal(size=(20000, 7, 3)) @ root
    start = random_particles(rng, 6)._replace(log_weight=np.full(6, -np.log(6)))
    one = jax.jit(
        jax.vmap(lambda poses: slam_particles.slam_pose_moments(start._replace(pose=poses)))
    )
    mean, cov = one(jnp.asarray(draws[:, :6]))
    error = draws[:, 6] - np.asarray(mean)
    np.testing.assert_allclose(np.asarray(cov).mean(0).diagonal(), error.var(0), rtol=0.04)
    # and its NEES is that of a small sample, 3 (n-1)/(n-5) = 15, as the docstring has it
    nees = np.einsum("ri,rij,rj->r", error, np.linalg.inv(cov), error)
    assert 3 < np.median(nees) < 8


def test_the_map_is_a_mixture_by_slot_where_tags_agree():
    rng = np.random.default_rng(2)
    state = random_particles(rng)
    best = int(state.best)
    other = [p for p in range(7) if p != best]
    state.tag[other[0], 0] = 9  # another landmark in that slot
    state.alive[other[1], 0], state.tag[other[1], 0] = False, -1
    state.tag[:, 1] = -1  # unknown: the most likely particle's own
    state.alive[best, 2], state.tag[best, 2] = False, -1
    out = jax.jit(partial(slam_particles.slam_estimate, sensor=RING.sensor))(state)
    keep = np.array([p not in other[:2] for p in range(7)])
    w = np.exp(state.log_weight) * keep
    w = w / w.sum()
    mean = w @ state.landmarks[:, 0]
    d = state.landmarks[:, 0] - mean
    cov = np.einsum("p,pij->ij", w, state.covs[:, 0]) + np.einsum("p,pi,pj->ij", w, d, d)
    np.testing.assert_allclose(out.points[0], mean, rtol=1e-12)
    np.testing.assert_allclose(out.point_covs[0], cov, rtol=1e-12)
    np.testing.assert_allclose(out.points[1], state.landmarks[best, 1], rtol=1e-12)
    np.testing.assert_allclose(out.point_covs[1], state.covs[best, 1], rtol=1e-12)
    np.testing.assert_array_equal(out.alive, [True, True, False])
    np.testing.assert_array_equal(out.points[2], [0, 0])


def test_headings_that_cancel_have_no_mean_and_no_nan():
    state = random_particles(np.random.default_rng(0), 2)._replace(log_weight=np.log([0.5, 0.5]))
    state.pose[:, 2] = [0.0, np.pi]
    mean, slope = jax.jit(
        jax.value_and_grad(
            lambda pose: slam_particles.slam_pose_moments(state._replace(pose=pose))[0].sum()
        )
    )(state.pose)
    chex.assert_tree_all_finite((mean, slope))


@pytest.mark.parametrize("count", [2, 4, 12])
def test_headings_that_cancel_are_those_of_the_likeliest_whatever_the_rounding(count):
    """Evenly spread headings, some ulp off: the mean is about that of the first particle."""
    rng = np.random.default_rng(count)
    turn = 2 * np.pi * np.arange(count) / count
    moments = jax.jit(pose_particles.weighted_pose_moments, static_argnums=2)
    for _ in range(20):
        first = rng.uniform(-3, 3)
        heading = np.angle(np.exp(1j * (first + turn))) * (1 + 4e-16 * rng.normal(size=count))
        pose = np.stack([np.zeros(count), np.zeros(count), heading], axis=1)
        mean = moments(pose, np.full(count, -np.log(count)), 0)[0]
        # Half a turn from the first may count as either side.
        off = np.angle(np.exp(1j * (heading - heading[0])))
        wanted = {np.round(s * np.pi / count, 6) for s in (-1, 1)}
        assert abs(np.abs(off).max() - np.pi) < 1e-9
        assert np.round(np.angle(np.exp(1j * (mean[2] - heading[0]))), 6) in wanted


# --- against the EKF, on worlds where linearization does no harm ---------------------------------


@PROPOSALS
def test_many_particles_are_the_posterior_of_the_ekf(proposal):
    """Mean within 5 standard errors, covariance within a quarter, and the evidence of the log."""
    ours, _, log = driven(proposal=proposal)
    theirs = jax.device_get(drive(worlds.ekf(RING), log))
    mean, cov = theirs.estimate.pose[-1], theirs.estimate.pose_cov[-1]
    error = ours.estimate.pose[-1] - mean
    assert np.all(np.abs(error) < 5 * np.sqrt(cov.diagonal() / 500))  # ESS may be a quarter of P
    np.testing.assert_allclose(ours.estimate.pose_cov[-1].diagonal(), cov.diagonal(), rtol=0.25)
    points = ours.estimate.points[-1] - theirs.estimate.points[-1]
    variance = np.einsum("nii->ni", theirs.estimate.point_covs[-1])
    assert np.all(np.abs(points) < 0.2 * np.sqrt(variance))
    of_points = np.einsum("nii->ni", ours.estimate.point_covs[-1])
    np.testing.assert_allclose(of_points, variance, rtol=0.25)
    np.testing.assert_allclose(
        ours.info.log_likelihood.sum(), theirs.info.log_likelihood.sum(), atol=0.3
    )
    assert np.all(ours.final.pose_cov == 0)
    np.testing.assert_allclose(np.exp(ours.final.log_weight).sum(), 1.0, rtol=1e-12)


def test_the_start_is_reported_before_anything_is_drawn():
    cov = np.diag([0.1, 0.2, 0.3])
    filter = of(count=5)
    out = jax.jit(lambda *start: filter.estimate(filter.init(*start)))(np.array([1.0, 2, 3]), cov)
    np.testing.assert_allclose(out.pose, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(out.pose_cov, cov, atol=1e-12)
    assert not np.any(out.alive)


# --- association of each particle ----------------------------------------------------------------


@pytest.mark.sweep
def test_unknown_identities_of_landmarks_far_apart_give_the_same_filter():
    known, _, log = driven()
    unknown = jax.device_get(
        drive(of(associate=association.JointCompatibility(0.9999)), worlds.nameless(log))
    )
    assert np.all(unknown.estimate.alive.sum(axis=1)[-1] == 6)
    np.testing.assert_allclose(unknown.estimate.pose, known.estimate.pose, atol=1e-9)
    np.testing.assert_allclose(unknown.final.landmarks, known.final.landmarks, atol=1e-9)
    np.testing.assert_array_equal(unknown.info.status, known.info.status)
    assert np.all(unknown.final.tag == -1)


# --- what a scan may do -------------------------------------------------------------------------


def scan_of(rows, places=4):
    """A scan of (tag, range, bearing) rows, padded."""
    z, tag = np.zeros((places, 2)), np.full(places, -1, np.int32)
    for i, (name, *value) in enumerate(rows):
        z[i], tag[i] = value, name
    return Scan(z, tag, np.arange(places) < len(rows))


def known_map(tags):
    """A state of one particle a row of tags (N,), -1 for a free slot, tag k at (k + 1, 0)."""
    tags = np.asarray(tags, np.int32)
    count, capacity = tags.shape
    alive = tags >= 0
    return weighted(
        pose=np.tile([0.0, 0.0, 0.1], (count, 1)),
        pose_cov=np.tile(np.diag([0.01, 0.01, 0.01]), (count, 1, 1)),
        log_weight=np.full(count, -np.log(count)),
        landmarks=np.where(alive[:, :, None], np.stack([tags + 1.0, 0.0 * tags], axis=2), 0.0),
        covs=np.where(alive[:, :, None, None], 0.01 * np.eye(2), np.eye(2)),
        alive=alive,
        tag=tags,
        best=np.int32(0),
    )


def test_particles_of_different_maps_with_full_tables_lose_what_they_must_and_count_it():
    maps = [[0, 1, 2, 3], [0, 2, 3, -1], [5, 6, 8, 9], [5, 6, 8, 9]]
    scan = scan_of([(1, 2.0, -0.4), (7, 3.0, 0.5)])
    state, info = updated(of(count=4, capacity=4, threshold=1e-9), known_map(maps), scan)
    np.testing.assert_array_equal(state.lost, [1, 1, 2, 2])
    np.testing.assert_array_equal(state.tag, [maps[0], [0, 2, 3, 1], *maps[2:]])
    assert np.all(state.alive)
    assert np.isfinite(state.log_weight).all()
    assert not info.extra["particles"].resampled
    wanted = [[Status.FUSED, Status.OVERFLOW], [Status.BORN, Status.OVERFLOW]]
    wanted += [[Status.OVERFLOW] * 2] * 2
    np.testing.assert_array_equal(info.status[:2], wanted[int(state.best)])
    assert info.overflow


def test_where_all_weights_underflow_the_filter_goes_on_and_counts():
    """A measurement so far off that no particle gives it a density above zero."""
    filter, start = of(count=4, capacity=4, threshold=0.5), known_map([[0, 1, -1, -1]] * 4)
    after, info = updated(filter, start, scan_of([(0, 1e200, 0.0)]))
    assert info.extra["particles"].underflow
    assert not info.extra["particles"].resampled
    np.testing.assert_array_equal(info.status, [Status.REJECTED] + [Status.EMPTY] * 3)
    np.testing.assert_allclose(np.exp(after.log_weight), 1 / 4)
    np.testing.assert_array_equal(after.landmarks, start.landmarks)
    assert np.all(np.abs(after.pose - start.pose) < 1.0)  # drawn, and no more
    assert info.log_likelihood == 0.0
    chex.assert_tree_all_finite((info, jax.jit(filter.estimate)(after)))
    _, info = updated(filter, start, scan_of([(0, 0.9, -0.4)]))
    assert not info.extra["particles"].underflow


def test_a_gate_drops_an_outlier_and_births_have_a_quota_and_a_tag_is_born_once():
    strict, start = (
        of(count=4, capacity=4, gate=sigma_gate(4, 2), births=1),
        known_map([[0, 1, -1, -1]] * 4),
    )
    after, info = updated(strict, start, scan_of([(0, 3.0, 0.0)]))
    np.testing.assert_array_equal(info.status, [Status.REJECTED] + [Status.EMPTY] * 3)
    assert info.nis[0] > 16
    assert info.dof[0] == 0
    np.testing.assert_array_equal(after.landmarks[:, 0], np.tile([1.0, 0.0], (4, 1)))
    rows = [(3, 1.0, 0.0), (3, 1.0, 0.1), (4, 2.0, 0.0)]
    after, info = updated(strict, start, scan_of(rows))
    wanted = [Status.BORN, Status.REPEATED, Status.DEFERRED, Status.EMPTY]
    np.testing.assert_array_equal(info.status, wanted)
    np.testing.assert_array_equal(after.tag, [[0, 1, 3, -1]] * 4)


@pytest.mark.sweep
def test_negative_evidence_removes_a_landmark_from_every_map():
    """One that is measured once and then never again, though in view."""
    world = worlds.ring(6)
    _, log = worlds.draw(world)
    gone = (log.scan.tag == 5) & (np.arange(6) > 0)[:, None]
    log = log._replace(scan=log.scan._replace(valid=log.scan.valid & ~gone))
    filter = of(world, 8, life=life.Existence(lambda pose, landmark: jnp.asarray(True)))
    trace = jax.device_get(drive(filter, log, world))
    assert trace.final.life.log_odds.shape == (8, 6)
    np.testing.assert_array_equal(np.sort(trace.final.tag), [[-1, 0, 1, 2, 3, 4]] * 8)
    # log(0.1/0.9) a miss: at the second the odds fall below 0.05/0.95
    np.testing.assert_array_equal(
        trace.info.extra["pruning"].removed.sum(axis=1), [0, 0, 1, 0, 0, 0]
    )
    dead = ~np.asarray(trace.final.alive)
    np.testing.assert_array_equal(np.asarray(trace.final.landmarks)[dead], 0.0)
    np.testing.assert_array_equal(
        np.asarray(trace.final.covs)[dead], np.tile(np.eye(2), (dead.sum(), 1, 1))
    )


# --- resampling within the filter ----------------------------------------------------------------


@pytest.mark.sweep
def test_it_resamples_where_the_threshold_says_and_it_is_counted():
    # ESS is at least 1, so this is never; 0 itself would be another program.
    never, often = (driven(proposal="motion", threshold=t)[0] for t in (1e-9, 0.5))
    of_often, of_never = often.info.extra["particles"], never.info.extra["particles"]
    assert not np.any(of_never.resampled)
    np.testing.assert_array_equal(of_often.resampled, of_often.ess < COUNT / 2)
    assert 0 < np.sum(of_often.resampled) < STEPS
    assert np.all((of_often.ess > 1 - 1e-9) & (of_often.ess < COUNT + 1e-9))
    assert of_never.ess[-1] < of_often.ess[-1]
    assert np.ptp(often.final.log_weight) == 0 or not of_often.resampled[-1]
    counts = {name: int(np.sum(happened)) for name, happened in of_often.counts().items()}
    assert (counts["resampled"], counts["underflow"]) == (of_often.resampled.sum(), 0)


@jax.jit
def resampled_by(number, state, scan):
    """An update with the method of that number: one program for all."""
    methods = [resampling.REGISTRY[name] for name in sorted(resampling.REGISTRY)]
    filter = of(count=3, capacity=2, resample=lambda *a: jax.lax.switch(number, methods, *a))
    return filter.update(state, scan, KEY)


@pytest.mark.parametrize("name", sorted(resampling.REGISTRY))
def test_any_method_resamples_whole_particles(name):
    """Weights that leave only the second: all descend from it, maps, tags and counts."""
    state = known_map([[0, 1], [1, 0], [0, 1]])
    state = state._replace(
        log_weight=np.array([-900.0, 0.0, -900.0]), lost=np.array([1, 2, 3], np.int32)
    )
    after, info = resampled_by(sorted(resampling.REGISTRY).index(name), state, scan_of([]))
    assert info.extra["particles"].resampled
    np.testing.assert_array_equal(after.tag, [[1, 0]] * 3)
    np.testing.assert_array_equal(after.landmarks[:, 0], np.tile([2.0, 0.0], (3, 1)))
    np.testing.assert_array_equal(after.lost, [2, 2, 2])
    np.testing.assert_allclose(np.exp(after.log_weight), 1 / 3)
    assert len(np.unique(after.pose[:, 0])) == 3  # each drew a pose of its own


# --- the house ----------------------------------------------------------------------------------


@pytest.mark.sweep
def test_a_batch_is_a_loop_and_keys_matter():
    logs = [worlds.draw(RING, seed)[1] for seed in range(2)]
    together = jax.random.split(jax.random.key(3), 2)
    keys, filter = list(together), of()
    both = jax.device_get(
        jax.jit(jax.vmap(lambda log, key: drive(filter, log, key=key)))(
            jax.tree.map(lambda *x: np.stack(x), *logs), together
        )
    )
    alone = [jax.device_get(drive(filter, logs[i], key=keys[i])) for i in range(2)]
    for i in range(2):
        mine = jax.tree.map(lambda leaf, i=i: leaf[i], both)
        chex.assert_trees_all_close(mine, alone[i], rtol=1e-9, atol=1e-11)
    other = jax.device_get(drive(filter, logs[0], key=keys[1]))
    assert np.all(alone[0].final.pose != other.final.pose)


@pytest.mark.sweep
@PROPOSALS
def test_float32_stays_float32_and_near(proposal):
    double, _, log = driven("still")
    single = worlds.narrow(log)
    filter = of(STILL, proposal=proposal)
    go = partial(drive, filter, world=STILL)
    if proposal == "measurement":  # with a proposal that weighs nothing they are the same
        trace = jax.device_get(go(single))
        chex.assert_tree_all_finite(trace)
        np.testing.assert_allclose(trace.estimate.points, double.estimate.points, atol=2e-4)
    else:
        trace = jax.eval_shape(go, single)
    assert all(leaf.dtype != np.float64 for leaf in jax.tree.leaves(trace))


@pytest.mark.sweep
@PROPOSALS
def test_gradients_are_finite_where_the_pose_is_known_exactly(proposal):
    """By both noises, in reverse through a motion, corrections, a birth and resampling, P0 = 0."""
    start = known_map([[0, 1, -1, -1]] * 4)._replace(
        pose_cov=np.zeros((4, 3, 3)), log_weight=np.log([0.7, 0.1, 0.1, 0.1])
    )
    start = jax.tree.map(jnp.asarray, start)
    scan = scan_of([(0, 1.1, -0.35), (1, 2.05, -0.42), (7, 3.0, 0.5)])
    method = resampling.StopGradient() if proposal == "motion" else resampling.systematic

    def cost(sigma):
        models = {
            "motion": motion.Increment(jnp.diag(sigma[:2]) ** 2),
            "sensor": sensors.RangeBearing(sigma[2] ** 2 * jnp.eye(2), mount=MOUNT),
        }
        world = dataclasses.replace(RING, **models)
        filter = of(world, 4, capacity=4, proposal=proposal, resample=method, threshold=1.0)
        state, info = filter.update(filter.predict(start, jnp.array([0.1, 0.05]), KEY), scan, KEY)
        return info.log_likelihood + filter.estimate(state).pose_cov.sum(), info

    slope, info = jax.jit(jax.grad(cost, has_aux=True))(np.array([0.01, 0.04, 0.05]))
    assert np.isfinite(slope).all()
    assert np.all(slope != 0)
    assert info.extra["particles"].resampled
    np.testing.assert_array_equal(info.status[:3], [Status.FUSED] * 2 + [Status.BORN])


@refused(
    ({"particles": 0}, "particles: expected an integer"),
    ({"particles": 2.5}, "particles: expected an integer"),
    ({"capacity": 0}, "capacity: expected an integer"),
    ({"births": 0}, "births: expected an integer"),
    ({"proposal": "optimal"}, 'proposal: expected "motion" or "measurement"'),
    ({"threshold": 1.5}, "threshold: expected a number from 0 to 1"),
    ({"threshold": np.nan}, "threshold: expected a number from 0 to 1"),
    ({"gate": 0.0}, "gate: expected a probability above 0 and below 1"),
    ({"resample": "systematic"}, "resample: expected a function"),
    ({"life": "existence"}, "life: expected a Life"),
    ({"sensor": sensors.Compass(np.eye(1))}, "not a suite"),
    (
        {"sensor": sensors.BearingInverseDepth(np.eye(1), min_distance=1.0, to_point=0.1)},
        "converted to points",
    ),
)
def test_bad_input_is_refused(change):
    arguments = {"motion": RING.motion, "sensor": RING.sensor, "capacity": 6, "particles": 5}
    FastSlam(**(arguments | change))
