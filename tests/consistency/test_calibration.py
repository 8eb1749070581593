"""Calibration from innovations is least squares where all is linear, and needs no identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused
from reference import plane

from jaxslam import association, motion, run, sensors
from jaxslam.calibration import calibrate, consider_cov
from jaxslam.core.record import record
from jaxslam.core.types import Info, Log, Scan
from jaxslam.filters import EkfSlam
from jaxslam.life import Recency

KEY = jax.random.key(0)
Q, R = np.diag([0.03, 0.02, 0.0]) ** 2, 0.1**2 * np.eye(2)


def test_it_is_generalized_least_squares_where_all_is_linear():
    """A robot that never turns: z_t = l - Σ_{s<=t} (u_s + p ∘ u_s + w_s) + v_t, nothing known of l."""
    rng, steps, truth = np.random.default_rng(0), 12, np.array([0.05, -0.1])
    control = np.column_stack([rng.uniform(0.5, 1.0, (steps, 2)), np.zeros(steps)])
    noise = rng.normal(size=(steps, 2)) * np.sqrt(np.diag(Q)[:2])
    at = np.cumsum(control[:, :2] * (1 + truth) + noise, axis=0)
    z = np.array([5.0, -3.0]) - at + rng.normal(size=(steps, 2)) * 0.1
    scan = Scan(z[:, None], np.zeros((steps, 1), np.int32), np.ones((steps, 1), bool))

    def info(p):
        filter = EkfSlam(
            motion.PoseIncrement(Q), sensors.RelativePosition(R), 1, correction="joint"
        )
        scaled = control * jnp.concatenate([1 + p, jnp.ones(1)])[None]
        return run(filter, Log(scaled, scan), np.zeros(3), np.zeros((3, 3)), KEY).info

    result = calibrate(info, np.zeros(2))
    shared = np.minimum(*np.indices((steps, steps))) + 1
    for axis in range(2):
        # Unknowns l and p; the first has no prior.
        slope = np.column_stack([np.ones(steps), -np.cumsum(control[:, axis])])
        weight = np.linalg.inv(Q[axis, axis] * shared + 0.1**2 * np.eye(steps))
        cov = np.linalg.inv(slope.T @ weight @ slope)
        best = cov @ slope.T @ weight @ (z[:, axis] + np.cumsum(control[:, axis]))
        np.testing.assert_allclose(result.parameters[axis], best[1], rtol=1e-8)
        np.testing.assert_allclose(result.cov[axis, axis], cov[1, 1], rtol=1e-8)
    assert abs(result.cov[0, 1]) < 1e-12
    assert result.converged and len(result.misfit) == 2 and result.path.shape == (3, 2)
    np.testing.assert_array_equal(result.dof, 2 * (steps - 1))


@pytest.mark.sweep
def test_a_pose_covariance_with_what_parameters_add_is_that_of_the_joint_estimate():
    """Of a robot that never turns, whose odometry has a scale p to be found from the same log."""
    rng, steps, start = np.random.default_rng(1), 9, 0.2**2
    control = np.column_stack([rng.uniform(0.5, 1.0, (steps, 2)), np.zeros(steps)])
    z = np.array([5.0, -3.0]) - np.cumsum(control[:, :2], axis=0)
    scan = Scan(z[:, None], np.zeros((steps, 1), np.int32), np.ones((steps, 1), bool))

    def trace(p):
        filter = EkfSlam(
            motion.PoseIncrement(Q), sensors.RelativePosition(R), 1, correction="joint"
        )
        scaled = control * jnp.concatenate([1 + p, jnp.ones(1)])[None]
        known = np.diag([start, start, 0.0])
        return run(filter, Log(scaled, scan), np.zeros(3), known, KEY)

    result = calibrate(lambda p: trace(p).info, np.zeros(2))
    added = consider_cov(lambda p: trace(p).estimate.pose, result.parameters, result.cov)
    assert added.shape == (steps, 3, 3)
    total = trace(jnp.asarray(result.parameters)).estimate.pose_cov[-1] + added[-1]
    for axis in range(2):
        # Unknowns: start, positions 1 to T, landmark, scale.
        size = steps + 3
        information = np.zeros((size, size))
        rows = [(np.eye(size)[0], start)]
        for k in range(1, steps + 1):
            step = np.eye(size)[k] - np.eye(size)[k - 1] - control[k - 1, axis] * np.eye(size)[-1]
            rows += [(step, Q[axis, axis]), (np.eye(size)[-2] - np.eye(size)[k], R[axis, axis])]
        for row, variance in rows:
            information += np.outer(row, row) / variance
        joint = np.linalg.inv(information)
        np.testing.assert_allclose(total[axis, axis], joint[steps, steps], rtol=1e-6)
        assert added[-1, axis, axis] > 0.1 * joint[steps, steps]


@refused(
    (lambda p: p, [np.nan], 1.0, "finite"),
    (lambda p: p, [], np.eye(0), "finite"),
    (lambda p: p, [[1.0]], 1.0, "shape"),
    (lambda p: p, [1.0, 2.0], np.eye(3), r"shape \(2, 2\)"),
    (lambda p: p, [1.0, 2.0], [[1.0, 0.5], [0.0, 1.0]], "symmetric"),
    (lambda p: p, [1.0, 2.0], -np.eye(2), "negative variance"),
    (lambda p: p, [1.0, 2.0], np.diag([1.0, -1e-9]), "negative variance"),
    (lambda p: p, [1.0, 2.0], [[1.0, 1e-9], [1e-9, 0.0]], "positive semi-definite"),
    (lambda p: p, [1.0, 2.0], [[1.0, np.nan], [np.nan, 1.0]], "a NaN or an infinity"),
    (3.0, [1.0], 1.0, "a function of p, got 3.0"),
    (lambda p: jnp.where(p > 0, jnp.nan, p), [1.0], 1.0, "not finite"),
    (lambda p: p.sum(), [1.0, 2.0], np.eye(2), "array"),
    (lambda p: (p, 3), [1.0], 1.0, "array"),
    (lambda p: p > 0, [1.0], 1.0, "real numbers"),
    (lambda p: jnp.sqrt(p), [0.0], 1.0, "derivatives"),
    told="consider_cov: .*",
)
def test_what_adds_no_covariance_is_refused(result, parameters, cov):
    consider_cov(result, parameters, cov)


def test_uncertain_parameters_are_not_considered_within_a_trace():
    with pytest.raises(ValueError, match=r"consider_cov: .*outside jit"):
        jax.jit(lambda p: jnp.asarray(consider_cov(lambda q: q, p, 1.0)))(1.0)


def test_a_calibration_of_what_is_no_run_is_refused():
    with pytest.raises(ValueError, match="calibrate: expected info to return the Info of a run"):
        calibrate(lambda p: p, [1.0])


def drive(seed, steps=160, drift=0.02, turn=0.1):
    """Odometry that turns too little and to one side, among trees 3 m apart, and no identity."""
    rng = np.random.default_rng(seed)
    trees = np.stack(np.meshgrid(np.arange(-9, 10, 3.0), np.arange(-9, 10, 3.0)), -1).reshape(-1, 2)
    trees = trees + rng.uniform(-0.5, 0.5, trees.shape)
    pose, rows = np.zeros(3), []
    for t in range(steps):
        u = np.array([0.3, 0.0, 0.08 * np.sin(2 * np.pi * t / 80)])
        w = rng.normal(size=3) * np.sqrt(np.diag(NOISE))
        true = u + w + [0, 0, drift * u[0] + turn * u[2]]
        pose = plane.compose(pose, true)
        seen = plane.to_frame(pose, trees)
        near = seen[(seen[:, 0] > 0) & (np.hypot(*seen.T) < 5.0)][:PLACES]
        z = np.zeros((PLACES, 2))
        z[: len(near)] = near + rng.normal(size=near.shape) * 0.1
        rows.append((u, z, np.arange(PLACES) < len(near)))
    control, z, valid = map(np.array, zip(*rows, strict=True))
    return Log(control, Scan(z, np.full(valid.shape, -1, np.int32), valid))


PLACES, NOISE = 3, np.diag([0.01, 0.01, 0.002]) ** 2


@pytest.mark.sweep
def test_odometry_is_calibrated_without_identities():
    logs = [drive(seed) for seed in range(4)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *logs)
    model, sensor = motion.PoseIncrement(NOISE), sensors.RelativePosition(R)
    near, local = association.Nearest(0.9973), Recency(patience=20)
    filter = EkfSlam(model, sensor, 20, associate=near, correction="joint", life=local)

    def info(p):
        def one(log):
            u = log.control
            u = u.at[:, 2].add(p[0] * u[:, 0] + p[1] * u[:, 2])
            return run(filter, log._replace(control=u), np.zeros(3), np.zeros((3, 3)), KEY).info

        return jax.vmap(one)(together)

    result = calibrate(info, np.zeros(2))
    off = result.parameters - [0.02, 0.1]
    assert result.converged
    assert off @ np.linalg.solve(result.cov, off) < 13.8  # 99.9 % of χ²(2)
    assert (np.sqrt(np.diag(result.cov)) < [0.003, 0.015]).all()  # and that says something
    assert result.misfit[-1] < result.misfit[0] and abs(result.misfit[-1] - 1) < 0.2


def plain(innovation, status=1):
    """An Info of two places of one step: a fused one, and an empty one that is not finite."""
    empty = jnp.full((1, 1), jnp.nan)
    return Info(
        nis=None,
        dof=jnp.array([[int(status == 1), 0]]),
        innovation=jnp.concatenate([jnp.reshape(innovation, (1, 1)), empty])[None],
        innovation_cov=jnp.stack([jnp.eye(1), empty])[None],
        slot=None,
        status=jnp.array([[status, 0]]),
        log_likelihood=None,
    )


TRACED = []


@record
class Parabola:
    """p² - y, counting how often it is traced."""

    y: float

    def __call__(self, p):
        TRACED.append(1)
        return p**2 - self.y


@record
class Run:
    """The Info of a run whose innovation is that of a parabola."""

    of: Parabola

    def __call__(self, p):
        return plain(self.of(p))


def test_other_numbers_of_a_record_cost_no_trace_and_no_program():
    def both(y):
        result = calibrate(Run(Parabola(y)), 1.5)
        added = consider_cov(Parabola(y), result.parameters, 1.0)
        return result.parameters[0], added[0, 0]

    both(3.0)
    with worlds.nothing_compiled(TRACED):
        root, added = both(2.0)
    np.testing.assert_allclose(root, np.sqrt(2), rtol=1e-4)
    np.testing.assert_allclose(added, 8.0, rtol=1e-3)


def test_results_may_be_a_tree():
    added = consider_cov(lambda p: {"a": p, "b": jnp.outer(p, p)}, [2.0, 1.0], np.diag([0.1, 0.2]))
    np.testing.assert_allclose(added["a"], np.diag([0.1, 0.2]), rtol=1e-6)
    slope = np.array([[4.0, 0.0], [1.0, 2.0]])  # of (p0², p0 p1)
    np.testing.assert_allclose(added["b"][0], slope @ np.diag([0.1, 0.2]) @ slope.T, rtol=1e-6)


def test_what_is_empty_does_not_count_and_a_number_will_do():
    result = calibrate(lambda p: plain(p[0] ** 2 - 4.0), 1.0)  # Newton's √4
    np.testing.assert_allclose(result.parameters, [2.0], atol=1e-3)
    np.testing.assert_allclose(result.path[1], [2.5])
    assert result.converged
    assert not calibrate(lambda p: plain(p[0] ** 2 - 4.0), 1.0, iterations=1).converged

    def wider(p):
        """As a suite has it whose other sensor measures more."""
        info = plain(p[0] ** 2 - 4.0)
        return info._replace(
            innovation=jnp.pad(info.innovation, [(0, 0), (0, 0), (0, 1)]),
            innovation_cov=jnp.pad(info.innovation_cov, [(0, 0), (0, 0), (0, 1), (0, 1)]),
        )

    again = calibrate(wider, 1.0)
    np.testing.assert_array_equal(again.dof, result.dof)
    np.testing.assert_allclose(again.misfit, result.misfit, rtol=1e-12)
    np.testing.assert_allclose(again.parameters, result.parameters, rtol=1e-12)


@refused(
    (plain, [[1.0]], {}, "start"),
    (plain, [np.nan], {}, "start"),
    (plain, [], {}, "start"),
    (plain, 1.0, {"iterations": 0}, "iterations"),
    (plain, 1.0, {"tolerance": 0.0}, "tolerance"),
    (lambda p: plain(p[0], status=3), 1.0, {}, "expected fused measurements"),
    (lambda p: plain(jnp.log(p[0])), -1.0, {}, "not finite"),
    (lambda p: plain(p[0] + p[1]), [1.0, 2.0], {}, "does not determine"),
    (lambda p: plain(p[0] * 0), 1.0, {}, "does not determine"),
)
def test_refusals(info, start, options):
    calibrate(info, start, **options)
