"""New landmarks: the state augmentation of a Kalman-type SLAM filter, and their covariances."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam import slots
from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.math import linalg
from jaxslam.math.xla import materialize
from jaxslam.protocols import Here
from jaxslam.slots import Joint


def augment(
    joint: Joint,
    z: Float[Array, "m Z"],
    tag: Int[Array, "m"],
    slot: Int[Array, "m"],
    granted: Bool[Array, "m"],
    settings: EkfSettings,
) -> tuple[Joint, Float[Array, "m L 3"]]:
    """The joint with new landmarks of measurements z (m, Z) in free slots (m,), where granted (m,);
    and the derivatives G_R of their errors by that of the pose.

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx: Solà (32)-(38),
    with the prior's term of (44); several in one scan are correlated through the robot.
    """
    chart, square_root = settings.chart, settings.square_root
    here = Here(joint, chart, joint.pose, slots.robot_cov(joint, square_root))

    def one(
        z_i: Float[Array, "Z"], tag_i: Int[Array, ""]
    ) -> tuple[Float[Array, "L"], Float[Array, "L 3"], Float[Array, "L L"]]:
        landmark, by_pose, own = settings.linearize.invert(settings.sensor, z_i, tag_i, here)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            by_pose = by_pose @ basis.pose - basis.cross
            if basis.landmark is not None:
                undo = linalg.inverse(basis.landmark)
                by_pose, own = undo @ by_pose, undo @ own @ undo.T
        return landmark, by_pose, own

    landmark, by_pose, own = materialize(jax.vmap(one)(z, tag))
    joint = slots.scatter(
        joint, slot, granted, landmark, by_pose, own, tag, square_root=square_root
    )
    new = jnp.zeros_like(joint.alive).at[slot].max(granted)
    return joint._replace(lin=settings.linearize.born(joint, new)), by_pose
