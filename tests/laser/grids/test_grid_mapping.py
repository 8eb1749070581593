"""Mapping with known poses: counts beam by beam in NumPy, order, the unknown, entropy."""

import itertools

import chex
import jax
import numpy as np
import pytest
from cases import refused
from reference.plane import from_frame, to_frame

from jaxslam import grids
from jaxslam.core.types import Beams
from jaxslam.simulation.laser import scan_world
from jaxslam.simulation.scenarios import square
from jaxslam.simulation.walls import rasterize

SHAPE, ORIGIN, CELL = (30, 40), np.array([-1.0, 0.5, 0.3]), 0.1


def scans(seed=0, steps=20, beams=11):
    rng = np.random.default_rng(seed)
    local = np.column_stack([rng.uniform(-0.3, 4.3, steps), rng.uniform(0, 3, steps)])
    local[0] = [-0.2, 1.0]  # off the map
    poses = np.column_stack([from_frame(ORIGIN, local), rng.uniform(-3, 3, steps)])
    ranges = rng.uniform(0.1, 4, (steps, beams))
    ranges[1, :3] = [np.nan, np.inf, -1.0]
    angles = np.tile(np.linspace(-2, 2, beams), (steps, 1))
    return poses, Beams(ranges, angles, rng.random((steps, beams)) < 0.9)


def reference_counts(poses, beams, max_range, free, mount):
    """Each beam cut at every line of the table that it crosses; the middle of a piece is in its cell."""
    hits, misses = np.zeros(SHAPE, int), np.zeros(SHAPE, int)
    outside = unusable = 0
    for pose, ranges, angles, valid in zip(poses, *beams, strict=True):
        a = to_frame(ORIGIN, from_frame(pose, mount[:2])) / CELL
        for r, angle, there in zip(ranges, angles, valid, strict=True):
            if not (there and r >= 0):
                unusable += 1
                continue
            if not (0 <= a[0] < SHAPE[1] and 0 <= a[1] < SHAPE[0]):
                outside += 1
                continue
            if r >= max_range and free == 0:
                continue
            h = pose[2] + mount[2] + angle - 0.3
            b = a + (r if r < max_range else free) / CELL * np.array([np.cos(h), np.sin(h)])
            cuts = [0.0, 1.0]
            for k in (0, 1):
                lines = np.arange(np.ceil(min(a[k], b[k])), np.floor(max(a[k], b[k])) + 1)
                cuts += list((lines - a[k]) / (b[k] - a[k]))
            cuts = np.sort(cuts)
            for low, high in itertools.pairwise(cuts):
                j, i = np.floor(a + (low + high) / 2 * (b - a)).astype(int)
                if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1]:
                    ends = high == 1.0
                    hits[i, j] += ends and r < max_range
                    misses[i, j] += not (ends and r < max_range)
    return hits, misses, outside, unusable


def counted(poses, beams, mount=(0.1, -0.05, 0.4), free=None):
    return grids.count(
        SHAPE, ORIGIN, CELL, poses, beams, max_range=2.5, no_return=free, mount=mount
    )


@pytest.mark.parametrize("free", [2.5, 0.7, 0.0])
def test_hits_and_misses_are_those_of_each_beam_alone(free):
    poses, beams = scans()
    found = counted(poses, beams, free=free)
    hits, misses, outside, unusable = reference_counts(poses, beams, 2.5, free, (0.1, -0.05, 0.4))
    np.testing.assert_array_equal(found.hits, hits)
    np.testing.assert_array_equal(found.misses, misses)
    assert (int(found.outside), int(found.unusable)) == (outside, unusable)
    assert outside > 0 and unusable > 2 and hits.sum() > 10


def test_order_does_not_matter_and_what_no_beam_saw_is_unknown():
    poses, beams = scans()
    forward = counted(poses, beams)
    shuffled = np.random.default_rng(1).permutation(len(poses))
    back = counted(poses[shuffled], Beams(*(np.asarray(part)[shuffled] for part in beams)))
    chex.assert_trees_all_equal(forward, back)
    seen = np.asarray(forward.hits + forward.misses) > 0
    for grid in (grids.occupancy(forward, hit=0.8), grids.reflection(forward)):
        assert np.all(np.asarray(grid.log_odds)[~seen] == 0)
        assert np.all(np.asarray(grids.entropy(grid))[~seen] == 1)
    one = grids.occupancy(forward, hit=0.8, miss=0.3)
    expected = np.asarray(forward.hits) * np.log(4) + np.asarray(forward.misses) * np.log(3 / 7)
    np.testing.assert_allclose(one.log_odds, expected, atol=1e-12)
    p = np.asarray(grids.reflection(forward).probability)
    np.testing.assert_allclose(p, (forward.hits + 1) / (forward.hits + forward.misses + 2))


def test_entropy_is_that_of_a_coin():
    log_odds = np.array([[-700.0, -3.0, -1e-8, 0.0, 2.0, 800.0]])
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        p = 1 / (1 + np.exp(-log_odds))
        expected = np.nan_to_num(-p * np.log2(p)) + np.nan_to_num(-(1 - p) * np.log2(1 - p))
    grid = grids.Grid(log_odds, np.zeros(3), np.float64(1))
    np.testing.assert_allclose(grids.entropy(grid), expected, atol=1e-12)
    slope = jax.grad(lambda x: grids.entropy(grid._replace(log_odds=x)).sum())(log_odds)
    assert np.all(np.isfinite(slope))


def test_a_map_of_a_square_room_is_that_room():
    world = square(beams=60)
    log = jax.device_get(scan_world(world, jax.random.key(0)))
    truth = rasterize(world.walls, 0.1)
    found = grids.count(
        truth.log_odds.shape, truth.origin, 0.1, log.pose, log.beams, max_range=10.0
    )
    grid = grids.occupancy(found)
    known = np.asarray(grid.observed)
    solid, said = np.asarray(truth.log_odds) > 0, np.asarray(grid.log_odds) > 0
    assert known[~solid].mean() > 0.98
    inner = np.zeros_like(solid)
    inner[7:-7, 7:-7] = True  # a cell and more from the walls
    assert not np.any(said & inner)
    assert said.sum() > 150


@refused(
    (lambda p, b: (p[:3], b), "count: poses: expected one .* for each of 20 scans"),
    (
        lambda p, b: (p, b._replace(angle=b.angle[:, :4])),
        "count: beams: expected as many ranges, angles",
    ),
    (lambda p, b: (p, None), "count: beams: expected Beams, got None"),
    (
        lambda p, b: (p, b._replace(range=b.range.tolist())),
        "count: beams: expected ranges, angles and masks in arrays, got list, ndarray, ndarray",
    ),
    (lambda p, b: (p, b._replace(valid=b.valid & False)), "count: beams: no scan has a valid beam"),
    (lambda p, b: (p * np.nan, b), "count: poses: expected finite numbers"),
)
def test_bad_scans_are_refused(change):
    counted(*change(*scans()))


def test_a_beam_of_no_angle_is_unusable():
    poses, beams = scans()
    angle, valid = beams.angle.copy(), beams.valid.copy()
    angle[4, 2:6] = np.nan
    valid[4, 2:6] = False
    same = counted(poses, beams._replace(valid=valid))
    jax.tree.map(np.testing.assert_array_equal, counted(poses, beams._replace(angle=angle)), same)
    with pytest.raises(ValueError, match="count: beams: no scan has a valid beam"):
        counted(poses, beams._replace(angle=angle * np.nan))


def test_a_beam_ends_where_it_leaves_the_map():
    """One of 1e9 m crosses 1e10 cells, of which all but a few are off the map."""
    poses, beams = scans()
    away = beams._replace(range=np.where(beams.range > 0, 1e9, beams.range))
    near, far = (
        grids.count(SHAPE, ORIGIN, CELL, poses, beams, max_range=max_range)
        for beams, max_range in [(beams._replace(range=away.range * 1e-7), 99.0), (away, 2e9)]
    )
    np.testing.assert_array_equal(far.misses, near.misses)
    assert far.hits.sum() == near.hits.sum() == 0 and far.misses.sum() > 100


def of_window(shape=SHAPE, origin=ORIGIN, cell=CELL, max_range=1.0):
    return grids.count(shape, origin, cell, *scans(), max_range=max_range)


@refused(
    (lambda: of_window(max_range=0.0), "count: max_range: expected a number above 0"),
    (lambda: of_window(max_range=np.inf), "count: max_range: expected a number above 0"),
    (lambda: of_window(max_range=np.nan), "count: max_range: expected a number above 0"),
    (lambda: of_window((0, 5)), r"count: shape: expected \(H, W\)"),
    (lambda: of_window((5.0, 5)), r"count: shape: expected \(H, W\)"),
    (lambda: of_window((5,)), r"count: shape: expected \(H, W\)"),
    (lambda: counted(*scans(), mount=(0.0, 0.0)), "count: mount: expected a mounting pose"),
    (lambda: of_window(cell=0.0), "count: resolution: expected a number above 0"),
    (lambda: of_window(origin=ORIGIN[:2]), "count: origin: expected finite"),
    (lambda: counted(*scans(), free=3.0), r"count: no_return: expected a number from 0 to 2\.5"),
    (lambda: grids.occupancy(counted(*scans()), hit=0.4), "occupancy: expected 0 < miss"),
    (lambda: grids.reflection(counted(*scans()), prior=0.0), "reflection: prior: expected"),
)
def test_bad_numbers_are_refused(call):
    call()
