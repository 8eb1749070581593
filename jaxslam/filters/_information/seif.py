"""The sparse extended information filter (SEIF), whose steps take constant time."""

import dataclasses

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core._record import record, static
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField, at_least
from jaxslam.filters._information import canonical, tag_innovation
from jaxslam.filters._information.active_set import (
    activate,
    active_matches,
    assign_indices,
    deactivate,
)
from jaxslam.filters._information.marginals import (
    blanket_marginals,
    recover_active_means,
    recover_passive_means,
    repeat_recovery,
    whole_marginals,
)
from jaxslam.filters._information.sparse_state import (
    SparseState,
    active_means,
    active_residual,
    cut_robot_links,
    empty_map,
    with_active_residual,
)
from jaxslam.filters._information.tag_innovation import (
    CanonicalInnovations,
    InformationFilter,
    TagAssociation,
    associate_by_index,
)


@record
class Seif(InformationFilter):
    """Sparse extended information filter (Thrun et al. 2004; the Notes, corrected by the errata).

    The robot is linked to at most `active` landmarks, the most recent ones, each landmark to at
    most `links` others. The four steps do not touch the rest of the map:

    1. motion update, of the robot and the active landmarks;
    2. sparsification: the least recently measured active landmarks
       lose their links to the robot, as many as the scan needs indices for;
    3. measurement update and new landmarks;
    4. mean recovery (`marginals`), one block at a time: the block of robot and active
       landmarks, and `passive` landmarks in rotation.

    The sources sparsify last, after measurement and mean. Here sparsification comes before the
    measurement, and only makes the room that the scan needs, so that a scan without another
    landmark drops nothing.

    With active = capacity it is `EifSlam`. `sparse_state` documents the approximation, and
    `SparseState.counts` counts it. NIS and gate, and `estimate` unless `exact_marginals`, use
    covariances of Markov blankets (`marginals`), which hold all other landmarks at their means:
    less than the true ones, by much in a map that has drifted as a whole. Sparsification is
    overconfident too. Landmarks are points associated by their tags; the slot of a landmark is its
    tag.

    Where the active block is not positive definite, the scan is refused as in `EifSlam`, and
    counted in `ApproximationCounts.refused`.

    Raises ValueError as `EifSlam`; on an active, links, passive or sweeps below 1; on landmarks
    that are not points (x, y); and, from `update`, on a scan with more measurement slots than
    `active`.
    """

    _: dataclasses.KW_ONLY
    active: int = static(check=at_least(1))
    """most active landmarks, at least as many as a scan has measurement slots; capped at the
    capacity"""
    links: int = static(check=at_least(1))
    """most links K of a landmark to others while one of both is passive"""
    passive: int = static(default=10, check=at_least(1))
    """landmarks whose means are recovered in rotation each scan, in addition to the active ones"""
    sweeps: int = static(default=1, check=at_least(1))
    """rounds of mean recovery a scan: passive landmarks, then the active block"""
    conservative: bool = static(default=False)
    """how a full list drops its weakest link. False: overconfidently, Ω
    stays positive definite. True: with loss of information; where a map needs many more links than
    it may have, Ω does not stay positive definite"""
    exact_marginals: bool = static(default=False)
    """`estimate` inverts Ω of all landmarks, O(N³), instead of Markov blankets"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sensor.of_points:
            reason = f"expected landmarks (x, y), got {self.sensor.landmark} of {self.sensor.name}"
            raise InvalidField("sensor", reason)

    @property
    def active_size(self) -> int:
        """The size A of the active set."""
        return min(self.active, self.capacity)

    @property
    def recovered(self) -> int:
        """The number of passive means that a round of mean recovery updates."""
        return min(self.passive, self.capacity)

    def init(self, pose: Array, pose_cov: Array) -> SparseState:
        information = canonical.initial_information(pose_cov, self.floor).astype(pose.dtype)
        return empty_map(pose, information, self.capacity, self.active_size, self.links)

    def predict(self, state: SparseState, u: Array, key: Array) -> SparseState:
        pose, omega, residual = canonical.motion_update(
            self.motion, state.pose, u, state.omega, active_residual(state)
        )
        return with_active_residual(state._replace(pose=pose, omega=omega), residual)

    def update(self, state: SparseState, scan: Scan, key: Array) -> tuple[SparseState, Info]:
        size = scan.tag.shape[0]
        if size > self.active:
            raise InvalidField(
                "active",
                f"expected a number >= {size}, the measurement slots of a scan, got {self.active}",
                owner="Seif",
            )
        # Means are recovered before they are linearized at, so that Jacobians are up to date.
        state = recover_passive_means(state, self.recovered)
        association = associate_by_index(state.alive, scan)
        state, index = _sparsify_and_activate(self, state, association)
        state, omega, innovations, solved = _correct_active(
            self, state, scan, index, association.matched
        )
        state = repeat_recovery(state, omega, solved, self.recovered, self.sweeps)
        wanted = association.new & association.has_slot & solved
        state, omega, initialized = _initialize_active(
            self, state, omega, scan, association.slot, index, wanted
        )
        state = _finish_scan(state, scan, index, association.has_slot, omega, solved)
        return state, canonical.report(scan, association, innovations, initialized)

    def estimate(self, state: SparseState) -> Estimate:
        marginals = whole_marginals if self.exact_marginals else blanket_marginals
        pose_cov, point_covs = marginals(state)
        unit = jnp.eye(2, dtype=point_covs.dtype)[None]
        alive = state.alive
        return Estimate(
            pose=state.pose,
            pose_cov=pose_cov,
            points=jnp.where(alive[:, None], state.landmarks, 0.0),
            point_covs=jnp.where(alive[:, None, None], point_covs, unit),
            alive=alive,
            tag=jnp.where(alive, jnp.arange(self.capacity), -1).astype(jnp.int32),
        )


def _sparsify_and_activate(
    filter: Seif, state: SparseState, association: TagAssociation
) -> tuple[SparseState, Int[Array, "M"]]:
    """The state with all measured landmarks active, and their indices in the active set.

    Empty indices are assigned first, then those of the least recently measured landmarks, which
    are sparsified and become passive.
    """
    matches = active_matches(state, association)
    enters = association.has_slot & ~matches.any(axis=1)
    empty = state.active >= filter.capacity
    # A measured landmark never leaves; an empty index comes before all.
    order = jnp.where(matches.any(axis=0), jnp.iinfo(jnp.int32).max, state.last_measured)
    order = jnp.where(empty, -1, order)
    index, assigned = assign_indices(order, jnp.cumsum(enters) - 1, enters, matches)
    leaving, most = assigned & ~empty, min(matches.shape)
    # In this order Ω stays positive definite. The cut replaces Ω by the information of
    # p(m) p(x | m+), a density whatever links there are to passive landmarks (`sparsify`). It comes
    # first: the lists have no entry for a link to the robot, so that deactivation would lose that
    # link without a change of the diagonal blocks. Deactivation then moves blocks to the lists,
    # where only `drop_link` changes Ω; it frees the indices to which activation moves the blocks
    # of the landmarks that enter.
    state = cut_robot_links(state, leaving)
    state = deactivate(state, leaving, most, filter.conservative)
    return activate(state, index, association.slot, enters), index


def _correct_active(
    filter: Seif,
    state: SparseState,
    scan: Scan,
    index: Int[Array, "M"],
    matched: Bool[Array, "M"],
) -> tuple[SparseState, Float[Array, "D D"], CanonicalInnovations, Bool[Array, ""]]:
    """The state with its mean corrected by measurements of active landmarks, Ω after them, their
    innovations, and whether the mean could be solved for."""
    innovations = tag_innovation.innovations(
        filter, state.omega, state.pose, active_means(state), scan, index, matched
    )
    omega, residual = canonical.measurement_update(state.omega, active_residual(state), innovations)
    state, solved = recover_active_means(state, omega, residual, innovations.omega_positive)
    return state, omega, tag_innovation.refuse_unless(solved, innovations), solved


def _initialize_active(
    filter: Seif,
    state: SparseState,
    omega: Float[Array, "D D"],
    scan: Scan,
    slot: Int[Array, "M"],
    index: Int[Array, "M"],
    wanted: Bool[Array, "M"],
) -> tuple[SparseState, Float[Array, "D D"], Bool[Array, "M"]]:
    """The state with new landmarks in their slots where wanted, Ω with them, and the mask of those
    initialized."""
    omega, landmarks, initialized = canonical.initialize_landmarks(
        filter.sensor, omega, state.pose, scan.z, index, wanted
    )
    into = jnp.where(initialized, slot, state.alive.shape[0])  # beyond the end: dropped
    state = state._replace(
        landmarks=state.landmarks.at[into].set(landmarks, mode="drop"),
        alive=state.alive.at[into].set(True, mode="drop"),
    )
    return state, omega, initialized


def _finish_scan(
    state: SparseState,
    scan: Scan,
    index: Int[Array, "M"],
    has_slot: Bool[Array, "M"],
    omega: Float[Array, "D D"],
    solved: Bool[Array, ""],
) -> SparseState:
    """The state with Ω of the active block, with diagonal loading if not solved; one more scan.

    index: index of each measured landmark in the active set.
    """
    at = jnp.where(has_slot, index, state.active.shape[0])
    refused = state.counts.refused + (scan.valid.any() & ~solved).astype(jnp.int32)
    return state._replace(
        omega=jnp.where(solved, omega, canonical.diagonal_loading(state.omega)),
        last_measured=state.last_measured.at[at].set(state.scans + 1, mode="drop"),
        scans=state.scans + 1,
        counts=state.counts._replace(refused=refused),
    )
