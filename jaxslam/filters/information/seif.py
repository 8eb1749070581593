"""The sparse extended information filter: a step costs the same in a map of any size."""

import jax
import jax.numpy as jnp

from jaxslam.filters.information import canonical
from jaxslam.filters.information.mean_recovery import owed_of, relaxed, solved, swept
from jaxslam.filters.information.sparse_filter import (
    allotted,
    asked,
    check_sparse,
    closed,
    in_area,
    sparse_filter,
)
from jaxslam.filters.information.sparse_state import Sparse
from jaxslam.filters.information.sparsification import activated, retired
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.types import Info, Scan


def seif(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    active: int,
    links: int,
    passive: int = 10,
    sweeps: int = 1,
    conservative: bool = False,
    whole: bool = False,
    gate: float | None = None,
    floor: float = 1e-4,
) -> Filter:
    """Sparse extended information filter (Thrun et al. 2004; the Notes, corrected by ERRATA).

    The robot is linked to at most `active` landmarks, the most recent ones, each landmark to at
    most `links` others. Four steps, none of which touches the rest of a `Sparse` map:

    1. motion update (`canonical.moved`), on the robot and the active landmarks;
    2. sparsification (`sparsification.sparsified`) of as many of the least recent active landmarks
       as the scan needs places for; then measurement update and new landmarks (`canonical`);
    3. mean recovery (`mean_recovery`), one block at a time: the block of robot and active
       landmarks, and `passive` landmarks in rotation.

    With active = capacity it is `eif_slam`. What is approximated is counted in `Sparse.counts`.
    NIS, gate and, unless `whole`, `estimate` take covariances of Markov blankets
    (`marginals`), which hold all other landmarks at their means: less than the true ones, by
    much in a map that has drifted as a whole. Sparsification is overconfident too, which `eseif` is
    not. Landmarks are points known by their tags, and the tag of one is its slot.

    An area that is not positive definite: as in `eif_slam`, with `Counts.broken`.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`, at the estimate.
        capacity: landmarks N; a tag beyond is `Status.OVERFLOW`.
        active: places of the area, at least those of a scan; capped at the capacity.
        links: most links K of a landmark to others while one of both is passive.
        passive: landmarks a scan whose means are recovered in rotation, beside the active.
        sweeps: how often mean recovery goes round a scan: the passive share, then the area.
        conservative: how a full list gives up its weakest link, `sparsification.without_link`.
            False: overconfidently, Ω stays definite. True: claiming less, which in a map that needs
            many more links than it may have costs Ω its definiteness.
        whole: `estimate` inverts Ω of all landmarks, O(N³): what the filter believes.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
        floor: standard deviation [m, rad] added to a singular pose_cov, which has no inverse.
    Raises:
        ValueError: as `eif_slam`; on an active, links, passive or sweeps below 1; on landmarks that
            are not points (x, y); and, from `update`, on a scan with more places than `active`.
    """
    check_sparse(
        "seif",
        motion,
        sensor,
        capacity,
        gate,
        floor,
        active=active,
        links=links,
        passive=passive,
        sweeps=sweeps,
    )
    count, share = min(active, capacity), min(passive, capacity)

    def update(state: Sparse, scan: Scan, key: jax.Array) -> tuple[Sparse, Info]:
        state = relaxed(state, share)
        of = asked(state, scan)
        # Places for the scan: empty ones first, then those not measured for longest.
        needs = of.wanted & ~of.match.any(axis=1)
        free = state.slot >= capacity
        last = jnp.where(of.match.any(axis=0), jnp.iinfo(jnp.int32).max, state.seen)
        turn = jnp.cumsum(needs) - 1
        place, taken = allotted(jnp.where(free, -1, last), turn, needs, of.match)
        state = retired(state, taken & ~free, min(scan.tag.shape[0], count), conservative)
        state = activated(state, place, of.slot, needs)

        weighed = canonical.weigh(
            state.omega, state.pose, in_area(state), scan, place, of.known, sensor, gate
        )
        omega, owed = canonical.informed(state.omega, owed_of(state), weighed)
        state, sound = solved(state, omega, owed, weighed.sound)
        state = swept(state, omega, sound, share, sweeps - 1)
        room = of.wanted & of.new & sound
        omega, points, granted = canonical.born(omega, state.pose, scan.z, place, room, sensor)
        state = closed(state, of, place, of.wanted, omega, points, granted, sound, scan.valid.any())
        info = canonical.reported(
            canonical.judged(weighed, sound),
            scan,
            of.slot,
            new=of.new,
            repeated=of.repeated,
            granted=granted,
            singular=of.wanted,
        )
        return state, info

    return sparse_filter(
        "seif",
        motion,
        sensor,
        capacity,
        update,
        active=active,
        links=links,
        whole=whole,
        floor=floor,
    )
