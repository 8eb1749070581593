"""Reader of relations: relative poses between stamps, the truth of laser SLAM in the plane."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.datasets.lines import TextFile
from jaxslam.math.numpy_poses import wrapped

_FIELDS = "t1", "t2", "x", "y", "z", "roll", "pitch", "yaw"
_FLAT = 1e-6
"""What z [m], roll and pitch [rad] of a pose of the plane may differ from 0."""


class StampedRelations(NamedTuple):
    """R relative poses between stamps."""

    first: Float[np.ndarray, "R"]
    """[s]"""
    second: Float[np.ndarray, "R"]
    """[s]; may be before `first`"""
    pose: Float[np.ndarray, "R 3"]
    """(x, y, θ) at `second` in the frame of the pose at `first` [m, m, rad]"""
    source: str
    """the file"""


def relation_file(path: str | Path) -> StampedRelations:
    """The relations of a file of the Freiburg benchmark, packed by gzip or not.

    A line: `t1 t2 x y z roll pitch yaw` [s, m, rad], the pose at t2 in the frame of that at t1.
    Blank lines and lines that begin with # are skipped. `metrics.given` joins them to a path.

    Source: Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss & Kleiner 2009, "On measuring
    the accuracy of SLAM algorithms", Autonomous Robots 27.

    Raises ValueError, `path:line: reason`, on a line that is malformed, a pose that is not of the
    plane (z, roll or pitch above 1e-6), and a file without relations.
    """
    file = TextFile(path, comment="#")
    rows = []
    for line, fields in file:
        row = file.numbers(line, fields, _FIELDS)
        for name, value in zip(_FIELDS[4:7], row[4:7], strict=True):
            if abs(value) > _FLAT:
                raise file.error(line, f"expected a pose of the plane, with {name} 0, got {value}")
        rows.append(row)
    if not rows:
        raise file.end_error(f"expected lines {' '.join(_FIELDS)}, got none")
    table = np.array(rows)
    pose = np.stack([table[:, 2], table[:, 3], wrapped(table[:, 7])], axis=1)
    return StampedRelations(table[:, 0], table[:, 1], pose, str(file.path))
