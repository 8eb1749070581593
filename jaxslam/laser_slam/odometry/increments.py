"""Laser odometry as the input of a filter: the pose of each keyframe relative to the one before."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.core.record import record
from jaxslam.laser_slam.odometry.tracking import Odometry
from jaxslam.laser_slam.records import Solved
from jaxslam.math import se2
from jaxslam.math.arrays import Control, Pose, ProcessNoise, ProcessNoiseCov
from jaxslam.protocols import Motion

ENDS = ("x [m]", "y [m]", "θ [rad]")
ROOTS = ("Lxx [m]", "Lyx [m]", "Lyy [m]", "Lθx [rad]", "Lθy [rad]", "Lθθ [rad]")


@record
class MatchMotion(Motion):
    """The motion model of a relative pose whose covariance is part of the control: pose ∘ z ∘ w.

    u = (z, L): z = (x [m], y [m], θ [rad]) in the robot's frame, and by rows the lower triangular
    root of the covariance of its end. w ~ N(0, L Lᵀ), (x [m], y [m], θ [rad]) in the frame of the
    robot after z. `match_controls` makes u of the matches of laser odometry.
    """

    controls = (*ENDS, *ROOTS)
    noises = ENDS

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        return se2.compose(se2.compose(pose, u[:3]), w)

    def noise_cov(self, pose: Pose, u: Control) -> ProcessNoiseCov:
        xx, yx, yy, tx, ty, tt = u[3:]
        zero = jnp.zeros_like(xx)
        rows = [xx, zero, zero], [yx, yy, zero], [tx, ty, tt]
        root = jnp.stack([jnp.stack(row) for row in rows])
        return root @ root.T


def match_controls(of: Odometry | Solved) -> Float[np.ndarray, "N 9"]:
    """The controls (N, 9) of `MatchMotion` along the N keyframes of laser odometry, in NumPy.

    Row n led to keyframe n, and row 0 is no motion: with the scans of `of.keyframe` they make a
    `Log`. Loops take no part. The filter takes noises of successive rows to be independent; matches
    that share scans are not.

    Args:
        of: what `laser_odometry` or `solve` found.
    Raises:
        ValueError: on anything else.
    """
    if isinstance(of, Odometry):
        z, cov = of.z[of.keyframe[1:]], of.cov[of.keyframe[1:]]
    elif isinstance(of, Solved):
        steps = of.graph.tables["relative_pose"]
        z, cov = np.asarray(steps.z), np.linalg.inv(np.asarray(steps.information, np.float64))
    else:
        raise ValueError(f"match_controls: expected Odometry or Solved, got {type(of).__name__}")
    controls = np.zeros((len(of.keyframe), 9))
    controls[1:, :3] = z
    row, column = np.tril_indices(3)
    controls[1:, 3:] = np.linalg.cholesky(cov)[:, row, column]
    return controls
