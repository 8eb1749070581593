"""Jacobians by difference quotients, with an error estimate."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

Values: TypeAlias = Float[np.ndarray, "..."]
Batch: TypeAlias = Callable[..., ArrayLike]
"""Arrays (B, n), one an argument, -> values (B, m)."""

_HALVINGS = 24
"""number of steps: the smallest is 3e-8, where rounding outweighs what a smaller step gains"""
_LARGEST = 0.25
"""the first step, in the unit of the argument"""
_ORDERS = 6
"""columns of the tableau; the error of the last is O(h¹²)"""
_FINE = 20
"""the halving at which the one-sided quotients are compared: h = 2.4e-7"""
_KINK = 0.05
"""relative difference of the one-sided quotients above which no derivative exists"""


class Quotient(NamedTuple):
    """A Jacobian by differences at S states, with its estimated error."""

    value: Float[np.ndarray, "S m n"]
    error: Float[np.ndarray, "S m n"]
    """estimated; inf where the quotients do not converge"""
    kink: Bool[np.ndarray, "S m n"]
    """mask of the entries whose one-sided derivatives differ"""


def quotients(
    function: Batch,
    arguments: tuple[Values, ...],
    k: int,
    periods: Float[np.ndarray, "m"],
    halvings: int = _HALVINGS,
) -> Quotient:
    """The derivative ∂f/∂argument at S states: central differences with Richardson's extrapolation.

    Steps h = ¼, ⅛, … are extrapolated to h → 0 (orders 2, 4, …, as in Ridders 1982); of all entries
    the tableau entry with the least estimated error is kept. The estimate is the change from
    its neighbours plus the rounding error of f and of the argument over h.

    If the one-sided derivatives differ, no derivative exists, though the central quotients may
    converge: `kink` marks this. For an output on a circle, steps that change it by more than half a
    period are ignored.

    Args:
        function: float64 in and out; called once with all columns, steps and states.
        arguments: (S, n_k) each.
        k: the argument to differentiate by.
        periods: (m,) period of an output on a circle, inf on a line; a jump by one is undone.
        halvings: number of steps.
    """
    x = arguments[k]
    count, n = x.shape
    if n == 0:
        none = np.zeros((count, len(periods), 0))
        return Quotient(none, none, none.astype(bool))
    steps = _LARGEST * 0.5 ** np.arange(halvings)
    moves = steps[:, None, None] * np.eye(n)  # (H, n, n)
    ends = x[:, None, None, None] + np.stack([moves, -moves])[None]  # (S, 2, H, n, n)
    flat = [np.repeat(a, 2 * halvings * n, axis=0) for a in arguments]
    flat[k] = ends.reshape(-1, n)
    values = np.asarray(function(*flat), np.float64).reshape(count, 2, halvings, n, -1)
    rise = values[:, 0] - values[:, 1]
    rise = modulo_periods(rise, periods)
    # The step after rounding of x ± h.
    width = (ends[:, 0] - ends[:, 1])[:, :, np.arange(n), np.arange(n)]  # (S, H, n)
    level = np.moveaxis(rise / width[..., None], 1, 0)  # (H, S, n, m)
    fine = min(_FINE, halvings - 1)
    aliased = np.abs(level[fine]) * 2 * steps[:, None, None, None] > periods / 2
    level = np.where(aliased, np.nan, level)
    centre = np.asarray(function(*arguments), np.float64)[:, None, None]  # (S, 1, 1, m)
    sides = modulo_periods(values - centre[:, None], periods)[:, :, fine]  # (S, 2, n, m)
    turn = np.abs(sides[:, 0] + sides[:, 1])
    kink = turn > _KINK * np.abs(sides).max(axis=(1, 2, 3), initial=0.0)[:, None, None]
    kink &= turn > 100 * np.finfo(np.float64).eps * (1 + np.abs(values).max(axis=(1, 2)))
    eps = np.finfo(np.float64).eps
    slope = np.fmax.reduce(np.abs(level), axis=0)
    size = np.abs(values).max(axis=(1, 2)) + slope * np.abs(x)[:, :, None]
    rounding = eps * size[None] / steps[:, None, None, None]

    best = level[0]
    least = np.full(best.shape, np.inf)
    for order in range(1, _ORDERS):
        factor = 4.0**order
        finer = (factor * level[1:] - level[:-1]) / (factor - 1)
        change = np.maximum(np.abs(finer - level[1:]), np.abs(finer - level[:-1]))
        error = change + rounding[order:]
        error = np.where(np.isfinite(error), error, np.inf)
        pick = np.argmin(error, axis=0)[None]
        candidate = np.take_along_axis(error, pick, axis=0)[0]
        better = candidate < least
        best = np.where(better, np.take_along_axis(finer, pick, axis=0)[0], best)
        least = np.where(better, candidate, least)
        level = finer
    return Quotient(best.swapaxes(1, 2), least.swapaxes(1, 2), kink.swapaxes(1, 2))


def modulo_periods(
    difference: Float[np.ndarray, "*batch m"], periods: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "*batch m"]:
    """Differences modulo their periods, in [-period/2, period/2]; inf is the period of a line."""
    turns = np.where(np.isfinite(periods), periods, 1.0)
    return np.where(
        np.isfinite(periods), difference - turns * np.round(difference / turns), difference
    )
