"""The common parts of `seif` and `eseif`: initialization, prediction, estimate, end of a scan."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information import canonical
from jaxslam.filters.information.marginals import blanket_marginals, whole_marginals
from jaxslam.filters.information.settings import SparseSettings
from jaxslam.filters.information.sparse_state import (
    SparseState,
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


def enter_landmarks(
    state: SparseState,
    slot: Int[Array, "M"],
    landmarks: Float[Array, "M 2"],
    initialized: Bool[Array, "M"],
) -> SparseState:
    """The state with new landmarks in their slots, where initialized."""
    into = jnp.where(initialized, slot, state.alive.shape[0])
    return state._replace(
        landmarks=state.landmarks.at[into].set(landmarks, mode="drop"),
        alive=state.alive.at[into].set(True, mode="drop"),
    )


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
