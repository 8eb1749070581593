"""Rooms with exact walls for a laser: segments and circles, without a grid."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from jaxslam._public import publish
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    positive,
    refusals_of,
    require,
)
from jaxslam.laser.grids._grid import Grid
from jaxslam.simulation._wall_geometry import Walls, is_free

__all__ = ["Walls", "make_walls", "rasterize"]


def make_walls(
    *chains: ArrayLike,
    circles: ArrayLike = (),
    glass: Mapping[tuple[int, int], float] | None = None,
) -> Walls:
    """The walls of some closed chains, each the corners (N, 2) of a polygon [m], and of circles.

    Args:
        glass: {(chain, side): share of the beams that pass}; side i leads from corner i to the
            next.
    Raises:
        ValueError: a chain that is not at least three finite corners, a circle that is not
            (x, y, radius) with radius above 0, no wall at all, glass on a missing side, or a share
            outside [0, 1].
    """
    segments = [np.zeros((0, 2, 2))]
    with refusals_of("make_walls"):
        for k, chain in enumerate(chains):
            corners = np.asarray(chain, np.float64)
            if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
                raise InvalidField(
                    "chains",
                    f"expected chain {k} of at least three corners (x, y), got {corners.shape}",
                )
            segments.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
        rounds = (
            np.atleast_2d(np.asarray(circles, np.float64)) if np.size(circles) else np.zeros((0, 3))
        )
        if rounds.ndim != 2 or rounds.shape[1] != 3:
            raise InvalidField("circles", f"expected (x, y, radius), got shape {rounds.shape}")
        walls = Walls(np.concatenate(segments), rounds)
        if not all(np.all(np.isfinite(part)) for part in walls[:2]) or np.any(rounds[:, 2] <= 0):
            raise InvalidField("", "expected finite numbers and radii above 0")
        if len(walls.segments) + len(rounds) == 0:
            raise InvalidField("", "expected at least one wall")
        if not glass:
            return walls
        shares = [np.zeros(len(chain)) for chain in segments[1:]]
        for (k, side), share in glass.items():
            if not (0 <= k < len(shares) and 0 <= side < len(shares[k])):
                raise InvalidField("glass", f"chain {k} has no side {side}")
            if not 0 <= share <= 1:
                raise InvalidField("glass", f"expected a share in [0, 1], got {share}")
            shares[k][side] = share
    return walls._replace(glass=np.concatenate(shares))


def rasterize(
    world: Walls, resolution: float, *, margin: float = 0.5, samples: int = 8, yaw: float = 0.0
) -> Grid:
    """A grid of the share of each cell that is solid, as probability, on the host.

    The share of samples × samples points of a cell is kept half a sample from 0 and 1, so that the
    log-odds are finite. No cell is unknown: a share of exactly ½ counts as a little more. All that
    is not free is solid, so walls between rooms need a thickness, of two cells or more for `cast`.

    Args:
        resolution: side of a cell [m].
        margin: width of solid cells around the walls [m].
        samples: points along a side of a cell.
        yaw: heading of the grid in the world [rad].
    Raises:
        ValueError: a resolution or a number of samples that is not above 0.
    """
    with refusals_of("rasterize"):
        require("world", world, instance_of(Walls))
        require("resolution", resolution, positive)
        require("samples", samples, at_least(1))
    corners = [np.asarray(world.segments).reshape(-1, 2)]
    for x, y, radius in np.asarray(world.circles):
        turn = 2 * np.pi * np.arange(360) / 360
        corners.append(np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], axis=1))
    c, s = np.cos(yaw), np.sin(yaw)
    turn_back = np.array([[c, -s], [s, c]])  # points in rows times this: R(yaw)ᵀ p
    local = np.concatenate(corners) @ turn_back
    low = local.min(axis=0) - margin
    count = np.ceil((local.max(axis=0) + margin - low) / resolution - 1e-9).astype(int)
    fine = resolution * (np.arange(max(count) * samples) + 0.5) / samples
    x = low[0] + fine[: count[0] * samples]
    solid = np.empty((count[1], count[0]))
    for i in range(count[1]):  # a row of cells at a time
        y = low[1] + fine[i * samples : (i + 1) * samples]
        points = np.stack(np.meshgrid(x, y), axis=-1) @ turn_back.T
        share = ~is_free(world, points)
        solid[i] = share.reshape(samples, count[0], samples).mean(axis=(0, 2))
    edge = 0.5 / samples**2
    solid = np.clip(solid, edge, 1 - edge)
    solid = np.where(solid == 0.5, 0.5 + 1e-9, solid)
    origin = np.array([*(turn_back @ low), yaw])
    return Grid(np.log(solid) - np.log1p(-solid), origin, np.array(resolution))


publish(__name__)
