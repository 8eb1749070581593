"""The points of scans, and the prior of a pose before its scan is matched."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxslam.core.types import Beams
from jaxslam.core.validation import InvalidField, positive, refusals_of, require
from jaxslam.laser.grids._grid import Grid
from jaxslam.math import se2
from jaxslam.math.angles import wrap


class Points(NamedTuple):
    """The ends of the beams of a scan, or of several, in one frame; padded, with a mask."""

    position: Float[Array, "N 2"]
    """[m]; finite also where not valid"""
    ray: Float[Array, "N 2"]
    """unit direction of the beam, the derivative of the position by the range: noise is along it"""
    valid: Bool[Array, "N"]
    """mask of the points"""


def points(
    beams: Beams,
    max_range: ArrayLike,
    *,
    min_range: ArrayLike = 0.0,
    mount: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Points:
    """The ends of the beams in the robot's frame, in the order of the beams.

    A beam without information, or without a hit up to max_range [m], gives no point (`Beams`), nor
    does a range of min_range or less.

    Args:
        mount: (3,) pose of the laser on the robot.
    Raises:
        ValueError: arrays that are not (B,), a max_range that is not above 0.
    """
    shapes = [np.shape(part) for part in beams]
    with refusals_of("points"):
        if len(set(shapes)) > 1 or len(shapes[0]) != 1:
            listed = ", ".join(map(str, shapes))
            raise InvalidField(
                "beams", f"expected ranges, angles and masks (B,) of one scan, got {listed}"
            )
        require("max_range", max_range, positive)
    r = jnp.asarray(beams.range)
    valid, _ = beams._replace(range=r).returns(
        jnp.asarray(max_range), min_range=jnp.asarray(min_range)
    )
    valid = jnp.asarray(valid)
    # Any finite range and angle: positions must be finite, with finite derivatives.
    r = jnp.where(valid, r, 1.0)
    eye = jnp.asarray(mount, r.dtype)
    heading = eye[2] + jnp.where(valid, beams.angle, 0.0)
    ray = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
    return Points(eye[None, :2] + r[:, None] * ray, ray, valid)


def transformed(of: Points, pose: Float[Array, "3"]) -> Points:
    """The points, given in the frame of a pose, in the frame in which the pose is given."""
    turn = se2.rotation(pose[2]).T
    return Points(of.position @ turn + pose[None, :2], of.ray @ turn, of.valid)


def move_along_rays(of: Points, by: Float[Array, "N"]) -> Points:
    """The points with a change [m] of their ranges."""
    return of._replace(position=of.position + by[:, None] * of.ray)


def raster(
    of: Points,
    resolution: float,
    half_width: float,
    *,
    center: ArrayLike | tuple[float, float] = (0.0, 0.0),
) -> Grid:
    """A grid in which the cells that hold a point are occupied, and the others free.

    A square with sides along the axes, of ⌈2 half_width/resolution⌉ cells a side, log-odds ±1.
    Points outside it are left out. Traceable for given sizes.

    Raises ValueError unless resolution and half_width are above 0 and finite.
    """
    with refusals_of("raster"):
        require("resolution", resolution, positive)
        require("half_width", half_width, positive)
    # 1e-9: a width that is a multiple of the cells must not get another by rounding.
    size = int(np.ceil(2 * half_width / resolution - 1e-9))
    corner = jnp.asarray(center, of.position.dtype) - 0.5 * size * resolution
    cell = jnp.floor((of.position - corner[None]) / resolution).astype(jnp.int32)
    inside = of.valid & jnp.all((cell >= 0) & (cell < size), axis=1)
    # Points off the grid have an index beyond it, which "drop" leaves out.
    row, column = jnp.where(inside[:, None], cell, size).T[::-1]
    free = jnp.full((size, size), -1.0, of.position.dtype)
    log_odds = free.at[row, column].set(1.0, mode="drop")
    origin = jnp.concatenate([corner, jnp.zeros(1, corner.dtype)])
    return Grid(log_odds, origin, jnp.asarray(resolution, corner.dtype))


class Prior(NamedTuple):
    """A pose that is expected: ½ eᵀ Λ e is added to ½ Σ w r², e = (x - x₀, y - y₀, θ - θ₀)."""

    pose: Float[Array, "3"]
    """(x₀, y₀, θ₀) in the frame of the reference"""
    information: Float[Array, "3 3"]
    """Λ = σ² P₀⁻¹, P₀ the covariance of (x₀, y₀, θ₀) and σ [m] that of a residual r; may be
    singular"""

    def error(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """The error e of a pose from the prior's, with the angle in (-π, π]."""
        off = pose - self.pose
        return jnp.concatenate([off[:2], wrap(off[2:])])

    def cost(self, pose: Float[Array, "3"]) -> Float[Array, ""]:
        """The cost ½ eᵀ Λ e of a pose by the prior."""
        e = self.error(pose)
        return 0.5 * e @ (self.information @ e)


def prior_cost(prior: Prior | None, pose: Float[Array, "3"]) -> Float[Array, ""]:
    """`Prior.cost`; 0 without a prior."""
    return jnp.zeros((), pose.dtype) if prior is None else prior.cost(pose)


def prior_terms(
    prior: Prior | None, pose: Float[Array, "3"]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """The curvature Λ and the slope Λ e of `Prior.cost`; zeros without a prior."""
    if prior is None:
        return jnp.zeros((3, 3), pose.dtype), jnp.zeros_like(pose)
    return prior.information, prior.information @ prior.error(pose)
