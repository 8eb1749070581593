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

# The tag of slots without a landmark: not -1, the tag of a measurement of unknown identity.
_NONE = -2


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
        area = min(self.area, self.filter.capacity)
        # A capacity is a shape, so the filter of the area is another record with the same models.
        spare = _postponed_slots(area, len(self.filter.sensor.landmark))
        return dataclasses.replace(self.filter, capacity=area + spare)


def open_area(joint: Joint, area: int) -> _Compressed:
    """A state of `CompressedEkfSlam` of a map, the area (min(area, N)) at its first slots."""
    return _open_at(joint, jnp.arange(min(area, joint.landmarks.shape[0]), dtype=jnp.int32))


def up_to_date(state: _Compressed) -> Joint:
    """The map with the postponed update applied, O(K·N²)."""
    joint = state.full
    at = _rows(state.slot, joint.landmarks.shape[1])
    before = joint.cov[at]
    phi, psi, _ = _postponed_update(state)
    # P_BB; the rows and columns of A that this touches too are overwritten below, P_AB by Φ P_AB,0.
    cov = joint.cov - linalg.symmetrize(before.T @ (psi @ before))
    now = (phi @ before).at[:, at].set(state.area.cov[: len(at), : len(at)])
    return joint._replace(
        pose=state.area.pose,
        landmarks=_move_map(state),
        cov=cov.at[at].set(now).at[:, at].set(now.T),
    )


def _with_area_of(scan: Scan, state: _Compressed, sensor: Sensor, most: int | None) -> _Compressed:
    """The state with an area that holds the landmarks of a scan: the same, or another one.

    most: new landmarks a scan.
    """
    joint, area = state.full, state.slot.shape[0]
    tagged = scan.valid & (scan.tag >= 0)
    slot, in_map = slots.find(joint.tag, joint.alive, scan.tag)
    seen = jnp.zeros(joint.alive.shape, bool).at[slot].max(tagged & in_map)
    # Counts repeated tags twice, and so may open an area too early, never too late.
    new = jnp.minimum((tagged & ~in_map).sum(), scan.tag.shape[0] if most is None else most)
    room, room_anywhere = (~state.area.alive).sum(), (~joint.alive).sum()
    outside = seen & ~jnp.zeros(joint.alive.shape, bool).at[state.slot].set(True)
    # Another area helps new landmarks only if the map has more room than this one.
    leave = outside.any() | ((new > room) & (room_anywhere > room))

    def reopen(state: _Compressed) -> _Compressed:
        joint = up_to_date(state)
        # The result of a run must not depend on other runs of the batch.
        opened = _open_at(joint, _choose_area(joint, area, sensor, seen, new))
        chosen: _Compressed = jax.tree.map(lambda a, b: jnp.where(leave, a, b), opened, state)
        return chosen

    after: _Compressed = where_any(leave, reopen, lambda state: state, state)
    return after


def _move_map(state: _Compressed) -> jax.Array:
    """The current landmarks (N, L)."""
    landmarks, area = state.full.landmarks, state.slot.shape[0]
    theta = _postponed_update(state)[2]
    # P_BA,0 θ for all landmarks, O(K·N); those of the area are set to its own.
    moved = (theta @ state.full.cov[_rows(state.slot, landmarks.shape[1])])[3:]
    return (
        (landmarks + moved.reshape(landmarks.shape)).at[state.slot].set(state.area.landmarks[:area])
    )


def _marginals(state: _Compressed) -> tuple[jax.Array, jax.Array]:
    """The current P of each landmark with itself (N, L, L) and with the robot (N, 3, L)."""
    capacity, size = state.full.landmarks.shape
    area, at = state.slot.shape[0], _rows(state.slot, size)

    def by_landmark(rows: jax.Array) -> jax.Array:
        return rows[:, 3:].reshape(len(rows), -1, size).transpose(1, 0, 2)

    def with_itself(cov: jax.Array, count: int) -> jax.Array:
        k = jnp.arange(count)
        # Landmarks by number and entry, (count, L, count, L): the diagonal blocks.
        return cov[3:, 3:].reshape(count, size, count, size)[k, :, k]

    phi, psi, _ = _postponed_update(state)
    before, inside = state.full.cov[at], state.area.cov[: len(at), : len(at)]
    # The diagonal blocks of P_BA,0 Ψ P_AB,0 alone, O(K²·N).
    lost = jnp.einsum("nal,nak->nlk", by_landmark(before), by_landmark(psi @ before))
    alone = with_itself(state.full.cov, capacity) - lost
    with_robot = by_landmark(phi[:3] @ before)
    return (
        alone.at[state.slot].set(with_itself(inside, area)),
        with_robot.at[state.slot].set(by_landmark(inside[:3])),
    )


def _postponed_update(state: _Compressed) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The postponed update Φ, Ψ (W, W) and θ (W,), W = 3 + K·L."""
    area, count = state.area, state.slot.shape[0]
    width = 3 + count * area.landmarks.shape[1]
    # The last of the spare slots may be used in part.
    theta = area.landmarks[count:].reshape(-1)[:width]
    return (
        area.cov[:width, width : 2 * width],
        -area.cov[width : 2 * width, width : 2 * width],
        theta,
    )


def _open_at(joint: Joint, slot: jax.Array) -> _Compressed:
    """The state with nothing postponed and the landmarks of slots (K,) as its area."""
    count, size = slot.shape[0], joint.landmarks.shape[1]
    at, spare = _rows(slot, size), _postponed_slots(count, size)
    inside = joint.cov[at][:, at]
    # Φ = 1, Ψ = 0, θ = 0; Φ of a dead slot is 0, since a landmark that starts there adds to zeros.
    living = jnp.concatenate([jnp.ones(3, bool), jnp.repeat(joint.alive[slot], size)])
    phi = jnp.diag(living.astype(inside.dtype))
    cov = jnp.zeros((len(at) + spare * size,) * 2, inside.dtype)
    cov = cov.at[: 2 * len(at), : 2 * len(at)].set(jnp.block([[inside, phi], [phi, 0 * phi]]))
    area = Joint(
        pose=joint.pose,
        landmarks=jnp.concatenate([joint.landmarks[slot], jnp.zeros((spare, size), inside.dtype)]),
        cov=cov,
        # Alive, so that no new landmark takes these slots; without a tag that a scan can have.
        alive=jnp.concatenate([joint.alive[slot], jnp.ones(spare, bool)]),
        tag=jnp.concatenate([joint.tag[slot], jnp.full(spare, _NONE, joint.tag.dtype)]),
        lin=joint.lin,
    )
    return _Compressed(joint, area, slot)


def _choose_area(
    joint: Joint, area: int, sensor: Sensor, seen: jax.Array, new: jax.Array
) -> jax.Array:
    """The slots (K,) of a new area, ascending: those seen, free ones, the nearest to the pose."""
    points = jax.vmap(sensor.position)(joint.landmarks)
    distance = ((points - joint.pose[None, :2]) ** 2).sum(axis=1)
    # A quarter of the area is reserved for new landmarks, each of which would need a new area.
    spare = jnp.cumsum(~joint.alive) <= jnp.maximum(new, area // 4)
    # Free slots in the order in which the whole map would fill them; more of them than the reserve
    # only where the map has too few landmarks for the area.
    rank = jnp.select([seen, ~joint.alive & spare, joint.alive], [0, 1, 2], 3)
    distance = jnp.where(joint.alive, distance, 0.0)
    # By rank, then distance (the last key is the first); ascending, as `slots.allocate` takes them,
    # so that a new landmark gets the slot that it would get in the whole map.
    return jnp.sort(jnp.lexsort((distance, rank))[:area]).astype(jnp.int32)


def _rows(slot: jax.Array, size: int) -> jax.Array:
    """The rows of the robot and of the landmarks in slots (K,), (3 + K·L,)."""
    of_landmarks = 3 + slot[:, None] * size + jnp.arange(size)[None, :]
    return jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1)])


def _postponed_slots(area: int, size: int) -> int:
    """The number of landmark slots that hold 3 + K·size variables."""
    return -(-(3 + area * size) // size)
