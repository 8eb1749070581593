"""Several controls between two scans, combined into one control."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import at_least, instance_of
from jaxslam.math._arrays import Control, ProcessNoise, Robot, StepJacobians

_Rows = tuple[Array, Array]
_Jacobians = tuple[Array, Array, Array]


@record
class Substeps(Motion):
    """The motion model of n = count steps of another model between two scans, u = (u_1, …, u_n).

    pose_k = motion.step(pose_{k-1}, u_k, w_k), from pose_0 = pose to pose_n. The noises are
    independent: noise_cov is block diagonal, block k being the model's own Q(pose_{k-1}, u_k) on
    the nominal path, w = 0. With F_k, G_k the model's derivatives by pose and by u_k (or w_k), all
    at the poses of the path with its noise,

        ∂pose_n/∂pose_0 = F_n ⋯ F_1        ∂pose_n/∂u_k = F_n ⋯ F_{k+1} G_k

    A filter linearizes the whole as one function: the mean is what n predictions give, and so is
    the covariance to first order, G Q Gᵀ = Σ_k (F_n ⋯ F_{k+1} G_k) Q_k (F_n ⋯ F_{k+1} G_k)ᵀ. The
    loop is a scan: unrolled, it compiles and, on CPU, runs several times slower.

    It has nU controls and nW noises, named after the model's with the number of the substep before
    the unit. It perturbs controls, and has hand-derived Jacobians, where the model does.
    """

    motion: Motion = field(check=instance_of(Motion))
    """the model, with U controls and W noises"""
    count: int = static(check=at_least(1))
    """n"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{self.count} x {self.motion.name}"

    @property
    def equations(self) -> str:  # type: ignore[override]
        return self.motion.equations

    @property
    def state(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.state

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return _number_names(self.motion.controls, self.count)

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return _number_names(self.motion.noises, self.count)

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        def substep(pose: Robot, row: _Rows) -> tuple[Array, None]:
            return self.motion.step(pose, *row), None

        return jax.lax.scan(substep, pose, self._rows(u, w))[0]

    def noise_cov(self, pose: Robot, u: Control) -> Array:
        size = self.count * len(self.motion.noises)

        def substep(pose: Robot, row: _Rows) -> _Rows:
            u_k, no_noise = row
            return self.motion.step(pose, u_k, no_noise), self.motion.noise_cov(pose, u_k)

        _, blocks = jax.lax.scan(substep, pose, self._rows(u, jnp.zeros(size, pose.dtype)))
        # Axes (substep, noise, substep, noise): Q_k where the substeps are the same, else zero.
        identity = jnp.eye(self.count, dtype=blocks.dtype)[:, None, :, None]
        return (identity * blocks[:, :, None, :]).reshape(size, size)

    @property
    def perturb(self) -> Callable[[Array, Array], Array] | None:
        return None if self.motion.perturb is None else self._perturb

    @property
    def jacobians(self) -> Callable[..., StepJacobians] | None:
        return None if self.motion.jacobians is None else self._jacobians

    def _rows(self, u: Control, w: ProcessNoise) -> _Rows:
        return u.reshape(self.count, -1), w.reshape(self.count, -1)

    def _perturb(self, u: Control, w: ProcessNoise) -> Control:
        perturbed: Array = jax.vmap(self.motion.perturb)(*self._rows(u, w))
        return perturbed.ravel()

    def _jacobians(self, pose: Robot, u: Control, w: ProcessNoise) -> StepJacobians:
        def forward(pose: Robot, row: _Rows) -> tuple[Array, _Jacobians]:
            return self.motion.step(pose, *row), self.motion.jacobians(pose, *row)

        def backward(after: Array, step: _Jacobians) -> tuple[Array, _Rows]:
            by_pose, by_u, by_w = step
            return after @ by_pose, (after @ by_u, after @ by_w)  # after is F_n ⋯ F_{k+1}

        _, along = jax.lax.scan(forward, pose, self._rows(u, w))
        identity = jnp.eye(len(pose), dtype=pose.dtype)
        by_pose, (by_u, by_w) = jax.lax.scan(backward, identity, along, reverse=True)
        return by_pose, jnp.concatenate(by_u, axis=1), jnp.concatenate(by_w, axis=1)


def _number_names(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Numbered names: ("v [m/s]",) twice is ("v 1 [m/s]", "v 2 [m/s]"), units last for `verify`."""
    parts = [name.partition(" [") for name in names]
    return tuple(
        f"{bare} {k + 1}{bracket}{unit}" for k in range(count) for bare, bracket, unit in parts
    )
