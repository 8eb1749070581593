"""A lost robot found again by geometry: exhaustive search, ambiguity, and the pose's own covariance."""

import itertools
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from reference import plane

from jaxslam import charts, motion, se2, sensors
from jaxslam.core.slots import Joint
from jaxslam.core.types import Scan, Status
from jaxslam.filters import EkfSlam
from jaxslam.filters._ekf.correction import correct
from jaxslam.filters.map_management.relocalization import (
    forget_pose,
    points_of_map,
    relocalize,
    replace_pose,
    seen_points,
)
from jaxslam.linearize import FirstEstimate
from jaxslam.math.stats import chi2_band, chi2_quantile

SENSOR = sensors.RangeBearing(np.diag([0.05, 0.01]) ** 2, mount=(0.2, 0.1, 0.3))
FIND, ALIGN = jax.jit(relocalize), jax.jit(se2.align)
LOST = jax.jit(forget_pose, static_argnums=1, static_argnames="square_root")
MAP_OF = jax.jit(points_of_map, static_argnums=1, static_argnames="square_root")
RELOCATED = jax.jit(replace_pose, static_argnums=1)


def world(seed, count, reach=10.0, spread=0.05):
    """True points, an estimate of them and its joint covariance, most of it common to all."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach, reach, (count, 2))
    common = np.tile(np.eye(2), (count, 1)) * 2.0
    turn = 0.1 * np.stack([-points[:, 1], points[:, 0]], axis=1).reshape(-1, 1)
    root = np.concatenate(
        [common, turn, spread * rng.normal(size=(2 * count, 2 * count)) / np.sqrt(2 * count)],
        axis=1,
    )
    cov = root @ root.T + spread**2 * np.eye(2 * count)
    return rng, points, cov


def seen_from(rng, pose, points, noise=0.05):
    """A scan's points in the robot's frame with independent noise."""
    exact = plane.to_frame(pose, points)
    covs = np.tile(noise**2 * np.eye(2), (len(points), 1, 1))
    return exact + noise * rng.normal(size=exact.shape), covs


SLOTS, PLACES = 30, 11


def padded(points, cov, seen, covs, valid=None, alive=None):
    """What `relocalize` takes, with dead landmarks and invalid places up to one size for all."""
    valid = np.ones(len(seen), bool) if valid is None else valid
    alive = np.ones(len(points), bool) if alive is None else alive
    slots, places = SLOTS - len(points), PLACES - len(seen)
    whole = np.eye(2 * SLOTS)
    whole[: len(cov), : len(cov)] = cov
    return (
        np.pad(points, ((0, slots), (0, 0))),
        whole,
        np.pad(alive, (0, slots)),
        np.pad(seen, ((0, places), (0, 0))),
        np.concatenate([covs, np.tile(np.eye(2), (places, 1, 1))]),
        np.pad(valid, (0, places)),
    )


def find(points, cov, seen, covs, valid=None, alive=None):
    found = jax.device_get(FIND(*padded(points, cov, seen, covs, valid, alive)))
    return found._replace(slot=found.slot[: len(seen)])


@pytest.mark.parametrize("seed", swept(range(4), 0))
def test_without_noise_the_pose_is_exact(seed):
    rng, points, _ = world(seed, 30)
    pose = np.append(rng.uniform(-5, 5, 2), rng.uniform(-3, 3))
    of = rng.permutation(30)[:7]
    seen, covs = seen_from(rng, pose, points[of], 0.0)
    for cov in (np.zeros((60, 60)), 1e-6 * np.eye(60)):
        found = find(points, cov, seen, covs + 1e-8 * np.eye(2))
        np.testing.assert_array_equal(found.slot, of)
        np.testing.assert_allclose(found.pose, pose, atol=1e-7)
        assert found.ok and found.explained == 7


def generalized_least_squares(seen, covs, points, cov, start):
    """min rᵀ Σ⁻¹ r over the pose, to first order about a start, with dense algebra."""
    pose, n = np.array(start), len(seen)
    turn = plane.turn(pose[2])
    r = (plane.from_frame(pose, seen) - points).ravel()
    lever = points - pose[:2]
    slope = np.zeros((2 * n, 3))
    slope[0::2, 0] = slope[1::2, 1] = 1
    slope[0::2, 2], slope[1::2, 2] = -lever[:, 1], lever[:, 0]
    sigma = cov.copy()
    for i in range(n):
        sigma[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += turn @ covs[i] @ turn.T
    weight = np.linalg.inv(sigma)
    step = np.linalg.inv(slope.T @ weight @ slope) @ slope.T @ weight @ r
    left = r - slope @ step
    return pose - step, left @ weight @ left


def exhaustive(points, cov, seen, covs, probability=0.99):
    """Of all partial assignments, the most pairs with D² <= χ²(2n-3); of several, the least D²."""
    best = (0, np.inf, None, None)
    for choice in itertools.product(range(-1, len(points)), repeat=len(seen)):
        choice = np.array(choice)
        pick = choice[choice >= 0]
        n = len(pick)
        if n < 3 or len(set(pick)) < n or n < best[0]:
            continue
        z, m = seen[choice >= 0], points[pick]
        start = np.asarray(ALIGN(z, m))
        if np.abs(plane.from_frame(start, z) - m).max() > 3:
            continue
        at = (2 * pick[:, None] + np.arange(2)).ravel()
        pose, distance = generalized_least_squares(
            z, covs[choice >= 0], m, cov[np.ix_(at, at)], start
        )
        better = (-n, distance) < (-best[0], best[1])
        if better and distance <= chi2_quantile(probability, 2 * n - 3):
            best = (n, distance, choice, pose)
    return best


@pytest.mark.parametrize("seed", swept(range(5), 0))
def test_exhaustive_search_finds_no_better(seed):
    rng, points, cov = world(seed, 5)
    estimate = points + (np.linalg.cholesky(cov) @ rng.normal(size=10)).reshape(-1, 2)
    of = rng.permutation(5)[:3]
    clutter = rng.uniform(-5, 5, (1, 2))
    seen, covs = seen_from(rng, [1.0, -2.0, 0.7], np.concatenate([points[of], clutter]))
    count, distance, choice, pose = exhaustive(estimate, cov, seen, covs)
    found = find(estimate, cov, seen, covs)
    assert found.explained == count
    np.testing.assert_array_equal(found.slot, choice)
    np.testing.assert_allclose(found.distance, distance, rtol=1e-6)
    np.testing.assert_allclose(found.pose, pose, atol=1e-2)


@pytest.mark.sweep
@pytest.mark.usefixtures("full_optimization")
def test_clutter_is_left_alone_and_the_right_place_found_at_full_size():
    """200 landmarks, 6 of a scan's 9 measurements of them: never sure of a wrong place."""
    right = sure = 0
    for seed in range(10):
        rng, points, cov = world(seed, 200, reach=60.0)
        estimate = points + (np.linalg.cholesky(cov) @ rng.normal(size=400)).reshape(-1, 2)
        of = np.argsort(((points - points[0]) ** 2).sum(axis=1))[:6]
        clutter = points[0] + rng.uniform(-8, 8, (3, 2))
        pose = np.append(points[0] + 1.0, rng.uniform(-3, 3))
        seen, covs = seen_from(rng, pose, np.concatenate([points[of], clutter]))
        order = rng.permutation(9)
        found = FIND(estimate, cov, np.ones(200, bool), seen[order], covs, np.ones(9, bool))
        truth = np.where(order < 6, of[np.minimum(order, 5)], -1)
        good = (np.asarray(found.slot) == truth)[truth >= 0].all()
        sure += bool(found.ok)
        right += bool(found.ok) and good
    assert right == sure
    assert sure >= 7


def test_a_symmetric_map_is_ambiguous():
    square = 5.0 * np.array(
        [[1, 1], [-1, 1], [-1, -1], [1, -1], [2, 1], [-1, 2], [-2, -1], [1, -2]]
    )
    rng = np.random.default_rng(0)
    seen, covs = seen_from(rng, [0.5, 0.3, 0.4], square, 0.01)
    cov = 1e-4 * np.eye(16)
    found = find(square, cov, seen, covs)
    assert found.explained == found.runner_up == 8
    assert not found.ok
    points = np.concatenate([square, [[3.0, 8.0], [9.0, -1.0], [-2.0, -13.0]]])
    seen, covs = seen_from(rng, [0.5, 0.3, 0.4], points, 0.01)
    found = find(points, 1e-4 * np.eye(22), seen, covs)
    assert found.ok and found.explained == 11 and found.runner_up == 8


def test_too_few_points_and_nothing_that_agrees():
    rng, points, cov = world(1, 10)
    seen, covs = seen_from(rng, [1.0, 2.0, 0.5], points[:5], 0.01)
    for count in (0, 1, 2, 3):
        found = find(points, cov, seen, covs, valid=np.arange(5) < count)
        assert not found.ok
        assert found.explained <= count
    one = jax.eval_shape(FIND, points, cov, np.ones(10, bool), seen[:1], covs[:1], np.ones(1, bool))
    assert one.slot.shape == (1,)
    far = find(points, 1e-6 * np.eye(20), 100 * seen, 1e-6 * covs)
    assert far.explained == 0 and not far.ok
    np.testing.assert_array_equal(far.slot, -1)


@pytest.mark.sweep
def test_dead_landmarks_are_not_matched_and_vmap_is_a_loop():
    rng, points, cov = world(2, 12)
    seen, covs = seen_from(rng, [1.0, 2.0, 0.5], points[:6])
    alive = np.arange(12) != 3
    found = find(points, cov, seen, covs, alive=alive)
    assert found.ok and found.slot[3] == -1 and found.explained == 5
    parts = list(padded(points, cov, seen, covs, alive=alive))
    parts[3] = np.stack([padded(points, cov, z, covs)[3] for z in (seen, seen[::-1])])
    many = jax.jit(jax.vmap(relocalize, (None, None, None, 0, None, None)))(*parts)
    np.testing.assert_array_equal(many.slot[0, :6], found.slot)
    np.testing.assert_array_equal(many.slot[1, :6], found.slot[::-1])
    np.testing.assert_allclose(many.pose[1], found.pose, atol=1e-9)


@pytest.mark.sweep
def test_float32():
    rng, points, cov = world(3, 40, reach=40.0)
    of = np.argsort(((points - points[0]) ** 2).sum(axis=1))[:7]
    seen, covs = seen_from(rng, [1.0, 2.0, 0.5], points[of])
    points, cov, seen, covs = (np.asarray(p, np.float32) for p in (points, cov, seen, covs))
    found = FIND(points, cov, np.ones(40, bool), seen, covs, np.ones(7, bool))
    assert found.pose.dtype == jnp.float32
    assert found.ok
    np.testing.assert_array_equal(found.slot, of)


def test_a_scan_as_points():
    z = np.array([[2.0, 0.3], [5.0, -1.0], [9.0, 9.0]])
    scan = Scan(z, np.full(3, -1), np.array([True, True, False]))
    points, covs = jax.jit(partial(seen_points, SENSOR))(scan)
    invert = jax.jit(SENSOR.invert)
    for i in range(2):
        expected = invert(np.zeros(3), z[i], np.zeros(0))
        np.testing.assert_allclose(points[i], expected)
        r, phi = float(z[i, 0]), float(z[i, 1]) + 0.3
        slope = np.array([[np.cos(phi), -r * np.sin(phi)], [np.sin(phi), r * np.cos(phi)]])
        np.testing.assert_allclose(covs[i], slope @ SENSOR.noise_cov(z[i]) @ slope.T, atol=1e-12)
    np.testing.assert_array_equal(points[2], 0.0)


def some_joint(seed=0, count=6):
    rng, points, cov = world(seed, count)
    size = 3 + 2 * count
    whole = np.eye(size)
    whole[3:, 3:] = cov
    root = 0.3 * rng.normal(size=(3, size))
    whole[:3, :3] = root[:, :3] @ root[:, :3].T + np.eye(3)
    whole[:3, 3:] = 0.02 * root[:, 3:]
    whole[3:, :3] = whole[:3, 3:].T
    alive = np.arange(count) != 2
    dead = np.concatenate([np.zeros(3, bool), np.repeat(~alive, 2)])
    whole = np.where(dead[:, None] | dead[None], np.eye(size), whole)
    points = np.where(alive[:, None], points, 0.0)
    parts = np.array([0.5, 1.0, 0.3]), points, whole, alive, np.where(alive, np.arange(count), -1)
    return Joint(*parts, ())


@pytest.mark.parametrize(
    "name", swept(["euclidean", "right_invariant", "left_invariant"], "right_invariant")
)
@pytest.mark.parametrize("square_root", swept([False, True], True))
def test_lost_forgets_the_pose_and_nothing_else(name, square_root):
    chart = charts.REGISTRY[name]()
    joint = some_joint()
    if square_root:
        joint = joint._replace(cov=np.linalg.cholesky(joint.cov))
    pose_cov = np.diag([100.0, 100.0, 9.0])
    gone = LOST(joint, chart, pose_cov, square_root=square_root)
    before, after = (MAP_OF(s, chart, square_root=square_root)[1] for s in (joint, gone))
    np.testing.assert_allclose(after, before, atol=1e-9)
    cov = gone.cov @ gone.cov.T if square_root else gone.cov
    size = cov.shape[0]

    def coordinates(xi):
        poses, points = jax.vmap(chart.retract, (None, 0, None, 0))(
            gone.pose, gone.landmarks, xi[:3], xi[3:].reshape(-1, 2)
        )
        return jnp.concatenate(
            [poses[0], jnp.where(gone.alive[:, None], points, xi[3:].reshape(-1, 2)).ravel()]
        )

    slope = np.asarray(jax.jit(jax.jacfwd(coordinates))(np.zeros(size)))
    whole = slope @ cov @ slope.T
    np.testing.assert_allclose(whole[:3, :3], pose_cov, atol=1e-9)
    np.testing.assert_allclose(whole[:3, 3:], 0, atol=1e-9)


@pytest.mark.parametrize("name", swept(["euclidean", "right_invariant"], "euclidean"))
def test_relocated_is_the_limit_of_an_update_from_a_large_covariance(name):
    chart = charts.REGISTRY[name]()
    sensor = sensors.RelativePosition(0.1**2 * np.eye(2))
    rng = np.random.default_rng(5)
    joint = some_joint()
    slot = np.array([0, 4, -1, 5, 1])
    pose = np.array([3.0, -1.0, 2.0])
    seen, _ = seen_from(rng, pose, np.asarray(joint.landmarks)[np.maximum(slot, 0)], 1e-3)
    covs = np.tile(0.1**2 * np.eye(2), (5, 1, 1))
    found = RELOCATED(joint, chart, slot, seen, covs)
    # Linearized at the answer, the same update from a large covariance hardly moves the pose.
    wide = LOST(joint._replace(pose=found.pose), chart, 1e7 * np.eye(3))
    ekf = EkfSlam(motion.Increment(np.eye(2)), sensor, len(joint.tag), chart=chart)
    correction = jax.jit(lambda *scan: correct(ekf, sensor, *scan, None))
    limit, _ = correction(wide, seen, np.maximum(slot, 0), slot >= 0)
    tolerance = 1e-5 if name == "euclidean" else 1e-3  # basis at the answer, or before it
    np.testing.assert_allclose(found.pose, limit.pose, atol=tolerance)
    np.testing.assert_allclose(found.landmarks, limit.landmarks, atol=20 * tolerance)
    np.testing.assert_allclose(found.cov, limit.cov, atol=20 * tolerance)


def test_the_relocated_pose_is_honest():
    """NEES of pose and of pose with map over 300 draws of map and scan."""
    chart, count, runs = charts.Euclidean(), 6, 300
    rng, points, cov = world(7, count)
    # A common turn of 0.1 rad (1 σ) is beyond first order; what is linear is tested here.
    cov = 0.05 * cov
    pose, size = np.array([1.0, -2.0, 2.5]), 3 + 2 * count
    whole = np.eye(size)
    whole[3:, 3:] = cov
    root = np.linalg.cholesky(cov)

    def one(normals, noise):
        estimate = jnp.asarray(points) + (jnp.asarray(root) @ normals).reshape(-1, 2)
        state = Joint(
            jnp.zeros(3), estimate, jnp.asarray(whole), jnp.ones(count, bool), jnp.arange(count), ()
        )
        exact = jax.vmap(se2.to_frame, (None, 0))(jnp.asarray(pose), jnp.asarray(points)[:4])
        covs = jnp.tile(0.05**2 * jnp.eye(2), (4, 1, 1))
        after = replace_pose(state, chart, jnp.arange(4), exact + 0.05 * noise, covs)
        turn = jnp.arctan2(jnp.sin(after.pose[2] - pose[2]), jnp.cos(after.pose[2] - pose[2]))
        error = jnp.concatenate(
            [after.pose[:2] - pose[:2], turn[None], (after.landmarks - points).ravel()]
        )
        return error, after.cov

    error, covs = jax.jit(jax.vmap(one))(
        rng.normal(size=(runs, 2 * count)), rng.normal(size=(runs, 4, 2))
    )
    for part in (slice(0, 3), slice(0, size)):
        e, p = np.asarray(error)[:, part], np.asarray(covs)[:, part, part]
        nees = np.einsum("ri,rij,rj->r", e, np.linalg.inv(p), e).mean()
        low, high = chi2_band(e.shape[1], runs, 0.999)
        assert low < nees < high


def test_two_pairs_are_enough_and_fewer_change_nothing():
    joint, chart = some_joint(), charts.Euclidean()
    rng = np.random.default_rng(0)
    seen, covs = seen_from(rng, [2.0, 1.0, -1.0], np.asarray(joint.landmarks)[[0, 4]])
    found = RELOCATED(joint, chart, np.array([0, 4]), seen, covs)
    assert np.abs(found.pose - np.array([2.0, 1.0, -1.0])).max() < 0.3
    for slot in ([0, -1], [-1, -1], [2, 0]):  # 2 is dead
        same = RELOCATED(joint, chart, np.array(slot), seen, covs)
        chex.assert_trees_all_equal(same, joint)


@pytest.mark.sweep
def test_a_kidnapped_robot_finds_itself_and_goes_on():
    """Put elsewhere without a word: scans no longer fit, it is lost, it is found, it is honest."""
    chart = charts.RightInvariant()
    rng = np.random.default_rng(11)
    move = jax.jit(se2.compose)
    landmarks = rng.uniform(-12, 12, (25, 2))
    model = motion.PoseIncrement(np.diag([0.02, 0.02, 0.01]) ** 2)
    sensor = sensors.RangeBearing(np.diag([0.05, 0.01]) ** 2)
    filter = EkfSlam(model, sensor, 25, chart=chart, gate=0.9999, correction="joint")
    predict, update = jax.jit(filter.predict), jax.jit(filter.update)
    look = jax.jit(jax.vmap(sensor.observe, (None, 0)))
    points_of = jax.jit(partial(seen_points, sensor))
    again = jax.jit(lambda s, slot, scan: replace_pose(s, chart, slot, *seen_points(sensor, scan)))
    key = jax.random.key(0)
    pose, u = np.zeros(3), np.array([0.4, 0.0, 0.08])
    state, missing, events = filter.init(np.zeros(3), np.zeros((3, 3))), False, []
    for step in range(160):
        noisy = u + np.array([0.02, 0.02, 0.01]) * rng.normal(size=3)
        pose = np.asarray(move(pose, noisy))
        if step == 100:
            pose = np.array([-6.0, -3.0, 2.0])
        exact = np.asarray(look(pose, landmarks))
        near = np.argsort(exact[:, 0])[:8]
        z = exact[near] + rng.normal(size=(8, 2)) * [0.05, 0.01]
        # Identities are given while it knows where it is; afterwards they are ignored.
        scan = Scan(z, near, np.ones(8, bool))
        state = predict(state, u, key)
        if missing:
            points, cov, alive = MAP_OF(state, chart)
            found = find(points, cov, *points_of(scan), scan.valid, alive)
            if found.ok:
                state, missing = again(state, found.slot, scan), False
                events.append(("found", step))
                np.testing.assert_array_equal(
                    np.asarray(state.tag)[found.slot[found.slot >= 0]], near[found.slot >= 0]
                )
            continue
        state_after, info = update(state, scan, key)
        if (info.status == Status.REJECTED).sum() >= 5:
            state, missing = LOST(state, chart, np.diag([100.0, 100.0, 9.0])), True
            events.append(("lost", step))
        else:
            state = state_after
    assert [e[0] for e in events] == ["lost", "found"]
    assert events[0][1] == 100 and events[1][1] < 110
    estimate = jax.jit(filter.estimate)(state)
    error = np.asarray(estimate.pose) - pose
    error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
    assert error @ np.linalg.solve(estimate.pose_cov, error) < chi2_quantile(0.999, 3)
    assert np.hypot(*error[:2]) < 0.5


def relocalized(cov=slice(None), **options):
    rng, points, whole = world(0, 5)
    seen, covs = seen_from(rng, [0.0, 0.0, 0.0], points)
    yes = np.ones(5, bool)
    relocalize(points, whole[cov], yes, seen, covs, yes, **options)


def former(joint):
    return joint._replace(lin=FirstEstimate().init(joint.pose, joint.landmarks))


@refused(
    (lambda: relocalized(least=2), "least"),
    (lambda: relocalized(margin=0), "margin"),
    (lambda: relocalized(probability=1.0), "probability"),
    (lambda: relocalized(pairs=0), "pairs"),
    (lambda: relocalized(candidates=0), "candidates"),
    (lambda: relocalized(slice(4)), "shape"),
    (lambda: forget_pose(some_joint(), charts.Euclidean(), -np.eye(3)), "covariance"),
    (
        lambda: forget_pose(former(some_joint()), charts.Euclidean(), np.eye(3)),
        "keeps former estimates",
    ),
    (
        lambda: MAP_OF(some_joint()._replace(landmarks=np.zeros((4, 3))), charts.Euclidean()),
        "landm",
    ),
    (
        lambda: RELOCATED(
            some_joint(), charts.Euclidean(), np.arange(2), np.zeros((3, 2)), np.zeros((3, 2, 2))
        ),
        r"replace_pose: seen: expected shape \(2, 2\), got \(3, 2\)",
    ),
    (
        lambda: seen_points(sensors.BearingOnly(0.1 * np.eye(1)), None),
        "seen_points: sensor: expected one that measures points, got bearing_only",
    ),
)
def test_refusals(call):
    call()
