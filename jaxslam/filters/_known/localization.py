"""EKF localization: the robot's pose in a known map."""

import dataclasses
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.association._rules import Known, prediction_from
from jaxslam.charts import Euclidean, with_further
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import (
    Associate,
    Chart,
    Filter,
    LinearizationPoint,
    Linearizer,
    Motion,
    Prediction,
    Sensor,
)
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    one_of,
    or_none,
    probability,
)
from jaxslam.filters._ekf.checks import check_iterations
from jaxslam.filters._ekf.correction import (
    Correction,
    CorrectionOrder,
    no_correction,
    report_fused,
)
from jaxslam.filters._ekf.ekf_slam import associate_scan
from jaxslam.filters._gaussian_correction import GaussianCorrection, correct_gaussian
from jaxslam.filters._known_map import hold_map, map_tags
from jaxslam.filters._reporting import info_of_ignored, join_infos, report_scan
from jaxslam.linearize._first_order import AtEstimate, predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import gaussian_terms, is_inside, log_det_of_pivots
from jaxslam.math._xla import scan_in_groups
from jaxslam.sensors._suite import of_robot


@record
class Localization(Filter):
    """Extended Kalman filter of the pose in a known map without errors (Williams, localization).

    The equations of EKF-SLAM with P_ll = 0: z = h(x, l_j) with H by the robot alone, P (R, R): here
    R = 3, or 3 + E with the further numbers of `Motion.state`. A step costs O(M), plus the search
    for tags among N (0.09 ms a step with 10,000); association other than by tags compares all
    landmarks. With a `sensors.Suite`, absolute sensors (compass, position fix) correct in the same
    update.

    The state is a `slots.Joint` of the map, whose P (R, R) is the robot's. A measurement without a
    landmark in the map is `Status.UNMATCHED`.

    Raises ValueError on a map that is not finite (N, L), tags that are not N different numbers from
    0 on, a chart or linearizer that needs the landmarks' errors, and as `EkfSlam` does.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    landmarks: ArrayLike
    """(N, L) the map, in the sensor's parameters"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """N different ones, in any form, as of a map of some landmarks; default the row numbers"""
    chart: Chart = field(default=Euclidean(), check=instance_of(Chart))
    """the error coordinates of P; its pose part"""
    linearize: Linearizer = field(default=AtEstimate(), check=instance_of(Linearizer))
    """one without a memory of landmarks (AtEstimate, Unscented)"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """See `EkfSlam.associate`."""
    correction: CorrectionOrder = static(
        default="sequential", check=one_of(*get_args(CorrectionOrder))
    )
    """See `EkfSlam.correction`."""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    iterations: int = static(default=1, check=at_least(1))
    """See `EkfSlam.iterations`."""
    covariance: Literal["plain", "joseph"] = static(
        default="plain", check=one_of("plain", "joseph")
    )
    """See `EkfSlam.covariance`."""
    further = True

    def __post_init__(self) -> None:
        linearize = self.linearize
        hold_map(self)
        if linearize.own_landmarks:
            reason = f"{linearize.name} is for estimated maps, not for a known one"
            raise InvalidField("linearize", reason)
        check_iterations(linearize, self.iterations)
        super().__post_init__()

    @property
    def map_size(self) -> int | None:  # type: ignore[override]
        is_whole = self.tags is None and self.sensor.landmark
        return np.shape(self.landmarks)[0] if is_whole else None

    @property
    def robot_chart(self) -> Chart:
        """The chart of all R numbers of the robot."""
        return with_further(self.chart, self.motion.state)

    def init(self, pose: Float[Array, "R"], pose_cov: Float[Array, "R R"]) -> Joint:
        landmarks, tags = jnp.asarray(self.landmarks, pose.dtype), map_tags(self)
        if self.chart.basis is not None:
            undo = linalg.inverse(self.robot_chart.pose_basis(pose))
            pose_cov = undo @ pose_cov @ undo.T
        lin = self.linearize.init(pose, landmarks)
        joint = Joint(pose, landmarks, pose_cov, jnp.ones(len(tags), bool), tags, lin)
        return joint.with_robot(pose)

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        chart = self.robot_chart
        point = LinearizationPoint(state, chart, state.robot, state.cov)
        pose, f, noise, lin = self.linearize.motion(self.motion, u, point)
        if chart.basis is not None:
            undo = linalg.inverse(chart.pose_basis(pose))
            f = linalg.matmul(linalg.matmul(undo, f), chart.pose_basis(state.robot))
            noise = linalg.matmul(linalg.matmul(undo, noise), undo.T)
        cov = linalg.symmetrize(linalg.matmul(linalg.matmul(f, state.cov), f.T) + noise)
        return state.with_robot(pose)._replace(cov=cov, lin=lin)

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        infos = []
        for sensor, part in self.sensor.scans(scan):
            if sensor is None:  # of a suite: it measures other robots
                infos.append(info_of_ignored(part))
                continue
            sensor = of_robot(sensor, self.motion.state)
            # Padding may hold any number, and is multiplied by zero below.
            part = part._replace(z=jnp.where(part.valid[:, None], part.z, 0.0))
            # Associate; a landmark that is not in the map starts none.
            association, matched = associate_scan(
                self.associate, sensor, part, partial(_predict_map, self, sensor, state)
            )
            association = association._replace(is_new=jnp.zeros_like(association.is_new))
            # Correct, at once or one measurement after the other.
            gamma = gate_quantile(self.gate, len(sensor.measurements))
            correct = partial(_correct, self, sensor, gamma=gamma)
            measurements = part.z, jnp.maximum(association.slot, 0), matched
            if self.correction == "joint" and len(part.tag) > 0:
                state, correction = correct(state, *measurements)
            else:
                skip = partial(
                    no_correction,
                    (1, part.z.shape[1]),
                    state.robot_size,  # H has the columns of the robot alone
                    jnp.result_type(part.z, state.pose, state.cov),
                    has_basis=False,
                )
                state, correction = scan_in_groups(correct, skip, state, measurements, 1)
            # Report.
            infos.append(report_scan(part.valid, association, matched, correction))
        return state, join_infos(infos, scan.z.shape[1])

    def estimate(self, state: Joint) -> Estimate:
        cov, n = state.cov, state.robot_size
        if self.chart.basis is not None:
            basis = self.robot_chart.pose_basis(state.robot)
            cov = basis @ cov @ basis.T
        return Estimate(
            pose=state.pose,
            pose_cov=cov if n == 3 else cov[:3, :3],
            points=jax.vmap(self.sensor.position)(state.landmarks),
            point_covs=jnp.zeros((len(state.landmarks), 2, 2), cov.dtype),
            alive=state.alive,
            tag=state.tag,
            further=state.further,
            further_cov=None if n == 3 else cov[3:, 3:],
        )


def _predict_map(filter: Localization, sensor: Sensor, state: Joint) -> Prediction:
    """The `Prediction` of the map, whose landmarks have no errors: H_i P H_jᵀ by the pose alone."""

    def linearize() -> tuple[Float[Array, "N Z"], Float[Array, "N Z R"], Float[Array, "N Z Z"]]:
        every_slot = jnp.arange(len(state.tag))
        z_hat, h, added_noise = _linearize(filter, sensor, state, every_slot, state.robot)
        if filter.chart.basis is not None:
            h = h @ filter.robot_chart.pose_basis(state.robot)
        return z_hat, h, added_noise

    def measurements() -> tuple[Float[Array, "N Z"], Float[Array, "N Z Z"]]:
        z_hat, h, added_noise = linearize()
        return z_hat, linalg.symmetrize(h @ state.cov @ h.transpose(0, 2, 1)) + added_noise

    def cross() -> Float[Array, "N Z N Z"]:
        h = linearize()[1]
        return jnp.einsum("izx,xy,jwy->izjw", h, state.cov, h)

    return prediction_from(sensor, state.tag, state.alive, measurements, cross)


def _linearize(
    filter: Localization,
    sensor: Sensor,
    state: Joint,
    slot: Int[Array, "m"],
    pose: Float[Array, "R"],
) -> tuple[Float[Array, "m Z"], Float[Array, "m Z R"], Float[Array, "m Z Z"]]:
    """The predicted measurements of landmarks (m,) from a pose, H by its coordinates, and the
    covariance that the linearizer adds to R."""

    def observe(
        slot: Int[Array, ""], landmark: Float[Array, "L"]
    ) -> tuple[Float[Array, "Z"], Float[Array, "Z R"], Float[Array, "Z Z"]]:
        point = LinearizationPoint(state, filter.robot_chart, pose, state.cov, slot, landmark)
        z_hat, by_pose, _, added_noise = filter.linearize.observe(sensor, point)
        return z_hat, by_pose, added_noise

    return jax.vmap(observe)(slot, state.landmarks[slot])


def _correct(
    filter: Localization,
    sensor: Sensor,
    state: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
    gamma: Number | None,
) -> tuple[Joint, Correction]:
    """The state corrected by m measurements at once, Solà (26)-(30) with H by the robot alone.

    The first iteration, at the prior, decides the gate, R(ẑ) and the reported numbers; a further
    one linearizes at the newest estimate, but starts again from the prior (`correction._innovate`).
    """
    chart, robot, (m, size_z) = filter.robot_chart, state.robot, z.shape

    def linearize(pose: Float[Array, "R"], xi: Float[Array, "R"]) -> tuple[Array, ...]:
        """ẑ, ν, H by the errors, H by the coordinates, and added noise at the pose x ⊞ ξ."""
        z_hat, by_pose, added_noise = _linearize(filter, sensor, state, slot, pose)
        h, nu = by_pose, jax.vmap(sensor.residual)(z, z_hat)
        if chart.basis is not None:
            h = by_pose @ jax.jacfwd(chart.retract_pose, argnums=1)(robot, xi)
        return z_hat, nu, h, by_pose, added_noise

    # (25)-(27) for each measurement alone: its gate.
    z_hat, nu, h, by_pose, added_noise = linearize(robot, jnp.zeros_like(robot))
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, z, matched) + added_noise
    s_ii = linalg.symmetrize(h @ state.cov @ h.transpose(0, 2, 1) + noise)
    alone = jax.vmap(gaussian_terms)(nu, s_ii)
    prior = Correction(
        z_hat=z_hat,
        innovation=nu,
        innovation_cov=s_ii,
        nis=alone.distance,
        log_likelihood=jnp.zeros_like(alone.distance),
        inside=is_inside(alone.distance, gamma),
        positive=alone.positive,
        jacobian=by_pose,
        basis=None,
    )
    fuse = matched & prior.inside & prior.positive
    # R of the scan, block diagonal: (m, Z, m, Z) as a (mZ, mZ) matrix, mZ = m·Z. A measurement that
    # is not fused has ν = 0, H = 0 and R = 1, and so no effect on the others.
    blocks = jnp.where(fuse[:, None, None], noise, jnp.eye(size_z, dtype=noise.dtype))
    diagonal = jnp.eye(m, dtype=noise.dtype)[:, None, :, None] * blocks[:, :, None]
    scan_noise = diagonal.reshape(m * size_z, m * size_z)

    def solve(nu: Float[Array, "m Z"], h: Float[Array, "m Z R"]) -> GaussianCorrection:
        """K ν and the corrected P of the fused measurements: (28)-(30)."""
        return correct_gaussian(
            jnp.where(fuse[:, None], nu, 0.0).reshape(-1),
            jnp.where(fuse[:, None, None], h, 0.0).reshape(-1, len(robot)),
            state.cov,
            scan_noise,
            joseph=filter.covariance == "joseph",
        )

    correction = solve(nu, h)
    pivots = jnp.diagonal(correction.terms.factor).reshape(m, size_z)
    log_det, regular = log_det_of_pivots(pivots), (pivots > 0).all(axis=1)
    report = report_fused(prior, fuse, correction.terms.whitened, log_det, regular)
    pose = chart.retract_pose(robot, correction.xi)
    for _ in range(filter.iterations - 1):
        _, nu, h, _, _ = linearize(pose, correction.xi)
        # Back to the prior: z ⊖ h(x_i) + H ξ_i.
        correction = solve(nu + h @ correction.xi, h)
        pose = chart.retract_pose(robot, correction.xi)
    return state.with_robot(pose)._replace(cov=correction.cov), report
