"""Several controls between two scans, combined into one control."""

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.math.arrays import Control, Pose, ProcessNoise, StepJacobians
from jaxslam.protocols import Motion
from jaxslam.validation.numbers import check_count

_Rows = tuple[Array, Array]
_Jacobians = tuple[Array, Array, Array]


def substeps(motion: Motion, count: int) -> Motion:
    """The motion model of n = count steps of another model between two scans, u = (u_1, …, u_n).

    pose_k = motion.step(pose_{k-1}, u_k, w_k), from pose_0 = pose to pose_n. The noises are
    independent: noise_cov is block diagonal, block k being the model's own Q(pose_{k-1}, u_k) on
    the nominal path, w = 0. With F_k, G_k the model's derivatives by pose and by u_k (or w_k), all
    at the poses of the path with its noise,

        ∂pose_n/∂pose_0 = F_n ⋯ F_1        ∂pose_n/∂u_k = F_n ⋯ F_{k+1} G_k

    A filter linearizes the whole as one function: the mean is what n predictions give, and so is
    the covariance to first order, G Q Gᵀ = Σ_k (F_n ⋯ F_{k+1} G_k) Q_k (F_n ⋯ F_{k+1} G_k)ᵀ. The
    loop is a scan: unrolled, it compiles and, on CPU, runs several times slower.

    Args:
        motion: the model, with U controls and W noises; the result has nU and nW, named after
            theirs with the number of the substep before the unit. It perturbs controls, and has
            hand-derived Jacobians, where the model does.
        count: n.
    Raises:
        ValueError: if count is not an integer >= 1.
    """
    check_count("substeps: count", count)
    size_u, size_w = len(motion.controls), len(motion.noises)

    def rows(u: Control, w: ProcessNoise) -> _Rows:
        return u.reshape(count, size_u), w.reshape(count, size_w)

    def step(pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        def one(pose: Pose, row: _Rows) -> tuple[Array, None]:
            return motion.step(pose, *row), None

        return jax.lax.scan(one, pose, rows(u, w))[0]

    def noise_cov(pose: Pose, u: Control) -> Array:
        def one(pose: Pose, row: _Rows) -> _Rows:
            u_k, none = row
            return motion.step(pose, u_k, none), motion.noise_cov(pose, u_k)

        _, blocks = jax.lax.scan(one, pose, rows(u, jnp.zeros(count * size_w, pose.dtype)))
        own = jnp.eye(count, dtype=blocks.dtype)[:, None, :, None]
        return (own * blocks[:, :, None, :]).reshape(count * size_w, count * size_w)

    def perturb(u: Control, w: ProcessNoise) -> Control:
        assert motion.perturb is not None
        return jax.vmap(motion.perturb)(*rows(u, w)).ravel()

    def jacobians(pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        hand = motion.jacobians
        assert hand is not None

        def forward(pose: Pose, row: _Rows) -> tuple[Array, _Jacobians]:
            return motion.step(pose, *row), hand(pose, *row)

        def backward(after: Array, own: _Jacobians) -> tuple[Array, _Rows]:
            by_pose, by_u, by_w = own
            return after @ by_pose, (after @ by_u, after @ by_w)  # after is F_n ⋯ F_{k+1}

        _, along = jax.lax.scan(forward, pose, rows(u, w))
        identity = jnp.eye(3, dtype=pose.dtype)
        by_pose, (by_u, by_w) = jax.lax.scan(backward, identity, along, reverse=True)
        return by_pose, jnp.concatenate(by_u, axis=1), jnp.concatenate(by_w, axis=1)

    return Motion(
        name=f"{count} x {motion.name}",
        controls=_numbered(motion.controls, count),
        noises=_numbered(motion.noises, count),
        step=step,
        noise_cov=noise_cov,
        perturb=perturb if motion.perturb is not None else None,
        jacobians=jacobians if motion.jacobians is not None else None,
    )


def _numbered(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Numbered names: ("v [m/s]",) twice is ("v 1 [m/s]", "v 2 [m/s]"), units last for `verify`."""
    parts = [name.partition(" [") for name in names]
    return tuple(f"{a} {k + 1}{space}{unit}" for k in range(count) for a, space, unit in parts)
