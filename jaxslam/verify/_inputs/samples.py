"""The states at which models are verified: random ones, and difficult ones by unit."""

from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from jaxslam.core.protocols import POSE, Sensor
from jaxslam.math._xla import quick_jit
from jaxslam.verify._inputs.functions import Argument, periods, robot_argument

Values: TypeAlias = Float[np.ndarray, "_ _"]
"""States (S, n) of one argument."""

FAR = 1e5
"""Distance from the origin of survey coordinates [m]."""
_OUT_OF_SIGHT = 16.0
"""Distance from the robot to a far landmark, along each axis [m]."""
_NEAR = 2.0**-10
"""Distance from the robot to a close landmark [m]; a power of two is exact in float32, too."""
NOMINAL = ("random", "given")
"""Labels of the states that are not chosen to be difficult."""
LARGE = "large coordinates"
"""Label of the states `FAR` from the origin."""
_SEAM = 1e-9
"""Distance from the seam of an angle, and from 0 of a rate; well above the rounding of π."""

# One coordinate at a time takes these values while the others are random. Between 0.499 and 0.501
# `angles.sinc` changes from its series to the closed form.
_HARD = {
    "[rad]": (0.0, _SEAM, -_SEAM, 1e-4, np.pi - _SEAM, _SEAM - np.pi, np.pi, np.pi / 2),
    "[rad/s]": (0.0, _SEAM, -_SEAM, 1e-4, 0.499, 0.501),
    "[m/s]": (0.0, _SEAM),
    "[m]": (0.0,),
    "[s]": (0.0,),
    "[1/m]": (0.0, _SEAM, -_SEAM, -0.5),
}

_Group: TypeAlias = tuple[str, tuple[Values, ...]]
"""A label, and states (S, n) for each argument."""


class Samples(NamedTuple):
    """S states: an array (S, n) for each argument, and a label for each state."""

    values: tuple[Values, ...]
    labels: tuple[str, ...]


def argument_samples(arguments: tuple[Argument, ...], count: int, seed: int) -> Samples:
    """Samples of a function's arguments by their units: random, difficult, near, far and zero."""
    rng = np.random.default_rng(seed)
    base = tuple(_sampled_argument(rng, argument, count) for argument in arguments)
    groups: list[_Group] = [("random", base)]
    for k, argument in enumerate(arguments):
        groups += list(_one_at_a_time(base, k, argument))
        if not _is_place(argument):
            groups.append((f"zero {argument.name}", _replace(base, k, 0.0 * base[k][:4], 4)))
    others = [k for k, argument in enumerate(arguments) if not _is_place(argument)]
    if len(others) > 1:
        still = tuple(a[:2] * (k not in others) for k, a in enumerate(base))
        groups.append((f"zero {' and '.join(arguments[k].name for k in others)}", still))
    places = [k for k, argument in enumerate(arguments) if _is_place(argument)]
    if places:
        shift = np.array([[FAR, -FAR], [-FAR, FAR]])
        far = [table[:2].copy() for table in base]
        for k in places:
            far[k][:, :2] += shift
        groups.append((LARGE, tuple(far)))
    for k in places[1:]:
        for distance in (_NEAR, 2.0**-4):
            close = base[k][:2].copy()
            close[:, :2] = base[places[0]][:2, :2] + distance * np.array([[1, 0.5], [-0.25, 1]])
            groups.append((f"{arguments[k].name} close", _replace(base, k, close, 2)))
    return _concatenate(groups)


def coincident_states(
    arguments: tuple[Argument, ...], samples: Samples
) -> Iterable[tuple[str, tuple[np.ndarray, ...]]]:
    """States where distances vanish, with a label: each place at the origin, or at the first."""
    state = [table[0].copy() for table in samples.values]
    places = [k for k, argument in enumerate(arguments) if _is_place(argument)]
    for k in places:
        moved = [entry.copy() for entry in state]
        alone = k == places[0]
        moved[k][:2] = 0.0 if alone else state[places[0]][:2]
        where = "the origin" if alone else f"the {arguments[places[0]].name}"
        yield f"{arguments[k].name} at {where}", tuple(moved)


def sensor_samples(sensor: Sensor, count: int, seed: int) -> tuple[Samples, Samples]:
    """Samples (pose, landmark) for `observe`, and (pose, measurement, free) for `invert`.

    Landmarks come from the sensor's own `embed` and `invert`, first seen from another pose than the
    present one; each of their coordinates also takes its difficult values.
    """
    rng = np.random.default_rng(seed)
    embed = quick_jit(jax.vmap(sensor.embed))
    place = quick_jit(jax.vmap(sensor.invert))

    def at(poses: Values, points: Values) -> Values:
        return np.asarray(embed(poses[:, :3], points), np.float64)

    robot = robot_argument(sensor)
    pose = _sampled_argument(rng, robot, count)
    elsewhere = _sampled_argument(rng, Argument("pose", POSE), count)
    offset = rng.normal(size=(count, 2)) * 4
    first = pose.copy()
    first[:, :2] = np.round(first[:, :2] * 64) / 64
    landmark = at(elsewhere, pose[:, :2] + offset)
    base = (pose, landmark)
    groups: list[_Group] = [("random", base)]
    for k, argument in enumerate((robot, Argument("landmark", sensor.landmark))):
        groups += list(_one_at_a_time(base, k, argument))

    mean = np.asarray(sensor.free.mean, np.float64)
    root = np.linalg.cholesky(np.asarray(sensor.free.cov, np.float64)) if len(mean) else mean
    s = mean + rng.normal(size=(count, len(mean))) @ np.reshape(root, (len(mean), len(mean))).T
    z = np.asarray(quick_jit(jax.vmap(sensor.observe))(pose, landmark), np.float64)
    metres = np.array([name.endswith("[m]") for name in sensor.measurements])
    few = slice(0, 4)
    if sensor.landmark:
        turn = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
        close = first[few, :2] + _NEAR * np.sign(offset[few])
        ahead = pose[few, :2] - 5 * turn[few]
        groups += [
            ("landmark close to the robot", (first[few], at(first[few], close))),
            ("landmark behind, on the seam", (pose[few], at(elsewhere[few], ahead))),
            ("landmark at the robot", (pose[few], at(pose[few], pose[few, :2]))),
            ("landmark far", (pose[few], at(pose[few], pose[few, :2] + _OUT_OF_SIGHT))),
        ]
        for label, scale in ("landmark close to the sensor", _NEAR), ("landmark at the sensor", 0):
            seen = np.where(metres, z[few] * scale, z[few])
            near = np.asarray(place(pose[few], seen, s[few] * scale), np.float64)
            if np.isfinite(near).all():  # else `invert` fails, which another check reports
                groups.append((label, (pose[few], near)))
    corners = np.array([[FAR, -FAR], [-FAR, FAR]])
    away = pose[:2].copy()
    away[:, :2] += corners
    groups.append((LARGE, (away, at(away, away[:, :2] + offset[:2]))))
    observed = _concatenate(groups)

    back: list[_Group] = [("random", (pose, z, s))]
    back += list(_one_at_a_time((pose, z, s), 0, robot))
    seen = np.asarray(quick_jit(jax.vmap(sensor.observe))(*observed.values), np.float64)
    reached = _reach(seen, sensor)
    difficult = _one_at_a_time((pose, z, s), 1, Argument("measurement", sensor.measurements))
    back += [(label, part) for label, part in difficult if reached(part[1]).all()]
    zero = np.where(reached(0 * z[few]), 0.0, z[few])
    back.append(("zero measurement", (pose[few], zero, s[few])))
    if len(mean):
        back.append(("free coordinates zero", (pose[few], z[few], 0 * s[few])))
    back.append((LARGE, (away, z[:2], s[:2])))
    return observed, _concatenate(back)


def inverse_samples(sensor: Sensor, states: Samples, sampled: Samples) -> Samples:
    """Samples (pose, measurement, free) for `invert`: what `observe` returns at a user's states.

    sampled: samples of `invert`, whose free coordinates are used.
    """
    z = np.asarray(quick_jit(jax.vmap(sensor.observe))(*states.values), np.float64)
    s = np.resize(sampled.values[2], (len(z), sampled.values[2].shape[1]))
    return Samples((states.values[0], z, s), states.labels)


def _reach(seen: Values, sensor: Sensor) -> Callable[[Values], np.ndarray]:
    """The function of measurements (B, m) -> whether each entry is one that the sensor can return.

    An angle is, if it is between the smallest and the largest observed one, or if these cover
    nearly the whole turn. Any entry is only within the sensor's `support`.
    """
    names, circle = sensor.measurements, periods(sensor.measurements)
    least, most = np.fmin.reduce(seen), np.fmax.reduce(seen)
    whole_turn = ~np.isfinite(circle) | (most - least > 0.9 * circle)
    low, high = np.transpose([sensor.support.get(name, (-np.inf, np.inf)) for name in names])
    return lambda z: (whole_turn | ((least < z) & (z < most))) & (low < z) & (z < high)


def _sampled_entry(rng: np.random.Generator, name: str, count: int) -> Float[np.ndarray, "S"]:
    """Random values of a coordinate by its unit."""
    unit = name.split(" ")[-1]
    if "steering" in name:  # a wheel does not turn by a right angle
        return rng.uniform(-0.8, 0.8, count)
    if unit == "[rad]":
        return rng.uniform(-np.pi, np.pi, count)
    if unit == "[deg]":
        return rng.uniform(-180, 180, count)
    if unit == "[s]":
        return np.abs(rng.normal(size=count))
    if unit == "[1/m]":
        return 0.3 + 0.2 * rng.normal(size=count)
    return rng.normal(size=count) * (3.0 if unit == "[m]" else 1.0)


def _sampled_argument(rng: np.random.Generator, argument: Argument, count: int) -> Values:
    """Random values of an argument."""
    columns = [_sampled_entry(rng, name, count) for name in argument.entries]
    table = np.stack(columns, axis=1) if columns else np.zeros((count, 0))
    table = argument.scale * table
    if argument.scale != 1:  # noise: zero in half of the states
        table[::2] = 0
    return table


def _is_place(argument: Argument) -> bool:
    """Whether the argument is a pose or a point."""
    return argument.entries[:2] == POSE[:2]


def _one_at_a_time(base: tuple[Values, ...], k: int, argument: Argument) -> Iterable[_Group]:
    """States in which one entry of an argument has a difficult value."""
    for column, name in enumerate(argument.entries):
        hard = np.array(_HARD.get(name.split(" ")[-1], ()))
        if "steering" in name:
            hard = hard[np.abs(hard) < 1]
        if len(hard) and argument.scale == 1:
            count = len(hard)
            rows = np.arange(count) % len(base[k])
            moved = base[k][rows].copy()
            moved[:, column] = hard
            for i, value in enumerate(hard):
                state = tuple(a[rows[i : i + 1]] for a in base)
                label = f"{argument.name} {name.split(' ')[0]} = {value:.4g}"
                yield label, _replace(state, k, moved[i : i + 1], 1)


def _replace(base: tuple[Values, ...], k: int, new: Values, count: int) -> tuple[Values, ...]:
    """The first states, with another value of one argument."""
    return tuple(new[:count] if i == k else a[:count] for i, a in enumerate(base))


def _concatenate(groups: list[_Group]) -> Samples:
    labels = tuple(label for label, parts in groups for _ in range(len(parts[0])))
    parts = zip(*(parts for _, parts in groups), strict=True)
    return Samples(tuple(np.concatenate(part) for part in parts), labels)
