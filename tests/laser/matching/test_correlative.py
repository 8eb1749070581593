"""Correlative matching against all poses of its window; the field; bad scans."""

import jax
import numpy as np
import pytest
from cases import swept
from reference.plane import from_frame
from scanned_rooms import pairs, points_at, stacked

from jaxslam import matching
from jaxslam.laser.matching import MatchStatus

CELL, WINDOW, TURN_WINDOW, TURN, SPREAD = 0.1, 0.3, 0.1, 0.02, 0.1
COUNT = 4
MATCHER = matching.Correlative(
    cell=CELL, window=WINDOW, turn_window=TURN_WINDOW, turn=TURN, sigma=SPREAD, block=4
)
STRICT = matching.Correlative(
    cell=CELL, window=WINDOW, turn_window=TURN_WINDOW, turn=TURN, sigma=SPREAD,
    apart=0.15, ambiguous=0.8,
)  # fmt: skip
RASTERS = jax.jit(jax.vmap(lambda points: matching.raster(points, CELL, 5.0)))
REFERENCES, SCANS, TRUTH, STARTS = pairs(COUNT, off=(0.08, 0.08, 0.04), beams=600)
PRIOR = matching.Prior(STARTS, np.zeros((COUNT, 3, 3)))
PRIOR.information[2:] = 60 * (np.diag([4.0, 4.0, 1.0]) + 0.5)  # of all points, so that it matters


@pytest.fixture(scope="module")
def found():
    """Grids, what is prepared of them, matches on the lattice, and refined by the field."""
    grids = RASTERS(REFERENCES)
    prepared = jax.jit(lambda g: jax.lax.map(MATCHER.prepare, g))(grids)
    coarse = jax.jit(jax.vmap(MATCHER.match))(prepared, SCANS, STARTS, PRIOR)
    fine = matching.match(matching.FieldMatcher(least_score=0.3), grids, SCANS, coarse.pose)
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
            cells = np.floor((from_frame(pose, SCANS.position[k]) - grids.origin[k, :2]) / CELL)
            for x in shifts:
                for y in shifts:
                    at = (cells + [x, y]).astype(int)
                    inside = np.all((at >= 0) & (at < len(d)), axis=1)
                    at = np.clip(at, 0, len(d) - 1)
                    score = np.where(inside, table[at[:, 1], at[:, 0]], 0.0).mean()
                    off = np.array([x * CELL, y * CELL, turn])
                    score -= off @ PRIOR.information[k] @ off / (2 * SPREAD**2 * len(cells))
                    if score > best + 1e-12:
                        best, where = score, pose + [x * CELL, y * CELL, 0]
        off = where - STARTS[k]
        taken = off @ PRIOR.information[k] @ off / (2 * SPREAD**2 * SCANS.valid[k].sum())
        assert coarse.score[k] - taken == pytest.approx(best, abs=1e-12)
        np.testing.assert_allclose(coarse.pose[k], where, atol=1e-9)
    assert np.all(coarse.status == MatchStatus.CONVERGED)
    near = np.abs(coarse.pose - TRUTH) < [CELL, CELL, 2 * TURN]
    assert np.all(near[:2]) and not np.all(near[2:])  # the prior holds the last two back


def test_the_field_refines_it(found):
    *_, coarse, fine = found
    assert np.all(fine.status <= MatchStatus.NOT_CONVERGED)
    error = np.abs(fine.pose - TRUTH)
    # Of cells of 10 cm, 30 points each: 10/√(12·30) cm, and as much over 1.7 m; three times that.
    assert np.all(error < [0.016, 0.016, 0.01])
    assert error.sum() < np.abs(coarse.pose - TRUTH).sum()


def round_room(pose, beams):
    """The scan of a round room of 3 m about the origin."""
    scan = points_at(pose, np.random.default_rng(1), beams=beams)
    heading = pose[2] + np.arctan2(scan.ray[:, 1], scan.ray[:, 0])
    along = pose[:2] @ np.stack([np.cos(heading), np.sin(heading)])
    ranges = -along + np.sqrt(along**2 + 9 - pose[:2] @ pose[:2])
    ranges += 0.01 * np.random.default_rng(beams).standard_normal(beams)
    return scan._replace(position=ranges[:, None] * scan.ray)


@pytest.mark.parametrize("name", swept(["field", "correlative"], "correlative"))
def test_what_a_scan_does_not_determine_is_named(name):
    """A corridor beyond the range, and a round room, which any turn about its middle fits."""
    at = np.array([0.8, 0.5, 0.0])
    rng = np.random.default_rng(3)
    halls = [points_at(np.full(3, 1e-3), rng, half=(1e3, 1.0), beams=beams) for beams in (600, 60)]
    for hall in halls:
        hall.valid[:] = np.abs(hall.position).max(axis=1) < 4.5
    references = stacked([halls[0], round_room(at, 600)])
    scans = stacked([halls[1], round_room(at, 60)])
    grids = RASTERS(references)
    matcher = {"field": matching.FieldMatcher(least_score=0.3), "correlative": STRICT}[name]
    start = np.array([[0.1, 0.05, 0.02], [0.0, 0.05, 0.02]])
    found = jax.device_get(matching.match(matcher, grids, scans, start))
    assert list(found.status) == [MatchStatus.DEGENERATE] * 2
    # About the middle of the room, where the robot is at (x, y), it moves by dθ (-y, x).
    ways = np.array([[1.0, 0.0, 0.0], [-at[1], at[0], 1.0]])
    square = np.where(scans.valid, (scans.position**2).sum(axis=2), 0.0)
    length = np.sqrt(square.sum(axis=1) / scans.valid.sum(axis=1))
    scale = np.stack([[1.0, 1.0, each] for each in length])
    ways, weakest = ways * scale, found.weakest * scale
    cosine = (ways * weakest).sum(axis=1) / np.linalg.norm(ways, axis=1)
    np.testing.assert_allclose(np.abs(cosine), 1, rtol=0.01)
    if name == "field":
        # Along it the pose is that of the start.
        moved = ((found.pose - start) * scale * ways).sum(axis=1) / np.linalg.norm(ways, axis=1)
        assert np.all(np.abs(moved) < 0.02)
    off_the_map = matching.match(matcher, grids, scans, start + [[1e3, 1e3, 0.0]])
    assert np.all(off_the_map.status >= MatchStatus.UNLIKE)


def test_a_map_with_two_places_that_fit_alike_is_ambiguous():
    """A room that stands once in a map, and twice in another, as before a loop is closed."""
    rng = np.random.default_rng(5)
    at, places = np.array([0.05, 0.05, 0.0]), np.array([[0.0, 0.0], [0.2, 0.2]])
    rooms = [points_at(at, rng, beams=300) for _ in places]
    references = [
        matching.Points(
            np.concatenate([room.position + place for room, place in zip(rooms, of, strict=True)]),
            np.concatenate([room.ray for room in rooms]),
            np.ones(600, bool),
        )
        for of in (places[[0, 0]], places)
    ]
    scans = stacked([points_at(at, rng)] * 2)
    start = np.array([[0.1, 0.1, 0.0]] * 2)
    grids = RASTERS(stacked(references))
    found = jax.device_get(matching.match(STRICT, grids, scans, start))
    assert list(found.status) == [MatchStatus.CONVERGED, MatchStatus.AMBIGUOUS]
    # Of both places it names one.
    off = np.abs(found.pose[:, None, :2] - places).max(axis=2)
    assert off[0, 0] < CELL and off[1].min() < CELL
    assert np.all(np.abs(found.pose[:, 2]) <= TURN)
