"""The smoother and the batch solution against dense least squares, SciPy, and a plain NumPy RTS."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from cases import swept
from own_models import motion_of, sensor_of
from reference import ekf_slam as plain
from reference.plane import compose
from worlds import ring

from jaxslam import filters, motion, run, sensors, simulate
from jaxslam.core.protocols import Free
from jaxslam.core.types import Log, Scan, Status
from jaxslam.graphs import Ending
from jaxslam.graphs.smoothing import BatchMap, Smoother
from jaxslam.math.stats import chi2_band

KEY = jax.random.key(0)


def arguments(world):
    return world.motion, world.sensor, len(world.landmarks), world.pose, world.pose_cov


def by_tag(trace, count):
    """Landmarks (count, L) in the order of tags, from the final joint."""
    joint = trace.final.joint
    order = [int(np.flatnonzero(np.asarray(joint.tag) == i)[0]) for i in range(count)]
    return np.asarray(joint.landmarks)[order], order


# --- a linear world -----------------------------------------------------------------------------

F = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, -0.2], [0.0, 0.0, 1.0]])
W = np.array([[1.0, 0.2], [0.5, -0.3], [0.0, 0.1]])
H = np.array([[-1.0, 0.0, 0.4], [0.0, -1.0, 0.7]])
Q = np.array([[0.04, 0.01], [0.01, 0.02]])
R = np.array([[0.02, 0.005], [0.005, 0.03]])
P0 = np.diag([0.1, 0.0, 0.002])  # one coordinate is known exactly
MARK = 5.0  # a measurement predicted beyond claims to be exact
FAR = 6  # the only step from which one is


@cache
def linear_world():
    """Affine models; two noises for three coordinates; landmarks that come into view late."""
    moves = motion_of(
        name="linear",
        controls=("a", "b", "c"),
        noises=("v", "w"),
        step=lambda pose, u, w: (
            jnp.asarray(F, pose.dtype) @ pose + u + jnp.asarray(W, pose.dtype) @ w
        ),
        noise_cov=lambda pose, u: jnp.asarray(Q, pose.dtype),
    )
    sees = sensor_of(
        name="linear",
        measurements=("p", "q"),
        landmark=("x [m]", "y [m]"),
        observe=lambda pose, landmark: jnp.asarray(H, pose.dtype) @ pose + landmark,
        residual=lambda z, z_hat: z - z_hat,
        noise_cov=lambda z: jnp.asarray(R, z.dtype) * (z[0] < MARK),
        invert=lambda pose, z, s: z - jnp.asarray(H, z.dtype) @ pose,
        position=lambda landmark: landmark,
        embed=lambda pose, point: point,
        free=Free(jnp.zeros(0), jnp.zeros((0, 0))),
    )
    return moves, sees


def linear_log(steps=9, count=3, seed=0):
    rng = np.random.default_rng(seed)
    control = 0.1 * rng.normal(size=(steps, 3))
    z = rng.normal(size=(steps, count, 2))
    valid = rng.uniform(size=(steps, count)) < 0.6
    valid[0, 1:] = False
    valid[3:5, 2] = [False, True]
    valid[:3, 2] = False
    valid[FAR] = [True, False, False]
    control[FAR, 0], control[FAR + 1, 0] = -2 * MARK, 2 * MARK
    z[FAR, 0, 0] += 2 * MARK
    tag = np.broadcast_to(np.arange(count, dtype=np.int32), valid.shape)
    return Log(control, Scan(z, np.where(valid, tag, -1), valid))


def regular(log):
    """Which measurements have a noise that is not singular."""
    return log.scan.valid & (np.arange(len(log.control)) != FAR)[:, None]


def dense_linear(log, pose):
    """Mean and covariance of all poses (T+1, 3) and landmarks, by one dense least-squares problem
    in the noises and the map."""
    steps, count = log.scan.valid.shape
    root0, root = np.linalg.cholesky(P0 + 1e-300 * np.eye(3)), np.linalg.cholesky(Q)
    root0[1, 1] = 0.0
    size = 3 + 2 * steps + 2 * count
    poses, offsets = [np.zeros((3, size))], [np.asarray(pose, float)]
    poses[0][:, :3] = root0
    for t in range(steps):
        moved = F @ poses[-1]
        moved[:, 3 + 2 * t : 5 + 2 * t] += W @ root
        poses.append(moved)
        offsets.append(F @ offsets[-1] + log.control[t])
    rows, right = [np.eye(3 + 2 * steps, size)], [np.zeros(3 + 2 * steps)]
    white = np.linalg.inv(np.linalg.cholesky(R))
    for t, i in zip(*np.nonzero(regular(log)), strict=True):
        row = H @ poses[t + 1]
        row[:, 3 + 2 * steps + 2 * i : 5 + 2 * steps + 2 * i] += np.eye(2)
        rows.append(white @ row)
        right.append(white @ (log.scan.z[t, i] - H @ offsets[t + 1]))
    a, b = np.concatenate(rows), np.concatenate(right)
    cov = np.linalg.inv(a.T @ a)
    best = cov @ a.T @ b
    path = np.array([p @ best + o for p, o in zip(poses, offsets, strict=True)])
    covs = np.array([p @ cov @ p.T for p in poses])
    return (
        path,
        covs,
        best[-2 * count :].reshape(count, 2),
        cov[-2 * count :, -2 * count :],
        (0.5 * ((a @ best - b) ** 2).sum()),
    )


@cache
def solve_linear(kind):
    """The linear log in a dtype, and its batch solution; in float64 with a loop of fixed length."""
    log = jax.tree.map(lambda a: a.astype(kind) if a.dtype == float else a, linear_log())
    return log, jax.device_get(jax.jit(lambda pose: solution(log, pose))(jnp.asarray(START, kind)))


def solution(log, pose):
    options = {"iterations": 2, "tolerance": None} if pose.dtype == np.float64 else {}
    return BatchMap(*linear_world(), 4, pose, P0, **options)(log, KEY)


START = (0.3, -0.2, 0.1)


@pytest.mark.parametrize(
    ("kind", "close"), swept([(np.float64, 1e-9), (np.float32, 3e-4)], (np.float64, 1e-9))
)
def test_a_linear_log_is_dense_least_squares(kind, close):
    path, covs, landmarks, map_cov, cost = dense_linear(linear_log(), START)
    trace = solve_linear(kind)[1]
    by_tags, order = by_tag(trace, 3)
    for actual, wanted in (
        (trace.estimate.pose, path[1:]),
        (trace.estimate.pose_cov, covs[1:]),
        (trace.final.start, path[0]),
        (trace.final.start_cov, covs[0]),
        (by_tags, landmarks),
    ):
        assert actual.dtype == kind
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=close)
    at = 3 + 2 * np.repeat(order, 2) + np.tile([0, 1], 3)
    np.testing.assert_allclose(trace.final.joint.cov[np.ix_(at, at)], map_cov, rtol=0, atol=close)
    np.testing.assert_allclose(trace.final.cost, cost, rtol=close)
    assert bool(trace.final.regular)
    if kind == np.float32:
        assert trace.final.ending == Ending.CONVERGED
    else:
        assert trace.final.ending == Ending.EXHAUSTED
        assert np.ptp(trace.final.costs) < 1e-12 * cost  # Gauss-Newton is exact: one step did it
        assert trace.final.step < 1e-10


def test_measurements_of_singular_noise_are_left_out_and_counted():
    log, trace = solve_linear(np.float64)
    status = trace.info.status
    np.testing.assert_array_equal(np.argwhere(status == Status.SINGULAR), [[FAR, 0]])
    used = (status == Status.FUSED) | (status == Status.BORN)
    np.testing.assert_array_equal(used, regular(log))
    np.testing.assert_array_equal(trace.info.slot >= 0, used)
    np.testing.assert_array_equal(trace.info.dof > 0, status == Status.FUSED)
    assert trace.info.nis[FAR, 0] == 0


@pytest.mark.sweep
def test_it_can_be_differentiated():
    """By the mean of the start, in reverse, through a loop of fixed length."""
    log = linear_log()
    last = jax.grad(lambda pose: solution(log, pose).estimate.pose[-1, 0])
    slope = jax.jit(last)(jnp.asarray(START))
    wanted = slopes(lambda pose: dense_linear(log, pose)[0][-1, 0][None], np.asarray(START))[0]
    np.testing.assert_allclose(slope, wanted, rtol=0, atol=1e-7)


def slopes(function, at, step=1e-6):
    """Central differences (…, n), angles being far from their seam."""
    columns = []
    for i in range(len(at)):
        shift = step * (np.arange(len(at)) == i)
        columns.append((function(at + shift) - function(at - shift)) / (2 * step))
    return np.stack(columns, axis=-1)


# --- the smoother -------------------------------------------------------------------------------


def steady_ring(steps=12):
    """All six landmarks at every step, a start that is uncertain in every direction, and a noise
    that grows with the range."""
    return dataclasses.replace(
        ring(steps),
        sensor=sensors.RangeBearing(sensors.RangeBearingNoise(0.03, 0.02, share=0.1)),
        pose_cov=np.diag([0.02, 0.03, 0.01]) ** 2,
    )


@cache
def drawn(make, steps, seed=4):
    world = make(steps)
    truth, log = jax.device_get(simulate(world, jax.random.key(seed)))
    return world, truth, log


def test_it_is_the_rauch_tung_striebel_smoother():
    """The recursion as in the textbook, on dense covariances of a filter written in NumPy."""
    world, _, log = drawn(steady_ring, 12)
    scans = [list(enumerate(z)) for z in log.scan.z]
    q = np.diag([0.01, 0.01]) ** 2
    kept = list(
        plain.run(
            world.pose,
            world.pose_cov,
            log.control,
            scans,
            motion=plain.increment,
            observe=plain.range_bearing,
            invert=plain.range_bearing_inverse,
            Q=q,
            R=lambda z: np.diag([0.03**2 + (0.1 * z[0]) ** 2, 0.02**2]),
            bearing=1,
            joint=True,
        )
    )
    means, covs = [x for x, _, _ in kept], [p for _, p, _ in kept]
    x, p = means[-1], covs[-1]
    path, path_covs = [x], [p]
    for t in range(len(means) - 2, -1, -1):
        ahead, by_pose, by_noise = plain.increment(means[t][:3], log.control[t + 1])
        step = np.eye(len(x))
        step[:3, :3] = by_pose
        predicted = step @ covs[t] @ step.T
        predicted[:3, :3] += by_noise @ q @ by_noise.T
        gain = covs[t] @ step.T @ np.linalg.inv(predicted)
        off = x - np.concatenate([ahead, means[t][3:]])
        off[2] = plain.wrap(off[2])
        x = means[t] + gain @ off
        p = covs[t] + gain @ (p - predicted) @ gain.T
        path.append(x)
        path_covs.append(p)
    path, path_covs = np.array(path[::-1]), np.array(path_covs[::-1])
    trace = jax.jit(Smoother(*arguments(world)))(log, KEY)
    np.testing.assert_allclose(trace.estimate.pose, path[:, :3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(trace.estimate.pose_cov, path_covs[:, :3, :3], rtol=0, atol=1e-9)


def late_ring(steps=14, **other):
    """Landmarks come into view one by one; the start is known."""
    return dataclasses.replace(
        ring(steps),
        **other,
        visible=lambda pose, point: ((point - pose[:2]) ** 2).sum() < 3.0**2,
        places=4,
    )


def camera_ring(steps=14):
    """`ring` seen by a camera, with a prior of the range."""
    camera = sensors.BearingOnly(np.array([[0.02**2]]), free=(np.array([3.0]), np.array([[1.0]])))
    return dataclasses.replace(ring(steps), sensor=camera)


def fixed_ring(steps=14):
    """`ring` with a satellite receiver, and no landmark."""
    receiver = sensors.PositionFix(0.1**2 * np.eye(2))
    return dataclasses.replace(ring(steps), sensor=receiver, landmarks=np.zeros((1, 0)))


@pytest.mark.parametrize(
    ("make", "options"),
    swept([(camera_ring, {"gate": 0.6, "births": 1}), (fixed_ring, {})], (fixed_ring, {})),
)
def test_it_ends_where_the_filter_ends(make, options):
    """The last pose and the map, with all covariances: births, gates and priors as the filter has
    them; and no pose is known worse than before the rest of the log came."""
    world = make()
    _, log = simulate(world, jax.random.key(6))
    size = len(world.landmarks)
    ekf = filters.EkfSlam(world.motion, world.sensor, size, correction="joint", **options)

    @jax.jit
    def both(log):
        wanted = run(ekf, log, world.pose, world.pose_cov, KEY)
        return wanted, Smoother(*arguments(world), **options)(log, KEY)

    wanted, trace = jax.device_get(both(log))
    joint, final = trace.final.joint, wanted.final
    np.testing.assert_allclose(joint.pose, final.pose, rtol=0, atol=1e-9)
    np.testing.assert_allclose(joint.landmarks, final.landmarks, rtol=0, atol=1e-8)
    np.testing.assert_allclose(joint.cov, final.cov, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(joint.tag, final.tag)
    np.testing.assert_array_equal(trace.info.status, wanted.info.status)
    if options:
        assert {Status.BORN, Status.REJECTED, Status.DEFERRED} <= set(wanted.info.status.ravel())
    less = wanted.estimate.pose_cov - trace.estimate.pose_cov
    assert np.linalg.eigvalsh(less).min() > -1e-12
    assert np.linalg.eigvalsh(less[len(less) // 2]).max() > 1e-6
    assert not np.ptp(trace.estimate.points, axis=0).any()


# --- the batch solution -------------------------------------------------------------------------

SIGMA_W, SIGMA_Z = np.array([0.03, 0.02, 0.02]), np.array([0.05, 0.02])


def step_ring(steps=10):
    """`late_ring` with noise in all three coordinates of a motion, as GTSAM needs it."""
    return late_ring(
        steps,
        motion=motion.PoseIncrement(np.diag(SIGMA_W) ** 2),
        sensor=sensors.RangeBearing(np.diag(SIGMA_Z) ** 2),
        controls=np.tile([0.6, 0.0, 0.4], (steps, 1)),
    )


def residuals(unknowns, log, world):
    """All whitened residuals in the noises and the map, in NumPy; and the path they make."""
    steps, count = len(log.control), len(world.landmarks)
    noise = unknowns[: 3 * steps].reshape(steps, 3)
    landmarks = unknowns[3 * steps :].reshape(count, 2)
    pose, path, out = np.asarray(world.pose, float), [], [noise.ravel()]
    for t in range(steps):
        pose = compose(pose, log.control[t] + SIGMA_W * noise[t])
        path.append(pose)
        for z, tag, there in zip(log.scan.z[t], log.scan.tag[t], log.scan.valid[t], strict=True):
            if there:
                off = z - plain.range_bearing(pose, landmarks[tag])[0]
                out.append(np.array([off[0], plain.wrap(off[1])]) / SIGMA_Z)
    return np.concatenate(out), np.array(path)


RUNS, STEPS = 40, 10


@cache
def many():
    """Truths, logs, and traces of smoother and batch on the same draws of `step_ring`, by vmap."""
    world = step_ring(STEPS)
    smoother, batch = Smoother(*arguments(world)), BatchMap(*arguments(world), tolerance=1e-9)

    @jax.jit
    @jax.vmap
    def one(key):
        truth, log = simulate(world, key)
        return truth, log, {"smooth": smoother(log, KEY), "batch": batch(log, KEY)}

    return jax.device_get(one(jax.random.split(jax.random.key(1), RUNS)))


@cache
def solved():
    """One of the batch solutions of `step_ring`, and its unknowns as `residuals` has them."""
    world = step_ring(STEPS)
    _, log, trace = jax.tree.map(lambda leaf: leaf[7], many())
    landmarks, order = by_tag(trace["batch"], 6)
    unknowns = np.concatenate([trace["batch"].final.noise.ravel(), landmarks.ravel()])
    return world, log, trace["batch"], unknowns, order


@pytest.mark.sweep
def test_the_batch_is_scipys_optimum():
    world, log, trace, unknowns, _ = solved()
    start = np.concatenate([np.zeros(30), np.asarray(world.landmarks).ravel()])

    def weighted(x):
        return residuals(x, log, world)[0]

    fit = scipy.optimize.least_squares(
        weighted, start, "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    best = fit.x
    # SciPy ends where the cost rounds, some 1e-8 σ away: the rest by Gauss-Newton, which looks at
    # the slope alone.
    for _ in range(3):
        best = best - np.linalg.lstsq(slopes(weighted, best), weighted(best), rcond=None)[0]
    # In standard deviations, as far as difference quotients go.
    np.testing.assert_allclose(best, fit.x, rtol=0, atol=1e-6)
    np.testing.assert_allclose(unknowns, best, rtol=0, atol=1e-7)
    np.testing.assert_allclose(trace.final.cost, fit.cost, rtol=1e-12)
    path = residuals(best, log, world)[1]
    np.testing.assert_allclose(trace.estimate.pose, path, rtol=0, atol=1e-8)
    assert trace.final.ending == Ending.CONVERGED
    assert trace.final.step < 2e-8


@pytest.mark.sweep
def test_its_gradient_is_zero_and_its_covariance_that_of_the_problem():
    world, log, trace, unknowns, order = solved()
    off, path = residuals(unknowns, log, world)
    jacobian = slopes(lambda x: residuals(x, log, world)[0], unknowns)
    assert np.abs(jacobian.T @ off).max() < 1e-7 * np.abs(jacobian).max()
    np.testing.assert_allclose(trace.estimate.pose, path, rtol=0, atol=1e-12)
    cov = np.linalg.inv(jacobian.T @ jacobian)
    by_unknown = slopes(lambda x: residuals(x, log, world)[1].ravel(), unknowns)
    whole = (by_unknown @ cov @ by_unknown.T).reshape(10, 3, 10, 3)
    each = whole[np.arange(10), :, np.arange(10)]
    np.testing.assert_allclose(trace.estimate.pose_cov, each, rtol=0, atol=1e-7 * each.max())
    at = 3 + 2 * np.repeat(order, 2) + np.tile([0, 1], 6)
    mine = trace.final.joint.cov[np.ix_(at, at)]
    np.testing.assert_allclose(mine, cov[30:, 30:], rtol=0, atol=1e-7 * mine.max())


@pytest.mark.sweep
def test_costs_fall():
    _, _, trace, _, _ = solved()
    costs = trace.final.costs
    assert (np.diff(costs) <= 1e-12 * costs[0]).all()
    assert costs[-1] == trace.final.cost < costs[0]


# --- many worlds --------------------------------------------------------------------------------


def pose_errors(truth, estimate):
    error = truth.pose - estimate.pose
    error[..., 2] = plain.wrap(error[..., 2])
    return error


@pytest.mark.sweep
def test_smoothed_is_better_than_filtered():
    truth, _, traces = many()
    estimates = {name: trace.estimate for name, trace in traces.items()}
    estimates["ekf"] = traces["smooth"].final.filtered
    square = {
        name: (pose_errors(truth, estimate) ** 2).mean(axis=(0, 1))
        for name, estimate in estimates.items()
    }
    for name in ("smooth", "batch"):
        assert square[name][:2].sum() < square["ekf"][:2].sum()
        assert square[name][2] < square["ekf"][2]
    less = estimates["ekf"].pose_cov - traces["smooth"].estimate.pose_cov
    assert np.linalg.eigvalsh(less).min() > -1e-12


@pytest.mark.sweep
@pytest.mark.parametrize("name", ["smooth", "batch"])
@pytest.mark.parametrize("step", [2, STEPS // 2, STEPS - 1])
def test_smoothed_is_honest(name, step):
    truth, _, traces = many()
    error = pose_errors(truth, traces[name].estimate)[:, step]
    cov = traces[name].estimate.pose_cov[:, step]
    nees = np.einsum("ri,rij,rj->r", error, np.linalg.inv(cov), error).mean()
    low, high = chi2_band(3, RUNS, 0.9999)
    assert low < nees < high


@pytest.mark.sweep
def test_a_batch_of_runs_ends_where_each_does():
    *_, traces = many()
    filtered = traces["smooth"].final.filtered
    smoothed = traces["smooth"].estimate
    for name in ("pose", "pose_cov", "points", "point_covs"):
        last, wanted = getattr(smoothed, name)[:, -1], getattr(filtered, name)[:, -1]
        np.testing.assert_allclose(last, wanted, rtol=0, atol=1e-10)
    # Where a step is all rounding, no share of it need lower the cost.
    ending = traces["batch"].final.ending
    assert set(ending.tolist()) <= {Ending.CONVERGED, Ending.STALLED}
    assert (ending == Ending.CONVERGED).mean() > 0.95
    assert len(set(traces["batch"].final.iterations.tolist())) > 1  # each its own number
    # Shorter than √eps, or than what a cost that rounds hides: a step s takes s²/2 off it, and a
    # sum of some hundred terms is known to that many eps at worst (17 were seen on one processor).
    hidden = np.sqrt(100 * np.finfo(float).eps * traces["batch"].final.cost)
    assert (traces["batch"].final.step < np.maximum(2e-8, hidden)).all()


# --- what is refused ----------------------------------------------------------------------------


EMPTY = Log(
    np.zeros((5, 2)), Scan(np.zeros((5, 1, 2)), np.zeros((5, 1), int), np.ones((5, 1), bool))
)
RAYS = sensors.BearingInverseDepth(np.eye(1), min_distance=1.0)


@pytest.mark.parametrize("method", [Smoother, BatchMap])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": sensors.Suite(((ring(5).sensor, 2),))}, "suite"),
        ({"sensor": RAYS}, "measurement and prior determine"),
        ({"capacity": 0}, "capacity"),
        ({"gate": -1.0}, "gate"),
        ({"pose": (0.0, 0.0)}, "pose"),
        ({"pose_cov": -np.eye(3)}, "pose_cov"),
        ({"log": EMPTY._replace(control=np.full((5, 2), np.nan))}, "not finite"),
    ],
)
def test_bad_input_is_refused(method, change, message):
    names = ("motion", "sensor", "capacity", "pose", "pose_cov")
    options = dict(zip(names, arguments(ring(5)), strict=True)) | change
    log = options.pop("log", EMPTY)
    with pytest.raises(ValueError, match=message):
        method(**options)(log, KEY)


def test_the_batch_refuses():
    world = ring(5)
    with pytest.raises(ValueError, match="iterations"):
        BatchMap(*arguments(world), iterations=0)
    for tolerance in (0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="tolerance"):
            BatchMap(*arguments(world), tolerance=tolerance)
    with pytest.raises(ValueError, match="leaves 1"):
        BatchMap(*arguments(camera_ring(5)))
