"""Correlative matching against all poses of its window; the field; bad scans."""

import jax
import numpy as np
import pytest
from scanned_rooms import moved, pairs

from jaxslam import matching
from jaxslam.matching import MatchStatus

CELL, WINDOW, TURN_WINDOW, TURN, SPREAD = 0.1, 0.3, 0.1, 0.02, 0.1
COUNT = 4
MATCHER = matching.correlative(
    cell=CELL, window=WINDOW, turn_window=TURN_WINDOW, turn=TURN, sigma=SPREAD, block=3
)
REFERENCES, SCANS, TRUTH, STARTS = pairs(COUNT, off=(0.08, 0.08, 0.04), beams=600)


@pytest.fixture(scope="module")
def found():
    """Grids, what is prepared of them, matches on the lattice, and refined by the field."""
    grids = jax.jit(jax.vmap(lambda p: matching.raster(p, CELL, 5.0)))(REFERENCES)
    prepared = jax.jit(lambda g: jax.lax.map(MATCHER.prepare, g))(grids)
    coarse = jax.jit(jax.vmap(MATCHER.match))(prepared, SCANS, STARTS)
    fine = matching.match(matching.field(least_score=0.3), grids, SCANS, coarse.pose)
    return jax.tree.map(np.asarray, (grids, prepared, coarse, fine))


def test_the_maximum_is_that_of_all_poses(found):
    grids, prepared, coarse, _ = found
    shifts = np.arange(-3, 4)
    turns = TURN * np.arange(-5, 6)
    for k in range(COUNT):
        d = prepared.field.values[k]
        table = np.exp(-0.5 * (d / SPREAD) ** 2)
        best, where = -1.0, None
        for turn in turns:
            pose = np.array([*STARTS[k, :2], STARTS[k, 2] + turn])
            cells = np.floor((moved(SCANS.position[k], pose) - grids.origin[k, :2]) / CELL)
            for x in shifts:
                for y in shifts:
                    at = (cells + [x, y]).astype(int)
                    inside = np.all((at >= 0) & (at < len(d)), axis=1)
                    at = np.clip(at, 0, len(d) - 1)
                    score = np.where(inside, table[at[:, 1], at[:, 0]], 0.0).mean()
                    if score > best + 1e-12:
                        best, where = score, pose + [x * CELL, y * CELL, 0]
        assert coarse.score[k] == pytest.approx(best, abs=1e-12)
        np.testing.assert_allclose(coarse.pose[k], where, atol=1e-9)
    assert np.all(coarse.status == MatchStatus.CONVERGED)
    assert np.all(np.abs(coarse.pose - TRUTH) < [CELL, CELL, 2 * TURN])


def test_the_field_refines_it(found):
    *_, coarse, fine = found
    assert np.all(fine.status <= MatchStatus.NOT_CONVERGED)
    error = np.abs(fine.pose - TRUTH)
    # Of cells of 10 cm, 30 points each: 10/√(12·30) cm, and as much over 1.7 m; three times that.
    assert np.all(error < [0.016, 0.016, 0.01])
    assert error.sum() < np.abs(coarse.pose - TRUTH).sum()


def test_a_long_corridor_is_degenerate_and_a_wide_window_ambiguous():
    """Walls at y = ±1 beyond the range along x: shifts along x fit as well."""
    references, scans, _, starts = pairs(1, half=(1e3, 1.0), off=(0.0, 0.0, 0.0), beams=600)
    for of in (references, scans):
        of.valid[:] = np.abs(of.position).max(axis=2) < 4.5
    grid = matching.raster(jax.tree.map(lambda a: a[0], references), CELL, 5.0)
    scan = jax.tree.map(lambda a: a[0], scans)
    matcher = matching.correlative(
        cell=CELL, window=WINDOW, turn_window=TURN_WINDOW, turn=TURN, sigma=SPREAD, block=3,
        apart=0.15, ambiguous=0.8,
    )  # fmt: skip
    found = matching.match(matcher, grid, scan, starts[0])
    assert int(found.status) in (MatchStatus.AMBIGUOUS, MatchStatus.DEGENERATE)
