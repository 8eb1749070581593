"""A range of 0, NaN, -1, infinite or above the maximum says the same to all that take beams."""

import jax
import numpy as np
import pytest

from jaxslam import datasets, features, grids, matching
from jaxslam.core.types import Beams

FAR = 8.0
NOTHING = [0.0, np.nan, -1.0, -np.inf]
FREE = [np.inf, FAR, FAR + 1, np.nextafter(np.float32(FAR), 0)]
ANGLES = np.linspace(-np.pi, np.pi, 72, endpoint=False)
ODD = np.full(72, 3.0)
ODD[24:56], ODD[56:] = np.repeat(NOTHING, 8), np.repeat(FREE, 4)
SEEN = Beams(ODD, ANGLES, np.ones(72, bool))
"""24 beams that met something, 32 that say nothing, 16 that met nothing."""
PLAIN = Beams(np.r_[np.full(56, 3.0), np.full(16, FAR)], ANGLES, np.arange(72) // 32 != 1)
PLAIN.valid[:] = (np.arange(72) < 24) | (np.arange(72) >= 56)
"""The same in plain numbers."""
MAP = grids.Grid(
    np.where(np.hypot(*np.mgrid[-4:4.1:0.5, -4:4.1:0.5]) < 3, -1.0, 1.0), [-4.25, -4.25, 0], 0.5
)
MAP = grids.Grid(MAP.log_odds, np.array(MAP.origin), np.array(MAP.resolution))


def rows(beams):
    return Beams(*(part[None] for part in beams))


def counted(beams):
    return grids.count(
        (21, 21), [-5.25, -5.25, 0], 0.5, np.zeros((1, 3)), rows(beams), max_range=FAR
    )


def likelihood(model):
    return lambda beams: grids.log_likelihood(
        model, model.prepare(MAP), np.array([0.1, 0, 0]), beams
    )


def fitted(beams):
    return grids.fit(
        beams.range[beams.valid], np.full(beams.valid.sum(), 2.9), FAR, method="em", iterations=3
    )


@pytest.mark.parametrize(
    "of",
    [
        counted,
        likelihood(grids.LikelihoodField(max_range=FAR, hit=0.8, random=0.1, maximum=0.1)),
        likelihood(grids.RayCast(max_range=FAR, method="cells")),
        lambda beams: matching.points(beams, FAR),
        lambda beams: features.segments(beams, sigma=0.01, max_range=FAR),
        lambda beams: grids.beam_log(np.zeros((1, 2)), rows(beams)).scan.valid,
        fitted,
    ],
    ids=["count", "likelihood_field", "ray_cast", "points", "segments", "beam_log", "fit"],
)
def test_odd_ranges_say_what_plain_ones_do(of):
    found, plain = (jax.device_get(of(beams)) for beams in (SEEN, PLAIN))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_beam_without_an_echo_makes_no_cell_occupied():
    """The robot's own cell is crossed by the 24 beams that met something and the 16 that did not."""
    for beams, crossing in (SEEN, 40), (SEEN._replace(valid=ODD == 3), 24):
        counts = counted(beams)
        assert (int(counts.misses[10, 10]), int(counts.hits[10, 10])) == (crossing, 0)
        assert int(counts.unusable) == 72 - crossing
    log_odds = grids.occupancy(counts).log_odds[10, 10]
    assert float(log_odds) == pytest.approx(24 * np.log(0.4 / 0.6), rel=1e-5)


def test_a_log_of_carmen_has_the_same_beams(tmp_path):
    numbers = " ".join(map(str, ODD))
    path = tmp_path / "a.log"
    path.write_text(f"FLASER 72 {numbers} 0 0 0 0 0 0 1 host 1\n")
    log = datasets.carmen(path, max_range=FAR)
    assert log.dropped == {"beams without a range": 32}
    np.testing.assert_array_equal(log.beams.returns(FAR), np.array(PLAIN.returns(FAR))[:, None])
