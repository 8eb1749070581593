"""Standard errors and limits of fitted parameters, from the observed information."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

BOUND = 1.35
"""By how much log L falls at the 95 % upper limit of a parameter whose estimate is 0: half the 0.90
quantile of χ² with one degree of freedom, since half of the estimates are 0 where the truth is."""

CONFOUNDED = 0.9
"""Correlation of two estimates above which they are named together."""


class LikelihoodPoint(NamedTuple):
    """The likelihood at one set of parameters, by the coordinates q."""

    q: np.ndarray
    value: float
    gradient: np.ndarray
    spread: np.ndarray
    """Σ g gᵀ over the rows"""
    nis: float
    dof: int


def newton_step(observed: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, float]:
    """Newton's step, in each direction at most 1, and the gain of log L that it promises.

    Where log L is convex the step goes uphill by as much as it would where it is concave.
    """
    values, vectors = np.linalg.eigh(observed)
    along = vectors.T @ gradient
    step = np.clip(along / np.maximum(np.abs(values), 1e-300), -1.0, 1.0)
    return vectors @ step, float(np.abs(along * step).sum() / 2)


def observed_information(
    at: Callable[[np.ndarray], LikelihoodPoint], here: LikelihoodPoint, logged: np.ndarray
) -> Float[np.ndarray, "P P"]:
    """The observed information -∂²log L/∂q², from differences of the gradient over part of a σ."""
    rows = []
    for i, scale in enumerate(np.diag(here.spread)):
        h = 0.05 / np.sqrt(scale) if scale > 0 else 1e-3
        move = (min(h, 0.01) if logged[i] else h) * np.eye(len(here.q))[i]
        slopes = [at(here.q + sign * move).gradient for sign in (-1, 1)]
        rows.append((slopes[0] - slopes[1]) / (2 * move[i]))
    found: np.ndarray = np.array(rows)
    return np.asarray((found + found.T) / 2)


def upper_limit(
    at: Callable[[np.ndarray], LikelihoodPoint], here: LikelihoodPoint, i: int
) -> float:
    """The deviation, above that of parameter i, at which log L is lower by `BOUND`; to 2 %."""
    unit, low, high = np.eye(len(here.q))[i], 0.0, np.log(2.0)
    while at(here.q + high * unit).value > here.value - BOUND and high < 20:
        low, high = high, high + np.log(2.0)
    for _ in range(5):
        middle = (low + high) / 2
        inside = at(here.q + middle * unit).value > here.value - BOUND
        low, high = (middle, high) if inside else (low, middle)
    return float(np.exp(here.q[i] + (low + high) / 2))


def standard_errors(
    observed: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    """The inverse of the observed information, robust errors, and confounded parameters of each.

    A parameter that has part in a direction without information has no error, and the others have
    that which they have when it is known.
    """
    scale = np.sqrt(np.maximum(np.diag(observed), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(observed / np.outer(unit, unit))
    part = np.abs(vectors[:, values < 1e-6]) > 0.3
    lost = (scale == 0) | part.any(axis=1)
    keep = np.ix_(~lost, ~lost)
    inverse = np.linalg.inv(observed[keep])
    error = np.sqrt(np.diag(inverse))
    cov, robust = np.diag(np.where(lost, np.inf, 0.0)), np.where(lost, np.inf, 0.0)
    cov[keep] = inverse
    robust[~lost] = np.sqrt(np.diag(inverse @ spread[keep] @ inverse))
    related = part.astype(int) @ part.T > 0
    related[keep] = np.abs(inverse / np.outer(error, error)) > CONFOUNDED
    np.fill_diagonal(related, False)
    return cov, robust, [list(np.flatnonzero(row)) for row in related]
