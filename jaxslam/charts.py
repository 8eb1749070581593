"""Charts: error coordinates of the covariance.

Of the Euclidean error, differences of coordinates; of the left-invariant one, in the robot's frame,
whose filter is known to be inconsistent; and of the right-invariant one, in which a rotation of
robot and map is one constant direction.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxslam.core._names import Named
from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Basis, Chart
from jaxslam.core.validation import InvalidField
from jaxslam.math import se2
from jaxslam.math._arrays import Landmark, Pose, Robot
from jaxslam.math.angles import wrap

__all__ = ["REGISTRY", "Euclidean", "LeftInvariant", "RightInvariant", "with_further"]


@record
class Euclidean(Chart):
    """The chart of plain differences, dx = x - x₀ (θ wrapped), dl = l - l₀: Solà's error (22)."""

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        return _wrap_heading(pose + dx), landmark + dl

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        return _wrap_heading(pose - pose0), landmark - landmark0


def _wrap_heading(pose: Pose) -> Array:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])


@record
class _WithFurther(Chart):
    """The chart of a robot (3 + E,): another chart for its pose, differences for the rest."""

    chart: Chart = field()
    turns: tuple[bool, ...] = static()
    """(E,) which of the further numbers are angles"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.chart.name

    @property
    def landmark_size(self) -> int | None:  # type: ignore[override]
        return self.chart.landmark_size

    @property
    def basis(self) -> Callable[[Array, Array], Basis] | None:
        return None if self.chart.basis is None else self._basis

    def retract(
        self, pose: Robot, landmark: Landmark, dx: Robot, dl: Landmark
    ) -> tuple[Robot, Landmark]:
        moved, landmark = self.chart.retract(pose[:3], landmark, dx[:3], dl)
        return jnp.concatenate([moved, self._wrapped(pose[3:] + dx[3:])]), landmark

    def local(
        self, pose0: Robot, landmark0: Landmark, pose: Robot, landmark: Landmark
    ) -> tuple[Robot, Landmark]:
        dx, dl = self.chart.local(pose0[:3], landmark0, pose[:3], landmark)
        return jnp.concatenate([dx, self._wrapped(pose[3:] - pose0[3:])]), dl

    def _wrapped(self, further: Array) -> Array:
        return jnp.where(np.array(self.turns), wrap(further), further)

    def _basis(self, pose: Robot, landmark: Landmark) -> Basis:
        basis: Basis = self.chart.basis(pose[:3], landmark)
        e = len(self.turns)
        of_pose = jnp.eye(3 + e, dtype=pose.dtype).at[:3, :3].set(basis.pose)
        return Basis(of_pose, jnp.pad(basis.cross, [(0, 0), (0, e)]), basis.landmark)


def with_further(chart: Chart, state: tuple[str, ...]) -> Chart:
    """The chart of a robot with these numbers (`Motion.state`); the same where it is a pose.

    The errors of the further numbers are differences, wrapped where they are in [rad].
    """
    turns = tuple(name.endswith("[rad]") for name in state[3:])
    return _WithFurther(chart, turns) if turns else chart


@record
class LeftInvariant(Chart):
    """The left-invariant chart: (R, t, l) ← (R, t, l)·exp(ξ), ξ in the Lie algebra of SE_{1+N}(2).

    With dx = (ρ, φ): θ ← θ + φ, t ← t + R V(φ) ρ, l ← l + R V(φ) dl, V as in `se2.exp`. The errors
    of robot and landmarks are in the estimated robot's frame, so a correction of its heading
    rotates them all; the unobservable directions depend on the estimate, as in the standard
    EKF. UKF-M (Brossard et al. 2020) shows that this choice is worse. Landmarks l = (x, y) only.
    """

    landmark_size = 2

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        shift = se2.exp(jnp.concatenate([dl, dx[2:]]))[:2]
        return se2.boxplus(pose, dx), landmark + se2.rotation(pose[2]) @ shift

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        shift = se2.rotation(pose0[2]).T @ (landmark - landmark0)
        turn = wrap(pose[2:] - pose0[2:])
        return se2.boxminus(pose, pose0), se2.log(jnp.concatenate([shift, turn]))[:2]

    def basis(self, pose: Pose, landmark: Landmark) -> Basis:
        turn = se2.rotation(pose[2])
        return Basis(
            pose=jnp.eye(3, dtype=pose.dtype).at[:2, :2].set(turn),
            cross=jnp.zeros((2, 3), pose.dtype),
            landmark=turn,
        )


@record
class RightInvariant(Chart):
    """The right-invariant chart: (R, t, l) ← exp(ξ)·(R, t, l), ξ in the Lie algebra of SE_{1+N}(2).

    With dx = (ρ, φ): θ ← θ + φ, t ← R(φ)t + V(φ)ρ, l ← R(φ)l + V(φ)dl, V as in `se2.exp`. A turn φ
    of the whole map about the origin leaves ρ and dl at zero, so the unobservable directions do not
    depend on the estimate, and the filter cannot gain information along them (Barrau & Bonnabel
    2015, arXiv:1510.06263; Zhang et al. 2017). For point landmarks l = (x, y), or rays.

    Raises ValueError where `retract` gets a landmark of another size.
    """

    rays: bool = static(default=False)
    """for l = (x0, y0, α, ρ), as of `sensors.BearingInverseDepth`: (x0, y0) changes as a point
    does, the direction rotates with the map, α ← α + φ + dα, and ρ ← ρ + dρ"""

    @property
    def landmark_size(self) -> int:  # type: ignore[override]
        return 4 if self.rays else 2

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        if landmark.shape != (self.landmark_size,):
            reason = f"expected shape ({self.landmark_size},), got {landmark.shape}"
            raise InvalidField("landmark", reason, owner=f"RightInvariant(rays={self.rays})")
        moved = se2.exp(dx)
        shift = se2.exp(jnp.concatenate([dl[:2], dx[2:]]))
        point = se2.from_frame(shift, landmark[:2])
        if self.rays:
            turned = wrap(landmark[2:3] + dx[2:] + dl[2:3])
            point = jnp.concatenate([point, turned, landmark[3:] + dl[3:]])
        return se2.compose(moved, pose), point

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        turn = wrap(pose[2:] - pose0[2:])
        moved = se2.log(se2.compose(pose, se2.inverse(pose0)))
        offset = landmark[:2] - se2.rotation(turn[0]) @ landmark0[:2]
        error = se2.log(jnp.concatenate([offset, turn]))[:2]
        if self.rays:
            turned = wrap(landmark[2:3] - landmark0[2:3] - turn)
            error = jnp.concatenate([error, turned, landmark[3:] - landmark0[3:]])
        return moved, error

    def basis(self, pose: Pose, landmark: Landmark) -> Basis:
        eye = jnp.eye(3, dtype=pose.dtype)
        cross = jnp.zeros((self.landmark_size, 3), pose.dtype)
        cross = cross.at[0, 2].set(-landmark[1]).at[1, 2].set(landmark[0])
        return Basis(
            pose=eye.at[0, 2].set(-pose[1]).at[1, 2].set(pose[0]),
            cross=cross.at[2, 2].set(1.0) if self.rays else cross,
            landmark=None,
        )


REGISTRY: dict[str, type[Chart]] = Named(
    {
        "euclidean": Euclidean,
        "left_invariant": LeftInvariant,
        "right_invariant": RightInvariant,
    }
)
