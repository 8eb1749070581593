"""What `particle_localization` refuses."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.math import linalg

# Particles that are kept at least, where the caller does not say.
_LEAST = 50


def check_resample(resample: Any) -> None:
    """A resampling method is a function."""
    if not callable(resample):
        raise ValueError(
            f"particle_localization: expected resample to be a function, got {resample!r}"
        )


def checked_least(particles: int, least: int | None) -> int:
    """The least number of particles, which by default is 50, or the capacity."""
    linalg.check_count("particle_localization: particles", particles)
    if least is None:
        return min(_LEAST, particles)
    linalg.check_count("particle_localization: least", least)
    if least > particles:
        raise ValueError(
            f"particle_localization: expected least <= particles = {particles}, got {least}"
        )
    return least


def check_numbers(
    threshold: float,
    gate: float | None,
    slack: float,
    forget: tuple[float, float] | None,
    bound: tuple[Any, float, float],
) -> None:
    """Numbers lie where they mean something; bound: bins, error and confidence."""
    name = "particle_localization"
    bins, error, confidence = bound
    if np.shape(bins) != (3,) or not all(np.isfinite(b) and b > 0 for b in bins):
        raise ValueError(f"{name}: expected bins of three sizes above 0, got {bins!r}")
    if not error > 0:
        raise ValueError(f"{name}: expected an error above 0, got {error}")
    if not 0 < confidence < 1:
        raise ValueError(f"{name}: expected a confidence between 0 and 1, got {confidence}")
    if linalg.is_concrete(threshold) and not 0 <= threshold <= 1:
        raise ValueError(f"{name}: expected a threshold from 0 to 1, got {threshold}")
    linalg.check_gate(name, gate)
    if linalg.is_concrete(slack) and not slack > 0:
        raise ValueError(f"{name}: expected a slack above 0, got {slack}")
    if forget is not None and not (np.shape(forget) == (2,) and 0 < forget[0] <= forget[1] <= 1):
        raise ValueError(
            f"{name}: expected forget = (slow, fast) with 0 < slow <= fast <= 1, got {forget!r}"
        )


def checked_box(box: ArrayLike | None, start: str) -> np.ndarray | None:
    """The box (2, 2), if there is one; a uniform start needs it."""
    name = "particle_localization"
    if start not in ("gaussian", "uniform"):
        raise ValueError(f'{name}: expected start "gaussian" or "uniform", got {start!r}')
    if box is None:
        if start == "uniform":
            raise ValueError(f"{name}: a uniform start needs a box")
        return None
    limits = np.asarray(box, np.float64)
    if limits.shape != (2, 2) or not np.isfinite(limits).all() or not (limits[1] > limits[0]).all():
        raise ValueError(
            f"{name}: expected a box of shape (2, 2), its lowest and highest (x, y), got {box!r}"
        )
    return limits
