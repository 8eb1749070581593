"""Errors of relative poses, given or made from a reference path; statistics of errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam.consistency.metrics._paths import PathErrors, pose_pair, poses_of
from jaxslam.core.logs._streams import is_gap
from jaxslam.core.validation import InvalidField, positive, refusals_of, require
from jaxslam.math.numpy_poses import between, wrapped

Spacing = float | Sequence[float] | None

_ROUNDING = 1e-6
"""Tolerance of a spacing [s, m]: times since 1970 are rounded to 2e-7 s."""


class Relations(NamedTuple):
    """Reference poses between rows of a path."""

    first: Int[np.ndarray, "R"]
    second: Int[np.ndarray, "R"]
    """rows of the path"""
    pose: Float[np.ndarray, "R 3"]
    """pose of the second row in the frame of the first"""


class Errors(NamedTuple):
    """The errors of relations; `statistics` sums them up."""

    translation: Float[np.ndarray, "R"]
    """[m]"""
    rotation: Float[np.ndarray, "R"]
    """size of the angle [rad], in [0, π]"""


def relations(
    reference: ArrayLike,
    *,
    rows: int | None = None,
    seconds: Spacing = None,
    metres: Spacing = None,
    time: ArrayLike | None = None,
) -> Relations:
    """The relations of a reference path from each row to the first that is far enough after it.

    A row without one that far after it has no relation; there may be none at all. With `seconds` it
    has none across a gap of the stamps, a step longer than the spacing and than ten times their
    median: that would be of another time.

    Args:
        reference: (K, 3) poses, in the order of time.
        rows: distance of the two poses in rows.
        seconds: at least so long after, by the stamps `time` (K,) [s]. Of several spacings, the
            relations of each, one after the other.
        metres: least distance along the reference path; as `seconds`.
    Raises:
        ValueError: unless exactly one spacing is given, and above 0; on poses that are none, and
            on stamps that are missing or go back.
    """
    with refusals_of("relations"):
        path = poses_of("reference", reference)
        if sum(spacing is not None for spacing in (rows, seconds, metres)) != 1:
            raise InvalidField("", "expected exactly one of rows, seconds and metres")
        if (time is None) != (seconds is None):
            raise InvalidField("", "expected the stamps, time=, with seconds= and nowhere else")
        if rows is not None and not float(rows).is_integer():
            raise InvalidField("rows", f"expected a whole number, got {rows}")
    at = distance_travelled(path) if seconds is None else np.asarray(time, np.float64)
    if rows is not None:
        at = np.arange(len(path), dtype=np.float64)
    with refusals_of("relations"):
        if at.shape != (len(path),):
            raise InvalidField("time", f"expected shape ({len(path)},), got {at.shape}")
        if not (rises := np.diff(at) >= 0).all():
            row = int(rises.argmin())
            raise InvalidField(
                "time",
                f"expected stamps that do not go back, got {at[row + 1]} in row {row + 1} "
                f"after {at[row]}",
            )
        distance = next(spacing for spacing in (rows, seconds, metres) if spacing is not None)
        spacings = np.atleast_1d(np.asarray(distance, np.float64))
        if (
            spacings.ndim != 1
            or not len(spacings)
            or not (np.isfinite(spacings) & (spacings > 0)).all()
        ):
            raise InvalidField("", f"expected finite spacings above 0, got {distance}")
    gaps = is_gap(at) if seconds is not None else np.zeros(len(path) - 1, bool)
    pairs = []
    for spacing in spacings:
        after = np.searchsorted(at, at + spacing - _ROUNDING * min(1.0, spacing))
        start = np.flatnonzero(after < len(path))
        passed = np.concatenate([[0], np.cumsum(gaps & (np.diff(at) > spacing))])
        start = start[passed[start] == passed[after[start]]]
        pairs.append((start, after[start]))
    first, second = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return _between(path, first, second)


def revisits(reference: ArrayLike, *, radius: float, apart: float) -> Relations:
    """The relations of a reference path between rows that are near in space and not along the path.

    For each row the nearest one before it, at most `radius` [m] away with at least `apart` [m] of
    path in between; rows without one have no relation. They show whether loops are closed.

    Raises ValueError on poses that are none, and on numbers that are not above 0.
    """
    with refusals_of("revisits"):
        path = poses_of("reference", reference)
        require("radius", radius, positive)
        require("apart", apart, positive)
    at = distance_travelled(path)
    before = np.searchsorted(at, at - apart, side="right")  # rows [0, before) are far enough back
    pairs = []
    for k in np.flatnonzero(before):
        off = path[: before[k], :2] - path[k, :2]
        squared = (off**2).sum(axis=1)
        nearest = int(np.argmin(squared))
        if squared[nearest] <= radius**2:
            pairs.append((nearest, k))
    rows = np.array(pairs, int).reshape(-1, 2)
    return _between(path, rows[:, 0], rows[:, 1])


def relations_at_stamps(
    time: ArrayLike, first: ArrayLike, second: ArrayLike, pose: ArrayLike, *, tolerance: float
) -> tuple[Relations, int]:
    """The relations of a file, by rows of a path instead of by stamps, and how many are dropped.

    Each stamp takes the row nearest in time, the first of several with the same stamp; a relation
    with one further than `tolerance` away is dropped.

    Args:
        time: (K,) stamps of the path [s], in any order: logs have scans stamped before their
            predecessor.
        first, second: (R,) stamps of the relations [s].
        pose: (R, 3) of the second in the frame of the first.
        tolerance: [s].
    Raises:
        ValueError: on shapes that do not fit, stamps of the path that are not finite, a tolerance
            that is not a number of at least 0; and if no relation is kept, with both time ranges.
    """
    stamps = np.asarray(time, np.float64)
    with refusals_of("relations_at_stamps"):
        of = poses_of("pose", pose)
        if stamps.ndim != 1 or not len(stamps) or not np.isfinite(stamps).all():
            raise InvalidField("time", f"expected finite stamps (K,), got {stamps.shape}")
        if not tolerance >= 0:
            raise InvalidField("tolerance", f"expected at least 0 s, got {tolerance}")
        for argument, values in (("first", first), ("second", second)):
            end = np.asarray(values, np.float64)
            if end.shape != (len(of),):
                raise InvalidField(argument, f"expected {len(of)} stamps, got {end.shape}")
            if not (finite := np.isfinite(end)).all():
                row = int(finite.argmin())
                reason = f"expected finite stamps, got {end[row]} in row {row}"
                raise InvalidField(argument, reason)
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    ends = np.stack([first, second]).astype(np.float64)
    after = np.clip(np.searchsorted(ordered, ends), 0, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    place = np.where(np.abs(ends - ordered[before]) <= np.abs(ordered[after] - ends), before, after)
    place = np.searchsorted(ordered, ordered[place])  # the first of the same stamp
    near = (np.abs(ordered[place] - ends) <= tolerance).all(axis=0)
    if not near.any():
        raise InvalidField(
            "",
            f"none of {len(of):,} relations, from {ends.min():.6f} s to "
            f"{ends.max():.6f} s, joins the path, from {ordered[0]:.6f} s to {ordered[-1]:.6f} s, "
            f"within {tolerance:g} s at both ends",
            owner="relations_at_stamps",
        )
    rows = order[place]
    return Relations(rows[0][near], rows[1][near], of[near]), int((~near).sum())


def relation_errors(of: Relations, estimate: ArrayLike) -> Errors:
    """The errors of an estimated path over relations, translation and rotation apart.

    With δ̂ the estimated pose of the second row in the frame of the first, and δ the reference: the
    translation and the rotation of δ⁻¹ ∘ δ̂, so |t̂ - t| and |θ̂ - θ| on the circle. They do not
    depend on the frames of the two paths, and an early error counts once.

    Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss & Kleiner 2009, "On measuring the
    accuracy of SLAM algorithms", Autonomous Robots 27; they report mean and standard deviation of
    the errors and of their squares.

    Raises ValueError on poses that are none, and on relations of rows that the path does not have.
    """
    with refusals_of("relation_errors"):
        path = poses_of("estimate", estimate)
        for rows in (of.first, of.second):
            if len(rows) and not (rows.min() >= 0 and rows.max() < len(path)):
                reason = f"of rows up to {int(rows.max())}, and the path has {len(path)}"
                raise InvalidField("of", reason)
    gap = _between(path, of.first, of.second).pose - of.pose
    return Errors(np.hypot(gap[:, 0], gap[:, 1]), np.abs(wrapped(gap[:, 2])))


def rpe(
    reference: ArrayLike,
    estimate: ArrayLike,
    *,
    rows: int | None = None,
    seconds: Spacing = None,
    metres: Spacing = None,
    time: ArrayLike | None = None,
) -> Errors:
    """The relative pose error: `relation_errors` over the `relations` of the reference path.

    Sturm et al. 2012, as in `ate`; row k of one path belongs to row k of the other. Raises
    ValueError as those two do.
    """
    with refusals_of("rpe"):
        true, path = pose_pair(reference, estimate)
    related = relations(true, rows=rows, seconds=seconds, metres=metres, time=time)
    return relation_errors(related, path)


def distance_travelled(path: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K"]:
    """The length of a path up to each of its poses [m]."""
    steps = np.diff(path[:, :2], axis=0)
    return np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])


def _between(
    path: Float[np.ndarray, "K 3"], first: Int[np.ndarray, "R"], second: Int[np.ndarray, "R"]
) -> Relations:
    return Relations(first, second, between(path[first], path[second]))


class Statistics(NamedTuple):
    """The statistics of errors, in their unit."""

    size: int
    mean: float
    std: float
    """standard deviation of the values, divided by their count"""
    rmse: float
    median: float
    min: float
    max: float


def statistics(values: ArrayLike) -> Statistics:
    """The figures of errors (R,); for the squares, `statistics(values**2)`.

    Raises ValueError unless there is at least one, and all are finite.
    """
    kept = np.asarray(values, np.float64)
    if kept.ndim != 1 or not len(kept) or not np.isfinite(kept).all():
        raise InvalidField(
            "values", f"expected finite errors (at least 1,), got {kept.shape}", owner="statistics"
        )
    return Statistics(
        size=len(kept),
        mean=float(kept.mean()),
        std=float(kept.std()),
        rmse=float(np.sqrt((kept**2).mean())),
        median=float(np.median(kept)),
        min=float(kept.min()),
        max=float(kept.max()),
    )


def summary(errors: Errors | PathErrors) -> dict[str, float]:
    """The figures of translation [m] and rotation [deg], by names that have their unit.

    For tables and JSON: "translation mean [m]", …, "rotation max [deg]". Raises ValueError where
    there are no errors.
    """
    figures_by_name = {}
    for name, unit, values in (
        ("translation", "m", errors.translation),
        ("rotation", "deg", np.rad2deg(errors.rotation)),
    ):
        figures = statistics(values)
        for figure in ("mean", "std", "rmse", "median", "max"):
            title = "RMSE" if figure == "rmse" else figure
            figures_by_name[f"{name} {title} [{unit}]"] = float(getattr(figures, figure))
    return figures_by_name


class MeanAndStd(NamedTuple):
    """Mean and standard deviation, as `Statistics` has them."""

    mean: float
    std: float


def benchmark_figures(errors: Errors) -> dict[str, MeanAndStd]:
    """The figures that the Freiburg benchmark reports of the errors of relations, by quantity.

    Of "translation [m]", "rotation [deg]" and their squares, "translation² [m²]" and
    "rotation² [deg²]".

    Kümmerle et al. 2009, as in `relation_errors`. Raises ValueError where there are no errors.
    """
    by_quantity = {}
    for name, unit, values in (
        ("translation", "m", np.asarray(errors.translation, np.float64)),
        ("rotation", "deg", np.rad2deg(errors.rotation)),
    ):
        for mark, power in (("", 1), ("²", 2)):
            figures = statistics(values**power)
            by_quantity[f"{name}{mark} [{unit}{mark}]"] = MeanAndStd(figures.mean, figures.std)
    return by_quantity
