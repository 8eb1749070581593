"""The states at which claims are verified: random ones, and difficult ones by unit and domain."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from jaxslam.core.claims import Argument, Claim, Gaussian, Points, ValuesOf
from jaxslam.core.protocols import POSE
from jaxslam.math._xla import quick_jit
from jaxslam.verify._inputs.functions import periods

Table: TypeAlias = Float[np.ndarray, "_ _"]
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
_SHIFT = np.array([[FAR, -FAR], [-FAR, FAR]])
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
_WITHIN = 1.7
"""Standard deviations of a prior within which its random values are: a range of 10 ± 5 m is none
below 0."""
_HALF_TURN = {"[rad]": np.pi, "[deg]": 180.0}
"""Largest random angle by its unit."""
_SPREAD = {"[m]": 3.0, "[1/m]": 0.2}
"""Standard deviation of random values by their unit; 1 of others."""

_Group: TypeAlias = tuple[str, dict[int, Table]]
"""A label, and states of some arguments by position; of the others the first random ones."""


class Samples(NamedTuple):
    """S states: an array (S, n) for each argument, and a label for each state."""

    values: tuple[Table, ...]
    labels: tuple[str, ...]


class Seen(NamedTuple):
    """The values of a claim at its samples."""

    claim: Claim
    samples: Samples
    values: Float[np.ndarray, "S m"]


def claim_samples(claim: Claim, count: int, seed: int, before: Sequence[Seen] = ()) -> Samples:
    """Samples of a claim: random, difficult, near, far and zero, by the domains of its arguments.

    before: the claims before; one whose values are an argument gives it, and the arguments of the
    same names. Where the functions of a domain fail, as `embed`, all samples are by the units.
    """
    if claim.states is not None:
        return Samples(*claim.states(count, seed))
    with contextlib.suppress(Exception, SystemExit):
        return _samples(claim, count, seed, before)
    arguments = tuple(replace(argument, domain=None) for argument in claim.arguments)
    return _samples(replace(claim, arguments=arguments), count, seed, ())


def _samples(claim: Claim, count: int, seed: int, before: Sequence[Seen]) -> Samples:
    rng = np.random.default_rng(seed)
    held: dict[str, Table] = {}
    reach: dict[int, Callable[[Table], np.ndarray]] = {}
    for k, argument in enumerate(claim.arguments):
        if isinstance(domain := argument.domain, ValuesOf):
            (seen,) = (s for s in before if s.claim.name == domain.claim)
            usual = [i for i, label in enumerate(seen.samples.labels) if label in NOMINAL]
            names = [argument.name for argument in seen.claim.arguments]
            held = dict(zip(names, (a[usual] for a in seen.samples.values), strict=True))
            held[argument.name], count = seen.values[usual], len(usual)
            reach[k] = _reach(seen.values, argument.entries, domain.support)
    base: list[Table] = []
    around: list[_Group] = []
    for k, argument in enumerate(claim.arguments):
        if argument.name in held:
            base.append(held[argument.name])
        elif isinstance(domain := argument.domain, Gaussian):
            draws = rng.uniform(-_WITHIN, _WITHIN, (count, len(argument.entries)))
            base.append(np.asarray(domain.mean) + draws @ np.linalg.cholesky(domain.cov).T)
        elif isinstance(domain, Points):
            landmarks, around = _landmarks(rng, domain, argument.name, base[0], k)
            base.append(landmarks)
        else:
            base.append(_random(rng, argument, count))
    if held and "given" in seen.samples.labels:
        return Samples(tuple(base), ("given",) * count)

    groups: list[_Group] = [("random", dict(enumerate(base)))]
    for k, argument in enumerate(claim.arguments):
        for label, rows, table in _one_at_a_time(argument, base[k]):
            if k not in reach or reach[k](table).all():
                groups.append((label, {i: a[rows] for i, a in enumerate(base)} | {k: table}))
    places = [k for k, argument in enumerate(claim.arguments) if _is_place(argument)]
    zeros = {
        k: np.where(reach[k](0 * base[k]), 0.0, base[k]) if k in reach else 0.0 * base[k]
        for k, argument in enumerate(claim.arguments)
        if argument.entries and k not in places and not isinstance(argument.domain, Points)
    }
    groups += [(f"zero {claim.arguments[k].name}", {k: zero[:4]}) for k, zero in zeros.items()]
    if len(zeros) > 1:
        label = f"zero {' and '.join(claim.arguments[k].name for k in zeros)}"
        groups.append((label, {k: zero[:2] for k, zero in zeros.items()}))
    if places and not around:
        groups.append((LARGE, {k: _shifted(base[k][:2], _SHIFT) for k in places}))
    for k in places[1:]:
        for distance in (_NEAR, 2.0**-4):
            close = base[k][:2].copy()
            close[:, :2] = base[places[0]][:2, :2] + distance * np.array([[1, 0.5], [-0.25, 1]])
            groups.append((f"{claim.arguments[k].name} close", {k: close}))
    if claim.everywhere:
        groups += coincident_states(claim.arguments, base)
    labels, tables = [], []
    for label, changed in [*groups, *around]:
        size = len(next(iter(changed.values())))
        labels += [label] * size
        tables.append([changed.get(k, a[:size]) for k, a in enumerate(base)])
    return Samples(tuple(map(np.concatenate, zip(*tables, strict=True))), tuple(labels))


def _landmarks(
    rng: np.random.Generator, points: Points, name: str, pose: Table, k: int
) -> tuple[Table, list[_Group]]:
    """Landmarks of random points, first seen from another pose than the present one, and groups of
    close, coincident, far and large ones."""
    elsewhere = _random(rng, Argument("pose", POSE), len(pose))
    offset = 4 * rng.normal(size=(len(pose), 2))
    near = _NEAR * np.sign(offset[:4])
    few, first, robot = pose[:4], pose[:4].copy(), pose[:4, :2]
    first[:, :2] = np.round(first[:, :2] * 64) / 64
    ahead = np.stack([np.cos(few[:, 2]), np.sin(few[:, 2])], axis=1)
    away = _shifted(pose[:2], _SHIFT)
    eye = np.asarray(quick_jit(jax.vmap(points.frame))(few), np.float64)[:, :2]
    # Each with the present pose, the pose from which the landmark was first seen, and its point.
    cases = {
        "random": (pose, elsewhere, pose[:, :2] + offset),
        f"{name} close to the robot": (first, first, first[:, :2] + near),
        f"{name} behind, on the seam": (few, elsewhere[:4], robot - 5 * ahead),
        f"{name} at the robot": (few, few, robot),
        f"{name} far": (few, few, robot + _OUT_OF_SIGHT),
        f"{name} close to the sensor": (few, few, eye + near),
        f"{name} at the sensor": (few, few, eye),
        LARGE: (away, away, away[:, :2] + offset[:2]),
    }
    seen_from = np.concatenate([case[1][:, :3] for case in cases.values()])
    at = np.concatenate([case[2] for case in cases.values()])
    landmarks = np.asarray(quick_jit(jax.vmap(points.embed))(seen_from, at), np.float64)
    ends = np.cumsum([len(case[2]) for case in cases.values()])[:-1]
    parts = dict(zip(cases, np.split(landmarks, ends), strict=True))
    table = parts.pop("random")
    groups = [(label, {0: cases[label][0], k: part}) for label, part in parts.items()]
    return table, groups if table.size else groups[-1:]


def coincident_states(arguments: Sequence[Argument], base: Sequence[Table]) -> Iterator[_Group]:
    """States where distances vanish: a place at the origin, the next ones at the first."""
    places = [k for k, argument in enumerate(arguments) if _is_place(argument)]
    for k in places:
        moved, first = base[k][:1].copy(), k == places[0]
        moved[:, :2] = 0.0 if first else base[places[0]][:1, :2]
        where = "the origin" if first else f"the {arguments[places[0]].name}"
        yield f"{arguments[k].name} at {where}", {k: moved}


def _reach(
    seen: Table, names: Sequence[str], support: Mapping[str, tuple[float, float]]
) -> Callable[[Table], np.ndarray]:
    """The function of values (B, m) -> whether each entry is one that a claim can return.

    An angle is, if it is between the smallest and the largest seen, or if these cover nearly the
    whole turn. Any entry is only within its support.
    """
    circle = periods(names)
    least, most = np.fmin.reduce(seen), np.fmax.reduce(seen)
    whole_turn = ~np.isfinite(circle) | (most - least > 0.9 * circle)
    limits = [support.get(name, (-np.inf, np.inf)) for name in names]
    low, high = np.reshape(limits, (-1, 2)).T
    return lambda z: (whole_turn | ((least < z) & (z < most))) & (low < z) & (z < high)


def _random(rng: np.random.Generator, argument: Argument, count: int) -> Table:
    """Random values of an argument by its units."""
    table = np.zeros((count, len(argument.entries)))
    for k, name in enumerate(argument.entries):
        unit = name.split(" ")[-1]
        if "steering" in name:  # a wheel does not turn by a right angle
            table[:, k] = rng.uniform(-0.8, 0.8, count)
        elif unit in _HALF_TURN:
            table[:, k] = rng.uniform(-_HALF_TURN[unit], _HALF_TURN[unit], count)
        else:
            table[:, k] = rng.normal(size=count) * _SPREAD.get(unit, 1.0)
            table[:, k] += 0.3 * (unit == "[1/m]")
            if unit == "[s]":
                table[:, k] = np.abs(table[:, k])
    table *= argument.scale
    if argument.scale != 1:  # noise: zero in half of the states
        table[::2] = 0
    return table


def _is_place(argument: Argument) -> bool:
    """Whether the argument is a pose or a point, drawn by its units."""
    return argument.entries[:2] == POSE[:2] and argument.domain is None


def _shifted(table: Table, by: Table) -> Table:
    """Poses or points moved in the plane."""
    return np.concatenate([table[:, :2] + by, table[:, 2:]], axis=1)


def _one_at_a_time(argument: Argument, base: Table) -> Iterator[tuple[str, list[int], Table]]:
    """The difficult values of each entry: a label, the row of the other entries, the argument."""
    for column, name in enumerate(argument.entries):
        hard = np.array(_HARD.get(name.split(" ")[-1], ()))
        if "steering" in name:
            hard = hard[np.abs(hard) < 1]
        for i, value in enumerate(hard if argument.scale == 1 else ()):
            row = [i % len(base)]
            moved = base[row].copy()
            moved[:, column] = value
            yield f"{argument.name} {name.split(' ')[0]} = {value:.4g}", row, moved
