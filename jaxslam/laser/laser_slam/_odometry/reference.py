"""Keyframes as the reference of a scan: a map of points and walls, and the match of a scan with it.

Constants without another origin were chosen on the logs intel, edmonton, freiburg-101 and CSAIL.
"""

import functools
from dataclasses import replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxslam.graphs import Cauchy
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._records import Settings
from jaxslam.laser.laser_slam._scan_points import Scans
from jaxslam.laser.matching import (
    Correlative,
    IcpSettings,
    Match,
    Matcher,
    MatchStatus,
    Points,
    PointToLine,
    Prior,
    raster,
    transformed,
)
from jaxslam.laser.matching._surfaces import Surface, surface_at
from jaxslam.math import numpy_poses as poses
from jaxslam.math import se2

CELL = 0.1
"""[m] side of a cell of the search."""
_BLUR = 0.1
"""[m] standard deviation of the score of a point by its distance from the reference: a cell."""
HALF = 16.0
"""[m] from the middle of a reference to the border of its grid."""
_AMBIGUOUS_SHARE = 0.9
"""Share of the best score at which another pose makes a match ambiguous."""

_SECTORS = 180
"""Sectors of a turn in which beams are compared with the reference: two degrees each."""
_MIN_CLEARANCE = 0.4
"""[m] least distance of a passed point in front of the end of a beam."""
_CLEARANCE_SHARE = 0.02
"""Further clearance by the distance of the point: half of a sector, on a wall seen at 45°."""
_VIEW_MARGIN = 0.2
"""[m] behind the end of the farthest beam of a sector up to which points are in view."""


class Reference(NamedTuple):
    """The points of scans in a common frame, and the lines through them."""

    points: Points
    surface: Surface
    table: PyTree
    """of `Correlative.prepare`, for all searches"""


class ScanMatch(NamedTuple):
    """A scan matched with a reference."""

    pose: Float[np.ndarray, "3"]
    """in the frame of the reference"""
    cov: Float[np.ndarray, "3 3"]
    """covariance of the end of the pose"""
    inliers: float
    """share of the points on walls; 0 if the pose is far off the window of the search"""
    residual: float
    """[m] root mean square distance of the points on walls from the walls"""
    ambiguous: bool
    """whether the search found another pose nearly as good"""
    through: float
    """share of the reference's points in view that the scan's beams pass through"""


def window_search(
    distance: float, angle: float, turn: float, *, ambiguous: float | None = _AMBIGUOUS_SHARE
) -> Correlative:
    """The search over a window of the reference's grid.

    Args:
        distance, angle: window to either side [m], [rad].
        turn: [rad] between headings.
        ambiguous: share of the best score that makes a match ambiguous; None: none is.
    """
    return Correlative(
        window=distance,
        turn_window=angle,
        turn=turn,
        cell=CELL,
        sigma=_BLUR,
        block=8,
        ambiguous=ambiguous,
        apart=0.5,
    )


_REFINED = 0.5, 0.35
"""[m], [rad]: farthest from the window of its search that a match may end. Where few points are on
walls, the iterations may lead metres off, to a place that looks alike."""

_CORRELATION = 2.0
"""Number of beams with a common error: the information of a match is divided by it."""
_FLOOR = (0.005, 0.005, 0.002)
"""Standard deviations of x, y [m], θ [rad] added to each match, for errors of the lines."""
# No least condition: a direction that the walls hardly determine must not be held at the start,
# which is a pose of the lattice. The covariance shows it, and the prior bounds it. Points without a
# line have half weight: 33 of 406 scans of CSAIL have no match by lines alone.
_OF_WALLS = IcpSettings(kernel=Cauchy(), scale=0.05, lone=0.5, iterations=10, least_condition=None)
WALLS = PointToLine(replace(_OF_WALLS, reach=0.5))
_NEAR_WALLS = PointToLine(replace(_OF_WALLS, reach=0.15))
"""The refinement after `WALLS`; its pairs are the points on walls."""
_TABLE_SEARCH = window_search(1.0, 0.5, 0.1)
"""The search that prepares a table for all searches, which differ only in their windows."""


def reference_of(
    scans: Scans,
    rows: Int[np.ndarray, "n"],
    path: Float[np.ndarray, "n 3"],
    origin: Float[np.ndarray, "3"],
    size: int,
) -> Reference:
    """The reference of scans at their poses, in the frame of a pose.

    Args:
        rows, path: the scans, at most `size`, and their poses.
        origin: pose of the frame.
        size: scans of the reference; the last scan is repeated without its points, so that all
            references share a program.
    """
    fill = size - len(rows)
    rows_filled = np.append(rows, np.repeat(rows[-1:], fill))
    path_filled = np.concatenate([path, np.repeat(path[-1:], fill, axis=0)])
    points = rows_of(scans.points, rows_filled)
    points = points._replace(valid=points.valid & (np.arange(size) < len(rows))[:, None])
    relative = poses.between(origin, path_filled).astype(np.float32)
    reference: Reference = _gather(points, rows_of(scans.surface, rows_filled), relative)
    return reference


def match(
    matcher: Correlative,
    reference: Reference,
    scan: Points,
    guess: Float[np.ndarray, "3"],
    prior_cov: Float[np.ndarray, "3 3"] | None,
    floor: Float[np.ndarray, "3 3"],
    settings: Settings,
) -> ScanMatch:
    """The match of a scan with a reference: a search, then the distances of points from walls.

    Args:
        guess: pose in the frame of the reference.
        prior_cov: covariance of the end of the guess; None: it is only a start.
        floor: information added to that of the walls without a prior.
    """
    prior_information = floor
    # Beside points of variance 1 whose information is divided by `_CORRELATION`.
    prior = np.zeros((3, 3))
    if prior_cov is not None:
        prior_information = np.linalg.inv(end_covariances.of_coordinates(prior_cov, guess))
        prior = _CORRELATION * prior_information
    packed = np.asarray(
        _match(
            matcher,
            reference,
            scan,
            guess.astype(np.float32),
            prior.astype(np.float32),
            np.float32(settings.sigma),
        ),
        np.float64,
    )
    pose, information = packed[:3], packed[3:12].reshape(3, 3)
    inliers, residual, ambiguous, through = packed[12:]
    off = poses.between(guess, pose)
    lattice = np.sqrt(2) * matcher.window, matcher.turn_window  # its farthest corner
    if (
        np.hypot(off[0], off[1]) > lattice[0] + _REFINED[0]
        or abs(off[2]) > lattice[1] + _REFINED[1]
    ):
        inliers = 0.0
    variance = max(settings.sigma, residual) ** 2 * _CORRELATION
    cov = np.linalg.inv(end_covariances.semidefinite(information) / variance + prior_information)
    return ScanMatch(
        pose,
        end_covariances.at_end(cov, pose) + np.diag(np.square(_FLOOR)),
        float(inliers),
        float(residual),
        bool(ambiguous),
        float(through),
    )


@jax.jit
def _gather(points: Points, surface: Surface, at: Float[Array, "n 3"]) -> Reference:
    """The points of n scans of B points, in the frame of their poses, as n · B points."""
    moved = jax.vmap(transformed)(points, at), jax.vmap(surface_at)(surface, at)
    gathered, lines = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), moved)
    return Reference(gathered, lines, _TABLE_SEARCH.prepare(raster(gathered, CELL, HALF)))


@functools.partial(jax.jit, static_argnums=0)
def _match(
    matcher: Matcher,
    reference: Reference,
    scan: Points,
    guess: Array,
    information: Array,
    sigma: Array,
) -> Array:
    """The match packed into an array (16,), since each transfer from the device takes time.

    Pose (3), information (9), share of inliers, residual, 1 if ambiguous, and share of points that
    beams pass through.

    Args:
        information: of the prior, relative to points of variance 1.
    """
    coarse = Prior(guess, _BLUR**2 * information)
    every_second = Points(*(part[::2] for part in scan))  # enough for the search
    searched = matcher.match(reference.table, every_second, guess, coarse)
    fine = Prior(guess, sigma**2 * information)
    refined: Match = WALLS.match(reference.surface, scan, searched.pose, fine)
    refined = _NEAR_WALLS.match(reference.surface, scan, refined.pose, fine)
    ambiguous = (searched.status == MatchStatus.AMBIGUOUS).astype(guess.dtype)
    through = _share_seen_through(reference.points, scan, refined.pose)
    scores = jnp.stack([refined.inliers, refined.residual, ambiguous, through])
    return jnp.concatenate([refined.pose, refined.information.reshape(-1), scores])


def _share_seen_through(reference: Points, scan: Points, pose: Array) -> Array:
    """The share of the reference's points in view that lie in front of the scan's points.

    At the right pose the beams of a scan pass through no wall of the reference, except for objects
    that have moved; at a wrong pose with as many points on walls they do. Points in sectors without
    a beam, and points behind the end of the beam, are not in view.
    """

    def sector(at: Array) -> Array:
        turn = jnp.arctan2(at[:, 1], at[:, 0]) / (2 * jnp.pi) + 0.5
        return jnp.minimum((_SECTORS * turn).astype(jnp.int32), _SECTORS - 1)

    far = jnp.sqrt((scan.position**2).sum(axis=1))
    # Points that are not valid go to a further sector, which is cut off.
    where = jnp.where(scan.valid, sector(scan.position), _SECTORS)
    nearest = jnp.full(_SECTORS + 1, jnp.inf, far.dtype).at[where].min(far)[:_SECTORS]
    farthest = jnp.zeros(_SECTORS + 1, far.dtype).at[where].max(far)[:_SECTORS]
    in_frame = (reference.position - pose[None, :2]) @ se2.rotation(pose[2])
    r, at = jnp.sqrt((in_frame**2).sum(axis=1)), sector(in_frame)
    met = reference.valid & jnp.isfinite(nearest[at])
    before = met & (r < nearest[at] - _MIN_CLEARANCE - _CLEARANCE_SHARE * r)
    in_view = met & (r < farthest[at] + _VIEW_MARGIN)
    return (before.sum() / jnp.maximum(in_view.sum(), 1)).astype(far.dtype)


Table = TypeVar("Table", bound=PyTree)


def rows_of(table: Table, rows: int | np.integer | np.ndarray | slice) -> Table:
    """The rows of a pytree of arrays: of scans, or of steps."""
    selected: Table = jax.tree.map(lambda part: part[rows], table)
    return selected
