"""The reader of MRCLAM: small files by hand, errors that say where, and the real files."""

from collections import Counter

import numpy as np
import pytest
from cases import swept
from recordings import EPOCH, MRCLAM, assert_log, assert_spoiled, folder, mapped, mrclam, write

from jaxslam import datasets


def test_mrclam_by_hand(tmp_path):
    data = datasets.mrclam(write(tmp_path, MRCLAM), 2)
    np.testing.assert_array_equal(data.time - EPOCH, [0.25, 0.5, 1, 1.5, 2, 3])
    empty = [[0, 0], [0, 0]]
    assert_log(
        data,
        control=[
            [0, 0, 0],  # nothing is known before the first time
            [0, 0, 0.25],  # no odometry yet
            [0.5, 0.125, 0.5],
            [2, 0.25, 0.5],  # of two lines with the same time the last one holds
            [2, 0.25, 0.5],  # held from one row to the next
            [0, 0, 1],  # and after the last line
        ],
        z=[
            [[1.5, 0.25], [0, 0]],
            empty,
            empty,
            [[2.5, -0.5], [3.5, 0.5]],
            [[4.5, 1], [0, 0]],
            empty,
        ],
        tag=[[0, -1], [-1, -1], [-1, -1], [1, 0], [0, -1], [-1, -1]],
        valid=[[True, False], [False] * 2, [False] * 2, [True] * 2, [True, False], [False] * 2],
    )
    assert data.tags == (6, 8)
    assert data.dropped == {"robot sightings": 2, "unknown barcodes": 1, "repeated in a scan": 1}
    assert data.corrections == ()
    np.testing.assert_array_equal(data.landmarks, [[0, 3], [1.5, -2]])


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "reason"),
    [
        ("Robot2_Odometry.dat", "273.000 2.0", "272.999 2.0", 4, "time goes back from"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " 2.0", 4, "expected 3 fields (time v omega), got 2"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " v 0.250", 4, "v is not a finite number: 'v'"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " 2.0 inf", 4, "omega is not a finite number"),
        ("Robot2_Odometry.dat", " 2.0 0.250", " 2.0 2e250", 4, "omega is beyond ±1e+60: 2e250"),
        ("Robot2_Odometry.dat", None, "# Time v omega\n", 1, "expected lines time "),
        ("Robot2_Odometry.dat", None, "", 1, "expected lines time "),
        ("Robot2_Measurement.dat", "273.500 5", "273.499 5", 4, "time goes back from"),
        ("Robot2_Measurement.dat", "70 2.75", "70 -2.75", 6, "the range -2.75 is negative"),
        ("Robot2_Measurement.dat", "70 2.75", "70.5 2.75", 6, "barcode is not a whole number"),
        ("Robot2_Measurement.dat", "70 2.75", "70 nan", 6, "range is not a finite number"),
        ("Robot2_Measurement.dat", "70 2.75 -0.5", "70 2.75", 6, "got 3"),
        ("Robot2_Measurement.dat", "5 1.00 0.0\n", "5 1.0", 10, "got 3"),
        ("Robot2_Measurement.dat", None, "\n\n", 2, "expected lines time "),
        ("Barcodes.dat", "8 \t 70", "8", 3, "expected 2 fields (subject barcode), got 1"),
        ("Barcodes.dat", "8 \t 70", "8 7.5", 3, "barcode is not a whole number"),
        ("Barcodes.dat", "8 \t 70", "x 70", 3, "subject is not a whole number"),
        ("Barcodes.dat", "8 \t 70", "8 5", 3, "subject 8 or barcode 5 occurs twice"),
        ("Barcodes.dat", "8 \t 70", "1 70", 3, "subject 1 or barcode 70 occurs twice"),
        ("Barcodes.dat", None, "1 5\n", 1, "no landmark in the file"),
        ("Landmark_Groundtruth.dat", "6 0 3", "6 0 y", 3, "y is not a finite number"),
        ("Landmark_Groundtruth.dat", "6 0 3", "7 0 3", 3, "subject 7 is not a landmark"),
        ("Landmark_Groundtruth.dat", "6 0 3", "8 0 3", 3, "subject 8 occurs twice"),
        ("Landmark_Groundtruth.dat", " 6 0 3 1e-4 1e-4\n", "", 2, "no position of subject 6"),
        ("Landmark_Groundtruth.dat", "6 0 3 1e-4", "6 0 3", 3, "got 4"),
    ],
)
def test_mrclam_errors_say_where(tmp_path, name, old, new, line, reason):
    spoil = (MRCLAM, name, old, new)
    assert_spoiled(tmp_path, *spoil, line, reason, lambda path: datasets.mrclam(path, 2))


@pytest.mark.parametrize("robot", [0, 6, -1, 1.0, "1", True, None])
def test_mrclam_has_robots_one_to_five(tmp_path, robot):
    with pytest.raises(ValueError, match="robot: expected a number from 1 to 5"):
        datasets.mrclam(write(tmp_path, MRCLAM), robot)


def raw(path):
    """A table as text fields, read without the package."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return [fields for fields in lines if fields and fields[0] != "#"]


@pytest.mark.parametrize(
    ("robot", "kept", "of_robots", "unknown", "places"),
    [(1, 4771, 952, 0, 5), (2, 5543, 1156, 0, 6), (3, 6771, 1969, 2, 6)],
)
def test_mrclam_files(robot, kept, of_robots, unknown, places):
    """Counts, times, held velocities and scans against the raw files."""
    path = folder("mrclam1")
    data = mrclam(robot)
    subject_of = {b: int(s) for s, b in raw(path / "Barcodes.dat")}
    odometry = raw(path / f"Robot{robot}_Odometry.dat")
    seen = raw(path / f"Robot{robot}_Measurement.dat")
    subjects = [subject_of.get(fields[1]) for fields in seen]
    assert subjects.count(None) == unknown == data.dropped["unknown barcodes"]
    assert sum(s in range(1, 6) for s in subjects) == of_robots == data.dropped["robot sightings"]
    assert len(seen) - of_robots - unknown == kept == data.measurements
    assert data.dropped["repeated in a scan"] == 0
    assert data.tags == tuple(range(6, 21))
    assert data.steps == len({fields[0] for fields in odometry} | {fields[0] for fields in seen})
    assert data.log.scan.z.shape == (data.steps, places, 2)

    times = [float(fields[0]) for fields in odometry] + [float(fields[0]) for fields in seen]
    assert data.time[0] == min(times)
    np.testing.assert_allclose(np.cumsum(data.log.control[:, 2]), data.time - min(times), atol=1e-5)
    assert (data.log.control[:, 2] == 0).sum() == 1
    t, m = np.nonzero(data.log.scan.valid)
    scan = data.log.scan
    found = Counter(zip(data.time[t], scan.tag[t, m] + 6, scan.z[t, m, 0], strict=True))
    expected = Counter(
        (float(fields[0]), s, float(fields[2]))
        for fields, s in zip(seen, subjects, strict=True)
        if s is not None and s > 5
    )
    assert found == expected
    velocity = {float(fields[0]): (float(fields[1]), float(fields[2])) for fields in odometry}
    for row in range(1, data.steps, 997):
        latest = max((when for when in velocity if when <= data.time[row - 1]), default=None)
        assert tuple(data.log.control[row, :2]) == velocity.get(latest, (0, 0))


EXCHANGED = 11, 17
"""Subjects of data set 1 whose surveyed positions are those of one another."""


def test_mrclam_survey_of_data_set_1_has_two_subjects_exchanged():
    """Shown by the raw scans alone: the distance between two landmarks seen at once."""
    path = folder("mrclam1")
    subject_of = {b: int(s) for s, b in raw(path / "Barcodes.dat")}
    as_is = datasets.mrclam(path, 1, errata=False)
    corrected = mrclam(1)
    assert as_is.corrections == ()
    assert corrected.corrections == ("the surveyed positions of subjects 11 and 17 were exchanged",)
    other = [i for i, name in enumerate(as_is.tags) if name not in EXCHANGED]
    np.testing.assert_array_equal(as_is.landmarks[other], corrected.landmarks[other])

    scans = {}
    for robot in (1, 2, 3):
        for when, barcode, distance, bearing in raw(path / f"Robot{robot}_Measurement.dat"):
            polar = float(distance) * np.exp(1j * float(bearing))
            scans.setdefault((robot, when), []).append((subject_of.get(barcode), polar))
    off = {"as is": [], "corrected": [], "of the others": []}
    for scan in scans.values():
        for i, (one, a) in enumerate(scan):
            for two, b in scan[:i]:
                if one is None or two is None or min(one, two) < 6 or one == two:
                    continue
                about_them = (one in EXCHANGED) != (two in EXCHANGED)
                for name, data in (("as is", as_is), ("corrected", corrected)):
                    apart = np.linalg.norm(data.landmarks[one - 6] - data.landmarks[two - 6])
                    kind = name if about_them else "of the others"
                    off[kind].append(abs(abs(a - b) - apart))
    assert len(off["as is"]) > 1000
    assert np.median(off["as is"]) > 2
    assert np.median(off["corrected"]) < 0.15
    assert np.median(off["of the others"]) < 0.15


@pytest.mark.parametrize(
    ("robot", "rmse", "nis"),
    swept([(1, 0.0731, 0.775), (3, 0.1124, 0.921)], (1, 0.0731, 0.775)),
)
def test_ekf_maps_mrclam(robot, rmse, nis):
    """Within 5 % of what was measured when the noise was chosen; 0.5 m was asked for."""
    found = mapped(mrclam(robot))
    assert found.final.alive.all()
    assert found.rmse < 1.05 * rmse
    assert found.nis_per_dof == pytest.approx(nis, rel=0.05)
