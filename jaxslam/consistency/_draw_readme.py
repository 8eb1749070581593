"""The README of a folder of draws: files, times, equations and numbers of a world, for a reader who
does not know this package."""

import dataclasses
import inspect
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.consistency._draw_tables import (
    STEP,
    Odometry,
    has_unknown_tags,
    single_motion,
    unsaid_options,
    unsaid_settings,
)
from jaxslam.core.logs._tables import (
    INTERVAL,
    TAG,
    TIME,
    label,
    measurement_columns,
    split_unit,
)
from jaxslam.core.noise import Constant
from jaxslam.core.protocols import Model, Motion, Sensor
from jaxslam.motion import Augmented, NoiseDensity, Substeps
from jaxslam.sensors._suite import Wrapped
from jaxslam.simulation._scans import BetweenRanges
from jaxslam.simulation._worlds import World

_MOUNT = """x_s = x + mount_x*cos(theta) - mount_y*sin(theta)
y_s = y + mount_x*sin(theta) + mount_y*cos(theta)
theta_s = wrap(theta + mount_theta)"""

_NO_MOUNT = "x_s, y_s, theta_s = x, y, theta    # the sensor is at the robot's pose"

_JUDGING = """The judge is a command of the Python package `jaxslam`. It compares the errors \
with the covariances (NEES, intervals, a verdict), beside filters of the package on the same runs, \
and can run your program itself:

```console
$ jaxslam judge estimates --draws draws --filters ekf --out out
$ jaxslam judge estimates --draws draws --out out --estimator './my_filter {run} {estimate}'
```"""


def readme_text(world: World, runs: int, odometry: Odometry) -> str:
    """The text of README.md. odometry: of the nominal controls, for columns and times."""
    sections = {
        f"Draws of the world `{world.name}`": _introduction(world, runs),
        "Files": _files(world, odometry),
        "Times": _times(world, odometry),
        "Start": _start(world),
        "Motion": _motion(world),
        "Measurements": _measurements(world),
        "What to write": _estimates(world),
        "How it is judged": _JUDGING,
        "dataset.toml": _settings(world),
    }
    (title, first), *rest = sections.items()
    return f"# {title}\n\n{first}\n" + "".join(f"\n## {name}\n\n{text}\n" for name, text in rest)


def _introduction(world: World, runs: int) -> str:
    count = int(np.shape(world.landmarks)[0])
    marks = f" among {count} landmarks" if world.sensor.landmark else ""
    source = f"\n\nThe world: {world.source}." if world.source else ""
    return (
        f"{runs:,} random run{'s' * (runs > 1)} of one simulated robot{marks}, {world.steps:,} "
        "steps each, for an estimator in any language. Your program reads `runs/0000`, and writes "
        "its estimate of the run to `estimates/0000`, for each run alone. `truth/` is for the "
        f"judge: an estimator must not read it.{source}\n\n"
        "Units are m, s and rad. Angles are counter-clockwise. A pose is (x, y, theta) in the map, "
        "theta = 0 along x. Numbers have as many digits as a float64 needs, 17 at most, and read "
        "back exactly. Equations are lines of Python: "
        "`wrap(a)` moves an angle to (-pi, pi], `sinc(a)` is `sin(a)/a`, 1 at a = 0, and `atan2` "
        "is that of C."
    )


def _files(world: World, odometry: Odometry) -> str:
    sensor = world.sensor
    measured = measurement_columns(sensor.measurements, sensor.landmark)
    lines = [
        "| file | columns |",
        "|---|---|",
        f"| `runs/0000/odometry.csv` | {_code((TIME, *odometry.names))} |",
        f"| `runs/0000/measurements.csv` | {_code(measured)} |",
        "| `runs/0000/dataset.toml` | the numbers below, for `jaxslam run` |",
        f"| `truth/0000/truth.csv` | {_code((TIME, *world.motion.state))}: the true "
        f"{_robot(world)} at each scan |",
    ]
    if sensor.landmark:
        lines.append("| `truth/0000/landmarks.csv` | `tag`, `x [m]`, `y [m]` of all landmarks |")
    lines.append("| `draws.json` | key of the random numbers, versions, SHA-256 of each file |")
    text = "\n".join(lines) + "\n\n"
    if not sensor.landmark:
        return text + "A measurement is of the robot itself: there are no landmarks, and no tags."
    text += "Where the landmarks are is not known at the start. "
    if has_unknown_tags(world):
        return text + (
            f"`{TAG}` is empty: which landmark a measurement is of is not known, and the estimator "
            "must find out (data association)."
        )
    return text + (
        f"`{TAG}` is the number of the landmark that is measured"
        + ("; it is empty where that is not known." if _spurious(world) else ".")
    )


def _times(world: World, odometry: Odometry) -> str:
    count = world.motion.count if isinstance(world.motion, Substeps) else 1
    lines = "every line" if count == 1 else f"one in {count} lines"
    first = "" if odometry.rows[0] == odometry.time[0] else " after the first"
    scans = (
        f"There is a scan at {lines} of `odometry.csv`{first}, at t = "
        f"{', '.join(f'{t:g}' for t in odometry.rows[:3])}, …, {odometry.rows[-1]:g} s. The lines "
        "of `measurements.csv` with its time are its measurements, taken at the pose of that time, "
        "after the motion that leads to it; without lines the scan is empty."
    )
    controls = single_motion(world).controls
    if INTERVAL not in controls:
        return (
            f"The model has no time: rows are {STEP:g} s apart, and t counts them. A line of "
            "`odometry.csv` at t is the motion that leads from the pose before, of the first line "
            f"from the start, to the pose at t. {scans}"
        )
    dt = odometry.intervals
    interval = (
        f"dt = {float(dt[-1])!r} s in every line" if np.ptp(dt) == 0 else "dt is that difference"
    )
    return (
        f"{_code(odometry.names)} of a line of `odometry.csv` at t hold from t to the time of the "
        f"next line; {interval}. The last line only ends the log. The start is the pose at the "
        f"time of the first line, {odometry.time[0]:g} s. {scans}"
    )


def _start(world: World) -> str:
    cov = np.asarray(world.pose_cov, np.float64)
    robot, names = _robot(world), _state(world.motion)
    pose = f"```text\n{names} = {_list(world.pose)}\n```"
    if not np.any(cov):
        return f"The {robot} before the first motion is known exactly:\n\n{pose}"
    return (
        f"The true {robot} before the first motion is drawn anew in each run, from the normal "
        f"distribution of this mean and covariance ({names}):\n\n{pose}\n\n"
        f"```text\nP0 =\n{_rows(cov)}\n```"
    )


def _motion(world: World) -> str:
    model = single_motion(world)
    names = ", ".join(f"`w_{label(name)}`" for name in model.noises)
    if getattr(world, "noise_on", "robot") == "odometry":
        disturbed = (
            "In the simulation the noise is on the odometry: the robot moves without noise, and "
            "what is recorded is the true value and the noise. For an estimator that is the same "
            "model, as the noise is symmetric."
        )
    else:
        disturbed = "In the simulation the noise moves the robot; the odometry is the nominal one."
    states = _state(model)
    of_state = ""
    if further := model.state[3:]:
        of_state = f" Beside the pose the robot has {_code(further)}, which no odometry tells."
    return (
        f"A line of odometry moves the {_robot(world)} ({states}) to "
        f"({', '.join(f'{name}1' for name in states.split(', '))}), with the noise "
        f"{names}, independent from line to line, normal, of mean 0.{of_state}\n\n"
        f"{_equations(model)}\n\n{_noise(model, model.noises, 'w')}\n\n{disturbed}"
    )


def _measurements(world: World) -> str:
    sensor = world.sensor
    names = ", ".join(f"`n_{label(name)}`" for name in sensor.measurements)
    frame, mount = _NO_MOUNT, (sensor.sensor if isinstance(sensor, Wrapped) else sensor).mount
    if mount is not None:
        frame = f"mount = mount_x, mount_y, mount_theta = {_list(mount)}\n{_MOUNT}"
    landmark = ", ".join(f"`l_{label(name)}`" for name in sensor.landmark)
    of = f" of the landmark ({landmark})" if sensor.landmark else ""
    of_robot = "".join(f", {label(name)}" for name in sensor.robot)
    text = (
        f"A measurement{of} from the {'robot' if of_robot else 'pose'} (x, y, theta{of_robot}), "
        f"with the noise {names}, independent from "
        "measurement to measurement, normal, of mean 0. The pose of the sensor is\n\n"
        f"```python\n{frame}\n```\n\nand the measurement\n\n{_equations(sensor)}\n\n"
        f"{_noise(sensor, sensor.measurements, 'n')}"
    )
    if np.size(sensor.free.mean):
        text += (
            "\n\nA measurement does not determine its landmark. Filters of the library start it "
            "with this prior of what is missing (the range of a bearing, the bearing of a range, "
            f"an inverse distance): mean {_list(sensor.free.mean)}, covariance "
            f"{_list(sensor.free.cov)}."
        )
    visible = getattr(world, "visible", None)
    if isinstance(visible, BetweenRanges):
        text += (
            f"\n\nLandmarks are measured from {float(visible.nearest):g} m to "
            f"{float(visible.farthest):g} m."
        )
    elif sensor.landmark:
        text += "\n\nNot every landmark is measured in each scan."
    if spurious := _spurious(world):
        text += f"\n\nThe sensor has faults: {spurious}."
    return text


def _spurious(world: World) -> str:
    """The faults of the world's sensor in words; "" without faults."""
    faults = world.spurious
    if faults is None:
        return ""
    rates = {
        "false measurements a scan on average": faults.clutter,
        "of the landmarks in view are not measured": faults.missed,
        "of the measurements are false, with a true tag": faults.outliers,
        "of the tags are wrong": faults.mislabelled,
    }
    parts = [f"{float(rate):g} {words}" for words, rate in rates.items() if np.any(rate)]
    if np.any(faults.reach):
        parts.append(
            f"a false measurement is of a random point within {float(faults.reach):g} m of the "
            "robot along x and y"
        )
    return "; ".join(parts)


def _estimates(world: World) -> str:
    tags = (
        "The `tag` of a landmark is that of its measurements."
        if not has_unknown_tags(world)
        else "Without known tags `landmark` is empty."
    )
    size = len(world.sensor.measurements)
    rows, columns = np.triu_indices(size)
    nu = ",".join(f"nu_{i + 1}" for i in range(size))
    s = ",".join(f"s_{i + 1}{j + 1}" for i, j in zip(rows, columns, strict=True))
    further = landmarks = ""
    if names := list(map(label, world.motion.state[3:])):
        rows, columns = np.triu_indices(len(names))
        pairs = (f"c_{names[i]}_{names[j]}" for i, j in zip(rows, columns, strict=True))
        further = (
            f"; optional columns: `{','.join([*names, *pairs])}`, what the robot has beside the "
            "pose, and the upper triangle of its covariance"
        )
    if world.sensor.landmark:
        landmarks = (
            "\n| `estimates/0000/map.csv` (optional) | `landmark,x,y,c_xx,c_xy,c_yy` | the final "
            "map: a line a landmark, its tag, position and the covariance of the position |"
        )
    return (
        "| file | columns | lines |\n|---|---|---|\n"
        "| `estimates/0000/trajectory.csv` | `time,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt` | a "
        "line a scan: its time, as in `truth.csv`, the pose after the scan is used, and the upper "
        f"triangle of the covariance of (x, y, theta) in the axes of the map{further} |"
        f"{landmarks}\n| `estimates/0000/innovations.csv` (optional) | `t,tag,{nu},{s}` | a line a "
        "measurement of a landmark that the map has: its innovation nu (measured minus predicted, "
        "angles wrapped), and the upper triangle of its covariance S; optional columns: rejected, "
        "1 where a gate dropped it; nis and log_likelihood, where a scan is used as a whole and "
        "these are not of nu and S alone |\n\n"
        "Write 17 digits, and a row for every scan, also for an empty one: a row that is missing, "
        "not finite, or whose covariance is not positive definite is counted. With `--every 10` "
        "the judge expects every tenth row alone. "
        f"{tags if world.sensor.landmark else ''}"
    ).rstrip()


def _settings(world: World) -> str:
    text = "`jaxslam run --dataset table runs/0000` runs the library's EKF-SLAM on a run."
    if keys := unsaid_settings(world):
        text = (
            f"`dataset.toml` cannot say {', '.join(keys)}, so `jaxslam run` refuses the folder. "
            "The tables are complete."
        )
    if options := unsaid_options(world):
        text += (
            f" The filters of the campaign have options that it does not say: {', '.join(options)}."
        )
    return text


def _robot(world: World) -> str:
    """What truth.csv has of the robot, in a word."""
    return "pose" if len(world.motion.state) == 3 else "state"


def _state(model: Motion) -> str:
    """The names of a model's state, as its equations have them."""
    return ", ".join(map(label, model.state))


# --- models -------------------------------------------------------------------------------------


def _equations(model: Motion | Sensor) -> str:
    """The equations of a model as a block of code, after its constants; else its docstring."""
    constants = [f"{name} = {_list(value)}" for name, value in _constants(model)]
    if model.equations:
        lines = "\n".join([*constants, model.equations])
        return f"```python\n{lines}\n```"
    text = inspect.getdoc(type(model)) or ""
    if text.startswith(f"{type(model).__name__}("):  # of `dataclasses`, where there is none
        text = ""
    if not text:
        return (
            f"The model is `{type(model).__name__}`, a class of the author of this world that has "
            "neither equations nor a docstring: ask the author."
        )
    numbers = "\n\n".join(["", *(f"`{line}`" for line in constants)])
    return (
        f"The model is `{type(model).__name__}`, a class of the author of this world, whose "
        f"docstring says:\n\n```text\n{text}\n```{numbers}"
    )


def _constants(model: object) -> Iterator[tuple[str, ArrayLike]]:
    """The numbers of a record, and of the model that it holds, by field; not those that vary."""
    varying = model.parameters if isinstance(model, Augmented) else ()
    for field in dataclasses.fields(model):  # type: ignore[arg-type]
        value = getattr(model, field.name)
        if isinstance(value, Model):
            yield from (row for row in _constants(value) if row[0] not in varying)
        elif field.name not in ("noise_cov", "noise", "mount", "free"):
            try:
                kind = np.asarray(value).dtype.kind
            except ValueError:  # of several shapes, as a mean and its covariance
                continue
            if kind in "iuf":
                yield field.name, value


def _noise(model: Motion | Sensor, names: tuple[str, ...], symbol: str) -> str:
    """The covariance of a model's noise, as numbers or as equations."""
    if isinstance(model, Augmented):
        moves, walks = model.motion.noises, names[len(model.motion.noises) :]
        variance = "sigma**2*dt" if INTERVAL in model.controls else "sigma**2"
        return f"{_noise(model.motion, moves, symbol)}\n\n{_sigmas(walks, model.noise, variance)}"
    bare = [f"{symbol}_{label(name)}" for name in names]
    units = [split_unit(name)[1] or "" for name in names]
    while isinstance(inner := getattr(model, "motion", getattr(model, "sensor", None)), Model):
        model = inner  # type: ignore[assignment]
    cov = model.noise_cov
    if isinstance(cov, NoiseDensity):
        return _sigmas(names, cov.sigma, "sigma**2/dt")
    if isinstance(cov, Constant):
        matrix = np.asarray(cov.cov, np.float64)
        if np.any(matrix - np.diag(np.diag(matrix))):
            return f"Covariance of ({', '.join(bare)}):\n\n```text\n{_rows(matrix)}\n```"
        lines = [
            f"| `{name}` | {math.sqrt(variance)!r} {unit} |"
            for name, unit, variance in zip(bare, units, np.diag(matrix).tolist(), strict=True)
        ]
        return "\n".join(["| noise | standard deviation |", "|---|---|", *lines])
    if equations := getattr(cov, "equations", ""):
        constants = [f"{name} = {_list(value)}" for name, value in _constants(cov)]
        lines = [*constants, equations]
        return "The noise has the variances\n\n```python\n" + "\n".join(lines) + "\n```"
    text = inspect.getdoc(getattr(cov, "function", None) or type(cov)) or "(no docstring)"
    return (
        f"The covariance of ({', '.join(bare)}) is a function of the author of this world, whose "
        f"docstring says:\n\n```text\n{text}\n```"
    )


def _sigmas(names: tuple[str, ...], sigma: ArrayLike, variance: str) -> str:
    """The noises of a motion whose variance is a function of σ and the interval."""
    values = np.broadcast_to(np.asarray(sigma, np.float64), (len(names),)).tolist()
    labels = map(label, names)
    lines = [f"| `w_{name}` | {value!r} |" for name, value in zip(labels, values, strict=True)]
    return "\n".join([f"| noise, of variance `{variance}` | sigma |", "|---|---|", *lines])


def _code(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _list(value: ArrayLike) -> str:
    """Numbers with all digits, as Python writes lists."""
    return repr(np.asarray(value, np.float64).tolist())


def _rows(matrix: np.ndarray) -> str:
    return "\n".join(f"    {_list(row)}" for row in matrix)
