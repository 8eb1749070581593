"""The tables of a run, as `datasets.table` reads them, with the settings of its models.

A row of a log is a control that leads to a pose, and the scan there. A line of a table has a time:
that of velocities where they begin to hold, that of an increment where it ends.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam import motion, sensors
from jaxslam.association import (
    GlobalNearest,
    JointCompatibility,
    Known,
    MaximumLikelihood,
    Nearest,
)
from jaxslam.core.logs._tables import (
    INTERVAL,
    POSE,
    TAG,
    TIME,
    measurement_columns,
    split_unit,
)
from jaxslam.core.noise import Constant
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log, Truth
from jaxslam.core.validation import InvalidField
from jaxslam.motion import Substeps
from jaxslam.sensors import Suite
from jaxslam.simulation._team_world import TeamWorld
from jaxslam.simulation._worlds import World, with_positions

Files = dict[str, str]
"""Texts by file name."""

STEP = 1.0
"""Time between rows of a motion model without Δt [s], which no equation contains."""

_UNSAID = "see README.md: settings cannot say it"
"""Value of a setting that the reader refuses, so that no default takes its place."""

_METHODS = {
    GlobalNearest: "global_nearest",
    JointCompatibility: "joint",
    MaximumLikelihood: "maximum_likelihood",
    Nearest: "nearest",
}


class Odometry(NamedTuple):
    """The lines of odometry of a run, and the times of its poses."""

    names: tuple[str, ...]
    """the columns besides the time"""
    time: Float[np.ndarray, "K"]
    values: Float[np.ndarray, "K V"]
    rows: Float[np.ndarray, "T"]
    """the time of each pose and its scan"""
    intervals: Float[np.ndarray, "_"]
    """the intervals Δt of the controls; of a model without Δt none"""


def check_tables(world: World) -> None:
    """Raise InvalidField, with the reason, unless a folder of tables can hold the world's logs."""
    owner, sensor = f"{type(world).__name__} {world.name!r}", world.sensor
    if isinstance(world, TeamWorld):
        reason = f"expected one robot, which a folder of tables has, got {len(world.robots)}"
        raise InvalidField("robots", reason, owner=owner)
    if isinstance(sensor, Suite):
        reason = (
            "expected one sensor, which a folder of tables has, got a suite of "
            f"{', '.join(part.sensor.name for part in sensor.parts)}"
        )
        raise InvalidField("sensor", reason, owner=owner)
    if sensor.landmark and not sensor.of_points and not sensor.landmark[0].startswith("x"):
        reason = (
            "expected landmarks that are points, as landmarks.csv has them, got "
            f"({', '.join(sensor.landmark)}) of {sensor.name}"
        )
        raise InvalidField("sensor", reason, owner=owner)


def has_unknown_tags(world: World) -> bool:
    """Whether the filters of a world do not get the tags of measurements."""
    associate = world.filter_options.get("associate")
    return associate is not None and not isinstance(associate, Known)


def single_motion(world: World) -> Motion:
    """The motion model of one line of odometry."""
    model = world.motion
    return model.motion if isinstance(model, Substeps) else model


def odometry_of(world: World, control: ArrayLike) -> Odometry:
    """The lines of odometry for the controls (T, U) of a log.

    A velocity holds from the time of its line to the next, so the last line only ends the log. An
    increment leads to the time of its line.

    Raises InvalidField on an interval that is not positive.
    """
    controls = single_motion(world).controls
    count = world.motion.count if isinstance(world.motion, Substeps) else 1
    u = np.asarray(control, np.float64).reshape(-1, len(controls))
    if INTERVAL not in controls:
        time = STEP * np.arange(1, len(u) + 1)
        return Odometry(controls, time, u, time[count - 1 :: count], np.zeros(0))
    place = controls.index(INTERVAL)
    dt, values = u[:, place], np.delete(u, place, axis=1)
    # A recorded log may begin at a scan, before any motion.
    at_scan = int(len(dt) > 1 and dt[0] == 0)
    if not (dt[at_scan:] > 0).all():
        row = int(np.flatnonzero(~(dt > 0))[at_scan])
        reason = f"expected intervals above 0, which lines of a table have, got {dt[row]:g}"
        owner = f"{type(world).__name__} {world.name!r}"
        raise InvalidField(f"controls, row {row}", reason, owner=owner)
    even = np.ptp(dt[at_scan:]) == 0
    after = dt[-1] * np.arange(1 - at_scan, len(dt) + 1 - at_scan) if even else np.cumsum(dt)
    names = tuple(name for name in controls if name != INTERVAL)
    ending = np.zeros((1, values.shape[1]))
    return Odometry(
        names,
        after if at_scan else np.concatenate([[0.0], after]),
        np.concatenate([values[at_scan:], ending]),
        after[count - 1 :: count],
        dt[at_scan:],
    )


def run_files(world: World, log: Log) -> Files:
    """The files of a run that an estimator reads."""
    odometry = odometry_of(world, log.control)
    scan, sensor = log.scan, world.sensor
    row, slot = np.nonzero(scan.valid)
    columns = [_numbers(odometry.rows[row])]
    if sensor.landmark:
        tag = np.where(has_unknown_tags(world), -1, np.asarray(scan.tag)[row, slot])
        columns.append(["" if number < 0 else str(number) for number in tag.tolist()])
    columns += map(_numbers, np.asarray(scan.z, np.float64)[row, slot].T)
    sections = {
        name: "".join(
            f"{key} = {_toml(value)}\n" for key, value in section.items() if value is not None
        )
        for name, section in settings_of(world, odometry).items()
    }
    return {
        "odometry.csv": _csv(
            (TIME, *odometry.names), [_numbers(odometry.time), *map(_numbers, odometry.values.T)]
        ),
        "measurements.csv": _csv(
            measurement_columns(sensor.measurements, sensor.landmark), columns
        ),
        "dataset.toml": "\n".join(f"[{name}]\n{text}" for name, text in sections.items()),
    }


def truth_files(world: World, truth: Truth, log: Log) -> Files:
    """The files of the truth of a run: the robot at each scan, and the landmarks by tag."""
    rows, path = odometry_of(world, log.control).rows, np.asarray(truth.robot, np.float64)
    names = (TIME, *POSE, *world.motion.state[3:])
    files = {"truth.csv": _csv(names, [_numbers(rows), *map(_numbers, path.T)])}
    if world.sensor.landmark:
        points = np.asarray(with_positions(world.sensor, truth).landmarks, np.float64)
        tags = list(map(str, range(len(points))))
        files["landmarks.csv"] = _csv((TAG, *POSE[:2]), [tags, *map(_numbers, points[:, :2].T)])
    return files


# --- settings -----------------------------------------------------------------------------------


def settings_of(world: World, odometry: Odometry) -> dict[str, dict[str, object]]:
    """The sections of dataset.toml; what they cannot say is text, which the reader refuses."""
    of_motion, of_states = _motion_sections(world, odometry)
    return {
        "motion": of_motion,
        **({"state": of_states} if of_states else {}),
        "sensor": _sensor_section(world.sensor),
        "filter": _filter_section(world),
    }


def unsaid_settings(world: World) -> list[str]:
    """The settings, as "[motion] noise", that dataset.toml of the world cannot say."""
    sections = settings_of(world, odometry_of(world, world.controls))
    return [
        f"[{section}] {key}"
        for section, settings in sections.items()
        for key, value in settings.items()
        if isinstance(value, str) and value.endswith(_UNSAID)
    ]


def unsaid_options(world: World) -> list[str]:
    """The options of the world's filters that dataset.toml has no key for."""
    return sorted(set(world.filter_options) - {"correction", "gate", "associate", "births"})


def _motion_sections(
    world: World, odometry: Odometry
) -> tuple[dict[str, object], dict[str, object]]:
    """The sections of the motion and of the states beside the pose; the latter {} without any."""
    model = line_motion = single_motion(world)
    errors: dict[str, object] = {}
    states: tuple[str, ...] = ()
    unit = "1"
    if isinstance(model, motion.Augmented):
        states, unit, model = model.parameters, model.unit, model.motion
    if isinstance(model, motion.Corrected):
        errors = {name: getattr(model, name) for name in ("scale", "wheels", "heading")}
        model = model.motion
    name, further = _registered(model, motion.REGISTRY), model.state[3:]
    # The reader makes states of errors of the odometry alone, beside no other, in units of 1.
    readable = not states or (not further and set(states) <= errors.keys() and unit == "1")
    if name is None or not readable:
        return {"model": f"{line_motion.name}: {_UNSAID}"}, {}
    noise, walks = _motion_deviations(model, odometry)
    section = {"model": name, "noise": noise} | _arguments(model)
    section |= {key: value for key, value in errors.items() if key not in states}
    if not (states or further):
        return section, {}
    if isinstance(line_motion, motion.Augmented):
        walks = np.broadcast_to(
            np.asarray(line_motion.noise, np.float64), (len(line_motion.state) - 3,)
        )
    cov = np.asarray(world.pose_cov, np.float64)
    correlated = np.any(cov[3:, :3]) or np.any(cov[3:, 3:] - np.diag(np.diag(cov)[3:]))
    return section, {
        "names": states or [split_unit(name)[0] for name in further],
        "start": np.asarray(world.pose, np.float64)[3:],
        "start_noise": _UNSAID if correlated else np.sqrt(np.diag(cov)[3:]),
        "noise": walks,
    }


def _motion_deviations(model: Motion, odometry: Odometry) -> tuple[object, object]:
    """The standard deviations of a line of odometry, and of the model's own states in a second.

    None without one. The reader scales the variance of velocities by the median interval over the
    line's own.
    """
    cov, dt = model.noise_cov, odometry.intervals
    beside = len(model.state) - 3  # whose rates are the last noises
    line = np.median(np.diff(odometry.time)) if dt.size else 1.0
    if isinstance(cov, motion.WhiteNoise) and not np.any(cov.turn_share):
        deviations: object = np.array([cov.travel, cov.turn], np.float64) / np.sqrt(line)
    elif isinstance(cov, motion.NoiseDensity) and dt.size:
        density = np.broadcast_to(np.asarray(cov.sigma, np.float64), (len(model.noises),))
        deviations = density / np.sqrt(line)
    elif not isinstance(cov, Constant) or (dt.size and np.ptp(dt) > 1e-9 * dt.max()):
        deviations = _UNSAID
    else:
        deviations = _deviations(cov.cov)
    if not beside:
        return deviations, None
    if not isinstance(deviations, np.ndarray):
        return deviations, deviations
    measured = len(model.noises) - beside
    return deviations[:measured] if measured else None, deviations[measured:] * np.sqrt(line)


def _sensor_section(model: Sensor) -> dict[str, object]:
    errors: dict[str, object] = {}
    if isinstance(model, sensors.Corrected):
        errors = {"range": model.range, "axis": model.axis}
        model = model.sensor
    name = _registered(model, sensors.REGISTRY)
    if name is None:
        return {"model": f"{model.name}: {_UNSAID}"}
    cov = model.noise_cov
    noise: dict[str, object] = {"noise": _UNSAID}
    if isinstance(cov, Constant):
        noise = {"noise": _deviations(cov.cov)}
    elif isinstance(cov, sensors.RangeBearingNoise):
        shares = {"share": cov.share, "across": cov.across}
        noise = {"noise": [cov.range, cov.bearing]}
        noise |= {key: value for key, value in shares.items() if np.any(value)}
    mount = {"mount": [0.0, 0.0, 0.0] if model.mount is None else model.mount}
    return {"model": name} | noise | mount | _arguments(model) | errors


def _filter_section(world: World) -> dict[str, object]:
    """The start, and the options of the campaign's filters."""
    cov, options = np.asarray(world.pose_cov, np.float64)[:3, :3], world.filter_options
    diagonal = not np.any(cov - np.diag(np.diag(cov)))
    spread = {"start_noise": np.sqrt(np.diag(cov))} if diagonal else {"start_covariance": cov}
    section: dict[str, object] = {
        "start": np.asarray(world.pose, np.float64)[:3],
        **spread,
        "capacity": int(np.shape(world.landmarks)[0]),
        "update": options.get("correction", "sequential"),
        "births": options.get("births"),
    }
    if not world.sensor.landmark:
        del section["capacity"]
    rule, gate = options.get("associate"), options.get("gate")
    if rule is None or isinstance(rule, Known):
        return section | {"associate": "known", "gate": gate}
    probability = getattr(rule, "probability", getattr(rule, "gate", None))
    method = _METHODS.get(type(rule))
    further = [
        field.name
        for field in dataclasses.fields(rule)
        if field.name not in ("gate", "new_gate", "probability")
        and getattr(rule, field.name) != field.default
    ]
    # A rule with further options is no method of the reader's, nor is one with a gate behind it.
    if method is None or probability is None or gate is not None or further:
        return section | {"associate": f"{rule!r}: {_UNSAID}"}
    new_gate = probability if rule.new_gate is None else rule.new_gate
    return section | {"associate": method, "gate": probability, "new_gate": new_gate}


def _registered(model: Motion | Sensor, registry: Mapping[str, object]) -> str | None:
    """The name of a model's class in the registry; None without one."""
    return next((name for name, factory in registry.items() if factory is type(model)), None)


def _arguments(model: Motion | Sensor) -> dict[str, object]:
    """The fields of a model of the library besides noise and mount."""
    names = [field.name for field in dataclasses.fields(model)]
    return {name: getattr(model, name) for name in names if name not in ("noise_cov", "mount")}


def _deviations(cov: object) -> object:
    """The standard deviations of a diagonal covariance; the text of what is unsaid of another."""
    matrix = np.asarray(cov, np.float64)
    variances = np.diag(matrix)
    return _UNSAID if np.any(matrix - np.diag(variances)) else np.sqrt(variances)


# --- text ---------------------------------------------------------------------------------------


def _numbers(values: Float[np.ndarray, "K"]) -> list[str]:
    """Numbers as text, each the shortest that reads as the same float64: 17 digits at most."""
    return list(map(repr, values.tolist()))


def _csv(header: Sequence[str], columns: Sequence[Sequence[str]]) -> str:
    lines = [",".join(header), *map(",".join, zip(*columns, strict=True))]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    """A value of TOML: text, a number, or lists of numbers."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    array = np.asarray(value, np.float64)
    return repr(float(array)) if array.ndim == 0 else f"[{', '.join(map(_toml, array))}]"
