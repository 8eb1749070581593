"""Rays: every cell against a slow traversal, ranges against exact geometry, derivatives by pose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import recordings
from cases import refused, swept
from reference.plane import from_frame
from reference.walls import is_free

from jaxslam import datasets, grids
from jaxslam.simulation.laser import Laser, true_ranges
from jaxslam.simulation.walls import make_walls, rasterize

ANGLES = np.linspace(-np.pi, np.pi, 37)[:-1] + 0.05


def grid_of(log_odds, origin=(0.0, 0.0, 0.0), resolution=0.1):
    return grids.Grid(
        np.asarray(log_odds, float), np.asarray(origin, float), np.float64(resolution)
    )


def reference_range(occupied, x, y, angle, limit):
    """In cells: the least entry of the ray into any occupied cell, tried one by one."""
    e = np.array([np.cos(angle), np.sin(angle)])
    best = limit
    for i, j in np.argwhere(occupied):
        enter, leave = 0.0, np.inf
        for start, slope, low in ((x, e[0], j), (y, e[1], i)):
            a, b = sorted(((low - start) / slope, (low + 1 - start) / slope))
            enter, leave = max(enter, a), min(leave, b)
        if enter < leave:
            best = min(best, enter)
    return best


def traversed(occupied, x, y, angle, limit):
    """In cells: where a ray enters the first occupied cell, by all lines that it crosses."""
    e = np.array([np.cos(angle), np.sin(angle)])
    lines = [
        (np.arange(np.floor(start - limit), np.ceil(start + limit) + 1) - start) / slope
        for start, slope in ((x, e[0]), (y, e[1]))
    ]
    cuts = np.unique(np.concatenate([[0.0, limit], *lines]))
    cuts = cuts[(cuts >= 0) & (cuts <= limit)]
    middle = (cuts[1:] + cuts[:-1]) / 2
    at = np.floor([y + middle * e[1], x + middle * e[0]]).astype(int)
    on_map = np.all((at >= 0) & (at.T - occupied.shape < 0).T, axis=0)
    hit = np.flatnonzero(on_map)[occupied[tuple(at[:, on_map])]]
    return cuts[hit[0]] if len(hit) else limit


@pytest.fixture(scope="module")
def blocks():
    """A map of random blocks, turned, and poses all over its free cells."""
    rng = np.random.default_rng(0)
    cells = rng.random((23, 31)) < 0.06
    cells[rng.random(cells.shape) < 0.02] = False
    log_odds = np.where(cells, 2.0, -2.0)
    log_odds[rng.random(cells.shape) < 0.2] = 0.0  # unknown
    free = np.argwhere(log_odds < 0)
    at = free[rng.choice(len(free), 12, replace=False)][:, ::-1] + rng.uniform(0.05, 0.95, (12, 2))
    heading = rng.uniform(-3, 3, 12)
    origin = np.array([3.0, -1.0, 0.6])
    position = from_frame(origin, 0.1 * at)
    return grid_of(log_odds, origin), at, heading, np.column_stack([position, heading + 0.6])


def test_a_ray_ends_where_it_enters_the_first_occupied_cell(blocks):
    grid, at, heading, pose = blocks
    found = grids.cast(grids.ray_map(grid, method="cells", skip=False), pose, ANGLES, 1.5)
    occupied = grid.log_odds > 0
    exact = [
        [reference_range(occupied, *p, h + a, 15.0) for a in ANGLES]
        for p, h in zip(at, heading, strict=True)
    ]
    np.testing.assert_allclose(found, 0.1 * np.array(exact), atol=1e-12)
    assert 0.2 < np.mean(np.asarray(found) < 1.5) < 0.99


@pytest.mark.parametrize("method", swept(["cells", "surface"], "surface"))
def test_long_steps_through_free_space_change_no_range(blocks, method):
    grid, _, _, pose = blocks
    step_by_step, skipping = (
        grids.cast(grids.ray_map(grid, method=method, skip=skip), pose, ANGLES, 1.5)
        for skip in (False, True)
    )
    np.testing.assert_allclose(skipping, step_by_step, rtol=0, atol=1e-12)


@pytest.mark.sweep
def test_rays_end_in_single_precision_too():
    """Rounding may leave a ray in a square whose end it has passed; it takes many to meet one."""
    rng = np.random.default_rng(0)
    log_odds = np.where(rng.random((800, 800)) < 0.01, 4.0, -4.0)
    free = np.argwhere(log_odds < 0)
    at = free[rng.integers(len(free), size=100)][:, ::-1] + 0.5
    pose = np.column_stack([0.05 * at, rng.uniform(-3, 3, 100)])
    grid = grids.Grid(log_odds, np.zeros(3), np.float64(0.05))
    grid, pose, angles = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), (grid, pose, np.linspace(-3.1, 3.1, 500))
    )
    step_by_step, skipping = (
        grids.cast(grids.ray_map(grid, method="cells", skip=skip), pose, angles, 20.0)
        for skip in (False, True)
    )
    assert skipping.dtype == jnp.float32
    differs = np.abs(np.asarray(skipping) - np.asarray(step_by_step)) > 1e-4
    assert differs.mean() < 1e-3  # rays through corners


def test_many_rays_are_as_few(blocks):
    grid, _, _, pose = blocks
    rays = grids.ray_map(grid, method="cells")
    few = np.asarray(grids.cast(rays, pose, ANGLES, 1.5))
    many = grids.cast(rays, np.tile(pose, (2, 10, 1)), np.tile(ANGLES, 3), 1.5)  # several chunks
    np.testing.assert_array_equal(many, np.tile(few, (2, 10, 3)))


def test_rays_are_the_same_one_step_at_a_time_as_on_a_gpu(blocks, monkeypatch):
    grid, _, _, pose = blocks
    rays = grids.ray_map(grid, method="surface")
    expected = grids.cast(rays, pose, ANGLES, 3.0)
    jax.clear_caches()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = grids.cast(rays, pose, ANGLES, 3.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    jax.clear_caches()


def test_poses_under_vmap_are_a_batch_of_poses_and_maps_may_vary(blocks):
    grid, _, _, pose = blocks
    rays = grids.ray_map(grid)
    batch = grids.cast(rays, pose, ANGLES, 1.5)
    each = jax.jit(jax.vmap(lambda p: grids.cast(rays, p, ANGLES, 1.5)))(pose)
    np.testing.assert_allclose(each, batch, rtol=0, atol=1e-12)
    moved = jax.tree.map(lambda x: np.stack([x, x]), rays)._replace(
        origin=np.stack([grid.origin, grid.origin + [0.1, 0, 0]])
    )
    two = jax.jit(jax.vmap(lambda r, p: grids.cast(r, p, ANGLES, 1.5)))(
        moved, np.stack([pose, pose + [0.1, 0, 0]])
    )
    np.testing.assert_allclose(two, np.stack([batch, batch]), atol=1e-9)
    np.testing.assert_allclose(two[0], batch, rtol=0, atol=1e-12)


def test_rays_along_the_axes_through_corners_and_from_borders_end():
    log_odds = np.full((6, 8), -2.0)
    log_odds[2, 5] = 2.0
    grid = grid_of(log_odds, resolution=1.0)
    rays = grids.ray_map(grid, method="cells")
    quarter = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    np.testing.assert_allclose(
        grids.cast(rays, np.array([1.5, 2.5, 0.0]), quarter, 9.0), [3.5, 9, 9, 9]
    )
    diagonal = grids.cast(rays, np.array([3.0, 0.0, np.pi / 4]), np.zeros(1), 9.0)
    np.testing.assert_allclose(diagonal, [2 * np.sqrt(2)])  # through the corners of cells
    corner = grids.cast(rays, np.array([8.0, 6.0, 0.0]), quarter, 9.0)
    np.testing.assert_allclose(corner, 9.0)
    np.testing.assert_array_equal(grids.cast(rays, np.array([5.5, 2.5, 0.0]), quarter, 9.0), 0.0)


def rooms():
    """Slanted walls, a pillar of eight corners and a round one; every solid part is thick."""
    outer = [[0, 0], [6, 0.7], [7, 4], [3.1, 5.3], [-0.8, 3.6]]
    turn = 2 * np.pi * np.arange(8) / 8 + 0.2
    pillar = np.array([4.6, 2.4]) + 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return make_walls(outer, pillar, circles=[[1.7, 2.9, 0.45]])


def test_ranges_are_those_of_exact_geometry_to_a_tenth_of_a_cell():
    """Beams whose exact range is steady under a shift of a cell to either side: none of those that
    pass an edge, which the grid rounds, or go along a wall."""
    world, cell = rooms(), 0.05
    rays = grids.ray_map(rasterize(world, cell, yaw=0.3))
    rng = np.random.default_rng(1)
    spots = rng.uniform([-0.5, 0.2], [6.8, 5], (300, 2))
    near = cell * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    spots = spots[is_free(world, spots[:, None] + 2 * near).all(axis=1)][:60]
    pose = np.column_stack([spots, rng.uniform(-3, 3, len(spots))])
    ranges = np.asarray(grids.cast(rays, pose, ANGLES, 5.0))
    ahead = Laser(np.zeros(1), max_range=5.0)
    exact_of = jax.jit(
        jax.vmap(
            lambda p: jax.vmap(lambda q, a: true_ranges(ahead, world, q.at[2].add(a))[0])(p, ANGLES)
        )
    )

    def shifted(side):
        heading = pose[:, 2, None] + ANGLES
        shift = side * cell * np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=-1)
        return np.asarray(exact_of(pose[:, None] + shift))

    left, exact, right = (shifted(side) for side in (1, 0, -1))
    steady = (np.maximum(np.abs(left - exact), np.abs(right - exact)) < 2 * cell) & (exact < 5)
    error = np.abs(ranges - exact)[steady] / cell
    assert steady.mean() > 0.7
    assert error.max() < 0.5
    assert np.median(error) < 0.1
    # The ends of all other beams lie on a wall as well, or the exact range was cut.
    heading = pose[:, 2, None] + ANGLES
    ends = pose[:, None, :2] + ranges[..., None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    )
    around = cell / 2 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    sides = is_free(world, ends[:, :, None] + around)
    assert np.all(sides.any(axis=2) & ~sides.all(axis=2) | (ranges >= 5))


@pytest.mark.parametrize("method", swept(["cells", "surface"], "surface"))
def test_the_derivative_by_the_pose_is_that_of_a_wall(method):
    world, cell = rooms(), 0.05
    rays = grids.ray_map(rasterize(world, cell, yaw=0.3), method=method)
    pose = np.array([[3.0, 2.1, 0.4], [2.6, 3.9, -1.0], [5.7, 2.2, 2.0]])
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda p: grids.cast(rays, p, ANGLES, 9.0))))(pose)
    laser = Laser(ANGLES, max_range=9.0)
    exact = jax.jit(jax.vmap(jax.jacfwd(lambda p: true_ranges(laser, world, p))))(pose)
    level = np.linalg.norm(np.asarray(exact)[..., :2], axis=-1) < 2  # less than 60° from the normal
    error = np.abs(slopes - exact)[level] / [1.0, 1.0, 2.0]  # by the heading as by a shift at 2 m
    assert level.mean() > 0.7
    assert np.median(error) < 0.02
    assert np.mean(error < 0.1) > 0.9


def test_rays_pass_no_wall_of_a_map_that_was_read():
    """By default; one of 57 passes a wall by more than half a metre with "surface"."""
    grid = datasets.read_map(recordings.folder("maps") / "turtlebot3_world.yaml")
    rng, cell, count = np.random.default_rng(0), float(grid.resolution), 5000
    free = np.argwhere(grid.log_odds < 0)
    at = free[rng.integers(len(free), size=count)][:, ::-1] + rng.random((count, 2))
    heading = rng.uniform(-np.pi, np.pi, count)
    pose = np.column_stack([grid.origin[:2] + cell * at, heading])
    occupied = grid.log_odds > 0
    first = [
        cell * traversed(occupied, *p, h, 3.5 / cell) for p, h in zip(at, heading, strict=True)
    ]
    for rays in (grid, grids.ray_map(grid)):
        beyond = np.asarray(grids.cast(rays, pose, np.zeros(1), 3.5))[:, 0] - first
        assert np.abs(beyond).max() < 1e-9  # of a cell's diagonal that one would forgive


def same_rays(grid, method, prepare=grids.ray_map):
    """Whether rays are prepared by a method without being asked for."""
    found, wanted = prepare(grid), grids.ray_map(grid, method=method)
    return found.ahead.shape == wanted.ahead.shape


def test_the_method_is_chosen_by_the_map():
    """A wall of cells that touch by corners and a pillar of one cell, whose corners "surface" cuts;
    a map of shares; one with unknown cells; a traced one."""
    log_odds = np.full((12, 12), -4.0)
    log_odds[np.arange(12), np.arange(12)] = log_odds[3, 6] = 4.0
    log_odds[np.tri(12, k=-1, dtype=bool)] = 0.0
    grid = grid_of(log_odds, resolution=1.0)
    angles = np.linspace(-3.1, 3.1, 400)
    first = np.array([traversed(log_odds > 0, 8.3, 3.6, a, 20.0) for a in angles])
    pose = np.array([8.3, 3.6, 0.0])
    np.testing.assert_allclose(grids.cast(grid, pose, angles, 20.0), first, rtol=0, atol=1e-9)
    cut = grids.cast(grids.ray_map(grid, method="surface"), pose, angles, 20.0)
    assert np.sum(cut - first > 2) > 5
    assert same_rays(grid, "cells")
    share = rasterize(rooms(), 0.1, yaw=0.3)
    assert same_rays(share, "surface")
    scans = share._replace(log_odds=np.where(share.log_odds > 4, 0.0, share.log_odds))
    assert same_rays(scans, "cells")  # cells within walls that no beam reached
    assert same_rays(share, "cells", jax.jit(grids.ray_map))
    model = grids.RayCast(max_range=5.0)
    assert same_rays(share, "surface", model.prepare)
    assert same_rays(grid, "cells", model.prepare)


@pytest.mark.sweep
def test_the_second_derivative_is_that_of_a_wall_too():
    """Its trace once went on without end, through the loop of the rays."""
    log_odds = np.full((20, 30), -2.0)
    log_odds[:, 29] = 2.0
    rays = grids.ray_map(grid_of(log_odds))
    pose, angles = np.array([1.0, 1.0, 0.1]), np.array([0.05, 0.2])
    second = jax.jit(jax.hessian(lambda p: grids.cast(rays, p, angles, 9.0)))(pose)
    slope, far = np.tan(0.1 + angles), 1.9 / np.cos(0.1 + angles)  # r = (2.9 - x)/cos φ
    expected = np.zeros((2, 3, 3))
    expected[:, 2, 2] = far * (1 + 2 * slope**2)
    expected[:, 0, 2] = expected[:, 2, 0] = -far / 1.9 * slope
    np.testing.assert_allclose(second, expected, atol=1e-9)


@pytest.mark.parametrize("method", swept(["cells", "surface"], "surface"))
def test_gradients_are_finite_at_walls_in_obstacles_and_off_the_map(blocks, method):
    grid, at, _, pose = blocks
    rays = grids.ray_map(grid, method=method)
    blocked = np.argwhere(grid.log_odds > 0)[:4, ::-1]
    hard = np.concatenate([blocked + 0.5, blocked, [[0, 0], [31, 23], [-5, 90], [31, 5.5]]])
    world = from_frame(grid.origin, 0.1 * hard)
    poses = np.concatenate([pose, np.column_stack([world, np.full(len(world), 0.6)])])
    angles = np.concatenate([ANGLES[::6], [0.0, np.pi / 2, np.pi, np.pi / 4]])
    slope = jax.jit(jax.vmap(jax.grad(lambda p: grids.cast(rays, p, angles, 1.5).sum())))(poses)
    assert np.all(np.isfinite(slope))
    assert np.all(slope[-2] == 0)  # off the map


def test_what_is_off_the_map_is_not_hit():
    """The surface beside a free cell of the border would go on beyond the map."""
    log_odds = np.full((6, 6), -1.0)
    log_odds[4:, 5] = 1.0
    rays = grids.ray_map(grid_of(log_odds, resolution=1.0), method="surface")
    # One leaves before it is at the wall, y = 4, one after, and one starts off the map.
    poses = np.array([[5.7, 3.0, np.arctan2(1.2, 0.6)], [5.7, 3.0, 1.3], [6.2, 3.4, np.pi / 2]])
    found = jax.jit(lambda p: grids.cast(rays, p, np.zeros(1), 20.0))(poses)[:, 0]
    assert found[0] == found[2] == 20.0
    np.testing.assert_allclose(found[1], 1 / np.sin(1.3))


@refused(
    (
        lambda g: grids.cast(g, np.array([9.0, 0.1, 0.0]), ANGLES, 1.0),
        r"pose 0, .*, is off the map",
    ),
    (lambda g: grids.cast(g, np.array([0.1, np.nan, 0.0]), ANGLES, 1.0), "pose 0"),
    (
        lambda g: grids.cast("x", np.zeros(3), ANGLES, 1.0),
        "cast: grid: expected a Grid or a RayMap, got 'x'",
    ),
    (lambda g: grids.cast(g, "abc", ANGLES, 1.0), "cast: pose: expected real numbers, got 'abc'"),
    (
        lambda g: grids.cast(g, np.zeros(3), ANGLES, "3"),
        "cast: max_range: expected a number above 0, got '3'",
    ),
    (
        lambda g: grids.cast(g._replace(resolution=None), np.zeros(3), ANGLES, 1.0),
        r"ray_map: grid\.resolution: expected a number above 0, got None",
    ),
    (lambda g: grids.cast(g, np.zeros(2), ANGLES, 1.0), r"expected poses \(x, y, θ\)"),
    (
        lambda g: grids.cast(g, np.zeros(3), ANGLES[:0], 1.0),
        r"cast: angles: expected shape \(at least 1,\), got \(0,\)",
    ),
    (
        lambda g: grids.cast(g, np.zeros(3), ANGLES * np.nan, 1.0),
        "cast: angles: expected finite numbers",
    ),
    (
        lambda g: grids.cast(g, np.zeros(3), ANGLES, -1.0),
        r"cast: max_range: expected a number above 0, got -1\.0",
    ),
    (
        lambda g: grids.ray_map(g._replace(log_odds=np.ones((2, 2)))),
        r"ray_map: grid: it has no free cell \(log-odds below 0\)",
    ),
    (lambda g: grids.ray_map(g, method="lut"), 'ray_map: method: expected "surface" or "cells"'),
)
def test_bad_input_is_refused(call):
    call(grid_of(np.full((5, 6), -1.0)))


@pytest.mark.sweep
def test_rays_in_float32(blocks):
    grid, _, _, pose = blocks
    single = jax.tree.map(np.float32, grid)
    for method in ("cells", "surface"):
        exact = grids.cast(grids.ray_map(grid, method=method), pose, ANGLES, 1.5)
        found = grids.cast(
            grids.ray_map(single, method=method), np.float32(pose), np.float32(ANGLES), 1.5
        )
        assert found.dtype == np.float32
        assert np.mean(np.abs(found - exact) < 1e-4) > 0.99  # a ray through a corner may part
