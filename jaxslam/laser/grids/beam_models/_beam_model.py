"""The base class of beam models, and the log-likelihood of a scan under it."""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import shape_text
from jaxslam.core.claims import Argument, Claim
from jaxslam.core.protocols import POSE, Component
from jaxslam.core.types import Beams, JaxOrNumPy
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    finite,
    instance_of,
    refusals_of,
    require,
)
from jaxslam.laser.grids._grid import Grid
from jaxslam.laser.grids.beam_models._smooth_room import ANGLES, poses_and_ranges, smooth_map
from jaxslam.math import se2
from jaxslam.math._arrays import Number, in_dtype


class BeamModel(Component):
    """A density of the range of each beam, given pose and map; a subclass is a record."""

    kind = "beam model"
    jacobian: Any = None
    """(prepared, pose, beams) -> (B, 3), derivatives of `log_likelihoods` by the pose, derived by
    hand: `verify` compares them with automatic differentiation and differences"""
    mount: ArrayLike | None = None
    """(3,) pose of the laser on the robot, which `log_likelihoods` takes into account"""

    def __post_init__(self) -> None:
        self._check(BeamModel, {"prepare": "grid", "log_likelihoods": "prepared, pose, beams"})

    def prepare(self, grid: Grid) -> PyTree:
        """The pytree of arrays that the model needs of the map, once for all scans."""
        raise NotImplementedError

    def log_likelihoods(self, prepared: PyTree, pose: Array, beams: Beams) -> Float[Array, "B"]:
        """The log-densities of the beams, finite also where a beam is not valid."""
        raise NotImplementedError

    def frame(self, pose: Array) -> Array:
        """The pose of the laser, pose ∘ mount."""
        if self.mount is None:
            return pose
        return se2.compose(pose, jnp.asarray(self.mount, pose.dtype))

    def claims(self) -> tuple[Claim, ...]:
        """The claim of the log-densities of eight beams by pose and ranges, in a smooth room."""
        prepared = self.prepare(smooth_map())
        numbers = range(1, len(ANGLES) + 1)

        def beams(ranges: Array) -> Beams:
            return Beams(ranges, jnp.asarray(ANGLES, ranges.dtype), jnp.ones(len(ANGLES), bool))

        def log_density(pose: Array, ranges: Array) -> Array:
            return self.log_likelihoods(in_dtype(prepared, pose.dtype), pose, beams(ranges))

        def jacobian(pose: Array, ranges: Array) -> tuple[Array, None]:
            return self.jacobian(in_dtype(prepared, pose.dtype), pose, beams(ranges)), None

        mount = np.zeros(3) if self.mount is None else np.asarray(self.mount, np.float64)
        names = tuple(f"range {k} [m]" for k in numbers)
        return (
            Claim(
                "log_density",
                log_density,
                (Argument("pose", POSE), Argument("ranges", names)),
                tuple(f"beam {k}" for k in numbers),
                None if self.jacobian is None else jacobian,
                states=partial(poses_and_ranges, mount),
            ),
        )


def log_likelihood(
    model: BeamModel,
    prepared: PyTree,
    pose: ArrayLike,
    beams: Beams,
    *,
    stride: int = 1,
    exponent: Number = 1.0,
) -> Float[Array, ""]:
    """The log-likelihood of a scan at a pose (3,): exponent · Σ log p(z_k) over its valid beams.

    Beams without information (`Beams`) add nothing. The beams of a scan are assumed independent
    given the pose, which they are not: what the map lacks, or a pose between two cells, spoils many
    of them in the same way. A `stride` n takes each n-th beam only, and an exponent below 1 tempers
    the likelihood; both make it wider. Differentiable by pose and exponent; `jax.vmap` it over
    poses.

    Raises ValueError on beams that are not one scan, a pose that is not (3,), stride below 1,
    an exponent below 0, and a grid in place of the result of `model.prepare`.
    """
    with refusals_of("log_likelihood"):
        require("beams", beams, _one_scan)
        require("pose", pose, finite(3))
        if is_concrete(exponent) and not np.all(np.asarray(exponent) >= 0):
            raise InvalidField("exponent", f"expected a number >= 0, got {exponent!r}")
        require("stride", stride, at_least(1))
        if isinstance(prepared, Grid):
            reason = "expected what model.prepare makes of the grid, got the Grid itself"
            raise InvalidField("prepared", reason)
    beams = Beams(*(jnp.asarray(part)[::stride] for part in beams))
    usable = usable_beams(beams)
    # A harmless range and angle where a beam has no information: its derivative must be finite.
    ranges, angles = jnp.where(usable, beams.range, 1.0), jnp.where(usable, beams.angle, 0.0)
    clean = Beams(ranges, angles, usable)
    at = jnp.asarray(pose)
    log_p = model.log_likelihoods(prepared, at.astype(jnp.result_type(at, 0.0)), clean)
    return jnp.asarray(exponent) * jnp.where(usable, log_p, 0.0).sum()


def usable_beams(beams: Beams) -> Bool[JaxOrNumPy, "*n"]:
    """Mask of the beams with information, by `Beams.returns`."""
    met, free = beams.returns()
    return met | free


def _one_scan(value: Any) -> Beams:
    """The check of the beams of one scan.

    Ranges, angles and masks must have the same length; outside a trace at least one beam must be
    usable, and the angles of valid beams finite.
    """
    beams: Beams = instance_of(Beams)(value)
    shapes = [np.shape(part) for part in beams]
    if len(shapes[0]) != 1 or len(set(shapes)) != 1:
        listed = ", ".join(shape_text(part) for part in beams)
        raise ValueError(f"expected as many ranges, angles and masks, got {listed}")
    if not is_concrete(beams):
        return beams
    valid = np.asarray(beams.valid) & (np.asarray(beams.range) > 0)
    if not np.all(np.isfinite(np.asarray(beams.angle)[valid])):
        raise ValueError("expected finite angles of valid beams")
    if not np.any(valid):
        raise ValueError(f"the scan of {shapes[0][0]} beams has no valid beam")
    return beams
