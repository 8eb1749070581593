"""The reader of several robots of MRCLAM: small files by hand, and the real files."""

import numpy as np
import pytest
from recordings import EPOCH, TEAM, assert_log, mrclam, mrclam_team, write

from jaxslam import datasets


def test_mrclam_team_by_hand(tmp_path):
    data = datasets.mrclam_team(write(tmp_path, TEAM), (2, 1))
    np.testing.assert_array_equal(data.time - EPOCH, [0.25, 0.5, 1, 1.25, 1.5, 2, 3])
    no = [0, 0]
    rows = [
        [no, no, no, no, no],
        [no, no, no, no, no],
        [no, no, no, no, no],
        [no, no, no, no, no],
        [[2.5, -0.5], [3.5, 0.5], [1, 0], [4, 0.75], [1.25, 0.125]],
        [[4.5, 1], no, no, no, no],
        [no, no, [1, 0], no, no],
    ]
    rows[0][0] = [1.5, 0.25]
    tags = np.full((7, 5), -1)
    # Robot 2's landmarks and robots, then robot 1's; tags 2 and 3 are robots 2 and 1.
    tags[0, 0] = tags[5, 0] = 0
    tags[4] = [1, 0, 3, 0, 2]
    tags[6, 2] = 3
    assert_log(
        data,
        control=[
            [0, 0, 0, 0, 0, 0],
            [0, 0, 0.25, 0, 0, 0.25],
            [0.5, 0.125, 0.5, 0, 0, 0.5],
            [2, 0.25, 0.25, 1.5, 0.5, 0.25],
            [2, 0.25, 0.25, 0, 0, 0.25],
            [2, 0.25, 0.5, 0, 0, 0.5],
            [0, 0, 1, 0, 0, 1],
        ],
        z=rows,
        tag=tags,
        valid=tags >= 0,
    )
    assert data.tags == (6, 8)
    assert data.dropped == {"robot sightings": 0, "unknown barcodes": 2, "repeated in a scan": 1}
    assert [robot.sensors.places for robot in data.robots] == [(2, 1), (1, 1)]
    assert all(robot.start is None for robot in data.robots)
    alone = datasets.mrclam_team(tmp_path, (2,))
    assert alone.dropped["robot sightings"] == 2
    assert alone.log.scan.tag.max() == 1


@pytest.mark.parametrize("robots", [(), (1, 1), (0, 1), (1, 6), (1.0,), ("1",)])
def test_mrclam_team_has_different_robots(tmp_path, robots):
    with pytest.raises(ValueError, match="robots: expected different ones from 1 to 5"):
        datasets.mrclam_team(write(tmp_path, TEAM), robots)


@pytest.mark.parametrize(
    ("robot", "of_robots"), [(1, (226, 239)), (2, (324, 212)), (3, (377, 615))]
)
def test_mrclam_team_files(robot, of_robots):
    """Everything that one robot's reader gives, at the same times, and its sightings beside."""
    data, alone = mrclam_team(), mrclam(robot)
    first = sum(sum(r.sensors.places) for r in data.robots[: robot - 1])
    places, sights = data.robots[robot - 1].sensors.places
    scan, own = data.log.scan, alone.log.scan
    at = np.searchsorted(data.time, alone.time)
    np.testing.assert_array_equal(data.time[at], alone.time)
    np.testing.assert_array_equal(scan.tag[at, first : first + places], own.tag)
    np.testing.assert_array_equal(scan.z[at, first : first + places], own.z)
    assert scan.valid[:, first : first + places].sum() == own.valid.sum()
    seen = scan.tag[:, first + places : first + places + sights]
    others = [tag for tag in (15, 16, 17) if tag != 14 + robot]
    assert tuple((seen == tag).sum() for tag in others) == of_robots
    # The same travel, however time is cut; after a row of its own, the velocity is the same.
    mine = data.log.control[:, 3 * robot - 3 : 3 * robot]
    way = np.cumsum(mine[:, :2] * mine[:, 2:], axis=0)[at]
    np.testing.assert_allclose(
        way, np.cumsum(alone.log.control[:, :2] * alone.log.control[:, 2:], axis=0), atol=1e-6
    )
