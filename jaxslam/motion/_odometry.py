"""The odometry motion model: a rotation, a translation and a rotation."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import InvalidField, finite
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, ProcessNoiseCov, StepJacobians
from jaxslam.math.angles import wrap


@record
class Odometry(Motion):
    """The odometry motion model: Notes 3.

    u = (rot1 [rad], trans [m], rot2 [rad]), with additive noise.

    With the direction of travel h = θ + rot1 + w1,

        pose ← (x + (trans+w2) cos h, y + (trans+w2) sin h, wrap(h + rot2 + w3)).

    `odometry_control` gives u between two poses, `odometry_controls` along a path, and
    `OdometryNoise` a covariance that grows with u.
    Thrun, Burgard & Fox, Probabilistic Robotics (2005), ch. 5.4.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of w = (w1, w2, w3), or a function of (pose, u)."""
    controls = ("rot1 [rad]", "trans [m]", "rot2 [rad]")
    noises = ("rot1 [rad]", "trans [m]", "rot2 [rad]")
    equations = (
        "h = theta + rot1 + w_rot1\n"
        "x1 = x + (trans + w_trans)*cos(h)\n"
        "y1 = y + (trans + w_trans)*sin(h)\n"
        "theta1 = wrap(h + rot2 + w_rot2)"
    )

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        rot1, trans, rot2 = self.perturb(u, w)
        facing = jnp.stack([pose[0], pose[1], pose[2] + rot1])
        return se2.compose(facing, jnp.stack([trans, jnp.zeros_like(trans), rot2]))

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return u + w

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        h, d = pose[2] + u[0] + w[0], u[1] + w[1]
        c, s = jnp.cos(h), jnp.sin(h)
        # ∂(x, y, θ)/∂h, with (x, y) moved by d (cos h, sin h).
        turned = jnp.stack([-d * s, d * c, jnp.ones_like(d)])  # by θ and by rot1 alike
        by_pose = jnp.eye(3, dtype=pose.dtype).at[:, 2].set(turned)
        by_noise = jnp.zeros((3, 3), pose.dtype).at[:, 0].set(turned)
        by_noise = by_noise.at[0, 1].set(c).at[1, 1].set(s).at[2, 2].set(1)
        return by_pose, by_noise, by_noise


@record
class OdometryNoise:
    """The diagonal covariance of the noise of `Odometry`, a function (pose, u) -> (3, 3).

        var rot1  = α1 rot1² + α2 trans²
        var trans = α3 trans² + α4 (rot1² + rot2²)
        var rot2  = α1 rot2² + α2 trans²

    Variances, as in Probabilistic Robotics, Table 5.6. Backing up as rot1 = ±π counts as that much
    turning; (0, -d, 0) does not.
    """

    alpha: ArrayLike = field(check=finite(4, least=0.0))
    """(4,) α1, α3 [1], α2 [rad²/m²], α4 [m²/rad²], not negative"""
    equations = (
        "a1, a2, a3, a4 = alpha\n"
        "variance_of_w_rot1 = a1*rot1**2 + a2*trans**2\n"
        "variance_of_w_trans = a3*trans**2 + a4*(rot1**2 + rot2**2)\n"
        "variance_of_w_rot2 = a1*rot2**2 + a2*trans**2"
    )

    def __call__(self, pose: Pose, u: Control) -> ProcessNoiseCov:
        a1, a2, a3, a4 = jnp.asarray(self.alpha, pose.dtype)
        rot1, trans, rot2 = u[0] ** 2, u[1] ** 2, u[2] ** 2
        return jnp.diag(
            jnp.stack(
                [a1 * rot1 + a2 * trans, a3 * trans + a4 * (rot1 + rot2), a1 * rot2 + a2 * trans]
            )
        )


def odometry_control(before: Array, after: Array) -> Array:
    """The control (rot1, trans, rot2) of `Odometry` that leads from one pose to another: Notes 3.

        rot1  = wrap(atan2(y' - y, x' - x) - θ)
        trans = √((x' - x)² + (y' - y)²)
        rot2  = wrap(θ' - θ - rot1)

    trans >= 0, so a robot that backs up turns by π first and last. Without translation rot1 is
    undefined: u is (0, 0, wrap(θ' - θ)) with finite derivatives.

    Args:
        before, after: poses (3,) in one frame, for instance that of the odometry.
    """
    trans, bearing = se2.polar(se2.to_frame(before, after[:2]))
    rot1 = wrap(bearing)  # arctan2 of (-0, x < 0) is -π, which no wrapped angle is
    return jnp.stack([rot1, trans, wrap(after[2] - before[2] - rot1)])


def odometry_controls(path: ArrayLike) -> Float[np.ndarray, "T 3"]:
    """The controls (T, 3) of `Odometry` along a path of poses (T, 3), in NumPy; row 0 is zero.

    As `odometry_control` from pose to pose, but a robot that moves backward, with the translation
    in the half plane behind it, gets a negative trans in place of two turns by π, which
    `OdometryNoise` would count as turning.

    Raises ValueError unless the path is one of finite poses.
    """
    poses = np.asarray(path, np.float64)
    if poses.ndim != 2 or poses.shape[1] != 3 or not np.isfinite(poses).all():
        reason = f"expected finite poses (T, 3), got {poses.shape}"
        raise InvalidField("odometry_controls", "path", reason)
    moved = np.diff(poses, axis=0)
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    ahead, left = c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]
    way = np.where(ahead < 0, -1.0, 1.0)  # -1: backward, with no turn by π
    rot1 = np.arctan2(way * left, way * ahead)
    rot2 = moved[:, 2] - rot1
    # To (-π, π], as `wrap` does.
    rot2 = rot2 - 2 * np.pi * np.ceil((rot2 - np.pi) / (2 * np.pi))
    controls = np.zeros_like(poses)
    controls[1:] = np.column_stack([rot1, way * np.hypot(ahead, left), rot2])
    return controls
