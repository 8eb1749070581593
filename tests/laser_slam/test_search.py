"""A scan against points: the lattice's maximum, the nearest point, the pose by lines."""

import jax
import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven

from jaxslam.laser_slam import poses, scans_of
from jaxslam.laser_slam.search import (
    BLUR,
    CELL,
    PENALTY,
    Reference,
    Window,
    _nearest,
    correlate,
    fit_lines,
    tables,
)

WINDOW = Window(turns=3, turn=0.05, blocks=1, level=2, kept=64)
OFFSET = np.array([0.22, -0.13, 0.06], np.float32)


@pytest.fixture(scope="module")
def pair():
    """A scan as reference, and the same place from half a metre on."""
    true, log = driven(3)
    scans = scans_of(log, SETTINGS)
    reference = Reference(scans.points[0], scans.normals[0], scans.valid[0])
    z = poses.between(true[0], true[1]).astype(np.float32)
    return reference, scans.points[1], scans.valid[1], z


@pytest.fixture(scope="module")
def found(pair):
    reference, points, valid, z = pair
    start = z + OFFSET

    def one(reference, points, valid, start):
        nothing = np.zeros((3, 3), np.float32)
        best = correlate(tables(reference, WINDOW.level), points, valid, start, nothing, WINDOW)
        return best, fit_lines(reference, points, valid, best.pose, start, nothing)

    best, fit = jax.jit(one)(reference, points, valid, start)
    return start, best, fit


def test_correlation_is_the_maximum_over_the_lattice(pair, found):
    """In NumPy: every turn and shift, each point scored by its cell."""
    reference, points, valid, _ = pair
    start, best, _ = found
    cells = np.floor(reference.points[reference.valid] / CELL).astype(int)
    near = np.arange(-3, 4)

    def score(point):
        offset = np.floor(point / CELL).astype(int) - cells
        offset = offset[(np.abs(offset) <= near[-1]).all(axis=1)]
        return np.exp(-0.5 * ((CELL / BLUR) * offset) ** 2).prod(axis=1).max(initial=0.0)

    top = 0.0
    for turn in WINDOW.turn * np.arange(-WINDOW.turns, WINDOW.turns + 1):
        c, s = np.cos(start[2] + turn), np.sin(start[2] + turn)
        moved = points[valid] @ np.array([[c, s], [-s, c]]) + start[:2]
        for i in range(-4, 8):
            for j in range(-4, 8):
                here = np.floor(moved / CELL) * CELL + CELL / 2 + CELL * np.array([j, i])
                top = max(top, np.mean([score(point) for point in here]))
    np.testing.assert_allclose(best.score, top, rtol=1e-4)
    assert PENALTY > 0


def test_lines_find_the_pose(pair, found):
    z, fit = pair[3], found[2]
    off = poses.between(z.astype(float), np.asarray(fit.pose, float))
    assert np.hypot(*off[:2]) < 0.02 and abs(off[2]) < 0.01
    assert float(fit.inliers) > 0.8
    assert np.linalg.eigvalsh(np.asarray(fit.information, float)).min() > 0.5


def test_nearest_point(pair):
    reference, points, valid, _ = pair
    of = reference.points[reference.valid]
    got = np.asarray(jax.jit(_nearest)(points, of, (of**2).sum(axis=1)))
    distance = np.linalg.norm(points[:, None] - of[None], axis=-1)
    chosen = distance[np.arange(len(points)), got]
    np.testing.assert_allclose(chosen, distance.min(axis=1), rtol=1e-2, atol=1e-2)
