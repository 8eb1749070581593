"""The error of the right-invariant EKF: a turn of robot and map together is one direction."""

import jax
import jax.numpy as jnp

from jaxslam import se2
from jaxslam.angles import wrap
from jaxslam.protocols import Basis, Chart


def right_invariant() -> Chart:
    """(R, t, l) ← exp(ξ)·(R, t, l), the group SE_{1+N}(2) acting from the left of the estimate.

    With dx = (ρ, φ): θ ← θ + φ, t ← R(φ)t + V(φ)ρ, l ← R(φ)l + V(φ)dl, V as in `se2.exp`. A turn φ
    of the whole map about the origin leaves ρ and dl at zero, so the unobservable directions do not
    depend on the estimate, and the filter cannot gain information along them (Barrau & Bonnabel
    2015, arXiv:1510.06263; Zhang et al. 2017). For point landmarks l = (x, y) only.
    """

    def retract(
        pose: jax.Array, landmark: jax.Array, dx: jax.Array, dl: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        moved = se2.exp(dx)
        shift = se2.exp(jnp.concatenate([dl, dx[2:]]))
        return se2.compose(moved, pose), se2.from_frame(shift, landmark)

    def local(
        pose0: jax.Array, landmark0: jax.Array, pose: jax.Array, landmark: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        turn = wrap(pose[2:] - pose0[2:])
        moved = se2.log(se2.compose(pose, se2.inverse(pose0)))
        offset = landmark - se2.rotation(turn[0]) @ landmark0
        return moved, se2.log(jnp.concatenate([offset, turn]))[:2]

    def basis(pose: jax.Array, landmark: jax.Array) -> Basis:
        eye = jnp.eye(3, dtype=pose.dtype)
        cross = jnp.zeros((2, 3), pose.dtype)
        return Basis(
            pose=eye.at[0, 2].set(-pose[1]).at[1, 2].set(pose[0]),
            cross=cross.at[0, 2].set(-landmark[1]).at[1, 2].set(landmark[0]),
            landmark=None,
        )

    return Chart(name="right_invariant", retract=retract, local=local, basis=basis)
