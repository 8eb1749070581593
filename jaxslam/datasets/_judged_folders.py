"""Folders of draws and of estimates, which `jaxslam judge` reads: CSV files, a folder a run.

draws/draws.json                                       key, scenario, options
draws/truth/0000/truth.csv, landmarks.csv              what run 0 is compared with
estimates/0000/trajectory.csv, map.csv, innovations.csv     as `jaxslam run` writes them
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.consistency import Innovations, RunEstimate
from jaxslam.consistency.campaign._judging import Outcome, Source
from jaxslam.consistency.campaign._run_estimates import (
    EARLY,
    GAPS,
    MISSING,
    TIMES,
    RunFault,
    as_estimate,
)
from jaxslam.core.logs._tables import POSE, TAG, TIME, label, split_unit
from jaxslam.core.types import Log, Truth
from jaxslam.core.validation import InvalidFile, refusals_of
from jaxslam.datasets._csv import MISSING as NO_NUMBER
from jaxslam.datasets._csv import CsvTable
from jaxslam.datasets._landmark_logs.table_reader import MEASUREMENTS, ODOMETRY
from jaxslam.datasets._lines import stored_file

DRAWS, RUNS, TRUTH = "draws.json", "runs", "truth"
"""The file of settings, and the folders of logs and of truths, in a folder of draws."""

TRAJECTORY, MAP, INNOVATIONS = "trajectory.csv", "map.csv", "innovations.csv"
"""The files of the estimate of a run; the last two are optional."""

PROGRAM = "judge.json"
"""The file, in the folder of an estimate, with the command that wrote it, the checksums of what it
read, and its wall time."""

_SAME_TIME = 0.5e-6
"""Largest difference of two times that are one [s]: half of the last digit of stamps in µs."""

_SAME = 1e-6
"""Largest difference [m, rad] of a truth or a measurement in a file from the one drawn again here:
beyond what another processor rounds differently."""

_TIMES = ("t", "time")
_POSE = ("x", "y", "theta")
_POSE_COV = ("c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt")
_OF_INNOVATIONS = ("rejected", "nis", "log_likelihood")
"""Optional columns of innovations."""
_POINT, _POINT_COV = ("x", "y"), ("c_xx", "c_xy", "c_yy")
_UNITS = {"x": "m", "y": "m", "theta": "rad", "t": "s", "time": "s"}


class DrawsFolder(NamedTuple):
    """A folder of draws, as `jaxslam draws` writes it."""

    path: Path
    scenario: str
    """name, or FILE.py:NAME"""
    steps: int | None
    """the option; None for the scenario's own"""
    key: jax.Array
    runs: int
    checksums: Mapping[str, str]
    """SHA-256 of each file, as it was written; empty where nobody noted it"""

    def log_checksum(self, name: str) -> str:
        """The checksum of the files of a run that an estimator reads."""
        of_run = f"{RUNS}/{name}/"
        lines = [f"{k} {v}" for k, v in sorted(self.checksums.items()) if k.startswith(of_run)]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def read_draws(folder: Path) -> DrawsFolder:
    """The settings of a folder of draws; ValueError where it is none."""
    path = folder / DRAWS
    if not path.exists():
        raise ValueError(f"{folder}: expected a folder of `jaxslam draws`: there is no {DRAWS}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        options, runs, key = content["options"], content["runs"], _key(**content["key"])
        scenario, steps = options.get("scenario", content["scenario"]), options.get("steps")
        if type(runs) is not int or runs < 1 or not isinstance(scenario, str):
            raise ValueError
        if not (steps is None or type(steps) is int):
            raise ValueError
        checksums = content.get("checksums", {})
        if not all(isinstance(text, str) for text in checksums.values()):
            raise ValueError
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidFile(path, "expected the settings that `jaxslam draws` writes") from error
    return DrawsFolder(folder, scenario, steps, key, runs, checksums)


def _key(kind: str, numbers: Sequence[int]) -> jax.Array:
    """A PRNG key from its kind, "raw" of one without, and its numbers."""
    data = jnp.asarray(np.asarray(numbers, np.uint32))
    return data if kind == "raw" else jax.random.wrap_key_data(data, impl=kind)


def run_name(number: int) -> str:
    """The name of the folder of a run, as 0007."""
    return f"{number:04d}"


class TruthOfRun(NamedTuple):
    """The truth of a run, from its files."""

    time: Float[np.ndarray, "T"]
    robot: Float[np.ndarray, "T R"]
    """its pose, and what it has beside it"""
    tags: dict[int | str, int]
    """the row of each landmark, by its name"""
    odometry_time: Float[np.ndarray, "K"]
    """times of the lines of odometry, which need not be steps"""


def read_truth(draws: Path, name: str, steps: int, state: Sequence[str] = POSE) -> TruthOfRun:
    """The truth of the run with that name, of T steps. state: `Motion.state`.

    Raises ValueError, with file and line, where it cannot be read.
    """
    path = CsvTable(draws / TRUTH / name / "truth.csv")
    columns = path.columns((TIME, *state), "of the truth")
    if len(path.lines) != steps:
        reason = f"expected {steps} lines, as many as the run has steps, got {len(path.lines)}"
        raise InvalidFile(path.path, reason)
    tags: dict[int | str, int] = {}
    survey = draws / TRUTH / name / "landmarks.csv"
    if stored_file(survey) is not None:
        names = CsvTable(survey).columns((TAG,), "of landmarks").tags or ()
        tags = {tag: row for row, tag in enumerate(names) if tag is not None}
    odometry = CsvTable(draws / RUNS / name / ODOMETRY).columns((TIME,), "of odometry")
    return TruthOfRun(columns.columns[TIME], columns.values(state), tags, odometry.columns[TIME])


def folder_source(
    estimates: Path,
    draws: DrawsFolder,
    measurements: Sequence[str],
    stride: int,
    failures: Mapping[int, RunFault],
    state: Sequence[str] = POSE,
) -> Source:
    """The estimates in a folder, read run by run, as `judge_sources` takes them.

    Args:
        measurements: names of the numbers of a measurement, which are columns of a log.
        failures: of runs without an estimate, why there is none.
        state: names of the numbers of the robot, the pose first.
    """

    def outcome_of(number: int, truth: Truth, log: Log) -> Outcome:
        name = run_name(number)
        in_file = read_truth(draws.path, name, len(truth.pose), state)
        gap = np.abs(in_file.robot - np.asarray(truth.robot, np.float64))
        gap[:, 2] = np.minimum(gap[:, 2], np.abs(2 * math.pi - gap[:, 2]))
        if not (largest := float(gap.max())) <= _SAME:
            path = draws.path / TRUTH / name / "truth.csv"
            raise _draws_error(path, draws, f"numbers that differ by {largest:.3g}")
        if number == 0:  # the other runs have the same key
            _check_log(draws, name, measurements, log)
        truth = truth._replace(pose=in_file.robot[:, :3])
        if truth.further is not None:
            truth = truth._replace(further=in_file.robot[:, 3:])
        if number in failures:
            return Outcome(truth, None, failures[number])
        folder = estimates / name
        origin = origin_of(folder)
        if origin.get("log", checksum := draws.log_checksum(name)) != checksum:
            reason = f"expected an estimate of {draws.path}, got one of other draws"
            raise InvalidFile(folder / PROGRAM, reason)
        size = int(np.shape(log.scan.z)[2])
        result = read_estimate(folder, in_file, stride, size, state[3:])
        if isinstance(result, RunFault):
            return Outcome(truth, None, result)
        return Outcome(truth, result, None, _seconds(origin))

    return outcome_of


def _check_log(draws: DrawsFolder, name: str, measurements: Sequence[str], log: Log) -> None:
    """Raise ValueError unless the measurements of a run are those that are drawn here."""
    path = draws.path / RUNS / name / MEASUREMENTS
    valid = np.asarray(log.scan.valid)
    if stored_file(path) is None or not valid.any():
        return
    in_file = CsvTable(path).columns(measurements, "of measurements").values(measurements)
    drawn = np.asarray(log.scan.z, np.float64)[valid]
    if in_file.shape != drawn.shape:
        raise _draws_error(path, draws, f"{len(in_file)} lines, where {len(drawn)} are drawn")
    # Lines of one time are in any order.
    largest = float(np.abs(np.sort(in_file, axis=0) - np.sort(drawn, axis=0)).max())
    if not largest <= _SAME:
        raise _draws_error(path, draws, f"numbers that differ by {largest:.3g}")


def _draws_error(path: Path, draws: DrawsFolder, got: str) -> InvalidFile:
    """The error about a file that is not what the scenario draws."""
    return InvalidFile(
        path,
        f"expected what scenario {draws.scenario} draws here with the key of {DRAWS}, got {got}: "
        "the scenario, or the version, is another; write the draws again",
    )


def origin_of(folder: Path) -> dict[str, object]:
    """What the folder of an estimate notes about its origin; empty where nothing is noted."""
    try:
        note = json.loads((folder / PROGRAM).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _seconds(origin: Mapping[str, object]) -> float | None:
    """The wall time of the program that wrote an estimate [s]; None where nobody noted it."""
    seconds = origin.get("seconds")
    return seconds if isinstance(seconds, float) and math.isfinite(seconds) else None


def read_estimate(
    folder: Path, truth: TruthOfRun, stride: int, size: int, further: Sequence[str] = ()
) -> RunEstimate | RunFault:
    """The estimate in a folder, at steps k, 2k, …, T, or why there is none; k is `stride`.

    size: Z, of a measurement. further: names of what the robot has beside its pose. Raises
    ValueError, with file and line, on what is not such a file.
    """
    if stored_file(folder / TRAJECTORY) is None:
        detail = f"no {TRAJECTORY} in it" if folder.is_dir() else f"no folder {folder.name}"
        return RunFault(MISSING, detail)
    steps = len(truth.robot)
    path = _EstimateTable(folder / TRAJECTORY)
    if not path.header:
        return RunFault(EARLY, f"{TRAJECTORY} is empty")
    at = path.steps(truth)
    if isinstance(at, RunFault):
        return at
    row_of: dict[int, int] = {}
    for row, step in enumerate(at.tolist()):
        if step >= 0 and row_of.setdefault(step, row) != row:
            line = path.lines[row_of[step]]
            raise path.error(f"expected each time once, got that of line {line} again", row)
    judged = range(stride - 1, steps, stride)
    present = [step for step in judged if step in row_of]
    if len(present) < len(judged):
        if present == list(judged[: len(present)]):
            return RunFault(EARLY, f"{len(present)} of {len(judged)} rows")
        missing = next(step for step in judged if step not in row_of)
        return RunFault(GAPS, f"none at t = {truth.time[missing]:.12g}")
    rows = [row_of[step] for step in judged]
    poses = path.values(_POSE)[rows]
    covs = _symmetric(path.values(_POSE_COV)[rows], 3)
    beside = _read_further(path, rows, further)
    maps = innovations = None
    if stored_file(folder / MAP) is not None:
        maps = _read_map(_EstimateTable(folder / MAP), truth)
    if stored_file(folder / INNOVATIONS) is not None:
        innovations = _read_innovations(_EstimateTable(folder / INNOVATIONS), truth, size)
        if isinstance(innovations, RunFault):
            return innovations
    with refusals_of(str(folder)):
        return as_estimate(RunEstimate(poses, covs, maps, innovations, *beside))


def _read_further(
    path: "_EstimateTable", rows: Sequence[int], further: Sequence[str]
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """What the robot has beside its pose, and the covariances; None where the file has no column
    of these names."""
    names = list(map(label, further))
    path.units |= {name: split_unit(column)[1] for name, column in zip(names, further, strict=True)}
    if not set(names) & set(path.names):
        return None, None
    pairs = [(names[i], names[j]) for i, j in zip(*np.triu_indices(len(names)), strict=True)]
    triangle = path.values([f"c_{a}_{b}" for a, b in pairs])[rows]
    return path.values(names)[rows], _symmetric(triangle, len(names))


def _read_map(path: "_EstimateTable", truth: TruthOfRun) -> tuple[np.ndarray, ...]:
    """Means, covariances and tags of the landmarks that have a name."""
    tags = path.landmarks(path.place_of("landmark", TAG), truth.tags)
    is_named = tags >= 0
    names = [int(tag) for tag in tags[is_named]]
    if len(set(names)) < len(names):
        row = next(i for i, tag in enumerate(tags) if tag >= 0 and tag in tags[:i])
        raise path.error("expected a landmark once, got it twice", row)
    covs = _symmetric(path.values(_POINT_COV), 2)
    return path.values(_POINT)[is_named], covs[is_named], tags[is_named]


def _read_innovations(
    path: "_EstimateTable", truth: TruthOfRun, size: int
) -> Innovations | RunFault:
    """The innovations; columns that have no name of their own are ν, and S row by row."""
    used = {path.place_of(*_TIMES), path.place_of(TAG)}
    optional = {name: path.values((name,))[:, 0] for name in _OF_INNOVATIONS if name in path.names}
    used |= {path.place_of(name) for name in optional}
    places = [place for place in range(len(path.header)) if place not in used]
    expected = size + size * (size + 1) // 2
    if len(places) != expected:
        raise path.error(
            f"expected t, tag, {size} columns of ν and {expected - size} of the upper triangle of "
            f"S, got {', '.join(path.header)}"
        )
    at = path.steps(truth)
    if isinstance(at, RunFault):
        return at
    if (at < 0).any():
        reason = "expected the time of a measurement, got one of odometry alone"
        raise path.error(reason, int(np.argmax(at < 0)))
    numbers = path.side_by_side(places)
    tags = path.landmarks(path.place_of(TAG), truth.tags)
    S = _symmetric(numbers[:, size:], size)
    return Innovations(at, tags, numbers[:, :size], S, **optional)


def _symmetric(triangle: Float[np.ndarray, "K E"], size: int) -> Float[np.ndarray, "K n n"]:
    """Symmetric matrices from their upper triangles, row by row."""
    rows, columns = np.triu_indices(size)
    matrix = np.zeros((len(triangle), size, size))
    matrix[:, rows, columns] = matrix[:, columns, rows] = triangle
    return matrix


def _nearest(times: Float[np.ndarray, "T"], time: Float[np.ndarray, "K"]) -> np.ndarray:
    """The place of each time among rising times, to half a microsecond; -1 where it is not."""
    after = np.searchsorted(times, time)
    below, above = (np.clip(i, 0, len(times) - 1) for i in (after - 1, after))
    nearest = np.where(np.abs(times[above] - time) < np.abs(times[below] - time), above, below)
    return np.where(np.abs(times[nearest] - time) <= _SAME_TIME, nearest, -1)


class _EstimateTable(CsvTable):
    """A CSV file of an estimate; what is not finite is NaN or ∞, and no error.

    It may be empty, or a header alone, of a program that ended at once or had nothing to tell.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, needs_units=False, may_be_empty=True)
        self.units: dict[str, str | None] = dict(_UNITS)

    @property
    def names(self) -> list[str]:
        return list(map(label, self.header))

    def number(self, cell: str, optional: bool = False) -> float:
        value = self._value(cell)
        if math.isnan(value) and cell.lower() not in NO_NUMBER:
            raise ValueError(f"expected a number, got {cell!r:.60}")
        return value

    def place_of(self, *names: str) -> int:
        """The place of the column that has one of some names; ValueError without it."""
        name = next((name for name in names if name in self.names), " or ".join(names))
        place = self.place(name)
        unit = split_unit(self.header[place])[1]
        if unit not in (None, self.units.get(name)):
            raise self.error(f"expected the unit [{self.units.get(name, '')}]", place=place)
        return place

    def values(self, names: Sequence[str]) -> Float[np.ndarray, "K n"]:
        """Some columns side by side, by name."""
        return self.side_by_side([self.place_of(name) for name in names])

    def side_by_side(self, places: Sequence[int]) -> Float[np.ndarray, "K n"]:
        """Some columns side by side."""
        return np.column_stack([self.numbers(place) for place in places])

    def steps(self, truth: TruthOfRun) -> np.ndarray | RunFault:
        """The step of each row, -1 at a line of odometry that is none.

        A fault where a time is neither.
        """
        time = self.numbers(self.place_of(*_TIMES))
        steps = _nearest(truth.time, time)
        fits = (steps >= 0) | (_nearest(truth.odometry_time, time) >= 0)
        if not fits.all():
            row = int(np.argmin(fits))
            return RunFault(TIMES, f"{self.path.name}:{self.lines[row]}: t = {time[row]:.12g}")
        return steps

    def landmarks(self, place: int, tags: Mapping[int | str, int]) -> np.ndarray:
        """The row of the landmark in each cell of a column by its tag; -1 of an empty one."""
        names = list(self._read(place, self.tag))
        for row, name in enumerate(names):
            if name is not None and name not in tags:
                got = f"{self.cells(place)[row]!r:.60}"
                reason = f"expected a landmark of landmarks.csv, or nothing, got {got}"
                raise self.error(reason, row, place)
        return np.array([-1 if name is None else tags[name] for name in names], int)
