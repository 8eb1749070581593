"""Reader of the simulated data of the robot mapping courses of Freiburg and Bonn."""

from pathlib import Path

import numpy as np

from jaxslam.core.logs.streams import as_recorded
from jaxslam.core.types import Log
from jaxslam.datasets.dataset import Dataset
from jaxslam.datasets.lines import TextFile
from jaxslam.motion import PoseIncrement
from jaxslam.sensors import RangeBearing

SOURCE = (
    "C. Stachniss, Robot Mapping, course exercises, University of Freiburg and University of Bonn"
)
_ODOMETRY_COV = np.diag([0.001, 0.001, 0.001]) ** 2
MEASUREMENT_COV = np.diag([0.1, 0.05]) ** 2


def bonn(folder: str | Path) -> Dataset:
    """The data set in the files `world.dat` (landmarks: id x y) and `sensor_data.dat` of a folder.

    The latter has a line `ODOMETRY rot1 trans rot2` for each step, followed by lines `SENSOR id
    range bearing` of that step. The motion is the pose increment
    (trans cos rot1, trans sin rot1, rot1 + rot2). Next to a landmark the simulated noise can make a
    range negative; such a measurement has no direction, and is dropped and counted.

    The default noise maximizes the likelihood of the innovations of an EKF, rounded: 0.1 m and
    0.05 rad for the sensor; for the odometry it only shows that σ is about 0.001 per step (m or
    rad). NIS/dof is then 0.95.

    Source: course data by C. Stachniss, University of Freiburg and University of Bonn.

    Args:
        folder: the folder of the two files.
    Raises:
        ValueError: `path:line: reason` on a malformed line, a landmark that is not in `world.dat`
            or is measured twice in a step, or a SENSOR line before the first ODOMETRY.
    """
    names, landmarks = _read_world(TextFile(Path(folder) / "world.dat"))
    tag_of = {name: tag for tag, name in enumerate(names)}
    file = TextFile(Path(folder) / "sensor_data.dat")
    controls: list[list[float]] = []
    rows: list[int] = []
    tags: list[int] = []
    z: list[list[float]] = []
    in_step: set[int] = set()
    dropped = {"negative ranges": 0}
    for line, (keyword, *fields) in file:
        if keyword == "ODOMETRY":
            rot1, trans, rot2 = file.numbers(line, fields, ("rot1", "trans", "rot2"))
            controls.append([trans * np.cos(rot1), trans * np.sin(rot1), rot1 + rot2])
            in_step = set()
        elif keyword == "SENSOR":
            _, distance, bearing = file.numbers(line, fields, ("id", "range", "bearing"))
            name = file.identity(line, fields[0], "id")
            if not controls:
                raise file.error(line, "SENSOR before the first ODOMETRY")
            if name not in tag_of:
                raise file.error(line, f"landmark {name} is not in world.dat")
            if name in in_step:
                raise file.error(line, f"landmark {name} is measured twice in a step")
            in_step.add(name)
            if distance < 0:
                dropped["negative ranges"] += 1
                continue
            rows.append(len(controls) - 1)
            tags.append(tag_of[name])
            z.append([distance, bearing])
        else:
            raise file.error(line, f"unknown keyword {keyword!r}")
    if not z:
        raise file.end_error(f"no {'SENSOR' if controls else 'ODOMETRY'} line in the file")
    time = np.arange(1.0, len(controls) + 1.0)
    return Dataset(
        name="bonn",
        log=Log.from_streams((time, controls), (time[rows], tags, z), as_recorded, time),
        time=time,
        motion=PoseIncrement(_ODOMETRY_COV),
        sensor=RangeBearing(MEASUREMENT_COV),
        tags=names,
        filter_options={"correction": "joint"},
        landmarks=landmarks,
        dropped=dropped,
        source=SOURCE,
    )


def _read_world(file: TextFile) -> tuple[tuple[int, ...], np.ndarray]:
    """The landmarks' ids in rising order and their positions (N, 2)."""
    points: dict[int, list[float]] = {}
    for line, fields in file:
        _, x, y = file.numbers(line, fields, ("id", "x", "y"))
        name = file.identity(line, fields[0], "id")
        if name in points:
            raise file.error(line, f"landmark {name} occurs twice")
        points[name] = [x, y]
    if not points:
        raise file.end_error("no landmark in the file")
    names = tuple(sorted(points))
    return names, np.array([points[name] for name in names])
