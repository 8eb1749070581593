"""Statistics of errors: mean, standard deviation, RMSE, median, extremes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.metrics.paths import PathErrors
from jaxslam.metrics.relations import Errors


class Statistics(NamedTuple):
    """The statistics of errors, in their unit."""

    size: int
    mean: float
    std: float
    """of the values themselves, divided by their count"""
    rmse: float
    median: float
    min: float
    max: float


def statistics(values: ArrayLike) -> Statistics:
    """The figures of errors (R,); those of their squares are `statistics(values**2)`.

    Raises ValueError unless there is at least one, and all are finite.
    """
    kept = np.asarray(values, np.float64)
    if kept.ndim != 1 or not len(kept) or not np.isfinite(kept).all():
        raise ValueError(f"statistics: expected finite errors (at least 1,), got {kept.shape}")
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
    found = {}
    for name, unit, values in (
        ("translation", "m", errors.translation),
        ("rotation", "deg", np.rad2deg(errors.rotation)),
    ):
        figures = statistics(values)
        for figure in ("mean", "std", "rmse", "median", "max"):
            told = "RMSE" if figure == "rmse" else figure
            found[f"{name} {told} [{unit}]"] = float(getattr(figures, figure))
    return found


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
    found = {}
    for name, unit, values in (
        ("translation", "m", np.asarray(errors.translation, np.float64)),
        ("rotation", "deg", np.rad2deg(errors.rotation)),
    ):
        for mark, power in (("", 1), ("²", 2)):
            figures = statistics(values**power)
            found[f"{name}{mark} [{unit}{mark}]"] = MeanAndStd(figures.mean, figures.std)
    return found
