"""Beam end-points against the distance to the nearest obstacle."""

import dataclasses
import math

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.core._record import field, record, static
from jaxslam.core.types import Beams, JaxOrNumPy
from jaxslam.core.validation import mounting_pose, or_none, positive
from jaxslam.laser.grids._distance import distance_field
from jaxslam.laser.grids._grid import Field, Grid, interpolate, slope
from jaxslam.laser.grids.beam_models._beam_model import BeamModel
from jaxslam.laser.grids.beam_models._ray_cast import check_weights
from jaxslam.math._arrays import Number


@record
class LikelihoodField(BeamModel):
    """The beam end-point model: log(hit · N(d; 0, σ²) + random/max_range), or log of maximum.

    d [m] is the distance from the end of the beam to the nearest obstacle, interpolated between
    centres of cells. A beam of max_range or more has maximum alone; where that is 0, it has no
    density (log 1). No ray is cast, so a beam through a wall costs nothing, and the density does
    not integrate to 1 over the range. Differentiable by pose, σ and weights; off the map the
    distance is that at the border.

    Thrun, Burgard & Fox 2005, "Probabilistic robotics", section 6.4.

    Raises ValueError on numbers out of range, or an invalid mount.
    """

    sigma: Number = field(default=0.1, check=positive)
    """[m]"""
    _: dataclasses.KW_ONLY
    max_range: Number = field(check=positive)
    """[m]"""
    hit: Number = 0.9
    """weight of beams that end near an obstacle of the map"""
    random: Number = 0.1
    """weight of beams that end anywhere"""
    maximum: Number = 0.0
    """weight of beams of max_range; the three have sum 1"""
    truncate: float | None = static(default=2.0, check=or_none(positive))
    """largest distance [m], None for no limit"""
    mount: ArrayLike | None = field(default=None, check=or_none(mounting_pose))
    """(3,) pose of the laser on the robot"""

    def __post_init__(self) -> None:
        check_weights({"hit": self.hit, "random": self.random, "maximum": self.maximum})
        super().__post_init__()

    def prepare(self, grid: Grid) -> Field:
        return distance_field(grid, truncate=self.truncate)

    def log_likelihoods(self, prepared: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        far, ends = self._ends(pose, beams)
        log_near = jnp.log(self._density(self._hit_density(interpolate(prepared, ends))))
        maximum = jnp.asarray(self.maximum)
        # A weight of 0 is left out (log 1), and its logarithm must have a finite derivative.
        silent = maximum == 0
        log_far = jnp.where(silent, 0.0, jnp.log(jnp.where(silent, 1.0, maximum)))
        return jnp.where(far, log_far.astype(log_near.dtype), log_near)

    def jacobian(self, prepared: PyTree, pose: Array, beams: Beams) -> Float[Array, "B 3"]:
        # log(n + r) by d is -n d/σ²/(n + r); the end moves by dt, and by dθ across the arm to it.
        far, ends = self._ends(pose, beams)
        d = interpolate(prepared, ends)
        near, sigma = self._hit_density(d), jnp.asarray(self.sigma, d.dtype)
        by_end = (-near * d / sigma**2 / self._density(near))[:, None] * slope(prepared, ends)
        arm = ends - pose[None, :2]
        turning = by_end[:, 1] * arm[:, 0] - by_end[:, 0] * arm[:, 1]
        return jnp.where(far[:, None], 0.0, jnp.concatenate([by_end, turning[:, None]], axis=1))

    def _ends(self, pose: Array, beams: Beams) -> tuple[Bool[JaxOrNumPy, "B"], Float[Array, "B 2"]]:
        """The mask of the beams of max_range, and the ends of all; those end at the laser."""
        eye = self.frame(pose)
        _, far = beams.returns(self.max_range)
        ranges = jnp.where(far, 0.0, beams.range)
        # In the frame of the laser, which poses of a `vmap` share, and turned: no sine a beam.
        ahead, left = ranges * jnp.cos(beams.angle), ranges * jnp.sin(beams.angle)
        c, s = jnp.cos(eye[2]), jnp.sin(eye[2])
        ends = jnp.stack([eye[0] + c * ahead - s * left, eye[1] + s * ahead + c * left], -1)
        return far, ends

    def _hit_density(self, d: Float[Array, "B"]) -> Float[Array, "B"]:
        """hit · N(d; 0, σ²)."""
        hit, sigma = jnp.asarray(self.hit, d.dtype), jnp.asarray(self.sigma, d.dtype)
        return hit * jnp.exp(-0.5 * (d / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))

    def _density(self, near: Float[Array, "B"]) -> Float[Array, "B"]:
        """The density with random/max_range; never 0, so that its logarithm is finite."""
        anywhere = jnp.asarray(self.random, near.dtype) / jnp.asarray(self.max_range, near.dtype)
        return jnp.maximum(near + anywhere, jnp.finfo(near.dtype).tiny)
