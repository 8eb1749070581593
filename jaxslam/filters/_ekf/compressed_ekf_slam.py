"""Compressed EKF-SLAM: updates of a local area, with those of the rest of the map postponed."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.association._rules import Known
from jaxslam.core import slots
from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Sensor, Wrapper
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField, at_least, instance_of
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import where_any
from jaxslam.sensors._suite import Suite

_NONE = -2
"""The tag of slots without a landmark: not -1, the tag of a measurement of unknown identity."""


class _Compressed(NamedTuple):
    """A map, its active area, and the postponed update of the landmarks outside the area.

    With A the errors of the robot and the K landmarks of the area, B those of all others, and
    index 0 for the time at which the area was opened, the map is now (Guivant & Nebot 2001)

        P_AB = Φ P_AB,0,   P_BB = P_BB,0 - P_BA,0 Ψ P_AB,0,   x_B = x_B,0 + P_BA,0 θ.

    A motion does Φ ← F Φ. A correction with V = L⁻¹ H P_AA and U = L⁻¹ H Φ does P_AA ← P_AA - VᵀV,
    Φ ← Φ - VᵀU, Ψ ← Ψ + UᵀU, θ ← θ + Uᵀ L⁻¹ ν: so [P_AA Φ; Φᵀ -Ψ] behaves as the covariance of
    a robot, K landmarks and 3 + K·L further variables with mean θ, and any filter on a `Joint`
    treats them as landmarks that are never measured.
    """

    full: Joint
    """the full map as it was when the area was opened, with the current tags and alive slots"""
    area: Joint
    """robot, K landmarks, and slots for Φ, Ψ and θ"""
    slot: jax.Array
    """(K,) the slots of the map in the area, ascending"""


@record
class CompressedEkfSlam(Wrapper):
    """EKF-SLAM with the same results, at a cost a step that depends on the area, not on the map.

    A step costs O(K²) for K = area landmarks. Only when a scan measures a landmark outside the area
    is the whole map updated, O(K·N²), and a new area chosen: the landmarks of the scan, room
    for new ones, and the landmarks nearest to the robot. J. E. Guivant, E. M. Nebot, "Optimization
    of the simultaneous localization and map-building algorithm for real-time implementation", IEEE
    T-RA 17(3), 2001. Landmarks are associated by their tags.

    The state is a `_Compressed`. `estimate` gives the moments of all landmarks, O(K²·N); moments
    that are not used cost nothing under `jit`. `up_to_date` gives the whole map as a `Joint`, and
    `open_area` makes a state of one.

    Raises ValueError on an area below 1 or an `EkfSlam` that is not as here; and, when a scan has
    more measurement slots than the area, from `update`.
    """

    filter: EkfSlam = field(check=instance_of(EkfSlam))
    """in the Euclidean chart, of one sensor of landmarks, with a linearizer without memory
    (AtEstimate, Unscented), associating by tags, without a life and the covariance
    "square_root\""""
    area: int = static(check=at_least(1))
    """number K of landmarks in the area; at least the measurement slots of a scan"""
    square_root = False
    landmark = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        filter, sensor = self.filter, self.filter.sensor
        joint = jax.eval_shape(filter.init, jnp.zeros(3), jnp.eye(3))
        for feature, is_unfit in {
            "a life": filter.life is not None,
            "an association other than by tags": not isinstance(filter.associate, Known),
            'the covariance "square_root"': filter.square_root,
            "a suite": isinstance(sensor, Suite),
            f"the sensor {sensor.name}, whose landmarks are converted to points,": (
                sensor.reduced is not None
            ),
            f"the sensor {sensor.name}, which has no landmarks,": not sensor.landmark,
            f"the chart {filter.chart.name}, in which a motion changes the covariance of every "
            "landmark,": filter.chart.basis is not None,
            f"the linearizer {filter.linearize.name}, which keeps former estimates,": bool(
                jax.tree.leaves(joint.lin)
            ),
        }.items():
            if is_unfit:
                raise InvalidField("filter", f"{feature} is not supported")

    @property
    def name(self) -> str:  # type: ignore[override]
        return "compressed_ekf_slam"

    def init(self, pose: jax.Array, pose_cov: jax.Array) -> _Compressed:
        return open_area(self.filter.init(pose, pose_cov), self.area)

    def predict(self, state: _Compressed, u: jax.Array, key: jax.Array) -> _Compressed:
        return state._replace(area=self._local.predict(state.area, u, key))

    def update(self, state: _Compressed, scan: Scan, key: jax.Array) -> tuple[_Compressed, Info]:
        if len(scan.tag) > self.area:
            reason = f"expected at least {len(scan.tag)}, as a scan has slots, got {self.area}"
            raise InvalidField("area", reason, owner="CompressedEkfSlam")
        state = _with_area_of(scan, state, self.filter.sensor, self.filter.births)
        area, info = self._local.update(state.area, scan, key)
        # Slots of the area into slots of the map.
        in_map = jnp.where(info.slot >= 0, state.slot[jnp.maximum(info.slot, 0)], -1)
        joint, count = state.full, state.slot.shape[0]
        joint = joint._replace(
            alive=joint.alive.at[state.slot].set(area.alive[:count]),
            tag=joint.tag.at[state.slot].set(area.tag[:count]),
        )
        return state._replace(full=joint, area=area), info._replace(slot=in_map)

    def estimate(self, state: _Compressed) -> Estimate:
        def estimate_landmark(
            landmark: jax.Array,
            alive: jax.Array,
            tag: jax.Array,
            landmark_cov: jax.Array,
            with_robot: jax.Array,
        ) -> Estimate:
            cov = jnp.block([[robot, with_robot], [with_robot.T, landmark_cov]])
            # A map of this one landmark: an estimate needs no covariance of two landmarks.
            place = state.area.pose, landmark[None], cov, alive[None], tag[None]
            return self.filter.estimate(Joint(*place, ()))

        robot, joint = state.area.cov[:3, :3], state.full
        landmarks = jax.vmap(estimate_landmark)(
            _move_map(state), joint.alive, joint.tag, *_marginals(state)
        )
        return Estimate(
            pose=state.area.pose,
            pose_cov=robot,
            points=landmarks.points[:, 0],
            point_covs=landmarks.point_covs[:, 0],
            alive=joint.alive,
            tag=joint.tag,
        )

    @property
    def _local(self) -> EkfSlam:
        """The filter of the area, with slots for the postponed update."""
        count = min(self.area, self.filter.capacity)
        # A capacity is a shape, so the filter of the area is another record with the same models.
        postponed = _postponed_slots(count, len(self.filter.sensor.landmark))
        return dataclasses.replace(self.filter, capacity=count + postponed)


def open_area(joint: Joint, area: int) -> _Compressed:
    """A state of `CompressedEkfSlam` of a map, the area (min(area, N)) at its first slots."""
    return _open_at(joint, jnp.arange(min(area, joint.landmarks.shape[0]), dtype=jnp.int32))


def up_to_date(state: _Compressed) -> Joint:
    """The map with the postponed update applied, O(K·N²)."""
    joint = state.full
    index = _rows(state.slot, joint.landmarks.shape[1])
    rows_0 = joint.cov[index]  # of A, [P_AA,0 P_AB,0] in the order of the map
    phi, psi, _ = _postponed_update(state)
    # P_BB; the rows and columns of A that this touches too are overwritten below, P_AB by Φ P_AB,0.
    cov = joint.cov - linalg.symmetrize(rows_0.T @ (psi @ rows_0))
    rows = (phi @ rows_0).at[:, index].set(state.area.cov[: len(index), : len(index)])
    return joint._replace(
        pose=state.area.pose,
        landmarks=_move_map(state),
        cov=cov.at[index].set(rows).at[:, index].set(rows.T),
    )


def _with_area_of(
    scan: Scan, state: _Compressed, sensor: Sensor, births: int | None
) -> _Compressed:
    """The state with an area that holds the landmarks of a scan: the same, or another one."""
    joint, count = state.full, state.slot.shape[0]
    tagged = scan.valid & (scan.tag >= 0)
    slot, in_map = slots.find(joint.tag, joint.alive, scan.tag)
    seen = jnp.zeros(joint.alive.shape, bool).at[slot].max(tagged & in_map)
    # Counts repeated tags twice, and so may open an area too early, never too late.
    new = jnp.minimum((tagged & ~in_map).sum(), scan.tag.shape[0] if births is None else births)
    free_in_area, free_in_map = (~state.area.alive).sum(), (~joint.alive).sum()
    outside = seen & ~jnp.zeros(joint.alive.shape, bool).at[state.slot].set(True)
    # Another area helps new landmarks only if the map has more free slots than this one.
    must_move = outside.any() | ((new > free_in_area) & (free_in_map > free_in_area))

    def reopen(state: _Compressed) -> _Compressed:
        joint = up_to_date(state)
        # The result of a run must not depend on other runs of the batch.
        opened = _open_at(joint, _choose_area(joint, count, sensor, seen, new))
        chosen: _Compressed = jax.tree.map(lambda a, b: jnp.where(must_move, a, b), opened, state)
        return chosen

    after: _Compressed = where_any(must_move, reopen, lambda state: state, state)
    return after


def _move_map(state: _Compressed) -> jax.Array:
    """The current landmarks (N, L)."""
    landmarks, count = state.full.landmarks, state.slot.shape[0]
    theta = _postponed_update(state)[2]
    # P_BA,0 θ for all landmarks, O(K·N); those of the area are set to its own.
    change = (theta @ state.full.cov[_rows(state.slot, landmarks.shape[1])])[3:]
    landmarks = landmarks + change.reshape(landmarks.shape)
    return landmarks.at[state.slot].set(state.area.landmarks[:count])


def _marginals(state: _Compressed) -> tuple[jax.Array, jax.Array]:
    """The current P of each landmark with itself (N, L, L) and of the robot with it (N, 3, L)."""
    capacity, size_l = state.full.landmarks.shape
    count, index = state.slot.shape[0], _rows(state.slot, size_l)

    def by_landmark(rows: jax.Array) -> jax.Array:
        """The columns of the landmarks, (N, rows, L)."""
        return rows[:, 3:].reshape(len(rows), -1, size_l).transpose(1, 0, 2)

    def own_blocks(cov: jax.Array, count: int) -> jax.Array:
        k = jnp.arange(count)
        # Landmarks by number and entry, (count, L, count, L): the diagonal blocks.
        return cov[3:, 3:].reshape(count, size_l, count, size_l)[k, :, k]

    phi, psi, _ = _postponed_update(state)
    rows_0, area_cov = state.full.cov[index], state.area.cov[: len(index), : len(index)]
    # The diagonal blocks of P_BA,0 Ψ P_AB,0 alone, O(K²·N).
    decrease = jnp.einsum("nal,nak->nlk", by_landmark(rows_0), by_landmark(psi @ rows_0))
    landmark_covs = own_blocks(state.full.cov, capacity) - decrease
    with_robot = by_landmark(phi[:3] @ rows_0)
    return (
        landmark_covs.at[state.slot].set(own_blocks(area_cov, count)),
        with_robot.at[state.slot].set(by_landmark(area_cov[:3])),
    )


def _postponed_update(state: _Compressed) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The postponed update Φ, Ψ (W, W) and θ (W,), W = 3 + K·L, out of the area's [P Φ; Φᵀ -Ψ]."""
    area, count = state.area, state.slot.shape[0]
    width = 3 + count * area.landmarks.shape[1]
    # The last of the postponed slots may be used in part.
    theta = area.landmarks[count:].reshape(-1)[:width]
    phi = area.cov[:width, width : 2 * width]
    psi = -area.cov[width : 2 * width, width : 2 * width]
    return phi, psi, theta


def _open_at(joint: Joint, slot: jax.Array) -> _Compressed:
    """The state with nothing postponed and the landmarks of slots (K,) as its area."""
    count, size_l = slot.shape[0], joint.landmarks.shape[1]
    index, postponed = _rows(slot, size_l), _postponed_slots(count, size_l)
    area_cov = joint.cov[index][:, index]
    # Φ = 1, Ψ = 0, θ = 0; Φ of a dead slot is 0, since a landmark that starts there adds to zeros.
    living = jnp.concatenate([jnp.ones(3, bool), jnp.repeat(joint.alive[slot], size_l)])
    phi = jnp.diag(living.astype(area_cov.dtype))
    blocks = jnp.block([[area_cov, phi], [phi, 0 * phi]])
    cov = jnp.zeros((len(index) + postponed * size_l,) * 2, area_cov.dtype)
    cov = cov.at[: len(blocks), : len(blocks)].set(blocks)
    theta = jnp.zeros((postponed, size_l), area_cov.dtype)
    area = Joint(
        pose=joint.pose,
        landmarks=jnp.concatenate([joint.landmarks[slot], theta]),
        cov=cov,
        # Alive, so that no new landmark takes these slots; without a tag that a scan can have.
        alive=jnp.concatenate([joint.alive[slot], jnp.ones(postponed, bool)]),
        tag=jnp.concatenate([joint.tag[slot], jnp.full(postponed, _NONE, joint.tag.dtype)]),
        lin=joint.lin,
    )
    return _Compressed(joint, area, slot)


def _choose_area(
    joint: Joint, count: int, sensor: Sensor, seen: jax.Array, new: jax.Array
) -> jax.Array:
    """The slots (K,) of a new area, ascending: those seen, free ones, the nearest to the pose."""
    points = jax.vmap(sensor.position)(joint.landmarks)
    distance = ((points - joint.pose[None, :2]) ** 2).sum(axis=1)
    # A quarter of the area is reserved for new landmarks, each of which would need a new area.
    is_reserve = jnp.cumsum(~joint.alive) <= jnp.maximum(new, count // 4)
    # Free slots in the order in which the whole map would fill them; more of them than the reserve
    # only where the map has too few landmarks for the area.
    rank = jnp.select([seen, ~joint.alive & is_reserve, joint.alive], [0, 1, 2], 3)
    distance = jnp.where(joint.alive, distance, 0.0)
    # By rank, then distance (the last key is the first); ascending, as `slots.allocate` takes them,
    # so that a new landmark gets the slot that it would get in the whole map.
    return jnp.sort(jnp.lexsort((distance, rank))[:count]).astype(jnp.int32)


def _rows(slot: jax.Array, size_l: int) -> jax.Array:
    """The rows of P of the robot and of the landmarks in slots (K,), (3 + K·L,)."""
    of_landmarks = 3 + slot[:, None] * size_l + jnp.arange(size_l)[None, :]
    return jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1)])


def _postponed_slots(count: int, size_l: int) -> int:
    """The number of landmark slots (L each) that hold Φ's 3 + count·L variables, rounded up."""
    return -(-(3 + count * size_l) // size_l)
