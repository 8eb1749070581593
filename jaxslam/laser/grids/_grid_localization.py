"""Monte-Carlo localization in an occupancy grid, from the beams of a laser, and its log."""

import dataclasses
import math
from functools import partial
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Bool, Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import field, record, set_field, static
from jaxslam.core._validation import motion_model
from jaxslam.core.protocols import Motion
from jaxslam.core.types import Beams, Estimate, Info, Log, Scan
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    positive,
    refusals_of,
    require,
)
from jaxslam.filters._particles.pose_particles import (
    PoseParticles,
    Region,
    active_mask,
    draw_start,
)
from jaxslam.filters._particles.pose_steps import MonteCarloFilter
from jaxslam.filters._reporting import info_of, status_of, with_extra
from jaxslam.laser.grids._grid import Grid, grid_map, to_cells
from jaxslam.laser.grids.beam_models._beam_model import BeamModel, log_likelihood
from jaxslam.math._arrays import Number, in_dtype
from jaxslam.math._xla import no_inline
from jaxslam.math.angles import wrap
from jaxslam.resampling._weights import normalize

_BEAM = ("range [m]", "angle [rad]")
"""Measurements of a beam in a log."""

_NOTHING = 1e6
"""[m] finite stand-in in a log for the infinite range of a beam that met nothing."""


def beam_log(control: ArrayLike, beams: Beams) -> Log:
    """The log of T controls and T scans of B beams: measurements (range, angle), without tags.

    A beam without information (`Beams`) is not valid. An infinite range becomes `_NOTHING`.
    Arrays are NumPy's, within a trace JAX's.

    Args:
        control: (T, U) of the motion model; row t led to where scan t was taken.
        beams: with leading T.
    Raises:
        ValueError: shapes that do not fit; outside a trace, angles of valid beams that are not
            finite, or no valid beam at all.
    """
    with refusals_of("beam_log"):
        require("beams", beams, instance_of(Beams))
        shapes = [np.shape(part) for part in beams]
        if len(shapes[0]) != 2 or len(set(shapes)) != 1:
            listed = ", ".join(map(str, shapes))
            raise InvalidField(
                "beams", f"expected as many ranges, angles and masks (T, B), got {listed}"
            )
        steps = shapes[0][0]
        if np.ndim(control) != 2 or np.shape(control)[0] != steps:
            raise InvalidField(
                "control", f"expected one (U,) for each of {steps} scans, got {np.shape(control)}"
            )
        concrete = is_concrete(control, beams)
        xp: ModuleType = np if concrete else jnp
        controls, ranges, angle, valid = (xp.asarray(part) for part in (control, *beams))
        # Without max_range only infinite ranges are free.
        met, free = Beams(ranges, angle, valid).returns()
        usable = xp.asarray(met | free)
        if concrete:
            lost = valid & (ranges > 0) & ~np.isfinite(angle)
            if lost.any():
                step = int(np.argmax(lost.any(axis=1)))
                raise InvalidField(
                    "beams", f"the angle of a valid beam of scan {step} is not finite"
                )
            if not usable.any():
                raise InvalidField("beams", f"none of {steps} scans has a valid beam")
    z = xp.stack([xp.minimum(ranges, _NOTHING), angle], axis=-1)
    scan = Scan(
        z=xp.where(usable[..., None], z, 0.0).astype(controls.dtype),
        tag=xp.full(shapes[0], -1, np.int32),
        valid=usable,
    )
    return Log(controls, scan)


def beams_of(scan: Scan, stride: int) -> Beams:
    """Each n-th beam of a scan of `beam_log`; beams that are not valid have range 0."""
    z, valid = scan.z[::stride], scan.valid[::stride]
    used = valid & (z[:, 0] > 0)
    clean = jnp.where(used[:, None], z, 0.0)
    return Beams(clean[:, 0], clean[:, 1], used)


@record
class _FreeSpace(Region):
    """The free cells of a map."""

    places: ArrayLike
    """(K, 2) centres of the cells"""
    sides: ArrayLike
    """(2, 2) sides of a cell, as rows"""

    @classmethod
    def of(cls, grid: Grid, box: Float[np.ndarray, "2 2"] | None) -> "_FreeSpace":
        """The free cells of a map whose centres lie in a box, None for all.

        Raises InvalidField if there is no such cell.
        """
        free = np.asarray(grid.log_odds) < 0
        if not free.any():
            raise InvalidField("grid", "it has no free cell (log-odds below 0)")
        origin, cell = np.asarray(grid.origin, np.float64), float(np.asarray(grid.resolution))
        c, s = np.cos(origin[2]), np.sin(origin[2])
        sides = cell * np.array([[c, s], [-s, c]])
        i, j = np.indices(free.shape) + 0.5
        middle = np.stack([j, i], axis=-1) @ sides + origin[:2]  # (x, y) is (column, row)
        if box is not None:
            free = free & ((middle >= box[0]) & (middle <= box[1])).all(axis=2)
            if not free.any():
                raise InvalidField("box", f"no free cell of the map is in {box.tolist()}")
        return cls(middle[free], sides)

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        key_cell, key_share = jax.random.split(key)
        places = jnp.asarray(self.places, dtype)
        cell = jax.random.randint(key_cell, (count,), 0, len(places))
        share = jax.random.uniform(key_share, (count, 3), dtype) - 0.5
        place = places[cell] + share[:, :2] @ jnp.asarray(self.sides, dtype)
        return jnp.concatenate([place, wrap(2 * math.pi * share[:, 2:])], axis=1)

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        places, sides = jnp.asarray(self.places, dtype), jnp.asarray(self.sides, dtype)
        mean = places.mean(axis=0)
        # Of the centres, and of a uniform place within a cell; likewise a uniform heading, π²/3.
        off = places - mean[None]
        spread = off.T @ off / len(places) + sides.T @ sides / 12
        cov = jnp.zeros((3, 3), dtype).at[:2, :2].set(spread).at[2, 2].set(math.pi**2 / 3)
        return jnp.concatenate([mean, jnp.zeros(1, dtype)]), cov


@record
class GridLocalization(MonteCarloFilter):
    """Monte-Carlo localization in a grid: particles weighted by a beam model, KLD, recovery.

    `filters.ParticleLocalization` with the beams of a laser in place of landmarks: the same
    motion, number of particles (Fox 2003) and resampling. It takes the log of `beam_log`. A weight
    is multiplied by

        (Π_k p(z_k | x, map))^exponent

    over the usable beams of the scan, each `stride`-th. An exponent below 1 tempers the likelihood:
    beams are not independent given the pose, and without it the particles are overconfident
    (Thrun, Burgard & Fox 2005, "Probabilistic robotics", sections 6.3.4 and 8.3.4). Which exponent
    is honest depends on model, map and number of beams; `consistency.judge_localization` measures
    it.

    Recovery (table 8.3) compares the geometric mean of p(z_k) over the beams of a scan, averaged
    over the particles, with its long-term average, so the number of beams does not matter. It draws
    particles from the free cells of the map (in the box, if given) with any heading; so does
    a uniform start.

    The estimate is a single mean and covariance, also where the particles form several groups:
    `clusters` of `final.pose` and `final.log_weight` finds these. A particle off the map or in an
    occupied cell has weight zero; `blocked` of `info.extra["particles"]`, a `ParticleInfo`, counts
    those in use. A scan without a usable beam gives no more information. The status of a beam is
    FUSED if it entered the weights, UNMATCHED if `stride` left it out or the scan left no particle
    a weight (`underflow`), as where all are off the map. log_likelihood is
    log Σ w p(z | x)^exponent.

    Raises ValueError as `MonteCarloFilter`, on a grid that is none, is a tracer, or has no free
    cell (in the box), a model that is none, an exponent not above 0 or stride below 1.
    """

    grid: Grid = field(check=grid_map)
    """a map with a free cell"""
    model: BeamModel = field(check=instance_of(BeamModel))
    """as `LikelihoodField` or `RayCast`"""
    motion: Motion = field(check=motion_model)
    """motion model; for odometry `motion.Odometry` with `odometry_controls`"""
    particles: int = static(check=at_least(1))
    """capacity P, at least 1; a step has P · B/stride look-ups"""
    _: dataclasses.KW_ONLY
    exponent: Number = field(default=0.1, check=positive)
    """of the likelihood, above 0; differentiable"""
    stride: int = static(default=1, check=at_least(1))
    """use each n-th beam, at least 1"""
    prepared: PyTree = dataclasses.field(init=False, repr=False)
    """result of `model.prepare` for the map"""
    region: _FreeSpace = dataclasses.field(init=False, repr=False)
    """free cells of the map (in the box), where the robot may be"""
    measurements = _BEAM

    def __post_init__(self) -> None:
        if not is_concrete(self.grid):
            reason = "expected one outside a trace, since its free cells are found"
            raise InvalidField("grid", reason)
        box = None if self.box is None else np.asarray(self.box)
        set_field(self, "region", _FreeSpace.of(self.grid, box))
        set_field(self, "prepared", self.model.prepare(self.grid))
        super().__post_init__()

    def update(self, state: PoseParticles, scan: Scan, key: Array) -> tuple[PoseParticles, Info]:
        state, beams = draw_start(state, key, self._start_region), beams_of(scan, self.stride)

        def fit_of(poses: Float[Array, "P 3"], map_of: PyTree, beams: Beams) -> Float[Array, "P"]:
            log_p = partial(log_likelihood, self.model, map_of, beams=beams)
            return -jax.vmap(log_p)(poses)

        # Without `no_inline` XLA computes it again in each of its consumers.
        fit = no_inline(fit_of, state.pose, in_dtype(self.prepared, state.pose.dtype), beams)
        # After the likelihood, which is finite there: ∞ must not enter its derivative.
        height, width = self.grid.log_odds.shape
        origin, resolution = jnp.asarray(self.grid.origin), self.grid.resolution
        cell = jnp.floor(to_cells(origin, resolution, state.pose[:, :2]))
        on_map = (cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        j, i = jnp.where(on_map[:, None], cell, 0.0).astype(jnp.int32).T
        blocked = ~on_map | (jnp.asarray(self.grid.log_odds > 0)[i, j])
        fit = jnp.where(blocked, jnp.inf, fit)
        misfit = jnp.where(blocked, jnp.inf, jnp.asarray(self.exponent, fit.dtype) * fit)
        evidence = normalize(state.log_weight - misfit)[1]
        blocked = blocked & active_mask(state)
        state, report = self.weigh(state, misfit, fit, beams.valid.sum())
        report = report._replace(blocked=blocked.sum(dtype=jnp.int32))
        info = info_of_beams(scan, self.stride, evidence, ~report.underflow)
        return state, with_extra(info, "particles", report)

    def estimate(self, state: PoseParticles) -> Estimate:
        no_points = jnp.zeros((0, 2), state.pose.dtype)
        return self.pose_estimate(state, no_points, jnp.zeros(0, jnp.int32))


def info_of_beams(
    scan: Scan, stride: int, log_likelihood: Float[Array, ""], used: Bool[Array, ""]
) -> Info:
    """The `Info` of a scan with the status of each beam; a beam has no innovation.

    Each n-th beam is FUSED where the scan was used; all others are UNMATCHED.
    """
    m = scan.valid.shape[0]
    fused = (jnp.arange(m) % stride == 0) & used
    dtype = scan.z.dtype
    return info_of(
        status_of(scan.valid, matched=fused, inside=scan.z[:, 0] > 0),
        fused,
        size=0,
        slot=jnp.full(m, -1, jnp.int32),
        nis=jnp.zeros(m, dtype),
        innovation=jnp.zeros((m, 0), dtype),
        innovation_cov=jnp.zeros((m, 0, 0), dtype),
        log_likelihood=log_likelihood.astype(dtype),
    )
