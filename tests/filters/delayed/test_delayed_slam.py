"""Delayed initialization: intersections, hypotheses, landmarks made of them, and the filter."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from reference.plane import from_frame
from worlds import draw, judged, nameless, narrow

import jaxslam
from jaxslam import Scenario, motion, sensors
from jaxslam.association import Nearest
from jaxslam.core.record import record
from jaxslam.core.types import Status
from jaxslam.filters import (
    DeadReckoning,
    DelayedSlam,
    Hypotheses,
    Promotion,
    StoredMeasurements,
)
from jaxslam.filters._delayed import (
    confirmation,
    hypotheses,
    initialization,
    intersection,
    state,
    triangulation,
)

CAMERA = sensors.BearingOnly([[0.01**2]])
BEACON = sensors.RangeOnly([[0.05**2]])
KINDS = {"rays": triangulation.Rays(), "circles": triangulation.Circles()}
EACH_KIND = pytest.mark.parametrize("kind", swept(KINDS, "rays"))
RESIDUAL = {kind: jax.jit(jax.vmap(model.residual)) for kind, model in KINDS.items()}


# --- where two measurements intersect -----------------------------------------------------------


def seen_by(kind, places, point):
    """Perfect stored measurements (q, 3) of a point from places (q, 2), in plain NumPy."""
    delta = point - places
    seen = np.arctan2(delta[:, 1], delta[:, 0]) if kind == "rays" else np.hypot(*delta.T)
    return np.column_stack([places, seen])


@EACH_KIND
def test_perfect_measurements_intersect_at_the_point(kind):
    rng = np.random.default_rng(0)
    places, points = rng.uniform(-5, 5, (200, 2, 2)), rng.uniform(-5, 5, (200, 2))
    seen = np.stack([seen_by(kind, p, x) for p, x in zip(places, points, strict=True)])
    met, ok = jax.jit(jax.vmap(KINDS[kind].intersect))(seen[:, 0], seen[:, 1])
    off = np.linalg.norm(np.asarray(met) - points[:, None], axis=2).min(axis=1)
    # The angle at the point between the two directions to it decides whether the intersection is sharp.
    a, b = points - places[:, 0], points - places[:, 1]
    sine = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    sine = sine / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    least = np.sin(0.1 if kind == "rays" else 0.3)
    np.testing.assert_array_equal(np.asarray(ok).all(axis=1), sine >= least)
    assert 100 < ok[:, 0].sum() < 200
    np.testing.assert_allclose(off[sine >= least], 0, atol=1e-9)
    np.testing.assert_allclose(RESIDUAL[kind](seen[:, 0], points), 0, atol=1e-12)


def with_jacobians(intersect):
    """The points, whether they are, and their derivatives by both measurements."""
    return jax.jit(
        lambda a, b: (*intersect(a, b), jax.jacfwd(lambda *s: intersect(*s)[0], (0, 1))(a, b))
    )


INTERSECT = {kind: with_jacobians(model.intersect) for kind, model in KINDS.items()}


def test_two_circles_intersect_in_mirrored_points():
    points, ok, _ = INTERSECT["circles"](np.array([0.0, 0, 5]), np.array([6.0, 0, 5]))
    assert ok.all()
    np.testing.assert_allclose(points, [[3, 4], [3, -4]], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "a", "b"),
    [
        ("rays", [0, 0, 0.0], [0, 1, 0.0]),  # parallel
        ("rays", [0, 0, 0.0], [0, 0, 0.0]),
        ("rays", [0, 0, 0.0], [1, 1, np.pi / 2]),  # behind the second
        ("rays", [0, 0, np.pi], [1, 1, -np.pi / 2]),  # behind the first
        ("circles", [0, 0, 1.0], [2, 0, 1.0]),  # touching
        ("circles", [0, 0, 1.0], [3, 0, 1.0]),  # apart
        ("circles", [0, 0, 3.0], [1, 0, 1.0]),  # one in the other
        ("circles", [0, 0, 1.0], [0, 0, 1.0]),
        ("circles", [0, 0, 0.0], [1, 0, 1.0]),
        ("circles", [0, 0, -2.0], [1, 0, 2.0]),  # noise can make a range negative
    ],
)
def test_what_does_not_intersect_is_not_ok_and_finite(kind, a, b):
    a, b = jnp.asarray(a, float), jnp.asarray(b, float)
    points, ok, jacobians = INTERSECT[kind](a, b)
    assert not ok.any()
    chex.assert_tree_all_finite((points, jacobians))


@EACH_KIND
def test_a_measurement_is_stored_where_the_sensor_is_mounted(kind):
    mount = (0.3, -0.2, 0.7)
    factory = sensors.BearingOnly if kind == "rays" else sensors.RangeOnly
    sensor = factory([[1e-4]], mount=mount)
    pose, point = np.array([1.0, 2.0, 2.5]), np.array([-3.0, 4.0])
    place = from_frame(pose, mount[:2])
    seen = KINDS[kind].store(sensor, jnp.asarray(pose), sensor.observe(pose, point))
    assert type(triangulation.triangulation_of(sensor)) is type(KINDS[kind])
    np.testing.assert_allclose(seen, seen_by(kind, place[None], point)[0], atol=1e-12)


# --- hypotheses in the table --------------------------------------------------------------------

LAYOUT = state.TableLayout(2, 2, 4)
ADD_HYPOTHESES = jax.jit(intersection.add_hypotheses, static_argnums=(1, 2))
RESIDUALS = jax.jit(hypotheses.point_residuals, static_argnums=1)
CONSTRAINTS = jax.jit(confirmation.constraints_of)
CORRECT = jax.jit(confirmation.correct_hypotheses, static_argnums=1)
ESTIMATE = jax.jit(initialization.initial_estimate, static_argnums=1)
ADD_LANDMARK = jax.jit(initialization.add_landmark)
CLOSER = jax.jit(hypotheses.closer_than, static_argnums=0)


def table(kind, seed=0, scale=0.01):
    """A joint state with a random covariance and four stored measurements of the point (1, 5)."""
    rng = np.random.default_rng(seed)
    size = 3 + 3 * LAYOUT.slots
    root = rng.normal(size=(size, size)) * scale
    cov = root @ root.T / size**0.5
    joint = jaxslam.core.slots.empty(jnp.asarray([0.1, 0.2, 0.3]), jnp.eye(3), LAYOUT.slots, 3)
    # One landmark, no hypothesis, stored measurements.
    alive = np.array([True, False, False, False, True, True, True, True])
    live = np.concatenate([np.ones(3, bool), np.repeat(alive, 3)])
    live[5] = False  # the landmark's padding
    cov = np.where(live[:, None] & live[None, :], cov, np.eye(size))
    places = np.array([[0.0, 0.0], [2.0, 0.5], [-2.0, 1.0], [3.0, 3.0]])
    seen = seen_by(kind, places, np.array([1.0, 5.0])) + 0.003 * rng.normal(size=(4, 3))
    landmarks = np.zeros((LAYOUT.slots, 3))
    landmarks[0, :2] = [4.0, 4.0]
    landmarks[4:] = seen
    return joint._replace(
        landmarks=jnp.asarray(landmarks),
        cov=jnp.asarray(cov),
        alive=jnp.asarray(alive),
        tag=jnp.where(alive, 0, -1).astype(jnp.int32),
    )


def closest_point(kind, seen):
    """The number of the intersection of two measurements that is near (1, 5)."""
    points = np.asarray(INTERSECT[kind](*map(jnp.asarray, seen))[0])
    return int(np.argmin(np.linalg.norm(points - [1, 5], axis=1)))


def formed(kind, joint, which):
    """The joint with a hypothesis where the first two measurements intersect."""
    new, parents = jnp.asarray([True, False]), jnp.asarray([[4, 5], [4, 4]])
    which = jnp.asarray([which, 0])
    return ADD_HYPOTHESES(joint, LAYOUT, KINDS[kind], new, parents, which, jnp.zeros(2, int))


@EACH_KIND
def test_the_covariance_of_an_intersection_is_that_of_draws(kind):
    joint = table(kind, scale=0.002)
    at = closest_point(kind, joint.landmarks[4:6])
    new = formed(kind, joint, at)
    rng = np.random.default_rng(1)
    live = np.r_[0:5, 15:27]
    mean = np.concatenate([joint.pose, np.asarray(joint.landmarks).reshape(-1)])[live]
    root = np.linalg.cholesky(np.asarray(joint.cov)[np.ix_(live, live)])
    draws = mean + rng.normal(size=(20_000, len(live))) @ root.T
    intersect = jax.jit(jax.vmap(lambda a, b: KINDS[kind].intersect(a, b)[0][at]))
    points = intersect(draws[:, 5:8], draws[:, 8:11])
    together = np.cov(np.column_stack([draws, points]).T)
    rows = np.r_[live, 9, 10]
    claimed = np.asarray(new.cov)[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(claimed))
    difference = (together - claimed) / scale[:, None] / scale[None, :]
    assert np.abs(difference).max() < 0.04
    np.testing.assert_allclose(new.landmarks[2, :2], points.mean(axis=0), atol=0.01)
    assert new.alive[2]
    assert not new.alive[3]
    # The third parameter is padding, and what was there is as it was.
    np.testing.assert_array_equal(new.cov[11], np.eye(len(new.cov))[11])
    others = np.delete(np.arange(len(new.cov)), [9, 10])
    np.testing.assert_array_equal(
        np.asarray(new.cov)[np.ix_(others, others)], np.asarray(joint.cov)[np.ix_(others, others)]
    )
    np.testing.assert_array_equal(new.cov, new.cov.T)


def jacobian_rows(kind, joint, point, stored, differences):
    """The residuals g of a point, G by the whole state, and G by the point; numerically."""

    def residual(s, x):
        return np.asarray(RESIDUAL[kind](s, x))

    seen = np.asarray(joint.landmarks)[stored]
    points = np.broadcast_to(point, (len(seen), 2))
    by_stored = differences(residual, (seen, points), 0)
    by_point = differences(residual, (seen, points), 1)
    rows = np.zeros((len(seen), len(joint.cov)))
    for k, slot in enumerate(stored):
        rows[k, 3 + 3 * slot : 6 + 3 * slot] = by_stored[k]
    return residual(seen, points), rows, by_point


@EACH_KIND
def test_a_confirmed_hypothesis_moves_and_nothing_else(kind, differences):
    joint = table(kind)
    joint = formed(kind, joint, closest_point(kind, joint.landmarks[4:6]))
    slots = jnp.asarray([2, 3])
    found = RESIDUALS(joint, KINDS[kind], slots, jnp.asarray([6, 7]))
    value, rows, by_point = jacobian_rows(
        kind, joint, np.asarray(joint.landmarks)[2, :2], [6], differences
    )
    rows[0, 9:11] = by_point[0]
    cov = np.asarray(joint.cov)
    s = rows @ cov @ rows.T
    np.testing.assert_allclose(found.value[0, 0], value[0], rtol=1e-9)
    np.testing.assert_allclose(found.variance[0, 0], s[0, 0], rtol=1e-6)

    gain = cov @ rows.T / s
    gain[np.delete(np.arange(len(gain)), [9, 10])] = 0
    left = np.eye(len(cov)) - gain @ rows
    part = (found.value[:, 0], found.by_point[:, 0], found.by_stored[:, 0], jnp.zeros(2))
    constraint = CONSTRAINTS(joint, slots, jnp.asarray([6, 6]), *part)
    new = CORRECT(joint, LAYOUT, constraint, jnp.asarray([True, False]))
    np.testing.assert_allclose(new.cov, left @ cov @ left.T, atol=1e-9 * cov.max())
    np.testing.assert_allclose(
        new.landmarks[2, :2], joint.landmarks[2, :2] - gain[9:11, 0] * value, atol=1e-8
    )
    np.testing.assert_array_equal(new.pose, joint.pose)
    np.testing.assert_array_equal(new.landmarks[4:], joint.landmarks[4:])


@record
class Growing:
    """The variance of one number that grows with its size."""

    share: float

    def __call__(self, z):
        return jnp.square(0.003 + self.share * jnp.abs(z))[:, None]


OF_STORED = np.array([17, 20, 23, 26])
"""the rows of the four values q"""


def noisy(kind, share):
    """`table` with a noise R(z) of each value, and errors of that size; and the noise."""
    factory = sensors.BearingOnly if kind == "rays" else sensors.RangeOnly
    joint = table(kind)
    z = np.asarray(joint.landmarks)[4:, 2:] - 0.3 * (kind == "rays")  # the heading
    z = z + share * z * np.array([[0.3], [-0.4], [0.5], [-0.2]])
    landmarks = joint.landmarks.at[4:, 2:].set(z + 0.3 * (kind == "rays"))
    variance = (0.003 + share * np.abs(z[:, 0])) ** 2
    cov = joint.cov.at[OF_STORED, OF_STORED].add(variance)
    noise = hypotheses.StoredNoise(factory(Growing(share)), jnp.asarray(z), jnp.ones(4))
    return joint._replace(landmarks=landmarks, cov=cov), noise


@pytest.mark.parametrize("share", [0.0, 0.1])
@EACH_KIND
def test_a_landmark_of_all_its_measurements_is_the_constrained_least_squares(
    kind, share, differences
):
    """Against the solution of minimize δᵀP⁻¹δ subject to the four constraints, by one inverse; P
    with R(ẑ) of the solution, though the table has R(z)."""
    joint, noise = noisy(kind, share)
    stored = jnp.asarray([4, 5, 6, 7, 4])
    use = jnp.asarray([True, True, True, True, False])
    start = jnp.asarray([1.1, 5.1])
    of_rows = noise._replace(z=noise.z[stored - 4], by_z=noise.by_z[stored - 4])
    found = ESTIMATE(joint, KINDS[kind], of_rows, start, stored, use)
    new = ADD_LANDMARK(joint, found, jnp.asarray(1), stored)

    def predicted(value):
        """P with R(ẑ)."""
        z, cov = np.asarray(noise.z)[:, 0], np.array(joint.cov)
        sigma, at_z = (0.003 + share * np.abs(x) for x in (z - value, z))
        cov[OF_STORED, OF_STORED] += sigma**2 - at_z**2
        return cov

    # At the point where Gauss-Newton ends, the linear problem in plain NumPy.
    point = np.array([1.1, 5.1])
    for _ in range(20):
        value, rows, by_point = jacobian_rows(kind, joint, point, [4, 5, 6, 7], differences)
        weight = np.linalg.inv(rows @ predicted(value) @ rows.T)
        lhs = by_point.T @ weight @ by_point
        point = point - np.linalg.solve(lhs, by_point.T @ weight @ value)
    value, rows, by_point = jacobian_rows(kind, joint, point, [4, 5, 6, 7], differences)
    live = np.r_[0:5, 15:27]
    n = len(live)
    system = np.zeros((n + 6, n + 6))
    system[:n, :n] = np.linalg.inv(predicted(value)[np.ix_(live, live)])
    system[n + 2 :, :n] = rows[:, live]
    system[n + 2 :, n : n + 2] = by_point
    system[:, n + 2 :] = system[n + 2 :].T
    inverse = np.linalg.inv(system)
    moved = inverse @ np.concatenate([np.zeros(n + 2), -value])
    rows = np.r_[live, 6, 7]
    # The values themselves are then deleted; where R varies, their rows are as with R(z).
    kept = np.flatnonzero(~np.isin(rows, OF_STORED) | (share == 0))
    np.testing.assert_allclose(
        np.asarray(new.cov)[np.ix_(rows[kept], rows[kept])],
        inverse[: n + 2, : n + 2][np.ix_(kept, kept)],
        atol=1e-9,
    )
    np.testing.assert_allclose(new.landmarks[1, :2], point + moved[n : n + 2], atol=1e-6)
    np.testing.assert_allclose(new.pose, joint.pose + moved[:3], atol=1e-7)
    columns = slice(0, 3 if share == 0 else 2)
    off = np.asarray(new.landmarks - joint.landmarks)[4:] - moved[5:n].reshape(4, 3)
    np.testing.assert_allclose(off[:, columns], 0, atol=1e-7)
    assert found.regular
    step = moved[:n]
    cost = step @ system[:n, :n] @ step
    np.testing.assert_allclose(found.nis, cost, rtol=1e-4)
    assert new.alive[1]


def test_gaussians_are_told_apart_by_either_distance():
    cov = np.diag([0.04, 0.01])
    points, others = np.array([[0.0, 0.0]]), np.array([[0.5, 0.0], [0.5, 0.0], [0.0, 2.0]])
    other_covs = np.stack([cov, 9 * cov, cov])
    d2 = np.array([0.25 / 0.08, 0.25 / 0.4, 4 / 0.02])
    log_det = [0.0, np.log(5) - np.log(3), 0.0]
    bhattacharyya = d2 / 4 + np.array(log_det)
    gaussians = (
        hypotheses.UncertainPoints(points, cov[None]),
        hypotheses.UncertainPoints(others, other_covs),
    )
    for distance, by_hand in (("mahalanobis", d2), ("bhattacharyya", bhattacharyya)):
        for limit in (0.3, 0.7, 1.0, 4.0):
            near = CLOSER(distance, limit, *gaussians)
            np.testing.assert_array_equal(near[0], by_hand < limit)


# --- the filter ---------------------------------------------------------------------------------


def world(kind, steps=120, **options):
    """A robot that drives in a circle among five landmarks, all seen, with little noise."""
    landmarks = np.array([[4.0, 5.0], [-3.0, 4.0], [-2.0, 0.5], [5.0, -1.0], [0.5, 8.0]])
    sensor = CAMERA if kind == "rays" else BEACON
    return Scenario(
        name=f"five, {kind}",
        motion=motion.Increment(np.diag([0.005, 0.003]) ** 2),
        sensor=sensor,
        landmarks=landmarks,
        controls=np.tile([0.2, 0.08], (steps, 1)),
        pose=(0.0, 0.0, 0.0),
        **options,
    )


def go(filter, log):
    return jaxslam.run(filter, log, np.zeros(3), np.zeros((3, 3)), jax.random.key(0))


def driven(filter, log):
    return jax.jit(partial(go, filter))(log)


RUNS = 40


@pytest.fixture(scope="module", params=swept(KINDS, "rays"))
def many(request):
    """Of one kind, truths, logs and traces of all runs: one program for all tests."""
    scenario = world(request.param)
    filter = DelayedSlam(
        scenario.motion,
        scenario.sensor,
        5,
        stored=StoredMeasurements(capacity=30),
        hypotheses=Hypotheses(capacity=12),
    )

    @jax.jit
    @jax.vmap
    def one(key):
        truth, log = jaxslam.simulate(scenario, key)
        return truth, log, go(filter, log)

    # The worlds of a campaign of this key.
    keys = [jax.random.split(jax.random.fold_in(jax.random.key(5), i))[0] for i in range(RUNS)]
    return jax.device_get(one(jnp.stack(keys)))


@pytest.fixture(scope="module")
def drive(many):
    """One of the runs."""
    return jax.tree.map(lambda leaf: leaf[2], many)


def test_every_landmark_is_found_where_it_is(drive):
    truth, log, trace = drive
    final = trace.estimate
    assert final.alive[-1].all()
    assert sorted(np.asarray(final.tag[-1])) == [0, 1, 2, 3, 4]
    off = np.asarray(final.points[-1]) - np.asarray(truth.landmarks)[final.tag[-1]]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert trace.info.tally(Status.BORN).sum() == 5
    assert trace.final.counts.promoted == 5
    # Afterwards nothing is left of how they came about.
    joint = trace.final.joint
    assert not joint.alive[5:].any()
    np.testing.assert_array_equal(joint.cov[18:], np.eye(len(joint.cov))[18:])


def test_every_measurement_is_accounted_for(drive):
    truth, log, trace = drive
    counts = {s.name: int(trace.info.tally(s).sum()) for s in Status}
    assert sum(counts.values()) == log.scan.valid.size
    assert counts["SIGHTED"] > 10
    assert counts["FUSED"] > 300
    assert counts["EMPTY"] == counts["OVERFLOW"] == counts["SINGULAR"] == 0
    born = np.asarray(trace.info.status) == Status.BORN
    slot = np.asarray(trace.info.slot)[born]
    tag = np.asarray(log.scan.tag)[born]
    np.testing.assert_array_equal(np.asarray(trace.estimate.tag[-1])[slot], tag)


def test_the_covariance_stays_positive(drive):
    trace = drive[-1]
    cov = np.asarray(trace.final.joint.cov)
    np.testing.assert_allclose(cov, cov.T, atol=1e-12)
    assert np.linalg.eigvalsh(cov)[0] > 0


def test_the_filter_is_honest(many):
    truth, _, trace = many
    chex.assert_tree_all_finite(trace)
    found = judged(truth, trace.estimate, trace.info)
    assert found["error_landmarks"][0] < 0.2
    for name, dof in (("nees_pose", 3), ("nees_landmarks", 2), ("nis_per_dof", 1)):
        mean, low, high = found[name]
        assert low < 1.15 * dof, name
        assert high > 0.85 * dof, name
        assert mean < 1.5 * dof, name


@pytest.mark.sweep
def test_ranges_whose_noise_grows_leave_the_filter_honest():
    """σ of 3 mm and 5, 10 and 20 % of the range. Stored a metre apart: with so much noise, places
    that are closer determine no point, and with a constant σ of 25 cm neither."""
    shares, runs = np.array([0.05, 0.1, 0.2]), 16

    def of_run(share, key):
        scenario = dataclasses.replace(world("circles"), sensor=sensors.RangeOnly(Growing(share)))
        filter = DelayedSlam(
            scenario.motion,
            scenario.sensor,
            5,
            stored=StoredMeasurements(capacity=60, spacing=1.0),
            hypotheses=Hypotheses(capacity=12),
            promotion=Promotion(persistence=7.0),
        )
        trace = go(filter, jaxslam.simulate(scenario, key)[1])
        return trace.info.nis.sum(), trace.info.dof.sum(), trace.estimate.alive[-1].sum()

    over_runs = jax.vmap(jax.vmap(of_run, (None, 0)), (0, None))
    keys = jax.random.split(jax.random.key(7), runs)
    nis, dof, count = map(np.asarray, jax.jit(over_runs)(shares, keys))
    assert (count.mean(axis=1) > 1).all()
    off = nis.sum(axis=1) / dof.sum(axis=1) - 1
    assert (np.abs(off) < 3.5 * np.sqrt(2 / dof.sum(axis=1))).all()


SMALL = {
    "stored": StoredMeasurements(capacity=15),
    "hypotheses": Hypotheses(capacity=6),
    "promotion": Promotion(per_scan=1),
}


def small(kind, capacity=3):
    """A filter that compiles fast, and a short log of three landmarks."""
    scenario = world(kind, steps=60)
    scenario = dataclasses.replace(scenario, landmarks=scenario.landmarks[:3])
    return scenario, DelayedSlam(scenario.motion, scenario.sensor, capacity, **SMALL)


@pytest.fixture(scope="module")
def poor():
    """In float32 with room for two of three landmarks: the truth, and runs of the log as drawn, of
    random bearings, without a measurement, without names."""
    scenario, filter = small("rays", capacity=2)
    truth, log = draw(scenario, 0)
    z = np.random.default_rng(3).uniform(-np.pi, np.pi, log.scan.z.shape)
    spoiled = log._replace(scan=log.scan._replace(z=z))
    empty = log._replace(scan=log.scan._replace(valid=np.zeros_like(log.scan.valid)))
    logs = narrow([log, spoiled, empty, nameless(log)])
    return scenario, filter, logs, truth, [jax.device_get(go(filter, each)) for each in logs]


@pytest.mark.sweep
def test_a_full_map_refuses_and_says_so_in_float32_too(poor):
    truth, (trace, *_) = poor[-2:]
    chex.assert_tree_all_finite(trace)
    final = jax.tree.map(lambda x: x[-1], trace.estimate)
    off = final.points - truth.landmarks[final.tag]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    error = trace.estimate.pose - truth.pose
    assert np.abs(error[:, :2]).max() < 0.2
    assert np.abs(np.angle(np.exp(1j * error[:, 2]))).max() < 0.2
    assert final.alive.all()
    assert trace.info.tally(Status.BORN).sum() == trace.final.counts.promoted == 2
    assert trace.info.tally(Status.OVERFLOW).sum() > 0


@pytest.mark.sweep
def test_spurious_bearings_move_no_robot_and_empty_scans_neither(poor):
    """Random bearings make no landmark, so all is as without them."""
    scenario, filter, (_, _, empty, _), _, (_, *traces) = poor
    alone = go(DeadReckoning(scenario.motion, scenario.sensor), empty).estimate
    for trace in traces:
        assert not trace.estimate.alive.any()
        np.testing.assert_allclose(trace.estimate.pose, alone.pose, atol=1e-6)
        np.testing.assert_allclose(trace.estimate.pose_cov, alone.pose_cov, atol=1e-9)
    spoiled, nothing, unnamed = traces
    assert spoiled.final.counts.vanished > 5
    assert (nothing.info.status == Status.EMPTY).all()
    assert (unnamed.info.status == Status.UNMATCHED).all()  # no names, and none asked for

    none = empty._replace(scan=jax.tree.map(lambda x: x[:, :0], empty.scan))
    trace = jax.eval_shape(partial(go, filter), none)
    assert (trace.estimate.pose.shape, trace.info.status.shape) == ((60, 3), (60, 0))


@pytest.mark.sweep
def test_float32_stays_float32(poor):
    """Of bearings by runs of a full map, of ranges by their shapes alone."""
    scenario, filter = small("circles")
    ranges = jax.eval_shape(partial(go, filter), narrow(draw(scenario, 1)[1]))
    for leaf in jax.tree.leaves((ranges, poor[-1])):
        assert leaf.dtype == np.float32 or not jnp.issubdtype(leaf.dtype, jnp.floating)


@pytest.mark.sweep
def test_derivatives_reach_the_noise_and_are_finite():
    """Of the whole filter forward; in reverse it compiles for minutes, and its parts are below."""
    scenario, _ = small("circles")
    _, log = draw(scenario, 1)

    def likelihood(sigma):
        sensor = sensors.RangeOnly(sigma[None, None] ** 2)
        filter = DelayedSlam(scenario.motion, sensor, 3, **SMALL)
        trace = jaxslam.run(filter, log, np.zeros(3), np.zeros((3, 3)), jax.random.key(0))
        return trace.info.log_likelihood.sum()

    both = jax.jit(lambda sigma: jax.jvp(likelihood, (sigma,), (jnp.ones(()),)))
    at = jnp.asarray(0.05)
    by_differences = (both(at + 1e-6)[0] - both(at - 1e-6)[0]) / 2e-6
    np.testing.assert_allclose(both(at)[1], by_differences, rtol=1e-4)


@EACH_KIND
def test_in_reverse_intersections_and_residuals_are_as_forward(kind):
    model = KINDS[kind]

    def both(a, b):
        points = model.intersect(a, b)[0]
        return points, jnp.stack([model.residual(a, b[:2] + point) for point in points])

    @jax.jit
    def ways(a, b):
        return jax.jacrev(both, (0, 1))(a, b), jax.jacfwd(both, (0, 1))(a, b)

    reverse, forward = ways(*np.asarray(table(kind).landmarks[4:6]))
    chex.assert_trees_all_close(reverse, forward, rtol=1e-9, atol=1e-12)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(reverse))


@pytest.mark.sweep
def test_in_reverse_what_makes_a_landmark_is_as_forward():
    """A hypothesis formed and confirmed, a point fitted and entered, by means and covariances."""
    kind = "rays"
    joint, noise = noisy(kind, 0.01)
    which = closest_point(kind, joint.landmarks[4:6])
    stored, use = jnp.array([4, 5, 6, 7, 4]), jnp.arange(5) < 4
    of_rows = noise._replace(z=noise.z[stored - 4], by_z=noise.by_z[stored - 4])

    def loss(landmarks, cov):
        start = joint._replace(landmarks=landmarks, cov=cov)
        new = formed(kind, start, which)
        slots = jnp.array([2, 3])
        residuals = hypotheses.point_residuals(new, KINDS[kind], slots, jnp.array([6, 7]))
        part = residuals.value[:, 0], residuals.by_point[:, 0], residuals.by_stored[:, 0]
        newest = noise._replace(z=noise.z[2:], by_z=noise.by_z[2:])
        part = *part, jax.vmap(newest.change)(residuals.value)[:, 0]
        constraint = confirmation.constraints_of(new, slots, jnp.array([6, 6]), *part)
        corrected = confirmation.correct_hypotheses(
            new, LAYOUT, constraint, jnp.array([True, False])
        )
        estimate = initialization.initial_estimate(
            start, KINDS[kind], of_rows, jnp.array([1.1, 5.1]), stored, use
        )
        entered = initialization.add_landmark(start, estimate, jnp.asarray(1), stored)
        parts = [(x.landmarks**2).sum() + (x.cov**2).sum() for x in (corrected, entered)]
        return sum(parts) + estimate.nis

    at = joint.landmarks, joint.cov
    rng = np.random.default_rng(0)
    along = tuple(rng.normal(size=x.shape) for x in at)

    @jax.jit
    def ways(at, along):
        return jax.grad(loss, argnums=(0, 1))(*at), jax.jvp(loss, at, along)[1]

    gradient, forward = ways(at, along)
    chex.assert_tree_all_finite(gradient)
    assert all(part.any() for part in gradient)
    reverse = sum((part * way).sum() for part, way in zip(gradient, along, strict=True))
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


@pytest.mark.sweep
def test_without_names_intersections_find_the_landmarks():
    """Every bearing may be of any landmark; the names in the log are not looked at."""
    scenario = world("rays")
    filter = DelayedSlam(
        scenario.motion,
        scenario.sensor,
        8,
        stored=StoredMeasurements(capacity=40),
        hypotheses=Hypotheses(capacity=40, decay=0.7),
        promotion=Promotion(persistence=6.0),
        associate=Nearest(0.99, 0.9999),
    )
    truth, log = draw(scenario, 4)
    final = jax.tree.map(lambda x: np.asarray(x[-1]), driven(filter, nameless(log)).estimate)
    off = np.linalg.norm(final.points[:, None] - np.asarray(truth.landmarks)[None], axis=2)
    assert (off[final.alive].min(axis=1) < 0.5).all()  # none is false
    assert len(set(off[final.alive].argmin(axis=1))) >= 4
    assert final.alive.sum() <= 6


@refused(
    (lambda: slam(sensors.RangeBearing(np.eye(2))), "one bearing or one range"),
    (lambda: slam(capacity=0), "DelayedSlam: capacity"),
    (lambda: slam(gate=0), "DelayedSlam: gate: expected a probability above 0 and below 1"),
    (lambda: slam(triangulation=3), "DelayedSlam: triangulation: expected a Triangulation"),
    (lambda: slam(triangulation=triangulation.Rays), "got the class Rays: call it"),
    (lambda: slam(stored=32), "DelayedSlam: stored: expected StoredMeasurements, got 32"),
    (lambda: slam(hypotheses=16), "DelayedSlam: hypotheses: expected Hypotheses, got 16"),
    (lambda: slam(promotion=2), "DelayedSlam: promotion: expected a Promotion, got 2"),
    (lambda: slam(BEACON, triangulation=triangulation.Rays()), "one bearing"),
    (lambda: slam(triangulation=triangulation.Circles()), "one range"),
    (
        lambda: triangulation.Rays(parallax=2.0),
        r"^Rays: parallax: expected an angle in \(0, π/2\), got 2\.0",
    ),
    (
        lambda: triangulation.Circles(angle=0.0),
        r"^Circles: angle: expected an angle in \(0, π/2\), got 0\.0",
    ),
    (lambda: StoredMeasurements(capacity=0), "^StoredMeasurements: capacity"),
    (
        lambda: StoredMeasurements(spacing=-0.1),
        "^StoredMeasurements: spacing: expected a finite number >= 0",
    ),
    (lambda: Hypotheses(capacity=0), "^Hypotheses: capacity"),
    (lambda: Hypotheses(patience=0.5), "^Hypotheses: patience"),
    (lambda: Hypotheses(decay=-1), "^Hypotheses: decay: expected a finite number >= 0"),
    (lambda: Hypotheses(spread=np.nan), "^Hypotheses: spread: expected a number above 0"),
    (lambda: Hypotheses(same=0), "^Hypotheses: same: expected a number above 0"),
    (lambda: Hypotheses(distance="euclid"), "^Hypotheses: distance: expected .*, got 'euclid'"),
    (lambda: Promotion(per_scan=1.5), "^Promotion: per_scan"),
    (lambda: Promotion(persistence=0), "^Promotion: persistence: expected a number above 0"),
    (lambda: Promotion(lead=-1), "^Promotion: lead: expected a finite number >= 0"),
)
def test_bad_arguments_are_refused(make):
    make()


def slam(sensor=CAMERA, capacity=3, **options):
    return DelayedSlam(motion.Increment(np.eye(2)), sensor, capacity, **options)
