"""Loops closed by the cluster of recent landmarks: what is merged, what is refused, and a whole run."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from reference import plane

from jaxslam import association, charts, motion, sensors, slots
from jaxslam.core.protocols import Pairs, Prediction
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan
from jaxslam.filters import Closing, EifSlam, EkfSlam, LoopSettings
from jaxslam.filters.map_management import _loop_closure, _merging
from jaxslam.life import Recency, Times

EUCLIDEAN = charts.Euclidean()
OPTIONS = {"window": 20, "cluster": 6, "least": 4}


def two_visits(seed=0, drift=4.0, shape=0.05, symmetric=False):
    """8 old landmarks; 5 of them again as recent ones, off by a common drift the filter knows of."""
    rng = np.random.default_rng(seed)
    old = rng.uniform(-12, 12, (8, 2))
    if symmetric:
        old = 6.0 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [2, 0], [0, 2], [-2, 0], [0, -2]])
    of = np.arange(5)
    turn = 0.05
    at = old[of]
    moved = at + turn * np.stack([-at[:, 1], at[:, 0]], axis=1) + drift * np.array([0.6, -0.8])
    points = np.concatenate([old, moved + shape * rng.normal(size=moved.shape), np.zeros((2, 2))])
    size = 3 + 2 * len(points)
    common = np.zeros((size, 3))
    common[:3] = np.diag([drift, drift, 0.1])
    for i, point in enumerate(at):
        rows = slice(3 + 2 * (8 + i), 5 + 2 * (8 + i))
        common[rows, :2] = drift * np.eye(2)
        common[rows, 2] = 0.1 * np.array([-point[1], point[0]])
    cov = common @ common.T + np.diag(np.append([1e-4] * 3, [1.5 * shape**2] * (size - 3)))
    alive = np.arange(15) < 13
    dead = np.concatenate([np.zeros(3, bool), np.repeat(~alive, 2)])
    cov = np.where(dead[:, None] | dead[None], np.eye(size), cov)
    born = np.where(alive, np.where(np.arange(15) < 8, 1, 90), 0)
    last = np.where(alive, np.where(np.arange(15) < 8, 20, 100), 0)
    life = Times(*map(jnp.asarray, (100, born, last, np.where(alive, 3, 0))))
    tag = np.where(alive, np.arange(15), -1)
    joint = Joint(*map(jnp.asarray, (np.zeros(3), points, cov, alive, tag)), (), life=life)
    return joint, of


def look(joint, **options):
    """By a program for all values of the options that are no integers."""
    closed = partial(
        _loop_closure.close_loop, chart=EUCLIDEAN, settings=LoopSettings(**(OPTIONS | options))
    )
    return jax.jit(closed)(joint)


MERGE = jax.jit(lambda joint, k, m: _merging.merge_landmarks(joint, EUCLIDEAN, k, m))


@pytest.mark.parametrize("seed", swept(range(3), 0))
def test_the_cluster_is_found_and_merged_exactly(seed):
    """The same as merging the true pairs one by one."""
    joint, of = two_visits(seed)
    closed, report = look(joint)
    assert report.merged == report.explained == 5 and report.likely
    expected = joint
    for i, k in enumerate(of):
        expected = MERGE(expected, k, 8 + i)
    np.testing.assert_array_equal(closed.alive, np.arange(15) < 8)
    np.testing.assert_allclose(closed.landmarks, expected.landmarks, atol=1e-9)
    np.testing.assert_allclose(closed.cov, expected.cov, atol=1e-9)
    np.testing.assert_array_equal(closed.life.last[:5], 100)
    np.testing.assert_array_equal(closed.life.seen[:5], 6)
    np.testing.assert_array_equal(closed.life.born[:5], 1)
    np.testing.assert_array_equal(closed.life.seen[8:], 0)


def test_what_was_seen_by_turns_is_never_one():
    joint, _ = two_visits()
    both = joint._replace(life=joint.life._replace(last=jnp.full_like(joint.life.last, 100)))
    same, report = look(both)
    assert report.merged == report.explained == 0
    chex.assert_trees_all_equal(same, both)


def test_a_hypothesis_the_covariance_excludes_is_refused():
    joint, _ = two_visits(drift=4.0)
    far = joint.landmarks.at[8:13].add(jnp.array([60.0, 0.0])[None])
    assert look(joint._replace(landmarks=far))[1].merged == 0


@pytest.mark.sweep
def test_a_symmetric_old_map_is_ambiguous():
    """A square may be entered by any of its sides, if the drift allows a quarter turn."""
    joint, _ = two_visits(symmetric=True, drift=8.0, shape=0.02)
    cov = joint.cov
    lever = np.zeros(cov.shape[0])
    for i in range(5):
        at = np.asarray(joint.landmarks[8 + i])
        lever[3 + 2 * (8 + i) : 5 + 2 * (8 + i)] = 2.0 * np.array([-at[1], at[0]])
    joint = joint._replace(cov=cov + lever[:, None] * lever[None])
    report = look(joint, drift=0.999999)[1]
    assert report.explained >= 4 and report.runner_up >= 4 and report.merged == 0


def test_recency_remembers():
    model = motion.PoseIncrement(1e-4 * np.eye(3))
    filter = EkfSlam(model, sensors.RelativePosition(0.01 * np.eye(2)), 4, life=Recency())
    state = jax.jit(filter.init)(np.zeros(3), np.zeros((3, 3)))
    update = jax.jit(filter.update)
    key = jax.random.key(0)
    for tags in ([0, -2], [0, 1], [1, -2]):
        valid = np.asarray(tags) >= 0
        scan = Scan(np.array([[2.0, 1.0], [3.0, -1.0]]), np.maximum(tags, -1), valid)
        if tags == [1, -2]:
            scan = scan._replace(z=scan.z[::-1])
        state, info = update(state, scan, key)
    life = state.life
    assert int(life.now) == 3
    np.testing.assert_array_equal(life.born, [1, 2, 0, 0])
    np.testing.assert_array_equal(life.last, [2, 3, 0, 0])
    np.testing.assert_array_equal(life.seen, [2, 2, 0, 0])
    assert not info.extra["pruning"].removed.any()


def test_recency_with_patience_forgets():
    """Seen at scans 1 and 2 the first landmark goes at 2 + 3, whether or not scans are empty."""
    info = Info(*[None] * 4, slot=None, status=None, log_likelihood=None)
    keeper = Recency(patience=3)
    joint = slots.empty(jnp.zeros(3), jnp.eye(3), 2, 2, ())
    joint = joint._replace(life=keeper.init(joint.pose, joint.landmarks))
    gone = []
    for slot, status in [(0, 2), (0, 1), (1, 2), (-1, 0), (-1, 0), (-1, 0)]:
        joint = joint._replace(alive=joint.alive | (jnp.arange(2) == slot))
        info = info._replace(slot=jnp.array([slot]), status=jnp.array([status]))
        memory, dead = keeper.after(joint, info, lambda: None)
        joint = slots.remove(joint._replace(life=memory), dead)
        gone.append([bool(d) for d in dead])
    none, first, second = [False, False], [True, False], [False, True]
    assert gone == [none, none, none, none, first, second]


def test_certain_hides_what_cannot_be_foretold():
    cov = jnp.stack([0.01 * jnp.eye(2), 4.0 * jnp.eye(2)])[None]
    distance = jnp.array([[3.0, 0.1]])
    pairs = Pairs(jnp.zeros((1, 2, 2)), cov, distance, jnp.zeros((1, 2)), jnp.ones((1, 2), bool))
    prediction = Prediction(jnp.full(2, -1), jnp.ones(2, bool), lambda scan: pairs, lambda: None)
    scan = Scan(jnp.zeros((1, 2)), jnp.array([-1]), jnp.array([True]))
    near = association.Nearest(0.99)
    assert int(near(prediction, scan).slot[0]) == 1
    assert int(association.Certain(near, 0.5)(prediction, scan).slot[0]) == 0
    hidden = association.Certain(near, 0.05)(prediction, scan)
    assert int(hidden.slot[0]) == -1 and bool(hidden.is_new[0])


@pytest.mark.sweep
def test_a_whole_run_ends_with_each_landmark_once():
    """Eight landmarks seen, a long way blind, and the same eight again: one loop, closed once."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-6, 6, (8, 2))
    filter = Closing(
        EkfSlam(
            motion.PoseIncrement(np.diag([0.05, 0.05, 0.008]) ** 2),
            sensors.RelativePosition(0.05**2 * np.eye(2)),
            20,
            chart=charts.RightInvariant(),
            correction="joint",
            associate=association.Certain(association.Nearest(0.99, 0.9999997), 0.4),
            life=Recency(),
        ),
        reach=1.0,
        settings=LoopSettings(window=10, cluster=8, sightings=2, least=5),
    )
    predict, update = jax.jit(filter.predict), jax.jit(filter.update)
    state = jax.jit(filter.init)(np.zeros(3), np.zeros((3, 3)))
    pose, key, reports = np.zeros(3), jax.random.key(0), []
    for step in range(140):
        u = np.array([0.5, 0.0, 2 * np.pi / 120])
        w = u + rng.normal(size=3) * [0.05, 0.05, 0.008]
        pose = plane.compose(pose, w)
        z = plane.to_frame(pose, points) + 0.05 * rng.normal(size=(8, 2))
        valid = np.full(8, step < 5 or step >= 118)
        scan = Scan(z, np.full(8, -1), valid)
        state = predict(state, u, key)
        state, info = update(state, scan, key)
        reports.append(info.extra["closing"])
    closings = jax.tree.map(lambda *leaves: np.stack(leaves), *reports)
    assert (closings.merged > 0).sum() >= 1
    assert closings.merged.sum() + closings.duplicates.sum() >= 8
    assert int(state.alive.sum()) == 8
    estimate = jax.jit(filter.estimate)(state)
    error = np.asarray(estimate.pose) - pose
    error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
    assert error @ np.linalg.solve(estimate.pose_cov, error) < 16.3
    assert np.hypot(*error[:2]) < 0.3


MODELS = motion.PoseIncrement(np.eye(3)), sensors.RelativePosition(np.eye(2)), 3


@refused(
    (lambda: LoopSettings(window=0), "window"),
    (lambda: LoopSettings(cluster=0), "cluster"),
    (lambda: LoopSettings(least=2), "LoopSettings: .*least"),
    (lambda: LoopSettings(drift=1.0), "LoopSettings: .*drift"),
    (lambda: LoopSettings(probability=0.0), "probability"),
    (lambda: look(two_visits()[0]._replace(life=None)), "keeps times"),
    (lambda: association.Certain(association.Nearest(0.99), 0.0), "spread"),
    (lambda: Closing(EkfSlam(*MODELS), period=0), "period"),
    (lambda: Closing(EkfSlam(*MODELS), reach=-1.0), "reach"),
    (lambda: Closing(EkfSlam(*MODELS)).init(jnp.zeros(3), jnp.eye(3)), "keeps times"),
    (lambda: Closing(EkfSlam(*MODELS, covariance="square_root", life=Recency())), "root"),
    (lambda: Closing(EifSlam(*MODELS)).init(jnp.zeros(3), jnp.eye(3)), "Joint"),
    (lambda: Recency(patience=0), "Recency: patience"),
)
def test_refusals(make):
    make()


def test_a_filter_of_several_sensors_keeps_its_places():
    one = sensors.RelativePosition(np.eye(2))
    both = sensors.Suite(((one, 2), (one, 2)))
    filter = EkfSlam(motion.PoseIncrement(np.eye(3)), both, 4, life=Recency())
    assert Closing(filter).places == filter.places == (2, 2)
