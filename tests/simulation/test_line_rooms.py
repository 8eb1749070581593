"""Walls as lines: the lines of a room, which of them are seen, and an EKF that maps them."""

import jax
import numpy as np
import pytest
import worlds

from jaxslam import catalog, run
from jaxslam.simulation import walls
from jaxslam.simulation.scenarios import office, office_lines, square_lines
from jaxslam.simulation.worlds import simulate


def test_the_lines_of_a_box_and_of_a_thin_wall():
    box = walls.walls([(0, 0), (4, 0), (4, 3), (0, 3)], [(1, 1), (3, 1), (3, 1.2), (1, 1.2)])
    lines, index = walls.wall_lines(box)
    np.testing.assert_array_equal(index, np.arange(8))
    quarter = np.pi / 2
    outer = [[0, -quarter], [4, 0], [3, quarter], [0, np.pi]]
    # The two faces of the thin wall have normals that point into it.
    inner = [[1, quarter], [-3, np.pi], [-1.2, -quarter], [1, 0]]
    gap = lines - np.array(outer + inner)
    np.testing.assert_allclose(np.exp(1j * gap), 1, atol=1e-12)
    np.testing.assert_allclose(gap[:, 0], 0, atol=1e-12)


def test_segments_on_one_line_share_it():
    lines, index = walls.wall_lines(office().walls)
    segments = np.asarray(office().walls.segments)
    assert len(lines) == 36 < len(segments) == len(index)
    normal = np.stack([np.cos(lines[index, 1]), np.sin(lines[index, 1])], axis=1)
    off = np.einsum("kea,ka->ke", segments, normal) - lines[index, :1]
    np.testing.assert_allclose(off, 0, atol=1e-9)
    assert walls.is_free(office().walls, segments.mean(axis=1) - 1e-4 * normal).all()


def test_rooms_without_segments_or_with_walls_of_no_thickness_are_refused():
    with pytest.raises(ValueError, match="wall_lines: expected at least one segment"):
        walls.wall_lines(walls.walls(circles=[[0, 0, 1]]))
    flat = walls.walls([(0, 0), (4, 0), (2, 0)])
    with pytest.raises(ValueError, match="wall_lines: segment 0 has no free side"):
        walls.wall_lines(flat)


@pytest.mark.parametrize("make", [office_lines, square_lines])
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
    with pytest.raises(ValueError, match=f"{world.name}: expected at most {world.steps} steps"):
        make(world.steps + 1)


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
