"""Beam end-points against the distance to the nearest obstacle."""

import math

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.core.numbers import check_mount, check_positive
from jaxslam.grids.beam_models.beam_model import BeamModel
from jaxslam.grids.beam_models.ray_cast import check_weights
from jaxslam.grids.distance import distance_field
from jaxslam.grids.grid import Field, Grid
from jaxslam.grids.interpolation import interpolate, slope
from jaxslam.math import se2
from jaxslam.types import Beams, JaxOrNumPy


def likelihood_field(
    sigma: ArrayLike = 0.1,
    *,
    max_range: float,
    hit: ArrayLike = 0.9,
    random: ArrayLike = 0.1,
    maximum: ArrayLike = 0.0,
    truncate: float | None = 2.0,
    mount: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
) -> BeamModel:
    """The beam end-point model: log(hit · N(d; 0, σ²) + random/max_range), or log of maximum.

    d [m] is the distance from the end of the beam to the nearest obstacle, interpolated between
    centres of cells. A beam of max_range or more has maximum alone; where that is 0, nothing is
    said of it (log 1). No ray is cast, so a beam through a wall costs nothing, and the density does
    not integrate to 1 over the range. Differentiable by pose, σ and weights; off the map the
    distance is that at the border.

    Thrun, Burgard & Fox 2005, "Probabilistic robotics", section 6.4.

    Args:
        sigma: [m]. max_range: [m].
        hit, random, maximum: weights, of sum 1.
        truncate: largest distance [m], None for no limit.
        mount: (3,) pose of the laser on the robot.
    Raises:
        ValueError: numbers out of range, a mount that is no pose.
    """
    check_positive("likelihood_field", sigma=sigma, max_range=max_range)
    check_weights("likelihood_field", {"hit": hit, "random": random, "maximum": maximum})
    check_positive("likelihood_field", **({} if truncate is None else {"truncate": truncate}))
    check_mount("likelihood_field", mount)

    def prepare(grid: Grid) -> Field:
        return distance_field(grid, truncate=truncate)

    def ends_of(pose: Array, beams: Beams) -> tuple[Bool[JaxOrNumPy, "B"], Float[Array, "B 2"]]:
        """Which beams have max_range, and the ends of the others."""
        eye = se2.compose(pose, jnp.asarray(mount, pose.dtype))
        _, far = beams.returns(max_range)
        ranges = jnp.where(far, 0.0, beams.range)
        # In the frame of the laser, which poses of a `vmap` share, and turned: no sine a beam.
        ahead, left = ranges * jnp.cos(beams.angle), ranges * jnp.sin(beams.angle)
        c, s = jnp.cos(eye[2]), jnp.sin(eye[2])
        ends = jnp.stack([eye[0] + c * ahead - s * left, eye[1] + s * ahead + c * left], -1)
        return far, ends

    def near_of(d: Float[Array, "B"]) -> Float[Array, "B"]:
        return jnp.asarray(
            hit * jnp.exp(-0.5 * (d / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        )

    def total_of(near: Float[Array, "B"]) -> Float[Array, "B"]:
        return jnp.maximum(near + random / max_range, jnp.finfo(near.dtype).tiny)

    def each(field: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        far, ends = ends_of(pose, beams)
        log_near = jnp.log(total_of(near_of(interpolate(field, ends))))
        silent = jnp.asarray(maximum) == 0
        log_far = jnp.where(silent, 0.0, jnp.log(jnp.where(silent, 1.0, maximum)))
        return jnp.where(far, log_far, log_near)

    def jacobian(field: PyTree, pose: Array, beams: Beams) -> Float[Array, "B 3"]:
        # log(n + r) by d is -n d/σ²/(n + r); the end moves by dt, and by dθ across the arm to it.
        far, ends = ends_of(pose, beams)
        d = interpolate(field, ends)
        near = near_of(d)
        by_end = (-near * d / sigma**2 / total_of(near))[:, None] * slope(field, ends)
        arm = ends - pose[None, :2]
        turning = by_end[:, 1] * arm[:, 0] - by_end[:, 0] * arm[:, 1]
        return jnp.where(far[:, None], 0.0, jnp.concatenate([by_end, turning[:, None]], axis=1))

    return BeamModel("likelihood_field", prepare, each, jacobian, mount)
