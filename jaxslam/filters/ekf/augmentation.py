"""New landmarks of a Kalman-type SLAM filter on a `Joint`, whatever chart and linearizer."""

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.math import linalg
from jaxslam.math.xla import settle
from jaxslam.protocols import Chart, Here, Linearizer, Sensor
from jaxslam.slots import Joint


def augment(
    joint: Joint,
    z: jax.Array,
    tag: jax.Array,
    slot: jax.Array,
    granted: jax.Array,
    *,
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
    square_root: bool = False,
) -> Joint:
    """Start landmarks from measurements z (m, Z) in free slots (m,), where granted (m,).

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx: Solà (32)-(38),
    with the prior's term of (44); several in one scan are correlated through the robot.
    """
    here = Here(joint, chart, joint.pose, slots.robot_cov(joint, square_root))

    def one(z_i: jax.Array, tag_i: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        landmark, by_pose, own = linearize.invert(sensor, z_i, tag_i, here)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            by_pose = by_pose @ basis.pose - basis.cross
            if basis.landmark is not None:
                undo = linalg.inverse(basis.landmark)
                by_pose, own = undo @ by_pose, undo @ own @ undo.T
        return landmark, by_pose, own

    landmark, by_pose, own = settle(jax.vmap(one)(z, tag))
    joint = slots.scatter(
        joint, slot, granted, landmark, by_pose, own, tag, square_root=square_root
    )
    born = jnp.zeros_like(joint.alive).at[slot].max(granted)
    return joint._replace(lin=linearize.born(joint, born))
