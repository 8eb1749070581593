"""Scans as the reference of another: points and walls in one frame, and how it is matched."""

from dataclasses import replace
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxslam.graphs import cauchy
from jaxslam.matching import (
    IcpSettings,
    Match,
    Matcher,
    Points,
    Prior,
    correlative,
    point_to_line,
    raster,
    transformed,
)
from jaxslam.matching.surface import Surface, surface_at

CELL = 0.1
"""[m] side of a cell that is searched"""
BLUR = 0.1
"""[m] standard deviation of the score of a point by its distance from the reference"""
HALF = 16.0
"""[m] from the middle of a reference to the border of its grid"""
PEAK = 0.9
"""A pose elsewhere of this share of the best score makes a match ambiguous."""


class Reference(NamedTuple):
    """The points of some scans, and the lines through them, in one frame."""

    points: Points
    surface: Surface


def gathered(points: Points, surface: Surface, poses: Float[Array, "n 3"]) -> Reference:
    """The points (n, B) of n scans in the frame in which their poses are, as n · B of one."""
    there = jax.vmap(transformed)(points, poses), jax.vmap(surface_at)(surface, poses)
    return Reference(*jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), there))


def search(distance: float, angle: float, turn: float, *, ambiguous: float = 1.0) -> Matcher:
    """The search over a window of the reference's grid, [m] and [rad] to either side."""
    return correlative(
        window=distance,
        turn_window=angle,
        turn=turn,
        cell=CELL,
        sigma=BLUR,
        block=8,
        ambiguous=ambiguous,
        apart=0.5,
    )


# What the walls hardly determine is not held at the start, which is of a lattice: the covariance
# tells it, and the prior bounds it.
_OF_WALLS = IcpSettings(kernel=cauchy(), scale=0.05, lone=0.5, iterations=10, least_condition=0.0)
WALLS = point_to_line(replace(_OF_WALLS, reach=0.5))
NEAR_WALLS = point_to_line(replace(_OF_WALLS, reach=0.15))
"""From where `WALLS` ends: its pairs are the points that lie on walls."""


def searched(matcher: Matcher, reference: Reference) -> Array:
    """What a search needs of a reference."""
    prepared: Array = matcher.prepare(raster(reference.points, CELL, HALF))
    return prepared


def on_walls(
    reference: Reference, scan: Points, start: Float[Array, "3"], prior: Prior | None
) -> Match:
    """The match with the walls of a reference from a start within half a metre of it."""
    near = WALLS.match(reference.surface, scan, start, prior)
    return NEAR_WALLS.match(reference.surface, scan, near.pose, prior)


def thinned(of: Points) -> Points:
    """Every second point."""
    return Points(*(part[::2] for part in of))


Of = TypeVar("Of", Points, Surface)


def taken(of: Of, rows: int | np.ndarray) -> Of:
    """Some scans of many."""
    found: Of = jax.tree.map(lambda part: part[rows], of)
    return found
