"""Rays that converted to points: the same map in fewer parameters, and the same filter from then on."""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from own_models import changed

from jaxslam import charts, motion, run, sensors, slots
from jaxslam.charts import RightInvariant
from jaxslam.core.protocols import Basis
from jaxslam.core.types import Log, Scan, Status
from jaxslam.filters import CompressedEkfSlam, EkfSlam
from jaxslam.filters._ekf.map_coordinates import reduce, reduce_where_ready, reduction
from jaxslam.linearize import Unscented

MOTION = motion.Increment(np.diag([0.02, 0.02]) ** 2)
NOISE = np.array([[0.01**2]])
POINTS = np.array([[4.0, 2.0], [3.0, -3.0], [7.0, 4.0]])


def camera(**options):
    return sensors.BearingInverseDepth(NOISE, min_distance=1.0, **options)


SENSOR = camera(to_point=0.1)
REDUCE = jax.jit(reduce, static_argnums=(2, 3))
READY = jax.jit(lambda *arguments: reduce_where_ready(*arguments)[1], static_argnums=(1, 2))


@cache
def a_log(steps=40, seed=0, dtype=np.float64):
    """A robot on a bend that sees the direction of POINTS."""
    rng = np.random.default_rng(seed)
    sensor, pose, rows = sensors.BearingOnly(NOISE, free=((1.0,), ((1.0,),))), np.zeros(3), []
    move, see = jax.jit(MOTION.step), jax.jit(jax.vmap(sensor.observe, (None, 0)))
    for _ in range(steps):
        pose = np.asarray(move(pose, np.array([0.2, 0.05]), rng.normal(size=2) * 0.02))
        z = np.asarray(see(pose, POINTS))
        rows.append(z + 0.01 * rng.normal(size=z.shape))
    tag = np.tile(np.arange(3, dtype=np.int32), (steps, 1))
    control = np.tile([0.2, 0.05], (steps, 1)).astype(dtype)
    return Log(control, Scan(np.array(rows, dtype), tag, np.ones((steps, 3), bool)))


def driven(filter, log, **options):
    dtype = log.control.dtype
    start = np.zeros(3, dtype), np.zeros((3, 3), dtype), jax.random.key(0)
    return run(filter, log, *start, **options)


CHARTS = {"euclidean": charts.Euclidean, "right_invariant": lambda: RightInvariant(rays=True)}


FORMS = pytest.mark.parametrize(
    ("name", "square_root"),
    swept([("euclidean", False), ("right_invariant", True)], ("euclidean", False)),
)


def state_of(joint):
    return joint


@cache
def traced(name, square_root, to_point):
    """A run whose probe is the state after every step; one program for every `to_point`."""
    covariance = "square_root" if square_root else "plain"
    options = {"chart": CHARTS[name](), "covariance": covariance}
    filter = EkfSlam(MOTION, camera(to_point=to_point), 4, **options)
    return jax.device_get(driven(filter, a_log(), probe=state_of)._replace(final=()))


@cache
def joint_of(name="euclidean", square_root=False):
    """The state of a filter on rays after 15 steps, with room for points."""
    states = traced(name, square_root, 1e-9).probe
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[14]), states)


@FORMS
def test_the_covariance_goes_through_the_derivative_of_position(name, square_root):
    joint = joint_of(name, square_root)
    which = np.array([True, False, True, False])
    less = jax.device_get(REDUCE(joint, which, SENSOR, square_root))
    slope = np.asarray(slope_of(name)(joint.pose, joint.landmarks, which))
    joint = jax.device_get(joint)
    full = joint.cov @ joint.cov.T if square_root else joint.cov
    expected = slope @ full @ slope.T
    freed = [3 + 4 * slot + k for slot in (0, 2) for k in (2, 3)]
    expected[freed, freed] = 1.0
    actual = less.cov @ less.cov.T if square_root else less.cov
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(less.landmarks[0, :2], SENSOR.position(joint.landmarks[0]))
    np.testing.assert_array_equal(less.landmarks[0, 2:], [0, 0])
    np.testing.assert_array_equal(less.landmarks[1], joint.landmarks[1])
    np.testing.assert_array_equal(less.reduced, which)
    transition = reduction(joint, which, SENSOR).times(np.eye(19))
    np.testing.assert_allclose(transition, slope, rtol=1e-9, atol=1e-9)


@cache
def slope_of(name):
    """Brute force: retract by all errors, take positions, ask the chart of points for theirs."""
    chart, of_points = CHARTS[name](), charts.REGISTRY[name]()

    def errors(xi, pose, landmarks, which):
        rows = xi[3:].reshape(4, 4)
        own, moved = jax.vmap(chart.retract, (None, 0, None, 0))(pose, landmarks, xi[:3], rows)
        points, points0 = jax.vmap(SENSOR.position)(moved), jax.vmap(SENSOR.position)(landmarks)
        dx, dl = jax.vmap(of_points.local, (None, 0, None, 0))(pose, points0, own[0], points)
        rows = jnp.where(which[:, None], jnp.pad(dl, [(0, 0), (0, 2)]), rows)
        return jnp.concatenate([dx[0], rows.reshape(-1)])

    return jax.jit(lambda *at: jax.jacfwd(errors)(jnp.zeros(19), *at))


@FORMS
def test_nothing_to_reduce_changes_nothing(name, square_root):
    joint = joint_of(name, square_root)
    same = REDUCE(joint, np.zeros(4, bool), SENSOR, square_root)
    chex.assert_trees_all_equal(same, joint)


@pytest.mark.sweep
@pytest.mark.parametrize("options", [{}, {"linearize": Unscented(), "correction": "joint"}])
def test_a_reduced_map_is_filtered_as_one_of_points(options):
    """From the moment of conversion on, the filter on 4-vectors is that on points (x, y)."""
    log = a_log()
    start = jax.device_get(REDUCE(joint_of(), np.array([1, 1, 1, 0], bool), SENSOR, False))
    keep = np.r_[0:3, np.arange(3, 19).reshape(4, 4)[:, :2].reshape(-1)]
    point = slots.Joint(
        start.pose,
        start.landmarks[:, :2],
        start.cov[np.ix_(keep, keep)],
        start.alive,
        start.tag,
        start.lin,
    )
    of_points = sensors.BearingOnly(NOISE, free=((1.0,), ((1.0,),)))
    finals = []
    for state, model in ((start, SENSOR), (point, of_points)):
        filter = EkfSlam(MOTION, model, 4, **options)

        @jax.jit
        def step(state, row, filter=filter):
            state = filter.predict(state, row.control, jax.random.key(0))
            state, info = filter.update(state, row.scan, jax.random.key(0))
            return state, info, filter.estimate(state)

        for t in range(15, 25):
            found = step(state, jax.tree.map(lambda leaf, t=t: leaf[t], log))
            state = found[0]
        finals.append(jax.device_get(found))
    (wide, info, estimate), (narrow, plain, expected) = finals
    # Sigma points of 7 variables are not those of 5.
    near = {"rtol": 1e-5, "atol": 1e-8} if "linearize" in options else {"rtol": 1e-8, "atol": 1e-12}
    np.testing.assert_allclose(wide.pose, narrow.pose, **near)
    np.testing.assert_allclose(wide.cov[np.ix_(keep, keep)], narrow.cov, **near)
    for name in ("pose_cov", "points", "point_covs"):
        a, b = getattr(estimate, name), getattr(expected, name)
        np.testing.assert_allclose(a[:3], b[:3], **near)
    np.testing.assert_allclose(info.nis, plain.nis, rtol=10 * near["rtol"])
    # What was freed stays inert.
    rest = np.setdiff1d(np.arange(19), keep)
    np.testing.assert_array_equal(wide.cov[np.ix_(rest, rest)], np.eye(len(rest)))
    np.testing.assert_array_equal(wide.cov[np.ix_(rest, keep)], 0)


@FORMS
def test_a_run_turns_rays_into_points_where_the_index_allows(name, square_root):
    trace = traced(name, square_root, 0.1)
    became = trace.info.extra["points"].reduced
    assert became.sum() >= 2
    assert became.sum(axis=0).max() == 1  # once a slot
    np.testing.assert_array_equal(became.any(axis=0), trace.probe.reduced[-1])
    assert (trace.info.status != Status.REJECTED).all()
    last = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    off = np.linalg.norm(last.points[:3] - POINTS, axis=1)
    spread = np.sqrt(np.trace(last.point_covs[:3], axis1=1, axis2=2))
    assert (off < 3 * spread).all(), (off, spread)
    # A conversion is no news: estimates go on where they would have.
    never = traced(name, square_root, 1e-9)
    assert not never.info.extra["points"].reduced.any()
    np.testing.assert_allclose(trace.estimate.pose, never.estimate.pose, atol=0.02)


def index_of(pose, landmark, sigma):
    """Civera, Davison & Montiel's L_d, from their picture."""
    direction = np.array([np.cos(landmark[2]), np.sin(landmark[2])])
    point = landmark[:2] + direction / landmark[3]
    sight = point - pose[:2]
    distance = np.linalg.norm(sight)
    return 4 * sigma / landmark[3] ** 2 / distance * abs(sight @ direction) / distance


def test_the_index_is_that_of_the_paper():
    rng = np.random.default_rng(2)
    for _ in range(20):
        pose = rng.normal(size=3)
        landmark = np.array([*rng.normal(size=2), rng.uniform(-3, 3), rng.uniform(0.05, 1)])
        sigma = rng.uniform(0.001, 0.1)
        cov = np.diag([1.0, 2.0, 3.0, sigma**2])
        index = index_of(pose, landmark, sigma)
        for factor, expected in ((1.001, True), (0.999, False)):
            yes = camera(to_point=float(index * factor)).reduced.ready(pose, landmark, cov)
            assert bool(yes) == expected


def test_rays_to_infinity_and_beyond_stay_rays():
    known = np.diag([1e-6, 1e-6, 1e-6, 1e-12])
    test = camera(to_point=10.0).reduced.ready
    for inverse in (0.0, -0.1):
        assert not test(np.zeros(3), np.array([0.0, 0.0, 0.3, inverse]), known)
    # … and a robot that stands at the landmark has no index.
    assert not test(np.array([2.0, 0, 0]), np.array([0.0, 0, 0, 0.5]), known)


def test_dead_and_reduced_slots_are_not_ready():
    sensor = camera(to_point=1e6)
    joint = joint_of()
    np.testing.assert_array_equal(READY(joint, sensor, False), [True, True, True, False])
    less = REDUCE(joint, np.array([True, False, False, False]), SENSOR, False)
    np.testing.assert_array_equal(READY(less, sensor, False), [False, True, True, False])
    gone = slots.remove(less, jnp.array([True, False, False, False]))
    assert not gone.reduced.any()


@pytest.mark.sweep
def test_gradients_and_float32():
    log = a_log(12, dtype=np.float32)

    def last(sigma):
        sensor = sensors.BearingInverseDepth(sigma[None, None] ** 2, to_point=1.0)
        trace = driven(EkfSlam(MOTION, sensor, 3), log)
        return trace.estimate.pose[-1].sum() + trace.estimate.points.sum(), trace

    (_, trace), slope = jax.jit(jax.value_and_grad(last, has_aux=True))(jnp.float32(0.01))
    assert np.isfinite(slope) and slope != 0
    assert trace.final.cov.dtype == jnp.float32
    assert trace.info.extra["points"].reduced.any()


TURNING = changed(
    RightInvariant(rays=True), basis=lambda x, y: Basis(jnp.eye(3), y[:, None], jnp.eye(4))
)
POINT_SENSOR = sensors.RangeBearing(np.eye(2))


@refused(
    (lambda: camera(to_point=0.0), "to_point: expected a number above 0"),
    (lambda: EkfSlam(MOTION, SENSOR, 4, chart=TURNING), "turn with the robot"),
    (
        lambda: EkfSlam(MOTION, camera(), 4, chart=RightInvariant()),
        "does not act on the 4-parameter",
    ),
    (
        lambda: EkfSlam(MOTION, POINT_SENSOR, 4, chart=RightInvariant(rays=True)),
        "does not act on the 2-parameter",
    ),
    (lambda: CompressedEkfSlam(EkfSlam(MOTION, SENSOR, 8), area=4), "converted to points"),
)
def test_refusals(make):
    make()
