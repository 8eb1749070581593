"""EKF-SLAM; the published variants are fields of one filter."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core import slots
from jaxslam.core._record import hold_function, record, static
from jaxslam.core.protocols import Associate, Chart, Filter, Life, Linearizer, Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._ekf import map_coordinates
from jaxslam.filters._ekf.ekf_settings import (
    CorrectionOrder,
    Covariance,
    EkfSettings,
    check_ekf_options,
    check_settings,
)
from jaxslam.filters._ekf.linear_system import LinearizedSteps, LinearSystem
from jaxslam.filters._ekf.map_coordinates import estimate_of
from jaxslam.filters._ekf.predict import propagate
from jaxslam.filters._ekf.scan import stages_of, update_by_scan, without_landmarks
from jaxslam.filters._reporting import with_extra, with_removed
from jaxslam.linearize._first_order import AtEstimate
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number


@record
class EkfSlam(Filter):
    """Extended Kalman filter SLAM in a map of fixed capacity (Solà 2).

    Each step propagates the robot (14)-(17); each scan corrects (26)-(30), then starts its new
    landmarks (31)-(38). The state is a `slots.Joint`; `slots.remove` deletes landmarks from it.

    Every valid measurement of an absolute sensor (L = 0: compass, position fix) corrects the robot,
    whatever its tag, and has slot -1; `associate` and `births` do not apply, and the map is empty.

    Several sensors are one `sensors.Suite`, whose parts are processed one after the other.

    Raises ValueError on models, charts, linearizers or associations of another type or size
    (`validation`), a capacity, iterations or births below 1, a gate not above 0 and below 1, an
    unknown correction or covariance, a chart or linearizer that does not fit the sensor's landmarks
    or one another, several iterations of a statistical linearizer, or a linearizer of landmarks for
    a suite with an absolute sensor.
    """

    motion: Motion
    sensor: Sensor
    """the models; Jacobians come from `jax.jacfwd`"""
    capacity: int = static()
    """landmark slots N. A new landmark that finds the map full is dropped and marked
    `Status.OVERFLOW`"""
    _: dataclasses.KW_ONLY
    chart: Chart = Euclidean()
    """the error coordinates of P"""
    linearize: Linearizer = AtEstimate()
    """where Jacobians are taken"""
    associate: Associate = Known()
    """the landmark of each measurement"""
    correction: CorrectionOrder = static(default="sequential")
    """"sequential" corrects by one measurement after the other, relinearizing each time, as the
    guide does; "joint" corrects by the whole scan at once"""
    gate: Number | None = None
    """the probability that a correct measurement passes, above 0 and below 1, as 0.999: one whose
    squared Mahalanobis distance d² exceeds the χ² quantile of its Z numbers is rejected; None: none
    is. The guide's 3 σ is `stats.sigma_gate(3, 2)`. float32 has no number between 1 - 6e-8
    (d² = 33 of Z = 2) and 1"""
    iterations: int = static(default=1)
    """passes of the iterated EKF, each from the same prior; 1 is the plain EKF"""
    covariance: Covariance = static(default="plain")
    """"plain"; "joseph", Joseph's form of the update, which costs more, and in float32 fails where
    "plain" does; or "square_root", a root X of P = X Xᵀ instead of P, which holds twice the digits,
    at a higher cost (the prediction is O(N³))"""
    births: int | None = static(default=None)
    """largest number of new landmarks a scan, the first in its order (that of tags in simulated
    scans), the rest `Status.DEFERRED`. The guide starts one, picked at random. None: no limit"""
    life: Life | None = None
    """a rule that removes landmarks after each scan, and may make room in a full map. Its memory is
    `Joint.life`; `info.extra["pruning"].removed` (N,) bool marks the slots"""

    def __post_init__(self) -> None:
        name = type(self).__name__
        validation.check_models(name, self.motion, self.sensor)
        validation.check_parts(name, self.chart, self.linearize, self.associate, self.life)
        hold_function(self, "associate", "prediction, scan")
        check_ekf_options(
            name,
            self.capacity,
            self.correction,
            self.gate,
            self.iterations,
            self.births,
            self.covariance,
        )
        check_settings(name, self._settings)
        super().__post_init__()

    @property
    def square_root(self) -> bool:  # type: ignore[override]
        return self.covariance == "square_root"

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.landmark

    @property
    def linearized(self) -> LinearizedSteps | None:
        """The steps with their linear system; None of a class that overrides one."""
        plain = type(self).predict is EkfSlam.predict and type(self).update is EkfSlam.update
        return LinearizedSteps(self._predict, self._update) if plain else None

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = initial_state(pose, pose_cov, self.capacity, self._settings)
        if self.life is None:
            return joint
        return joint._replace(life=self.life.init(pose, joint.landmarks))

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        return self._predict(state, u, key)[0]

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return self._update(state, scan, key)[:2]

    def estimate(self, state: Joint) -> Estimate:
        return estimate_of(state, self.sensor, self.chart, square_root=self.square_root)

    @property
    def _settings(self) -> EkfSettings:
        return EkfSettings(
            sensor=self.sensor,
            chart=self.chart,
            linearize=self.linearize,
            associate=self.associate,
            correction=self.correction,
            gate=self.gate,
            iterations=self.iterations,
            covariance=self.covariance,
            births=self.births,
            life=self.life,
        )

    def _predict(
        self, joint: Joint, u: Float[Array, "U"], key: Array
    ) -> tuple[Joint, LinearSystem]:
        joint, moved = propagate(joint, u, self.motion, self._settings)
        return joint, (moved,)

    def _update(self, joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info, LinearSystem]:
        turns = stages_of(self.sensor, self._settings)
        joint, info, evicted, system = update_by_scan(joint, scan, turns)
        if self.sensor.reduced is not None:
            joint, which, reduced = map_coordinates.reduced_where_ready(
                joint, self.sensor, self.square_root
            )
            info = with_extra(info, "points", map_coordinates.ToPoints(which))
            system = (*system, reduced)
        if self.life is not None:
            before = joint
            memory, dead = self.life.after(before, info, lambda: self.estimate(before))
            joint = without_landmarks(
                joint._replace(life=memory), dead, square_root=self.square_root
            )
            info = with_removed(info, evicted | dead)
        return joint, info, system


def initial_state(
    pose: Float[Array, "3"],
    pose_cov: Float[Array, "3 3"],
    capacity: int,
    settings: EkfSettings,
) -> Joint:
    """The initial state: a robot with covariance pose_cov in map coordinates, and no landmark."""
    sensor, chart = settings.sensor, settings.chart
    size_l = len(sensor.landmark)
    ground = jnp.zeros((capacity, size_l), pose.dtype)
    if chart.basis is not None:
        undo = linalg.inverse(chart.basis(pose, ground[0]).pose)
        pose_cov = undo @ pose_cov @ undo.T
    joint = slots.empty(
        pose,
        pose_cov,
        capacity,
        size_l,
        settings.linearize.init(pose, ground),
        square_root=settings.square_root,
    )
    if sensor.reduced is not None:
        joint = joint._replace(reduced=jnp.zeros_like(joint.alive))
    return joint
