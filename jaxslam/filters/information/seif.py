"""The sparse extended information filter (SEIF), whose steps take constant time."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Int

from jaxslam.filters.information import canonical
from jaxslam.filters.information.settings import SparseSettings
from jaxslam.filters.information.sparse.active_set import (
    activate,
    active_matches,
    assign_indices,
    deactivate,
)
from jaxslam.filters.information.sparse.mean_recovery import (
    recover_passive_means,
    repeat_recovery,
)
from jaxslam.filters.information.sparse.sparse_filter import (
    check_scan_size,
    correct_active,
    finish_scan,
    initialize_active,
    sparse_filter,
)
from jaxslam.filters.information.sparse.sparse_state import SparseState
from jaxslam.filters.information.sparse.sparsification import cut_robot_links
from jaxslam.filters.information.tag_association import TagAssociation, associate_by_index
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
    """Sparse extended information filter (Thrun et al. 2004; the Notes, corrected by the errata).

    The robot is linked to at most `active` landmarks, the most recent ones, each landmark to at
    most `links` others. Four steps, none of which touches the rest of the map:

    1. motion update (`canonical.motion_update`), of the robot and the active landmarks;
    2. sparsification (`sparsification.sparsify`): the least recently measured active landmarks
       lose their links to the robot, as many as the scan needs indices for;
    3. measurement update and new landmarks (`canonical`);
    4. mean recovery (`mean_recovery`), one block at a time: the block of robot and active
       landmarks, and `passive` landmarks in rotation.

    The sources sparsify last, after measurement and mean. Here sparsification comes before the
    measurement, and only makes the room that the scan needs, so that a scan without another
    landmark drops nothing.

    With active = capacity it is `eif_slam`. `sparsification` documents what is dropped, and
    `SparseState.counts` counts it. NIS, gate and, unless `whole`, `estimate` use covariances of
    Markov blankets (`marginals`), which hold all other landmarks at their means: less than the true
    ones, by much in a map that has drifted as a whole. Sparsification is overconfident too, which
    `eseif` is not. Landmarks are points associated by their tags, and the tag of one is its slot.

    An active block that is not positive definite: as in `eif_slam`, counted in
    `ApproximationCounts.refused`.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`, at the estimate.
        capacity: landmarks N; a tag beyond is `Status.OVERFLOW`.
        active: most active landmarks, at least as many as a scan has measurement slots; capped at
            the capacity.
        links: most links K of a landmark to others while one of both is passive.
        passive: landmarks whose means are recovered in rotation each scan, beside the active ones.
        sweeps: rounds of mean recovery a scan: passive landmarks, then the active block.
        conservative: how a full list drops its weakest link, `sparsification.drop_link`. False:
            overconfidently, Ω stays positive definite. True: with loss of information; where a map
            needs many more links than it may have, Ω does not stay positive definite.
        whole: `estimate` inverts Ω of all landmarks, O(N³): the filter's exact marginals.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
        floor: standard deviation [m, rad] added to a singular pose_cov, which has no inverse.
    Raises:
        ValueError: as `eif_slam`; on an active, links, passive or sweeps below 1; on landmarks that
            are not points (x, y); and, from `update`, on a scan with more measurement slots than
            `active`.
    """
    settings = SparseSettings(
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
        conservative=conservative,
        whole=whole,
    )

    def update(state: SparseState, scan: Scan, key: Array) -> tuple[SparseState, Info]:
        check_scan_size(settings, scan)
        state = recover_passive_means(state, settings.recovered)
        measured = associate_by_index(state.alive, scan)
        state, index = sparsify_and_activate(settings, state, measured)
        state, omega, innovations, solved = correct_active(
            settings, state, scan, index, measured.known
        )
        state = repeat_recovery(settings, state, omega, solved)
        room = measured.new & measured.has_slot & solved
        state, omega, initialized = initialize_active(
            settings, state, omega, scan, measured.slot, index, room
        )
        state = finish_scan(state, scan, index, measured.has_slot, omega, solved)
        return state, canonical.report(scan, measured, innovations, initialized)

    return sparse_filter(settings, update)


def sparsify_and_activate(
    settings: SparseSettings, state: SparseState, measured: TagAssociation
) -> tuple[SparseState, Int[Array, "M"]]:
    """The state with all measured landmarks active, and their indices in the active set.

    Empty indices are assigned first, then those of the least recently measured landmarks, which
    are sparsified and become passive.
    """
    matches = active_matches(state, measured)
    enters = measured.has_slot & ~matches.any(axis=1)
    empty = state.active >= settings.capacity
    order = jnp.where(matches.any(axis=0), jnp.iinfo(jnp.int32).max, state.last_measured)
    order = jnp.where(empty, -1, order)
    index, given = assign_indices(order, jnp.cumsum(enters) - 1, enters, matches)
    leaving, most = given & ~empty, min(matches.shape)
    state = cut_robot_links(state, leaving)
    state = deactivate(state, leaving, most, settings.conservative)
    return activate(state, index, measured.slot, enters), index
