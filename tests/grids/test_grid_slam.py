"""SLAM with a grid a particle: copies in place, counts of many maps, proposals, a run in a room."""

import jax
import numpy as np
import pytest

import jaxslam
from jaxslam import grids
from jaxslam.grids.mapping import add_scan
from jaxslam.grids.slam.particles import copied_rows, in_place
from jaxslam.grids.slam.proposal import climbed, propose
from jaxslam.motion import PoseIncrement
from jaxslam.simulation.laser import scan_world
from jaxslam.simulation.scenarios import square
from jaxslam.simulation.walls import rasterize
from jaxslam.types import Beams, Status


def test_survivors_stay_and_only_the_dead_are_overwritten():
    rng = np.random.default_rng(0)
    ancestors = rng.integers(0, 12, (40, 12)) * rng.integers(0, 2, (40, 1))
    table = rng.normal(size=(12, 3))

    def both(ancestor):
        source = in_place(ancestor)
        return source, *copied_rows((table, 10 * table[:, 0]), source)

    for ancestor, source, rows, more in zip(
        ancestors, *jax.jit(jax.vmap(both))(ancestors), strict=True
    ):
        np.testing.assert_array_equal(np.sort(source), np.sort(ancestor))
        alive = np.isin(np.arange(12), ancestor)
        np.testing.assert_array_equal(source[alive], np.flatnonzero(alive))
        np.testing.assert_array_equal(rows, table[source])
        np.testing.assert_array_equal(more, 10 * table[source, 0])


def test_the_counts_of_many_maps_are_those_of_each():
    rng = np.random.default_rng(1)
    shape, origin, cell = (20, 30), np.array([-1.0, -1.0, 0.2]), 0.2
    poses = rng.uniform([-0.5, 0.0, -3], [4, 2.5, 3], (5, 3))
    poses[2] = [-3.0, 0.0, 0.0]  # off the map
    angles = np.linspace(-2, 2, 9)
    scan = Beams(rng.uniform(0.2, 4, 9), angles, rng.random(9) < 0.9)
    none = jax.numpy.zeros(5 * 20 * 30, np.int32)
    hits, misses, lost = jax.jit(
        lambda eyes: add_scan(none, none, shape, origin, cell, eyes, scan, 3.0, 1.0)
    )(poses)
    alone = Beams(*(part[None] for part in scan))
    for k, pose in enumerate(poses):
        one = grids.count(shape, origin, cell, pose[None], alone, max_range=3.0, no_return=1.0)
        np.testing.assert_array_equal(np.reshape(hits, (5, *shape))[k], one.hits)
        np.testing.assert_array_equal(np.reshape(misses, (5, *shape))[k], one.misses)
        assert lost[k] == one.outside
    assert lost[2] > 0


@pytest.mark.parametrize("sharp", [0.2, 1.0])
def test_candidates_give_the_evidence_and_the_posterior_of_a_gaussian(sharp):
    """x' = w with w ~ N(0, Q), a likelihood exp(-|x' - z|²/2S): both integrals have closed forms."""
    q, z = np.array([0.3, 0.2, 0.1]) ** 2, np.array([0.25, -0.2, 0.05])
    s = (sharp * np.array([0.3, 0.2, 0.1])) ** 2
    motion = PoseIncrement(np.diag(q))

    def draw(key):
        return propose(
            lambda pose: -0.5 * ((pose - z) ** 2 / s).sum(),
            motion,
            np.zeros(3),
            np.zeros(3),
            key,
            candidates=16,
            iterations=20,
            spread=(0.05, 0.02),
        )

    keys = jax.random.split(jax.random.key(0), 4000)
    pose, log_weight = jax.device_get(jax.jit(jax.vmap(draw))(keys))
    weight = np.exp(log_weight)
    evidence = np.prod(np.sqrt(s / (s + q)) * np.exp(-0.5 * z**2 / (s + q)))
    assert abs(weight.mean() - evidence) < 4 * weight.std() / np.sqrt(4000)
    mean, cov = z * q / (q + s), s * q / (q + s)
    share = weight / weight.sum()
    effective = 1 / (share**2).sum()
    assert effective > 400
    error = (share[:, None] * pose).sum(axis=0) - mean
    assert np.all(np.abs(error) < 4.5 * np.sqrt(cov / effective))
    spread = (share[:, None] * (pose - mean) ** 2).sum(axis=0)
    np.testing.assert_allclose(spread, cov, rtol=0.35)


def test_the_search_climbs_to_a_maximum():
    found = jax.jit(
        lambda: climbed(lambda n: -((n - np.array([2.3, -0.7])) ** 2).sum(), np.zeros(2), 30)
    )()
    np.testing.assert_allclose(found, [2.3, -0.7], atol=1e-2)


WORLD = square(beams=24)
CELL = 0.15
ROOM = rasterize(WORLD.walls, CELL)


def slam(particles=8, **more):
    field = grids.likelihood_field(0.08, max_range=10.0)
    frame = ROOM.log_odds.shape, ROOM.origin, CELL
    return grids.grid_slam(*frame, field, WORLD.motion, particles, max_range=10.0, **more)


@pytest.mark.parametrize(("proposal", "share"), [("motion", 1.0), ("scan_matched", 0.5)])
def test_a_room_is_mapped_better_than_by_odometry(proposal, share):
    log = jax.device_get(scan_world(WORLD, jax.random.key(2)))
    rows = grids.beam_log(log.control, log.beams)
    filter = slam(proposal=proposal, exponent=0.3)
    trace = jaxslam.run(filter, rows, WORLD.pose, np.zeros((3, 3)), jax.random.key(1))
    error = np.hypot(*(np.asarray(trace.estimate.pose) - log.pose)[:, :2].T)
    v, omega, dt = log.control.T
    heading = WORLD.pose[2] + np.cumsum(omega * dt)
    before = np.concatenate([[WORLD.pose[2]], heading[:-1]])
    driven = WORLD.pose[:2] + np.cumsum(
        (v * dt)[:, None] * np.stack([np.cos(before), np.sin(before)], axis=1), axis=0
    )
    drift = np.hypot(*(driven - log.pose[:, :2]).T)
    assert np.sqrt((error**2).mean()) < share * np.sqrt((drift**2).mean())
    grid = grids.best_map(trace.final)
    assert float(grids.correlation(ROOM, grid)) > 0.3
    info = trace.info.extra["particles"]
    copied = np.asarray(trace.info.extra["maps"].copied)
    assert 0 < info.resampled.sum() < len(rows.control)
    assert np.all(copied[~np.asarray(info.resampled)] == 0) and copied.max() < 8
    assert (
        not np.any(info.underflow)
        and not np.any(info.invalid)
        and not np.any(trace.info.extra["maps"].outside)
    )
    assert np.all(np.isfinite(trace.estimate.pose_cov))


def test_a_scan_without_a_valid_beam_changes_no_weight_and_no_map():
    filter = slam()
    state = filter.init(np.float32([1.5, 1.5, 0]), np.zeros((3, 3), np.float32))
    rows = grids.beam_log(
        np.zeros((1, 3)), Beams(np.ones((1, 24)), np.ones((1, 24)), np.ones((1, 24), bool))
    )
    blind = jax.tree.map(lambda leaf: leaf[0], rows.scan)._replace(valid=np.zeros(24, bool))

    @jax.jit
    def step(state, scan, key):
        ahead = filter.predict(state, np.float32([0.5, 0, 0.25]), key)
        return filter.update(ahead, scan, key)

    after, info = step(state, blind, jax.random.key(0))
    np.testing.assert_allclose(after.log_weight, -np.log(8), rtol=1e-6)
    assert not np.any(after.hits) and not np.any(after.misses)
    assert after.pose.dtype == np.float32 and np.std(after.pose[:, 0]) > 0
    assert not info.extra["particles"].underflow
    away = state._replace(pose=np.asarray(state.pose) + 50)
    info = step(away, blind._replace(valid=np.ones(24, bool)), jax.random.key(0))[1]
    assert info.extra["maps"].outside == 8 and np.all(info.status == Status.UNMATCHED)
    with pytest.raises(ValueError, match=r"best_map: .* of one run.*jax\.vmap\(grids\.best_map\)"):
        grids.best_map(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), state))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"particles": 0}, "grid_slam: particles"),
        ({"proposal": "best"}, 'expected proposal "motion" or "scan_matched"'),
        ({"candidates": 1}, "grid_slam: expected an even number of candidates"),
        ({"candidates": 15}, "an even number of candidates, at least 2, got 15"),
        ({"exponent": 0.0}, "grid_slam: expected exponent above 0"),
        ({"exponent": np.inf}, "grid_slam: expected exponent above 0, got inf"),
        ({"spread": (0.1,)}, "a spread of two widths above 0"),
        ({"hit": 0.3}, "grid_slam: expected 0 < miss < 0.5 < hit"),
        ({"mount": (0.0, 0.0)}, "grid_slam: expected a mounting pose"),
        ({"no_return": 11.0}, "no_return from 0 to 10.0, got 11.0"),
        ({"threshold": 2.0}, "threshold from 0 to 1"),
        ({"every": 0}, "grid_slam: every"),
    ],
)
def test_bad_numbers_are_refused(change, reason):
    with pytest.raises(ValueError, match=reason):
        slam(**change)


def test_a_frame_that_is_none_is_refused():
    field = grids.likelihood_field(0.08, max_range=10.0)
    with pytest.raises(ValueError, match="expected a resolution above 0"):
        grids.grid_slam((3, 3), np.zeros(3), 0.0, field, WORLD.motion, 2, max_range=10.0)
    with pytest.raises(ValueError, match="expected max_range above 0, got inf"):
        grids.grid_slam((3, 3), np.zeros(3), 0.1, field, WORLD.motion, 2, max_range=np.inf)
    with pytest.raises(ValueError, match="at least one cell"):
        grids.grid_slam((0, 3), np.zeros(3), 0.1, field, WORLD.motion, 2, max_range=10.0)
    with pytest.raises(ValueError, match="expected a BeamModel"):
        grids.grid_slam((3, 3), np.zeros(3), 0.1, None, WORLD.motion, 2, max_range=10.0)
