"""The exactly sparse extended information filter, which relocates the robot to stay sparse."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from jaxslam.filters.information import canonical
from jaxslam.filters.information.innovation import CanonicalInnovations
from jaxslam.filters.information.settings import RelocationSettings
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
from jaxslam.filters.information.sparse.relocation import relocate_or_correct
from jaxslam.filters.information.sparse.sparse_filter import (
    check_scan_size,
    correct_active,
    finish_scan,
    initialize_active,
    sparse_filter,
)
from jaxslam.filters.information.sparse.sparse_state import (
    SparseState,
    linked_to_robot,
)
from jaxslam.filters.information.sparse.sparsification import cut_robot_links
from jaxslam.filters.information.tag_association import TagAssociation, associate_by_index
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.types import Info, Scan


def eseif(
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
    turn: float = 0.1,
    wait: bool = True,
) -> Filter:
    """Exactly sparse extended information filter (Walter, Eustice & Leonard 2007, "Exactly sparse
    extended information filters for feature-based SLAM", IJRR 26(4)).

    The map, motion update, new landmarks, mean recovery, options and limits of `seif`, without its
    sparsification: a landmark leaves the active set only if it has no link to the robot. Before
    such landmarks run out, the robot is relocated (`relocation`). With z_β the scan's measurements
    of active landmarks:

        Ω_m ← Ω_mm - Ω_mx Ω_xx⁻¹ Ω_xm, ρ_m ← ρ_m - Ω_mx Ω_xx⁻¹ ρ_x   the pose marginalized out,
        Ω ← Ω + H_βᵀ R⁻¹ H_β, ρ ← ρ + H_βᵀ R⁻¹ ν_β                   and estimated from z_β alone.

    The robot then has links to the landmarks of z_β, and exactly none to the others, which may
    leave the active set. The odometry between the map and z_β is discarded: for the same
    linearization Ω ⪯ Ω of the full filter, so the covariance is at least the full filter's. In
    other scans nothing is discarded. All of z_β relocates, none of it corrects the old pose.

    Landmarks that are not active yet are activated then, and their measurements fused; then new
    ones are initialized. z_β must determine the whole pose (`relocation.determines_pose`: two
    landmarks by range and bearing). Where it does not, relocation is postponed, and measurements of
    landmarks for which the active set has no room are `Status.DEFERRED`, new landmarks before known
    ones. So indices of the active set are reserved: as many as a scan has measurement slots, or
    half of those beyond a scan, but no more than there are landmarks beyond the active set: with
    active = capacity it is `eif_slam`. Where scans are of one or two landmarks only, so much is
    deferred that the map fails (Victoria Park as GTSAM has it); with wait = False links are cut as
    by `seif` instead, overconfidently, and counted.

    `ApproximationCounts.relocated` counts relocations, `.cut` the links to the robot removed, and
    `.cut_nats` the increase of the active block's entropy by it, or that of `seif`. As in `seif`,
    linearization, full lists of links, and covariances of Markov blankets cause overconfidence.

    Args:
        motion, sensor, capacity, active, links, passive, sweeps, conservative, whole, gate, floor:
            as `seif`.
        turn: greatest standard deviation of the heading [rad] that z_β may leave, landmarks given.
        wait: False: where relocation would have to be postponed, links are cut by sparsification.
    Raises:
        ValueError: as `seif`; on a turn not above 0.
    """
    settings = RelocationSettings(
        "eseif",
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
        turn=turn,
        wait=wait,
    )

    def update(state: SparseState, scan: Scan, key: Array) -> tuple[SparseState, Info]:
        check_scan_size(settings, scan)
        state = recover_passive_means(state, settings.recovered)
        measured = associate_by_index(state.alive, scan)
        matches = active_matches(state, measured)
        state, first, solved = relocate_or_correct(settings, state, scan, measured, matches)
        state, index, entered = activate_others(settings, state, measured, matches, solved)
        active, late = matches.any(axis=1) | entered, measured.known & entered
        state, omega, second, corrected = correct_active(settings, state, scan, index, late)
        solved = solved & corrected
        state = repeat_recovery(settings, state, omega, solved)
        room = active & measured.new & solved
        state, omega, initialized = initialize_active(
            settings, state, omega, scan, measured.slot, index, room
        )
        state = finish_scan(state, scan, index, active, omega, solved)
        waiting = measured.has_slot & ~active
        innovations = merge_passes(first, second, late, waiting, solved)
        return state, canonical.report(scan, measured, innovations, initialized, waiting & solved)

    return sparse_filter(settings, update)


def activate_others(
    settings: RelocationSettings,
    state: SparseState,
    measured: TagAssociation,
    matches: Bool[Array, "M A"],
    solved: Bool[Array, ""],
) -> tuple[SparseState, Int[Array, "M"], Bool[Array, "M"]]:
    """The state with measured landmarks active, as far as there is room; their indices in the
    active set; and which of them have entered it. None enters where not solved.

    Empty indices are assigned first, then those of the least recently measured landmarks without a
    link to the robot, which become passive; known landmarks get indices before new ones. With
    wait=False also those of landmarks with a link, which is cut.
    """
    enters = measured.has_slot & ~matches.any(axis=1)
    empty, in_scan = state.active >= settings.capacity, matches.any(axis=0)
    available = empty | ~(linked_to_robot(state.omega) | in_scan)
    most = jnp.iinfo(jnp.int32).max
    linked_order = jnp.where(in_scan, most, most // 2 + state.last_measured)
    order = jnp.where(available, state.last_measured, linked_order)
    order = jnp.where(empty, -1, order)
    known = enters & measured.known
    rank = jnp.where(known, jnp.cumsum(known), known.sum() + jnp.cumsum(enters & ~known)) - 1
    enters = enters & solved
    if settings.wait:
        enters = enters & (rank < available.sum())
    index, given = assign_indices(order, rank, enters, matches)
    leaving, at_most = given & ~empty, min(matches.shape)
    if not settings.wait:
        state = cut_robot_links(state, leaving)
    state = deactivate(state, leaving, at_most, settings.conservative)
    return activate(state, index, measured.slot, enters), index, enters


def merge_passes(
    first: CanonicalInnovations,
    second: CanonicalInnovations,
    late: Bool[Array, "M"],
    waiting: Bool[Array, "M"],
    solved: Bool[Array, ""],
) -> CanonicalInnovations:
    """The innovations for the `Info`: of the second pass where late, else of the first.

    Those of landmarks that wait are deferred, not rejected: they count as inside the gate, and as
    singular only where the scan could not be solved for. Whitened rows are those of the first pass.
    """

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(late.reshape(-1, *[1] * (a.ndim - 1)), b, a)

    return first._replace(
        compared=pick(first.compared, second.compared),
        positive=jnp.where(waiting, solved, pick(first.positive, second.positive)),
        inside=pick(first.inside, second.inside) | waiting,
        innovation=pick(first.innovation, second.innovation),
        innovation_cov=pick(first.innovation_cov, second.innovation_cov),
        nis=pick(first.nis, second.nis),
        log_likelihood=pick(first.log_likelihood, second.log_likelihood),
    )
