"""EIF-SLAM, the extended Kalman filter in exact canonical (information) form.

`InPieces` divides a scan for filters with room for few measurements at once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.charts import with_further
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Filter, Wrapper
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._ekf.map_coordinates import estimate_of
from jaxslam.filters._information import canonical, tag_innovation
from jaxslam.filters._information.tag_innovation import InformationFilter, associate_by_table
from jaxslam.math import _linalg as linalg
from jaxslam.sensors._suite import of_robot


class CanonicalState(NamedTuple):
    """Robot and map in canonical form; D = R + N·L, slots and padding as in `slots.Joint`."""

    pose: Float[Array, "R"]
    """with the further numbers of the robot after it, R = 3 + E"""
    landmarks: Float[Array, "N L"]
    omega: Float[Array, "D D"]
    """Ω, the inverse of the covariance; a dead slot has unit diagonal"""
    residual: Float[Array, "D"]
    """information residual ρ = ξ - Ω μ, zero after each update"""
    alive: Bool[Array, "N"]
    tag: Int[Array, "N"]
    """-1 where dead"""
    refused: Int[Array, ""]
    """number of scans refused because Ω was not positive definite"""

    @property
    def xi(self) -> Float[Array, "D"]:
        """The information vector ξ = Ω μ + ρ, with the heading wrapped."""
        mean = jnp.concatenate([self.pose, self.landmarks.reshape(-1)])
        return self.omega @ mean + self.residual


@record
class EifSlam(InformationFilter):
    """Extended information filter SLAM: `EkfSlam(correction="joint")` in canonical form.

    The steps are those of `canonical`; the mean is Ω⁻¹ ξ, solved for after each scan, O(D³). The
    results equal those of the EKF to rounding, at a higher cost; `Seif` approximates this filter.
    Measurements are associated with landmarks by their tags.

    Where rounding has made Ω indefinite (float32), the scan is refused: its measurements are
    `Status.SINGULAR`, `CanonicalState.refused` counts it, and √eps of Ω's diagonal is added to Ω,
    which may make it positive definite for the next scan.
    """

    further = True

    def init(self, pose: Array, pose_cov: Array) -> CanonicalState:
        capacity, size, n = self.capacity, len(self.sensor.landmark), len(pose)
        d = n + capacity * size
        information = canonical.initial_information(pose_cov, self.floor).astype(pose.dtype)
        return CanonicalState(
            pose=pose,
            landmarks=jnp.zeros((capacity, size), pose.dtype),
            omega=jnp.eye(d, dtype=pose.dtype).at[:n, :n].set(information),
            residual=jnp.zeros(d, pose.dtype),
            alive=jnp.zeros(capacity, bool),
            tag=jnp.full(capacity, -1, jnp.int32),
            refused=jnp.zeros((), jnp.int32),
        )

    def predict(self, state: CanonicalState, u: Array, key: Array) -> CanonicalState:
        pose, omega, residual = canonical.motion_update(
            self.motion, state.pose, u, state.omega, state.residual
        )
        return state._replace(pose=pose, omega=omega, residual=residual)

    def update(self, state: CanonicalState, scan: Scan, key: Array) -> tuple[CanonicalState, Info]:
        association = associate_by_table(state.tag, state.alive, scan)
        slot, n, names = association.slot, len(state.pose), self.motion.state
        sensor = of_robot(self.sensor, names)
        # Correct: Ω and ξ by the sum of all measurements, the mean by Ω⁻¹ ξ.
        innovations = tag_innovation.innovations(
            self, state.omega, state.pose, state.landmarks, scan, slot, association.matched
        )
        omega, residual = canonical.measurement_update(state.omega, state.residual, innovations)
        error, solved = canonical.mean_error(omega, residual, innovations.omega_positive)
        innovations = tag_innovation.refuse_unless(solved, innovations)
        turns = tuple(k for k, name in enumerate(names) if name.endswith("[rad]"))
        pose = canonical.correct_pose(state.pose, error[:n], turns)
        landmarks = state.landmarks + error[n:].reshape(state.landmarks.shape)
        landmarks = jnp.where(state.alive[:, None], landmarks, 0.0)
        # Initialize, linearized at the corrected mean.
        wanted = association.new & association.has_slot & solved
        omega, new_landmarks, initialized = canonical.initialize_landmarks(
            sensor, omega, pose, scan.z, slot, wanted
        )
        into = jnp.where(initialized, slot, self.capacity)  # beyond the end: dropped
        state = state._replace(
            pose=pose,
            landmarks=landmarks.at[into].set(new_landmarks, mode="drop"),
            omega=jnp.where(solved, omega, canonical.diagonal_loading(state.omega)),
            residual=jnp.where(solved, 0.0, state.residual),
            alive=state.alive.at[into].set(True, mode="drop"),
            tag=state.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
            refused=state.refused + (scan.valid.any() & ~solved).astype(jnp.int32),
        )
        return state, canonical.report(scan, association, innovations, initialized)

    def estimate(self, state: CanonicalState) -> Estimate:
        cov = linalg.inverse_psd(state.omega)
        joint = Joint(state.pose, state.landmarks, cov, state.alive, state.tag, ())
        chart = with_further(self.chart, self.motion.state)
        return estimate_of(joint.with_robot(state.pose), self.sensor, chart)


@record
class InPieces(Wrapper):
    """A filter applied in turn to pieces of a scan, of `size` measurement slots each.

    Slot i is in piece i mod the number of pieces. Numbers of an `Info` for the scan are summed over
    the pieces; its flags are true if they are true for any piece.
    """

    filter: Filter
    size: int = static()
    further = True

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.filter.name

    def update(self, state: PyTree, scan: Scan, key: jax.Array) -> tuple[PyTree, Info]:
        m, size = scan.tag.shape[0], self.size
        if m <= size:
            return self.filter.update(state, scan, key)
        pieces = -(-m // size)

        def deal(leaf: jax.Array) -> jax.Array:
            wide = jnp.pad(leaf, [(0, pieces * size - m), *[(0, 0)] * (leaf.ndim - 1)])
            # Slot i is in column i mod pieces of (size, pieces): the padding at the end of a scan
            # is spread over all pieces.
            return wide.reshape(size, pieces, *leaf.shape[1:]).swapaxes(0, 1)

        def update(state: PyTree, piece: tuple[Scan, jax.Array]) -> tuple[PyTree, Info]:
            return self.filter.update(state, *piece)

        scans, keys = jax.tree.map(deal, scan), jax.random.split(key, pieces)
        state, infos = jax.lax.scan(update, state, (scans, keys))

        def join(leaf: jax.Array) -> jax.Array:
            if leaf.ndim == 1:  # of a scan, not of its measurement slots
                return leaf.any() if leaf.dtype == bool else leaf.sum()
            return leaf.swapaxes(0, 1).reshape(size * pieces, *leaf.shape[2:])[:m]

        info: Info = jax.tree.map(join, infos)
        return state, info
