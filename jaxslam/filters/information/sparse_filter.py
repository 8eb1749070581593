"""What `seif` and `eseif` share beside their map: start, motion, moments, and what a scan asks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.information import canonical
from jaxslam.filters.information.eif_slam import check_models
from jaxslam.filters.information.marginals import marginals, whole_marginals
from jaxslam.filters.information.mean_recovery import owed_of, owing
from jaxslam.filters.information.sparse_state import Sparse, empty
from jaxslam.filters.reporting import seen_before
from jaxslam.math.linalg import check_count
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.types import Estimate, Info, Scan

Update = Callable[[Sparse, Scan, jax.Array], tuple[Sparse, Info]]


class Asked(NamedTuple):
    """What M measurements of a scan ask of the map; all (M,) but `match`."""

    repeated: jax.Array
    """bool: their tag occurs earlier in the scan"""
    wanted: jax.Array
    """bool: of a landmark that has, or may have, a slot"""
    slot: jax.Array
    """int32: that slot, N where not wanted"""
    known: jax.Array
    """bool: of a landmark of the map"""
    new: jax.Array
    """bool: of a tag that is not, or no longer wanted"""
    match: jax.Array
    """(M, A) bool: whose landmark has which place of the area"""


def asked(state: Sparse, scan: Scan) -> Asked:
    """What a scan asks; a landmark's slot is its tag."""
    capacity = state.own.shape[0]
    named = scan.valid & (scan.tag >= 0)
    repeated = named & seen_before(scan.tag, named)
    wanted = named & ~repeated & (scan.tag < capacity)
    slot = jnp.where(wanted, scan.tag, capacity).astype(jnp.int32)
    known = wanted & state.alive.at[slot].get(mode="fill", fill_value=False)
    match = wanted[:, None] & (slot[:, None] == state.slot[None, :])
    return Asked(repeated, wanted, slot, known, named & ~known, match)


def in_area(state: Sparse) -> jax.Array:
    """The means (A, 2) of the landmarks of the area."""
    means: jax.Array = state.landmarks.at[state.slot].get(mode="fill", fill_value=0)
    return means


def allotted(
    first: jax.Array, turn: jax.Array, needs: jax.Array, match: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Places (M,) of a scan's landmarks, and those taken (A,) for the ones that need one (M,).

    Places are given by `first` (A,), the least first, in the order of `turn` (M,) among `needs`.
    """
    order = jnp.argsort(first, stable=True)
    place = jnp.where(needs, order[jnp.clip(turn, 0, len(order) - 1)], jnp.argmax(match, axis=1))
    return place, slots.concerned(place, needs, len(order))


def closed(
    state: Sparse,
    of: Asked,
    place: jax.Array,
    wanted: jax.Array,
    omega: jax.Array,
    points: jax.Array,
    granted: jax.Array,
    sound: jax.Array,
    asked_any: jax.Array,
) -> Sparse:
    """The state after a scan: new landmarks points (M, 2) where granted (M,), Ω where sound ()."""
    capacity, count = state.own.shape[0], state.slot.shape[0]
    into = jnp.where(granted, of.slot, capacity)
    seen = state.seen.at[jnp.where(wanted, place, count)].set(state.scans + 1, mode="drop")
    return state._replace(
        landmarks=state.landmarks.at[into].set(points, mode="drop"),
        alive=state.alive.at[into].set(True, mode="drop"),
        omega=jnp.where(sound, omega, canonical.loaded(state.omega)),
        seen=seen,
        scans=state.scans + 1,
        counts=state.counts._replace(broken=state.counts.broken + (asked_any & ~sound)),
    )


def sparse_filter(
    name: str,
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    update: Update,
    *,
    active: int,
    links: int,
    whole: bool,
    floor: float,
) -> Filter:
    """The filter of an update of a `Sparse` map."""

    def init(pose: jax.Array, pose_cov: jax.Array) -> Sparse:
        start = canonical.started(pose_cov, floor).astype(pose.dtype)
        return empty(pose, start, capacity, min(active, capacity), links)

    def predict(state: Sparse, u: jax.Array, key: jax.Array) -> Sparse:
        pose, omega, owed = canonical.moved(motion, state.pose, u, state.omega, owed_of(state))
        return owing(state._replace(pose=pose, omega=omega), owed)

    def checked(state: Sparse, scan: Scan, key: jax.Array) -> tuple[Sparse, Info]:
        places = scan.tag.shape[0]
        if places > active:
            raise ValueError(f"{name}: a scan has {places} places, the active set holds {active}")
        return update(state, scan, key)

    def estimate(state: Sparse) -> Estimate:
        pose_cov, point_covs = whole_marginals(state) if whole else marginals(state)
        unit = jnp.eye(2, dtype=point_covs.dtype)[None]
        alive = state.alive
        return Estimate(
            pose=state.pose,
            pose_cov=pose_cov,
            points=jnp.where(alive[:, None], state.landmarks, 0.0),
            point_covs=jnp.where(alive[:, None, None], point_covs, unit),
            alive=alive,
            tag=jnp.where(alive, jnp.arange(capacity), -1).astype(jnp.int32),
        )

    return Filter(
        name=name,
        control_size=len(motion.controls),
        measurement_size=len(sensor.measurements),
        init=init,
        predict=predict,
        update=checked,
        estimate=estimate,
        chart=euclidean(),
    )


def check_sparse(
    name: str,
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    gate: float | None,
    floor: float,
    **counts: Any,
) -> None:
    """Raise ValueError on what no filter of a `Sparse` map takes; counts are to be above 0."""
    check_models(name, motion, sensor, capacity, gate, floor)
    for what, value in counts.items():
        check_count(f"{name}: {what}", value)
    if len(sensor.landmark) != 2:
        raise ValueError(f"{name}: the landmarks of {sensor.name} are not points (x, y)")
