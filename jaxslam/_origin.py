"""A map whose origin is far away, moved next to it: positions relative to the start.

At UTM coordinates (5e5, 5e6), float32 holds positions to 0.5 m, and a chart that turns the map
about its origin has a covariance of 10¹³ σ_θ². Models measure differences of positions, so a world
and its filters can be moved: the start's (x, y) is subtracted on the host, in float64, before
anything is computed, and added again, there, to what leaves as coordinates. `monte_carlo` does so
in both precisions, `simulate` and `run` in float32.

What depends on where it is must not be moved: a position fix, a beacon in a user's model, a field
of view with walls, the code of a user's filter. So models and fields of view are evaluated at both
places, classes of other origin are left alone, and nothing may hold a number as large as the
origin afterwards.
"""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._record import is_record
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Estimate, Truth
from jaxslam.math._arrays import float64
from jaxslam.sensors._suite import Suite

_T = TypeVar("_T")

Origin = Float[np.ndarray, "2"]

FAR = 1000.0
"""Nearer than this [m], what `simulate` and `run` return stays in float32, which holds 0.1 mm."""

_TRIALS = 24
"""Poses at which models are compared at both places."""


def far_origin(pose: ArrayLike, points: ArrayLike = (), least: float = 0.0) -> Origin | None:
    """The start's (x, y), if the map's origin is farther from the map than this is wide, and than
    `least` [m]; else None.

    pose: (3,) of the start. points: (N, L) landmarks, a position first.
    """
    start = np.asarray(jax.device_get(pose), np.float64)[:2]
    places, table = start[None], np.asarray(jax.device_get(points), np.float64)
    if table.size and table.shape[-1] > 1:
        places = np.concatenate([places, table.reshape(-1, table.shape[-1])[:, :2]])
    width = float(np.abs(places - start).max())
    nearest = float(np.abs(places).max(axis=1).min())
    return start if nearest > max(width, least) else None


def move_near_origin(of: _T, origin: Origin, controls: ArrayLike | None = None) -> _T | None:
    """A world, a filter or an estimator with positions relative to an origin; None if it depends
    on where it is, as far as can be told.

    controls: (T, U) of its motion, at which that is compared; default small ones.
    """
    if not _is_ours(of, []):
        return None
    near: _T = _subtract_origin(of, origin)
    return near if may_move(near, origin, controls) else None


def may_move(near: PyTree, origin: Origin, controls: ArrayLike | None = None) -> bool:
    """Whether a world, a filter or an estimator, whose positions are relative to an origin, gives
    what it gives in the map."""
    models: list[PyTree] = []
    if holds_far_numbers(near, origin) or not _is_ours(near, models):
        return False
    landmarks = getattr(near, "landmarks", None)
    pose = np.asarray(getattr(near, "pose", np.zeros(3)), np.float64)
    return all(_is_relative(model, pose, landmarks, controls, origin) for model in models)


def holds_far_numbers(tree: PyTree, origin: Origin) -> bool:
    """Whether a number of a tree is finite, and at least half as large as an origin."""
    leaves = [np.asarray(jax.device_get(leaf)) for leaf in jax.tree.leaves(tree)]
    sizes = [np.abs(leaf[np.isfinite(leaf)]) for leaf in leaves if leaf.dtype.kind == "f"]
    return any((size >= 0.5 * np.abs(origin).max()).any() for size in sizes)


def _is_ours(of: Any, models: list[PyTree]) -> bool:
    """Whether a record consists of models and fields of view, which are put into the list, and of
    records of this package, whose code does not depend on where it is."""
    if isinstance(of, Suite):
        return all(_is_ours(part, models) for part in of.parts)
    if isinstance(of, Motion | Sensor):
        models.append(of)
        return getattr(of, "carry", None) is None  # else landmarks do not begin with a position
    if isinstance(of, tuple):
        return all(_is_ours(entry, models) for entry in of)
    if not is_record(of):
        return True
    if type(of).__module__.partition(".")[0] != "jaxslam":
        return False
    for field in dataclasses.fields(of):
        value = getattr(of, field.name)
        if field.name == "visible" and value is not None:
            models.append(value)
        elif not _is_ours(value, models):
            return False
    return True


def _is_relative(
    model: PyTree, pose: np.ndarray, landmarks: Any, controls: ArrayLike | None, origin: Origin
) -> bool:
    """Whether a motion, a sensor or a field of view gives the same at both places."""
    rng = np.random.default_rng(0)
    if landmarks is None:
        points = rng.uniform(0.1, 1.0, (_TRIALS, len(getattr(model, "landmark", ())) or 2))
        points[:, :2] = pose[:2] + 10 * rng.standard_normal((_TRIALS, 2))
    else:
        table = np.asarray(landmarks, np.float64)
        points = np.resize(table, (_TRIALS, table.shape[-1]))
    poses = np.zeros((_TRIALS, 3))
    poses[:, :2] = points[:, :2] + rng.standard_normal((_TRIALS, 2))
    poses[:, 2] = rng.uniform(-3, 3, _TRIALS)
    poses[0] = pose[:3]
    beside = getattr(model, "state", (0, 0, 0))[3:] or getattr(model, "robot", ())
    poses = np.concatenate([poses, rng.uniform(0.5, 1.0, (_TRIALS, len(beside)))], axis=1)
    width = len(getattr(model, "controls", ())) or 1
    rows = np.resize(
        0.1 if controls is None else np.asarray(controls, np.float64), (_TRIALS, width)
    )
    with float64():
        change = np.asarray(_change(model, poses, points, rows, origin))
    return bool(change < 1e-5)


@jax.jit
def _change(
    model: PyTree,
    poses: Float[Array, "K R"],
    points: Float[Array, "K L"],
    controls: Float[Array, "K U"],
    origin: Float[Array, "2"],
) -> Float[Array, ""]:
    """The largest change of what a model gives, as poses and points move by an origin."""
    far_poses, far_points = (places.at[:, :2].add(origin) for places in (poses, points))
    if isinstance(model, Motion):
        noise = jnp.full((len(poses), len(model.noises)), 0.01)
        near, far = (jax.vmap(model.step)(at, controls, noise) for at in (poses, far_poses))
        covs = [jax.vmap(model.noise_cov)(at, controls) for at in (poses, far_poses)]
        pairs = [(near.at[:, :2].add(origin), far), (covs[0], covs[1])]
    elif isinstance(model, Sensor):
        size = len(model.landmark)
        near, far = (
            jax.vmap(model.observe)(at, landmarks[:, :size])
            for at, landmarks in ((poses, points), (far_poses, far_points))
        )
        pairs = [(jnp.zeros_like(near), jax.vmap(model.residual)(far, near))]
    else:
        see = jax.vmap(jax.vmap(model, (None, 0)), (0, None))
        pairs = [(see(poses, points).astype(float), see(far_poses, far_points).astype(float))]
    return jnp.stack([jnp.abs(far - near).max(initial=0.0) for near, far in pairs]).max()


def _subtract_origin(of: Any, origin: Origin) -> Any:
    """The record, or the truth, with the positions among its fields relative to an origin."""
    if isinstance(of, Truth):
        places = of.pose, of.landmarks, of.start
        pose, landmarks, start = (shift_positions(place, -origin) for place in places)
        return of._replace(pose=pose, landmarks=landmarks, start=start)
    names = {field.name for field in dataclasses.fields(of)}
    changed: dict[str, Any] = {
        name: shift_positions(getattr(of, name), -origin) for name in names & {"pose", "landmarks"}
    }
    if "truth" in names:
        changed["truth"] = _subtract_origin(of.truth, origin)
    return dataclasses.replace(of, **changed)


def shift_positions(positions: ArrayLike, by: Origin) -> np.ndarray:
    """Arrays (…, K) whose first two columns are a position, moved, in float64."""
    values = np.array(jax.device_get(positions), np.float64)
    values[..., :2] += by
    return values


def to_map_coordinates(of: _T, origin: Origin) -> _T:
    """A truth or an estimate relative to an origin, in the coordinates of the map, in float64."""
    if isinstance(of, Truth):
        truth: _T = _subtract_origin(of, -origin)
        return truth
    assert isinstance(of, Estimate)
    points = np.where(np.asarray(of.alive)[..., None], shift_positions(of.points, origin), 0.0)
    return of._replace(pose=shift_positions(of.pose, origin), points=points)
