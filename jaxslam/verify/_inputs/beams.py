"""A beam model as a function to verify: log-densities by pose and ranges in a smooth map."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.core.protocols import POSE
from jaxslam.core.types import Beams
from jaxslam.laser.grids._grid import Grid
from jaxslam.laser.grids.beam_models._beam_model import BeamModel
from jaxslam.verify._inputs.functions import Argument, Function
from jaxslam.verify._inputs.samples import Samples

FAR = 40.0
"""Maximum range [m] of the models that are made for the trial."""

_ANGLES = np.array([-2.7, -1.9, -1.1, -0.3, 0.5, 1.3, 2.1, 2.9])
_CELL, _ORIGIN = 0.5, (-17.03, -14.11, 0.2)
_WIDTH = 6.0
"""Width [m] of the strip at a wall over which the solid share rises from 0 to 1."""
_HEADINGS = (0.0, 1e-9, -1e-9, np.pi, np.pi - 1e-9, 1e-9 - np.pi, np.pi / 2)
_CORNER = 2.0
"""Least distance of a trial beam's end from a corner [m], and from another wall's line."""


def beam_function(model: BeamModel) -> Function:
    """The log-densities of eight beams by the pose and the ranges, with the Jacobian of the model.

    In a room of four slanted walls, near which the share of a cell that is solid falls off
    linearly, over cells: there bilinear interpolation has no error, so that a right derivative and
    differences of the values agree. Close to kinks, as the lines between cells, differences take
    smaller steps.
    """
    prepared = model.prepare(_trial_map())

    def beams_of(ranges: jax.Array) -> Beams:
        angles = jnp.asarray(_ANGLES, ranges.dtype)
        return Beams(ranges, angles, jnp.ones(len(_ANGLES), bool))

    def map_like(like: jax.Array) -> object:
        return jax.tree.map(
            lambda x: x.astype(like.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
            prepared,
        )

    def log_density(pose: jax.Array, ranges: jax.Array) -> jax.Array:
        return model.log_likelihoods(map_like(pose), pose, beams_of(ranges))

    def claim(pose: jax.Array, ranges: jax.Array) -> tuple[jax.Array, None]:
        assert model.jacobian is not None
        return model.jacobian(map_like(pose), pose, beams_of(ranges)), None

    names = tuple(f"range {k + 1} [m]" for k in range(len(_ANGLES)))
    return Function(
        "log_density",
        log_density,
        (Argument("pose", POSE), Argument("ranges", names)),
        tuple(f"beam {k + 1}" for k in range(len(_ANGLES))),
        None if model.jacobian is None else claim,
    )


@functools.cache
def _trial_map() -> Grid:
    """The map of the room."""
    height, width = 64, 70
    x, y = np.meshgrid(_CELL * (np.arange(width) + 0.5), _CELL * (np.arange(height) + 0.5))
    c, s = np.cos(_ORIGIN[2]), np.sin(_ORIGIN[2])
    points = np.stack([_ORIGIN[0] + c * x - s * y, _ORIGIN[1] + s * x + c * y], axis=-1)
    beyond = np.max(points @ _NORMALS.T - _OFFSETS, axis=-1)
    solid = np.clip(0.5 + beyond / _WIDTH, 0.01, 0.99)
    return Grid(np.log(solid / (1 - solid)), np.array(_ORIGIN), np.float64(_CELL))  # type: ignore[arg-type]


_TURNS = np.array([0.31, 1.93, 3.52, 5.0])
_NORMALS = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)
"""(4, 2) outward normals of the walls; a point is inside where n·p < offset for all."""
_OFFSETS = np.array([9.0, 8.0, 8.5, 7.5])


def beam_samples(model: BeamModel, count: int, seed: int) -> Samples:
    """Poses in the room, with ranges beside the true ones; the first are random, others have
    difficult headings."""
    mount = np.zeros(3) if model.mount is None else np.asarray(model.mount, np.float64)
    rng = np.random.default_rng(seed)
    headings = np.concatenate([rng.uniform(-np.pi, np.pi, count), _HEADINGS])
    labels = ("random",) * count + tuple(f"pose theta = {h:.4g}" for h in _HEADINGS)
    poses = []
    for heading in headings:
        pose = np.array([*rng.uniform(-3, 3, 2), heading])
        while not _ranges(pose[None], mount)[1].min() > _CORNER:  # a beam ends near a corner
            pose = np.array([*rng.uniform(-3, 3, 2), heading])
        poses.append(pose)
    pose = np.array(poses)
    ranges = _ranges(pose, mount)[0] + 0.15 * rng.normal(size=(len(pose), len(_ANGLES)))
    return Samples((pose, ranges), labels)


def _ranges(
    pose: Float[np.ndarray, "S 3"], mount: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "S B"], Float[np.ndarray, "S B"]]:
    """The exact range of each beam, and the distance of its end from the next wall's line."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    arm = np.stack([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]], axis=1)
    eye = (pose[:, :2] + arm)[:, None]
    heading = pose[:, 2, None] + mount[2] + _ANGLES
    e = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    towards = e @ _NORMALS.T
    room = (_OFFSETS - eye @ _NORMALS.T) / np.where(towards > 1e-9, towards, np.nan)
    ranges = np.nanmin(room, axis=-1)
    ends = eye + ranges[..., None] * e
    gaps = np.sort(_OFFSETS - ends @ _NORMALS.T, axis=-1)
    return ranges, gaps[..., 1]
