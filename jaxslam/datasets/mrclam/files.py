"""The files of MRCLAM as tables: what a robot recorded, its true path, barcodes and survey."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam.datasets.lines import TextFile, stored

ROBOTS = range(1, 6)
"""Subjects 1 to 5 are the robots; they carry barcodes like the landmarks, 6 to 20."""
EXCHANGED = {11: [3.15071999, 2.38294871], 17: [0.03596156, -2.84396626]}
"""Positions of two subjects that are exchanged in the survey of data set 1, as in the file: their
distances from landmarks of the same scan differ by metres from the survey, and by centimetres after
the exchange."""


def read_landmarks(
    folder: Path, errata: bool
) -> tuple[dict[int, int], tuple[int, ...], Float[np.ndarray, "N 2"], tuple[str, ...]]:
    """The subject of each barcode, the landmarks' subjects, positions, and corrections of these."""
    subject_of, names = _read_barcodes(TextFile(folder / "Barcodes.dat", "#"))
    points = _read_survey(TextFile(folder / "Landmark_Groundtruth.dat", "#"), names)
    corrections = _correct(points) if errata else ()
    return subject_of, names, np.array([points[name] for name in names]), corrections


def read_robot(
    folder: Path, robot: int
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "J 4"]]:
    """Odometry (t, v, ω) and measurements (t, barcode, range, bearing) of one robot."""
    odometry = _read_in_time(
        TextFile(folder / f"Robot{robot}_Odometry.dat", "#"), ("time", "v", "omega")
    )
    seen = _read_in_time(
        TextFile(folder / f"Robot{robot}_Measurement.dat", "#"),
        ("time", "barcode", "range", "bearing"),
    )
    return odometry, seen


def read_truth(folder: Path, robot: int) -> Float[np.ndarray, "K 4"] | None:
    """The true poses (t, x, y, θ) of one robot; None where there is no such file."""
    path = folder / f"Robot{robot}_Groundtruth.dat"
    if stored(path) is None:
        return None
    return _read_in_time(TextFile(path, "#"), ("time", "x", "y", "theta"))


def _read_in_time(file: TextFile, names: tuple[str, ...]) -> Float[np.ndarray, "_ _"]:
    """A table whose first column does not decrease; raises ValueError otherwise."""
    table: list[list[float]] = []
    for line, fields in file:
        values = file.numbers(line, fields, names)
        if table and values[0] < table[-1][0]:
            raise file.error(line, f"time goes back from {table[-1][0]} to {values[0]}")
        if names[1] == "barcode":
            file.identity(line, fields[1], "barcode")
            if values[2] < 0:
                raise file.error(line, f"the range {values[2]} is negative")
        table.append(values)
    if not table:
        raise file.end_error("no data in the file")
    return np.array(table)


def _read_barcodes(file: TextFile) -> tuple[dict[int, int], tuple[int, ...]]:
    """The subject of each barcode, and the landmarks' subjects in rising order."""
    subject_of: dict[int, int] = {}
    for line, fields in file:
        file.expect(line, fields, ("subject", "barcode"))
        subject = file.identity(line, fields[0], "subject")
        barcode = file.identity(line, fields[1], "barcode")
        if barcode in subject_of or subject in subject_of.values():
            raise file.error(line, f"subject {subject} or barcode {barcode} occurs twice")
        subject_of[barcode] = subject
    names = tuple(sorted(set(subject_of.values()) - set(ROBOTS)))
    if not names:
        raise file.end_error("no landmark in the file")
    return subject_of, names


def _read_survey(file: TextFile, names: tuple[int, ...]) -> dict[int, list[float]]:
    """The surveyed position of every landmark."""
    points: dict[int, list[float]] = {}
    for line, fields in file:
        columns = ("subject", "x", "y", "sigma_x", "sigma_y")
        _, x, y, _, _ = file.numbers(line, fields, columns)
        subject = file.identity(line, fields[0], "subject")
        if subject not in names:
            raise file.error(line, f"subject {subject} is no landmark in Barcodes.dat")
        if subject in points:
            raise file.error(line, f"subject {subject} occurs twice")
        points[subject] = [x, y]
    missing = [name for name in names if name not in points]
    if missing:
        raise file.end_error(f"no position of subject {missing[0]} in the file")
    return points


def _correct(points: dict[int, list[float]]) -> tuple[str, ...]:
    """Undo the exchange in the survey of data set 1; returns descriptions of what was done."""
    if any(points.get(subject) != position for subject, position in EXCHANGED.items()):
        return ()
    one, other = EXCHANGED
    points[one], points[other] = points[other], points[one]
    return (f"the surveyed positions of subjects {one} and {other} were exchanged",)
