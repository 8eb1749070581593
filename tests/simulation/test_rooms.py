"""Worlds of exact walls: ranges by hand, scans as their laser says, and what a scan cannot see."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept

from jaxslam import catalog, run, simulate
from jaxslam.simulation._wall_geometry import is_free, wall_lines
from jaxslam.simulation.laser import Laser, scan, scan_information, scan_world, true_ranges
from jaxslam.simulation.scenarios import (
    ROOMS,
    circular_room,
    corridor,
    office,
    office_lines,
    square,
    square_lines,
)
from jaxslam.simulation.walls import make_walls, rasterize


def reference_range(world, x, y, angle, limit):
    """By the intersection of two lines, one wall at a time."""
    e, best = np.array([np.cos(angle), np.sin(angle)]), limit
    for a, b in np.asarray(world.segments):
        try:
            r, share = np.linalg.solve(np.stack([e, a - b], axis=1), a - [x, y])
        except np.linalg.LinAlgError:
            continue
        if r > 0 and 0 <= share <= 1:
            best = min(best, r)
    for cx, cy, radius in np.asarray(world.circles):
        roots = np.roots([1, 2 * e @ [x - cx, y - cy], (x - cx) ** 2 + (y - cy) ** 2 - radius**2])
        best = min([best, *(r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0)])
    return best


def test_exact_ranges_are_intersections_with_every_wall(differences):
    turn = 2 * np.pi * np.arange(5) / 5
    star = np.stack([np.cos(turn), np.sin(turn)], axis=1) * [[5], [4], [5], [6], [4]]
    world = make_walls(star, [[1, 1], [2, 1], [1.4, 2]], circles=[[-2, 0, 0.7]])
    rng = np.random.default_rng(0)
    pose = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(-3, 3, 20)])
    angles = np.linspace(-3, 3, 25)
    laser = Laser(angles, max_range=4.5)
    both = jax.jit(
        jax.vmap(
            lambda p: (
                true_ranges(laser, world, p),
                jax.jacfwd(true_ranges, 2)(laser, world, p),
            )
        )
    )
    ranges, slopes = both(pose)
    exact = [[reference_range(world, x, y, h + a, 4.5) for a in angles] for x, y, h in pose]
    np.testing.assert_allclose(ranges, exact, atol=1e-12)
    error = np.abs(slopes - differences(lambda p: both(p)[0], (pose,), 0, 1e-7)).max(axis=2)
    assert np.mean(error < 1e-5) > 0.99  # but where a beam passes an edge between the two sides
    assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("name", swept(ROOMS, "office"))
def test_the_robot_drives_in_free_space_and_its_scans_are_the_lasers(name):
    world = ROOMS[name](beams=24)
    log = scan_world(world, jax.random.key(0))
    assert np.all(is_free(world.walls, np.asarray(log.pose)[:, :2]))
    laser = world.laser
    exact = np.array(jax.jit(jax.vmap(lambda p: true_ranges(laser, world.walls, p)))(log.pose))
    valid = np.asarray(log.beams.valid)
    n = valid.size
    assert abs((~valid).mean() - laser.dropout) < 5 * np.sqrt(laser.dropout / n)
    met = valid & (exact < laser.max_range - 6 * laser.sigma)
    error = (np.asarray(log.beams.range) - exact)[met] / laser.sigma
    assert abs(error.mean()) < 5 / np.sqrt(met.sum())
    assert abs(error.std() - 1) < 5 / np.sqrt(2 * met.sum())
    beyond = valid & (exact >= laser.max_range)
    assert np.all(np.asarray(log.beams.range)[beyond] == laser.max_range)
    assert np.asarray(log.control)[:, 0].std() > 0.03  # the odometry has noise


def test_free_space_is_what_an_odd_number_of_walls_encloses():
    world = make_walls(
        [[0, 0], [4, 0], [4, 4], [0, 4]], [[1, 1], [2, 1], [2, 2]], circles=[[3, 3, 0.5]]
    )
    points = [[0.5, 2], [1.9, 1.5], [1.1, 1.9], [3, 3], [3, 2], [5, 1]]
    np.testing.assert_array_equal(is_free(world, points), [True, False, True, False, True, False])


def test_a_grid_of_shares_has_the_area_of_the_room():
    world = circular_room().walls
    grid = rasterize(world, 0.1, yaw=0.4)
    area = 0.01 * np.sum(1 - np.asarray(grid.probability))
    edge = 0.01 * grid.log_odds.size * 0.5 / 64
    assert area == pytest.approx(np.pi * 9, abs=edge + 0.02)
    assert np.all(grid.observed)


def test_the_directions_that_a_scan_does_not_see_are_named():
    room, hall = circular_room(), corridor()
    found = scan_information(room.laser, room.walls, [0.7, -1.1, 0.3])
    assert found.names == ("rotation about (0.00 m, 0.00 m)",)
    about = np.array([1.1, 0.7, 1.0])
    np.testing.assert_allclose(
        np.abs(found.directions[0]), about / np.linalg.norm(about), atol=1e-6
    )
    np.testing.assert_allclose(found.information @ about, 0, atol=1e-6 * found.information.max())
    found = scan_information(hall.laser, hall.walls, [20.0, 0.2, 0.5])
    assert found.names == ("translation along 0.0°",)
    assert np.sqrt(found.bound[1, 1]) < 0.01
    for world, pose in ((square(), [2, 3, 0.1]), (hall, [3, 0.2, 0.5]), (office(), [1.8, 1.5, 0])):
        assert scan_information(world.laser, world.walls, pose).names == ()


@pytest.mark.sweep
def test_maximum_likelihood_estimates_reach_the_cramer_rao_bound():
    """400 draws, three steps of Gauss and Newton each: the mean NEES under the bound is 3."""
    world = square(beams=60)
    laser, pose = world.laser, np.array([2.1, 3.4, 0.3])
    bound = scan_information(laser, world.walls, pose).bound

    def ranges(pose):
        return true_ranges(laser, world.walls, pose)

    def estimate(key):
        beams = scan(laser, world.walls, pose, key)
        weight = beams.valid / laser.sigma**2
        estimated = jax.numpy.asarray(pose) + 0.02
        for _ in range(3):
            g = jax.jacfwd(ranges)(estimated)
            step = jax.scipy.linalg.solve(
                g.T @ (weight[:, None] * g), g.T @ (weight * (beams.range - ranges(estimated)))
            )
            estimated = estimated + step
        return estimated

    error = np.asarray(jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(1), 400))) - pose
    nees = np.einsum("ni,ij,nj->n", error, np.linalg.inv(bound), error)
    assert abs(nees.mean() - 3) < 4 * np.sqrt(6 / 400) + 0.1


def test_beams_pass_glass_as_often_as_it_says():
    """Of the beams on the east end of the corridor; those that pass meet nothing."""
    world, plain = office(beams=720, glass=0.7), office(beams=720)
    pose = np.array([9.0, 4.1, 0.2])
    exact = np.asarray(true_ranges(plain.laser, plain.walls, pose))
    heading = pose[2] + np.asarray(plain.laser.angles)
    ends = pose[:2] + exact[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    on_glass = (np.abs(ends[:, 0] - 12.0) < 1e-9) & (ends[:, 1] > 3.2) & (ends[:, 1] < 5.0)
    assert on_glass.sum() > 40
    keys = jax.random.split(jax.random.key(0), 20)
    beams = jax.jit(jax.vmap(lambda key: scan(world.laser, world.walls, pose, key)))(keys)
    valid, ranges = np.asarray(beams.valid), np.asarray(beams.range)
    through = ranges == 8.0
    n = valid[:, on_glass].sum()
    share = (through & valid)[:, on_glass].sum() / n
    assert abs(share - 0.7) < 5 * np.sqrt(0.21 / n)
    met = valid & ~through & (exact < 7.9)
    assert np.abs(ranges - exact)[met].max() < 0.12
    assert not np.any((through & valid)[:, ~on_glass & (exact < 7.9)])


def test_the_information_of_a_scan_through_glass_is_that_of_both_walls_by_their_shares():
    """A pillar of glass in a room, of which two sides let all beams pass, and the third a share."""
    laser, pose = Laser(np.linspace(-3, 3, 60), dropout=0.1), np.array([1.0, 1.2, 0.4])
    room, pillar = [[0, 0], [6, 0], [6, 3], [0, 3]], [[3, 1], [3.1, 1], [3.1, 2.5]]

    def seen(*chains, **more):
        return scan_information(laser, make_walls(*chains, **more), pose).information

    def through(*shares):
        return seen(room, pillar, glass={(1, side): share for side, share in enumerate(shares)})

    none, solid, front = seen(room), seen(room, pillar), through(1.0, 1.0, 0.0)
    np.testing.assert_allclose(through(0.0, 0.0, 0.0), solid, rtol=1e-9)
    np.testing.assert_allclose(through(1.0, 1.0, 1.0), none, rtol=1e-9)
    np.testing.assert_allclose(through(1.0, 1.0, 0.3), 0.7 * front + 0.3 * none, rtol=1e-9)
    world, plain = office(beams=90, glass=1.0), office(beams=90)
    at = np.array([9.0, 4.1, 0.2])
    clear = np.diag(scan_information(world.laser, world.walls, at).bound)
    assert np.all(clear > np.diag(scan_information(plain.laser, plain.walls, at).bound))


def test_a_laser_and_its_world_hold_numbers_alone():
    world = dataclasses.replace(
        square(beams=8), laser=Laser(np.linspace(-3, 3, 8), 0.02, mount=(0.2, 0, 0))
    )
    assert [np.shape(leaf) for leaf in jax.tree.leaves(world.laser)] == [(8,), (), (), (), (3,)]
    assert jax.tree.structure(world) == jax.tree.structure(pickle.loads(pickle.dumps(world)))
    assert jax.tree.structure(world) != jax.tree.structure(dataclasses.replace(world, name="b"))
    first, key = scan_world(world, jax.random.key(0)), jax.random.key(0)
    laser = dataclasses.replace(world.laser, sigma=0.1, mount=np.array([-0.3, 0.1, 0.2]))
    other = dataclasses.replace(world, laser=laser)
    with worlds.nothing_compiled():
        second = scan_world(other, key)
    np.testing.assert_array_equal(first.pose, second.pose)
    assert np.all(first.beams.range != second.beams.range)
    at, along = jnp.array([3.0, 3.0, 0.0]), Laser([0.0], mount=np.array([0.2, 0.1, 0.0]))
    slope = jax.grad(lambda laser: true_ranges(laser, world.walls, at).sum())(along)
    # The wall is at x = 6: the range is (6 - x)/cos θ.
    np.testing.assert_allclose(slope.mount, [-1, 0, 0], atol=1e-12)
    assert type(slope) is Laser and slope.sigma == 0


@refused(
    (lambda: make_walls([[0, 0], [1, 0], [0, 1]], glass={(0, 3): 0.5}), "chain 0 has no side 3"),
    (lambda: make_walls([[0, 0], [1, 0], [0, 1]], glass={(0, 1): 1.5}), "share in"),
    (
        lambda: rasterize(0.1, make_walls(circles=[[0, 0, 1]])),
        r"rasterize: world: expected Walls, got 0\.1",
    ),
    (lambda: make_walls(), "make_walls: expected at least one wall"),
    (
        lambda: make_walls(circles=[[1, 2]]),
        r"make_walls: circles: expected \(x, y, radius\), got shape \(1, 2\)",
    ),
    (
        lambda: make_walls([[0, 0], [1, 1]]),
        r"make_walls: chains: expected chain 0 of at least three corners \(x, y\), got",
    ),
    (
        lambda: make_walls(circles=[[0, 0, 0]]),
        "make_walls: expected finite numbers and radii above 0",
    ),
    (lambda: Laser([]), r"Laser: angles: expected finite angles \(at least 1,\), got \(0,\)"),
    (lambda: Laser([0.0], sigma=0.0), r"Laser: sigma: expected a number above 0, got 0\.0"),
    (
        lambda: Laser([0.0], max_range=np.inf),
        "Laser: max_range: expected a number above 0, got inf",
    ),
    (lambda: Laser([0.0], dropout=2.0), r"Laser: dropout: expected a number from 0 to 1, got 2\.0"),
    (
        lambda: Laser([0.0], mount=(0, 0)),
        r"Laser: mount: expected a mounting pose of shape \(3,\), got \(2,\)",
    ),
    (
        lambda: rasterize(square().walls, 0.0),
        r"rasterize: resolution: expected a number above 0, got 0\.0",
    ),
    (
        lambda: scan_information(Laser([0.0], max_range=0.1), square().walls, [3, 3, 0]),
        r"scan_information: pose: no beam from \[3\. 3\. 0\.\] meets a wall within",
    ),
    (
        lambda: scan_information(Laser([0.0]), square().walls, [3, 3]),
        r"scan_information: pose: expected \(x, y, θ\), got shape \(2,\)",
    ),
)
def test_bad_input_is_refused(call):
    call()


# --- Walls as lines: the lines of a room, which of them are seen, and an EKF that maps them -------


def test_the_lines_of_a_box_and_of_a_thin_wall():
    box = make_walls([(0, 0), (4, 0), (4, 3), (0, 3)], [(1, 1), (3, 1), (3, 1.2), (1, 1.2)])
    lines, index = wall_lines(box)
    np.testing.assert_array_equal(index, np.arange(8))
    quarter = np.pi / 2
    outer = [[0, -quarter], [4, 0], [3, quarter], [0, np.pi]]
    # The two faces of the thin wall have normals that point into it.
    inner = [[1, quarter], [-3, np.pi], [-1.2, -quarter], [1, 0]]
    gap = lines - np.array(outer + inner)
    np.testing.assert_allclose(np.exp(1j * gap), 1, atol=1e-12)
    np.testing.assert_allclose(gap[:, 0], 0, atol=1e-12)


def test_segments_on_one_line_share_it():
    lines, index = wall_lines(office().walls)
    segments = np.asarray(office().walls.segments)
    assert len(lines) == 36 < len(segments) == len(index)
    normal = np.stack([np.cos(lines[index, 1]), np.sin(lines[index, 1])], axis=1)
    off = np.einsum("kea,ka->ke", segments, normal) - lines[index, :1]
    np.testing.assert_allclose(off, 0, atol=1e-9)
    assert is_free(office().walls, segments.mean(axis=1) - 1e-4 * normal).all()


def test_rooms_without_segments_or_with_walls_of_no_thickness_are_refused():
    with pytest.raises(ValueError, match="wall_lines: world: expected at least one segment"):
        wall_lines(make_walls(circles=[[0, 0, 1]]))
    flat = make_walls([(0, 0), (4, 0), (2, 0)])
    with pytest.raises(ValueError, match="wall_lines: segment 0 has no free side"):
        wall_lines(flat)


@pytest.mark.parametrize("make", swept([office_lines, square_lines], square_lines))
def test_a_scan_has_the_walls_in_view_and_no_other(make):
    world = make()
    truth, log = simulate(world, jax.random.key(0))
    assert truth.missed.sum() == 0
    scan = jax.tree.map(np.asarray, log.scan)
    assert (scan.valid.sum(axis=1) >= 3).all()
    # A wall is seen from its free side; 6 σ.
    assert (scan.z[scan.valid][:, 0] > -0.12).all()
    if make is square_lines:
        assert scan.valid.all()
    with pytest.raises(ValueError, match=f"{world.name}: steps: expected at most {world.steps}"):
        make(world.steps + 1)


@pytest.mark.sweep
def test_the_ekf_of_lines_is_honest_over_a_few_steps():
    """100 runs of 12 steps; where the drive is short, the EKF's linearization costs nothing."""
    world = square_lines(12)
    filter = catalog.FILTERS["ekf"](world)

    def drive(key):
        truth, log = simulate(world, key)
        trace = run(filter, log, world.pose, world.pose_cov, key)
        return truth.pose, trace.estimate, trace.info

    pose, estimate, info = jax.jit(jax.vmap(drive))(jax.random.split(jax.random.key(3), 100))
    pose, estimate, info = jax.tree.map(np.asarray, (pose, estimate, info))
    # Four standard errors, here and below; the first scan starts the map.
    dof = info.dof.sum()
    assert dof == 2 * 4 * 11 * 100
    assert abs(info.nis.sum() - dof) < 4 * np.sqrt(2 * dof)
    error = pose[:, -1] - estimate.pose[:, -1]
    nees = worlds.nees(error, estimate.pose_cov[:, -1])
    assert abs(nees.mean() - 3) < 4 * np.sqrt(6 / 100)
    np.testing.assert_array_equal(estimate.tag[:, -1], np.tile(np.arange(4), (100, 1)))
    r, alpha = np.asarray(world.landmarks).T
    off = r[:, None] * np.stack([np.cos(alpha), np.sin(alpha)], axis=1) - estimate.points[:, -1]
    nees = worlds.nees(off, estimate.point_covs[:, -1])
    assert abs(nees.mean() - 2) < 4 * np.sqrt(4 / 100)
