"""Segments of scans: the lines of a room, their covariances held against draws, what is left out."""

import numpy as np
import pytest
from cases import refused, swept

from jaxslam.core.types import Beams
from jaxslam.laser.features import fit_line, segments

SIGMA = 0.02
SQUARE = np.array([[-2.0, -1.0], [4.0, -1.0], [4.0, 3.0], [-2.0, 3.0]])
"""Corners of a room, the laser at the origin."""
WALLS = np.array([[1.0, -np.pi / 2], [4.0, 0.0], [3.0, np.pi / 2], [2.0, np.pi]])


def scan(angle, seed=None, lines=WALLS, sigma=SIGMA):
    """The ranges in a convex room of these lines, with noise."""
    toward = np.cos(angle[:, None] - lines[:, 1])
    met = np.where(toward > 1e-9, lines[:, 0] / np.maximum(toward, 1e-9), np.inf)
    noise = 0.0 if seed is None else np.random.default_rng(seed).normal(size=len(angle)) * sigma
    exact = met.min(axis=1) + noise
    return Beams(exact, angle, np.ones(len(angle), bool))


def off(line, true):
    gap = line - true
    gap[..., 1] = np.angle(np.exp(1j * gap[..., 1]))
    return gap


def nearest(found):
    """The index of the wall of each found line."""
    gap = np.abs(off(found.line[:, None], WALLS[None])).sum(axis=2)
    assert (gap.min(axis=1) < 0.2).all()
    return gap.argmin(axis=1)


AROUND = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def test_a_room_has_its_four_walls_each_once_and_across_the_seam():
    walls = segments(scan(AROUND), sigma=SIGMA, max_range=10)
    assert sorted(nearest(walls)) == [0, 1, 2, 3]  # the seam is within wall 3
    np.testing.assert_allclose(off(walls.line, WALLS[nearest(walls)]), 0, atol=1e-9)
    assert walls.left == 360 - walls.size.sum() == 4 * 4
    for (r, alpha), ends in zip(walls.line, walls.ends, strict=True):
        np.testing.assert_allclose(ends @ [np.cos(alpha), np.sin(alpha)], r, atol=1e-9)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize(
    "angle",
    [
        np.linspace(0, 6.28319, 360),  # of a TurtleBot3 in Gazebo: 4.7e-6 above a turn
        np.linspace(-np.float32(np.pi), np.float32(np.pi), 361),
        np.linspace(0, 2 * np.pi, 360),
    ],
)
def test_the_first_beam_once_more_is_no_other_beam(angle, lost):
    """The segments are those without one of the two: the last, or the first where that is lost."""
    beams = scan(np.append(angle, np.nan), 0)  # a direction that is not finite says nothing
    beams.range[0] = np.nan if lost else beams.range[0]
    once = Beams(*(part[1:-1] if lost else part[:-2] for part in beams))
    walls, expected = (segments(of, sigma=SIGMA, max_range=10) for of in (beams, once))
    assert sorted(nearest(walls)) == [0, 1, 2, 3]
    for a, b in zip(walls, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_covariance_of_a_fit_is_that_of_the_draws():
    """A wall seen from -30° to 70°, 600 draws of the ranges and of the directions."""
    angle, true, noise = np.deg2rad(np.arange(-30, 71.0)), np.array([2.0, 0.0]), (0.03, 0.004)
    rng = np.random.default_rng(0)
    errors, white = [], []
    for _ in range(600):
        turned = angle + rng.normal(size=len(angle)) * noise[1]
        distance = 2.0 / np.cos(turned) + rng.normal(size=len(angle)) * noise[0]
        line, cov, chi2 = fit_line(angle, distance, *noise)
        errors.append(off(line, true))
        white.append((errors[-1] @ np.linalg.solve(cov, errors[-1]), chi2))
    nees, chi2 = np.mean(white, axis=0)
    # Four standard errors of the means of χ² of 2 and of 99 degrees of freedom.
    assert abs(nees - 2) < 4 * np.sqrt(4 / 600)
    assert abs(chi2 - 99) < 4 * np.sqrt(198 / 600) + 1.0  # and the second order of the directions
    np.testing.assert_allclose(np.cov(np.array(errors).T), cov, rtol=0.25, atol=1e-7)
    sigma = np.sqrt(np.diag(cov) / 600)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * sigma + [1e-3, 0])


def test_segments_of_noisy_scans_are_honest():
    white = []
    for seed in range(60):
        walls = segments(scan(AROUND, seed), sigma=SIGMA, max_range=10)
        which = nearest(walls)
        assert len(set(which)) == len(which)  # no wall twice
        gap = off(walls.line, WALLS[which])
        white += list(np.einsum("ki,kij,kj->k", gap, np.linalg.inv(walls.cov), gap))
    assert len(white) >= 0.98 * 240
    assert abs(np.mean(white) - 2) < 4 * np.sqrt(4 / len(white))


def test_the_normal_points_into_the_wall_wherever_the_wall_is():
    angle = np.deg2rad(np.arange(100.0, 171.0))  # a wall behind, to the left
    (r, alpha), _, _ = fit_line(angle, 3.0 / np.cos(angle - 2.5), SIGMA)
    np.testing.assert_allclose([r, alpha], [3.0, 2.5], atol=1e-9)


def test_jumps_divide_and_what_is_no_wall_is_left_out():
    beams = scan(AROUND, seed=1)
    beams.range[100:110] = 0.5  # somebody stands there
    beams.range[200] = np.nan
    beams.valid[201] = False
    beams.range[300:310] = 12.0
    walls = segments(beams, sigma=SIGMA, max_range=10)
    assert set(nearest(walls)) == {0, 1, 2, 3}
    assert walls.left == 348 - walls.size.sum()
    none = beams._replace(valid=np.zeros(360, bool))
    assert segments(none, sigma=SIGMA, max_range=10).left == 0


@pytest.mark.parametrize(("beams", "scans"), [(90, 60), (180, 60), (360, 30), (720, 30)])
def test_a_round_room_has_next_to_no_segment(beams, scans):
    """The circular room of the scenarios; its benchmark has at most 0.04 lines a scan."""
    rng = np.random.default_rng(beams)
    angle = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    e = np.stack([np.cos(angle), np.sin(angle)])
    count = 0
    for at in rng.uniform([-1.5, -1.0], [1.5, 1.0], (scans, 2)):
        exact = -at @ e + np.sqrt(9 - at @ at + (at @ e) ** 2)
        seen = Beams(exact + SIGMA * rng.normal(size=beams), angle, rng.random(beams) > 0.02)
        count += len(segments(seen, sigma=SIGMA, max_range=10).line)
    assert count <= 0.04 * scans + 4 * np.sqrt(0.04 * scans)


@pytest.mark.parametrize("beams", swept([8, 30], 8))
def test_a_bent_wall_is_found_as_often_as_the_docstring_says_and_a_straight_one_kept(beams):
    """One segment at 20 m, an arc whose sagitta is so many σ; no neighbour helps."""
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, beams)
    angle = np.arctan(x / 20)
    for sagitta, least, most in ((0, 0, 0.002), (11, 0.5, 1), (17, 0.95, 1)):
        bend, lost, draws = sagitta / np.sqrt(beams) * SIGMA * x**2, 0, 400
        for noise in SIGMA * rng.normal(size=(draws, beams)):
            seen = Beams((20 - bend) / np.cos(angle) + noise, angle, np.ones(beams, bool))
            lost += not len(segments(seen, sigma=SIGMA, max_range=30, trim=0).line)
        sigma = np.sqrt(draws * 0.25 if sagitta == 11 else draws * 0.05 if sagitta else 0.8)
        assert least * draws - 4 * sigma <= lost <= most * draws + 4 * sigma


@refused(
    ({"range": np.ones(3)}, {}, "segments: expected one scan"),
    ({"angle": AROUND[::-1]}, {}, "segments: expected angles that increase"),
    ({"angle": 1.01 * AROUND}, {}, "segments: expected angles that increase within one turn"),
    ({}, {"sigma": 0.0}, "segments: sigma: expected a number above 0"),
    ({"range": np.full(360, 1e-300)}, {}, "fit_line: expected beams"),
    ({}, {"least": 2}, "segments: least: expected an integer >= 3"),
)
def test_bad_input_is_refused(change, options):
    segments(scan(AROUND)._replace(**change), **({"sigma": 0.1, "max_range": 9} | options))


def test_what_is_no_scan_is_refused():
    with pytest.raises(ValueError, match="segments: beams: expected Beams, got 'x'"):
        segments("x", sigma=0.1, max_range=9)


@refused(
    (np.zeros(4), np.ones(4), SIGMA, "expected beams that end at different points"),
    (np.zeros(3), np.arange(1.0, 4), SIGMA, "expected beams whose ends are not in line with"),
    (AROUND[:3], np.full(3, 1e-300), SIGMA, "expected beams whose ends are not in line with"),
    (AROUND[:3], np.ones(3), 0.0, "sigma: expected a number above 0, got 0.0"),
    (AROUND[:3], np.array([1, np.nan, 1]), SIGMA, "expected finite angles and ranges"),
    told="fit_line: ",
)
def test_beams_that_make_no_line_are_refused(angle, distance, sigma):
    fit_line(angle, distance, sigma)
