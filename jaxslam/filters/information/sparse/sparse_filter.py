"""The common parts of `seif` and `eseif`: prediction, estimate, and the steps of a scan."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information import canonical, innovation
from jaxslam.filters.information.innovation import CanonicalInnovations
from jaxslam.filters.information.settings import SparseSettings
from jaxslam.filters.information.sparse.marginals import blanket_marginals, whole_marginals
from jaxslam.filters.information.sparse.mean_recovery import recover_active_means
from jaxslam.filters.information.sparse.sparse_state import (
    SparseState,
    active_means,
    active_residual,
    empty_map,
    with_active_residual,
)
from jaxslam.protocols import Filter
from jaxslam.types import Estimate, Info, Scan

Update = Callable[[SparseState, Scan, Array], tuple[SparseState, Info]]


def sparse_filter(settings: SparseSettings, update: Update) -> Filter:
    """The `Filter` with this update of a `SparseState`."""

    def init(pose: Array, pose_cov: Array) -> SparseState:
        information = canonical.initial_information(pose_cov, settings.floor).astype(pose.dtype)
        return empty_map(pose, information, settings.capacity, settings.active_size, settings.links)

    def predict(state: SparseState, u: Array, key: Array) -> SparseState:
        pose, omega, residual = canonical.motion_update(
            settings.motion, state.pose, u, state.omega, active_residual(state)
        )
        return with_active_residual(state._replace(pose=pose, omega=omega), residual)

    def estimate(state: SparseState) -> Estimate:
        marginals = whole_marginals if settings.whole else blanket_marginals
        pose_cov, point_covs = marginals(state)
        unit = jnp.eye(2, dtype=point_covs.dtype)[None]
        alive = state.alive
        return Estimate(
            pose=state.pose,
            pose_cov=pose_cov,
            points=jnp.where(alive[:, None], state.landmarks, 0.0),
            point_covs=jnp.where(alive[:, None, None], point_covs, unit),
            alive=alive,
            tag=jnp.where(alive, jnp.arange(settings.capacity), -1).astype(jnp.int32),
        )

    return canonical.information_filter(settings, init, predict, update, estimate)


def check_scan_size(settings: SparseSettings, scan: Scan) -> None:
    """Raise ValueError unless all landmarks of a scan can be active at once."""
    size = scan.tag.shape[0]
    if size > settings.active:
        raise ValueError(
            f"{settings.name}: expected active >= {size}, the measurement slots of a scan, got "
            f"{settings.active}"
        )


def correct_active(
    settings: SparseSettings,
    state: SparseState,
    scan: Scan,
    index: Int[Array, "M"],
    known: Bool[Array, "M"],
) -> tuple[SparseState, Float[Array, "D D"], CanonicalInnovations, Bool[Array, ""]]:
    """The state with its mean corrected by measurements of active landmarks, Ω after them, their
    innovations, and whether the mean could be solved for."""
    found = innovation.innovations(
        settings, state.omega, state.pose, active_means(state), scan, index, known
    )
    omega, residual = canonical.measurement_update(state.omega, active_residual(state), found)
    state, solved = recover_active_means(state, omega, residual, found.omega_positive)
    return state, omega, innovation.refuse_unless(solved, found), solved


def initialize_active(
    settings: SparseSettings,
    state: SparseState,
    omega: Float[Array, "D D"],
    scan: Scan,
    slot: Int[Array, "M"],
    index: Int[Array, "M"],
    wanted: Bool[Array, "M"],
) -> tuple[SparseState, Float[Array, "D D"], Bool[Array, "M"]]:
    """The state with new landmarks in their slots where wanted, Ω with them, and which were
    started."""
    omega, landmarks, initialized = canonical.initialize_landmarks(
        settings.sensor, omega, state.pose, scan.z, index, wanted
    )
    into = jnp.where(initialized, slot, state.alive.shape[0])
    state = state._replace(
        landmarks=state.landmarks.at[into].set(landmarks, mode="drop"),
        alive=state.alive.at[into].set(True, mode="drop"),
    )
    return state, omega, initialized


def finish_scan(
    state: SparseState,
    scan: Scan,
    index: Int[Array, "M"],
    active: Bool[Array, "M"],
    omega: Float[Array, "D D"],
    solved: Bool[Array, ""],
) -> SparseState:
    """The state with Ω of the active block, with diagonal loading if not solved; one more scan.

    index, active: of the measured landmarks, which of them are active, and where.
    """
    at = jnp.where(active, index, state.active.shape[0])
    refused = state.counts.refused + (scan.valid.any() & ~solved)
    return state._replace(
        omega=jnp.where(solved, omega, canonical.diagonal_loading(state.omega)),
        last_measured=state.last_measured.at[at].set(state.scans + 1, mode="drop"),
        scans=state.scans + 1,
        counts=state.counts._replace(refused=refused),
    )
