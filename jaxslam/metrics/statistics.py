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
