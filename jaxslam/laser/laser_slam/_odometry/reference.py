"""Keyframes as the reference of a scan: one map of points and walls, and how a scan is matched."""

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
"""[m] side of a cell that is searched"""
_BLUR = 0.1
"""[m] standard deviation of the score of a point by its distance from the reference"""
HALF = 16.0
"""[m] from the middle of a reference to the border of its grid"""
_AMBIGUOUS_SHARE = 0.9
"""Share of the best score at which another pose makes a match ambiguous."""

_SECTORS = 180
"""of a turn, in which beams are compared with the reference"""
_MIN_CLEARANCE = 0.4
"""[m] least distance of a passed point in front of the end of a beam"""


class Reference(NamedTuple):
    """The points of some scans, and the lines through them."""

    points: Points
    surface: Surface
    table: PyTree
    """what all searches need"""


class ScanMatch(NamedTuple):
    """A scan matched with a reference."""

    pose: Float[np.ndarray, "3"]
    """in the frame of the reference"""
    cov: Float[np.ndarray, "3 3"]
    """of the end of the pose"""
    inliers: float
    """share of the points that lie on walls; 0 where the pose is far off the search's window"""
    residual: float
    """[m] root mean square of their distances from these"""
    ambiguous: bool
    """whether the search found another pose nearly as good"""
    through: float
    """share of the reference's points in view that the scan's beams pass through"""


def window_search(
    distance: float, angle: float, turn: float, *, ambiguous: float | None = _AMBIGUOUS_SHARE
) -> Correlative:
    """The search over a window of the reference's grid, [m] and [rad] to either side."""
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

# What the walls hardly determine is not held at the start, which is of a lattice: the covariance
# tells it, and the prior bounds it.
_CORRELATION = 2.0
"""Beams that err together: the information of a match is divided by it."""
_FLOOR = (0.005, 0.005, 0.002)
"""Standard deviations of x, y [m], θ [rad] added to each match, for errors of the lines."""
_OF_WALLS = IcpSettings(kernel=Cauchy(), scale=0.05, lone=0.5, iterations=10, least_condition=None)
WALLS = PointToLine(replace(_OF_WALLS, reach=0.5))
_NEAR_WALLS = PointToLine(replace(_OF_WALLS, reach=0.15))
"""From where `WALLS` ends: its pairs are the points that lie on walls."""
_TABLE_SEARCH = window_search(1.0, 0.5, 0.1)
"""Its table serves all searches, which differ only in their windows."""


def reference_of(
    scans: Scans,
    rows: Int[np.ndarray, "n"],
    path: Float[np.ndarray, "n 3"],
    origin: Float[np.ndarray, "3"],
    size: int,
) -> Reference:
    """The reference of at most `size` scans at their poses, in the frame of a pose."""
    take = np.append(rows, np.repeat(rows[-1:], size - len(rows)))
    at = np.concatenate([path, np.repeat(path[-1:], size - len(rows), axis=0)])
    points = rows_of(scans.points, take)
    # The last scan is repeated without its points: a reference always has as many scans.
    points = points._replace(valid=points.valid & (np.arange(size) < len(rows))[:, None])
    relative = poses.between(origin, at).astype(np.float32)
    gathered: Reference = _gather(points, rows_of(scans.surface, take), relative)
    return gathered


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
        guess: pose in the frame of the reference. prior_cov: of the end of it; None: only a start.
        floor: information added to that of the walls without a prior.
    """
    known = floor
    prior = np.zeros((3, 3))
    if prior_cov is not None:
        known = np.linalg.inv(end_covariances.of_coordinates(prior_cov, guess))
        prior = _CORRELATION * known
    found = np.asarray(
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
    pose, information = found[:3], found[3:12].reshape(3, 3)
    inliers, residual, ambiguous, through = found[12:]
    off = poses.between(guess, pose)
    lattice = np.sqrt(2) * matcher.window, matcher.turn_window  # its farthest corner
    if (
        np.hypot(off[0], off[1]) > lattice[0] + _REFINED[0]
        or abs(off[2]) > lattice[1] + _REFINED[1]
    ):
        inliers = 0.0
    sigma = max(settings.sigma, residual) ** 2 * _CORRELATION
    cov = np.linalg.inv(end_covariances.semidefinite(information) / sigma + known)
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
    """The points (n, B) of n scans in the frame in which their poses are, as n · B of one."""
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
    """Pose, information, share of inliers, residual, whether it is ambiguous, and share of points
    that beams pass through, in one array, since each transfer from the device takes time.

    information: of the prior, relative to points of variance 1.
    """
    coarse = Prior(guess, _BLUR**2 * information)
    found = matcher.match(reference.table, _thin(scan), guess, coarse)
    fine = Prior(guess, sigma**2 * information)
    near: Match = WALLS.match(reference.surface, scan, found.pose, fine)
    near = _NEAR_WALLS.match(reference.surface, scan, near.pose, fine)
    ambiguous = (found.status == MatchStatus.AMBIGUOUS).astype(guess.dtype)
    through = _seen_through(reference.points, scan, near.pose)
    rest = jnp.stack([near.inliers, near.residual, ambiguous, through])
    return jnp.concatenate([near.pose, near.information.reshape(-1), rest])


def _seen_through(reference: Points, scan: Points, pose: Array) -> Array:
    """The share of the reference's points in view that lie in front of the scan's points.

    At the right pose the beams of a scan pass through no wall of the reference, except for what has
    moved; at a wrong one that has as many points on walls they do. By sectors of two degrees:
    points in sectors without a beam, and those behind what it met, are not in view.
    """

    def sector(at: Array) -> Array:
        turn = jnp.arctan2(at[:, 1], at[:, 0]) / (2 * jnp.pi) + 0.5
        return jnp.minimum((_SECTORS * turn).astype(jnp.int32), _SECTORS - 1)

    far = jnp.sqrt((scan.position**2).sum(axis=1))
    where = jnp.where(scan.valid, sector(scan.position), _SECTORS)
    nearest = jnp.full(_SECTORS + 1, jnp.inf, far.dtype).at[where].min(far)[:_SECTORS]
    farthest = jnp.zeros(_SECTORS + 1, far.dtype).at[where].max(far)[:_SECTORS]
    in_frame = (reference.position - pose[None, :2]) @ se2.rotation(pose[2])
    r, at = jnp.sqrt((in_frame**2).sum(axis=1)), sector(in_frame)
    met = reference.valid & jnp.isfinite(nearest[at])
    before = met & (r < nearest[at] - _MIN_CLEARANCE - 0.02 * r)
    in_view = met & (r < farthest[at] + 0.2)
    return (before.sum() / jnp.maximum(in_view.sum(), 1)).astype(far.dtype)


def _thin(of: Points) -> Points:
    """Every second point."""
    return Points(*(part[::2] for part in of))


Of = TypeVar("Of", bound=PyTree)


def rows_of(of: Of, rows: int | np.integer | np.ndarray | slice) -> Of:
    """Some scans of many."""
    found: Of = jax.tree.map(lambda part: part[rows], of)
    return found
