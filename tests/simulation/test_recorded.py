"""Worlds of recorded runs: a campaign of them is that of the draws they were made of."""

from functools import partial

import chex
import jax
import numpy as np
import pytest
import worlds
from cases import refused

from jaxslam import Scenario, catalog, monte_carlo, motion, recorded_world, sensors, simulate, store
from jaxslam.core.types import Log, Scan
from jaxslam.results import plot

KEY = jax.random.key(3)
DRAWN = Scenario(
    name="drawn",
    motion=motion.Unicycle(np.diag([0.05, 0.05]) ** 2),
    sensor=sensors.RangeBearing(np.diag([0.1, 0.05]) ** 2),
    landmarks=((2.0, 1.0), (-1.0, 3.0)),
    controls=np.tile([0.5, 0.2, 0.1], (6, 1)),
    pose=(1.0, 0.0, 0.3),
    pose_cov=np.diag([0.1, 0.1, 0.05]) ** 2,
)


def drawn(runs, key=KEY):
    """Truths and logs of runs 0 … of a campaign with the key, in NumPy."""
    keys = [jax.random.split(jax.random.fold_in(key, i))[0] for i in range(runs)]
    return zip(*(jax.tree.map(np.asarray, simulate(DRAWN, one)) for one in keys), strict=True)


def recorded(runs=5, **changed):
    truths, logs = drawn(runs)
    given = {
        "logs": list(logs),
        "poses": np.stack([truth.pose for truth in truths]),
        "landmarks": DRAWN.landmarks,
        "starts": np.stack([truth.start for truth in truths]),
        "pose": DRAWN.pose,
        "pose_cov": DRAWN.pose_cov,
    }
    return recorded_world(DRAWN.motion, DRAWN.sensor, **(given | changed))


def test_a_campaign_of_records_is_that_of_the_draws(tmp_path):
    """Also with another key, kept and resumed, and where the last block is not full."""
    filters = {"ekf": catalog.FILTERS["ekf"](DRAWN)}
    campaign = partial(monte_carlo, filters=filters, block=4, progress=False)
    expected = campaign(DRAWN, runs=5, key=KEY).filters["ekf"]
    world = recorded()
    for key, keep in ((KEY, None), (jax.random.key(8), store.open(tmp_path / "kept"))):
        found = campaign(world, runs=5, key=key, keep=keep).filters["ekf"]
        chex.assert_trees_all_close(found.per_run, expected.per_run, rtol=1e-9)
    again = campaign(recorded(), runs=5, key=key, keep=store.resume(tmp_path / "kept"))
    chex.assert_trees_all_equal(again.filters["ekf"].per_run, found.per_run)
    other = recorded(landmarks=np.add(DRAWN.landmarks, 1e-9))
    with pytest.raises(ValueError, match="world"):
        campaign(other, runs=5, key=key, keep=store.resume(tmp_path / "kept"))


def test_records_hold_what_the_robot_has_beside_its_pose():
    world = worlds.gyroscope(5)
    truths, logs = zip(*(worlds.draw(world, seed) for seed in (0, 1)), strict=True)
    given = [truth.robot for truth in truths]
    rest = {"pose": world.pose, "pose_cov": world.pose_cov}
    made = recorded_world(world.motion, world.sensor, list(logs), given, world.landmarks, **rest)
    truth, _ = made.run(KEY, 1)
    np.testing.assert_array_equal(truth.pose, truths[1].pose)
    np.testing.assert_array_equal(truth.further, truths[1].further)
    np.testing.assert_array_equal(truth.start, world.pose)
    with pytest.raises(ValueError, match=r"poses: expected shape \(2, 5, 5\), got \(2, 5, 3\)"):
        poses = [truth.pose for truth in truths]
        recorded_world(world.motion, world.sensor, list(logs), poses, world.landmarks, **rest)


def test_true_headings_in_degrees_are_told():
    """That is, those that contradict the path as radians and fit it as degrees."""
    turn = np.linspace(0.0, 5.0, 6)
    path = np.stack([np.sin(turn), 1 - np.cos(turn), turn], axis=1)
    poses = np.stack([path, path * [1, 1, 180 / np.pi]])
    with pytest.warns(UserWarning, match="recorded_world: the true headings of run 1 contradict"):
        recorded(2, poses=poses)


def test_simulate_takes_one_of_the_records():
    world = recorded()
    poses = np.asarray(world.truth.pose)
    for seed in range(3):
        truth, log = simulate(world, jax.random.key(seed))
        (i,) = np.flatnonzero((poses == np.asarray(truth.pose)).all(axis=(1, 2)))
        chex.assert_trees_all_equal(log.control, world.log.control[i])


def ragged():
    logs = recorded().log
    rows = [jax.tree.map(lambda leaf, i=i: leaf[i], logs) for i in range(5)]
    return [*rows[:4], jax.tree.map(lambda leaf: leaf[:-1], rows[4])]


def unlike(**fields):
    """Logs of which the second has other fields."""
    _, logs = drawn(5)
    logs = list(logs)
    scan = logs[1].scan._replace(**fields)
    return [logs[0], Log(logs[1].control, scan), *logs[2:]]


@refused(
    ({"logs": []}, "logs: expected a list of Log, one a run, got an empty list"),
    (
        {"logs": Log(np.zeros((2, 3)), Scan(*[np.zeros((2, 1))] * 3))},
        "logs: expected a list of Log",
    ),
    ({"logs": [None]}, r"logs\[0\]: expected a Log, got None"),
    ({"logs": ragged()}, r"got \(6, 2\) in run 0 and \(5, 2\) in run 4"),
    ({"logs": unlike(z=np.full((6, 2, 2), np.nan))}, "logs\\[1\\].*: .* is not finite"),
    ({"logs": unlike(tag=np.tile([0, 2], (6, 1)))}, r"below 2, .* got 2 \(run 1, row 0\)"),
    ({"poses": np.zeros((5, 4, 3))}, r"poses: expected shape \(5, 6, 3\)"),
    ({"poses": np.full((5, 6, 3), np.inf)}, "poses: expected finite numbers of run 0"),
    ({"landmarks": np.zeros((4, 2, 2))}, r"landmarks: expected shape \(5, N, 2\)"),
    ({"landmarks": np.zeros((0, 2))}, "tags below 0, the number of landmarks"),
    ({"starts": np.zeros(3)}, r"starts: expected shape \(5, 3\), got \(3,\)"),
    ({"pose": (0.0, 0.0)}, r"pose: expected finite numbers of shape \(3,\)"),
    ({"origin": np.zeros((5, 6, 2))}, "origin: expected integer"),
)
def test_what_is_no_record_is_refused(changed):
    recorded(**changed)


def test_a_campaign_of_more_runs_than_there_are_is_refused():
    filters = {"ekf": catalog.FILTERS["ekf"](DRAWN)}
    with pytest.raises(ValueError, match="at most 5, the recorded runs of recorded, got 6"):
        monte_carlo(recorded(), filters, 6, KEY)
    for number in (5, -1):
        with pytest.raises(ValueError, match=f"from 0 to 4, the recorded ones, got {number}"):
            plot.animate_world(recorded(), filters["ekf"], KEY, number=number)
