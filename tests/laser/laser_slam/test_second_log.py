"""A log of another size is solved by the programs of the first."""

import numpy as np
from ring_of_rooms import SETTINGS, driven, errors
from worlds import compilations

from jaxslam import laser_slam


def test_a_second_log_of_another_size_compiles_nothing():
    """Other scans, beams, walls and map; the first has a step of odometry that is not known, whose
    search a log may need or not."""
    true, log = driven()
    known = np.arange(len(true)) != 9
    with compilations() as count:
        first = laser_slam.solve(log._replace(odometry_known=known), SETTINGS)
        before = count()
        true, log = driven(scans=47, beams=90, seed=1, scale=1.6)
        second = laser_slam.solve(log, SETTINGS)
        assert count() == before
    assert second.map.log_odds.shape != first.map.log_odds.shape
    assert len(second.graph.poses) != len(first.graph.poses)
    assert len(second.loops.outcome) != len(first.loops.outcome) > 0
    assert errors(second.poses, true)[0].max() < 0.15
