"""EKF-SLAM; the published variants are arguments of one filter."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam import slots, validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.ekf.coordinates import to_points
from jaxslam.filters.ekf.coordinates.linear_system import LinearizedSteps, LinearSystem
from jaxslam.filters.ekf.coordinates.map_coordinates import estimate_of
from jaxslam.filters.ekf.settings import (
    Covariance,
    EkfSettings,
    Update,
    check_ekf_options,
    check_make_room,
    check_settings,
)
from jaxslam.filters.ekf.steps.predict import propagate
from jaxslam.filters.ekf.steps.scan import turns_of, update_by_scan
from jaxslam.filters.reporting import with_extra, with_removed
from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.math import linalg
from jaxslam.protocols import Associate, Chart, Filter, Life, Linearizer, Motion, Sensor
from jaxslam.sensors.suite import Suite
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan


def ekf_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    chart: Chart | None = None,
    linearize: Linearizer | None = None,
    associate: Associate | None = None,
    update: Update = "sequential",
    gate: float | None = None,
    iterations: int = 1,
    covariance: Covariance = "plain",
    births: int | None = None,
    make_room: Life | None = None,
) -> Filter:
    """Extended Kalman filter SLAM in a map of fixed capacity (Solà 2).

    Each step propagates the robot (14)-(17); each scan corrects (26)-(30), then starts its new
    landmarks (31)-(38). The state is a `slots.Joint`; `slots.remove` deletes landmarks from it.

    Every valid measurement of an absolute sensor (L = 0: compass, position fix) corrects the robot,
    whatever its tag, and has slot -1; `associate` and `births` do not apply, and the map is empty.

    Several sensors are one `sensors.Suite`, whose parts are processed one after the other.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`.
        capacity: landmark slots N. A new landmark that finds the map full is dropped and marked
            `Status.OVERFLOW`.
        chart: the error coordinates of P; default `charts.euclidean()`.
        linearize: where Jacobians are taken; default `linearize.at_estimate()`.
        associate: default `association.known()`.
        update: "sequential" corrects by one measurement after the other, linearizing anew each
            time, as the guide does; "joint" corrects by the whole scan at once.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
            The guide's 3 σ is `stats.sigma_gate(3)`, and `stats.chi2_quantile` gives a probability.
        iterations: passes of the iterated EKF, each from the same prior; 1 is the plain EKF.
        covariance: "plain"; "joseph", Joseph's form of the update, which costs more and is safer in
            float32; or "square_root", a root X of P = X Xᵀ instead of P, as accurate in float32 as
            P is in float64, at a higher cost (the prediction is O(N³)).
        births: at most so many new landmarks a scan, the first ones in its order (that of tags in
            simulated scans), the rest `Status.DEFERRED`. The guide starts one, picked at random.
            Default no limit.
        make_room: a `Life` that removes landmarks from a full map before new ones enter it; only
            for filters wrapped as `map_management.pruning(filter, make_room)`, which keeps its
            memory. Default: none is removed.
    Raises:
        ValueError: on models, charts, linearizers or associations of another type or size
            (`validation`), a capacity, iterations or births below 1, a gate not above 0, an unknown
            update or covariance, a chart or linearizer that does not fit the sensor's landmarks or
            one another, a `Life` without `make_room`, several iterations of a statistical
            linearizer, or a linearizer of landmarks for a suite with an absolute sensor; from
            `update`, on a make_room without `pruning`.
    """
    validation.check_models("ekf_slam", motion, sensor)
    validation.check_parts("ekf_slam", chart=chart, linearize=linearize, associate=associate)
    check_ekf_options("ekf_slam", capacity, update, gate, iterations, births, covariance)
    settings = EkfSettings(
        sensor=sensor,
        chart=chart or euclidean(),
        linearize=linearize or at_estimate(),
        associate=associate or known_association(),
        update=update,
        gate=gate,
        iterations=iterations,
        covariance=covariance,
        births=births,
        make_room=make_room,
    )
    check_settings(settings)
    check_make_room(make_room)
    chart, square_root = settings.chart, settings.square_root
    turns = turns_of(sensor, settings)
    places = sensor.places if isinstance(sensor, Suite) else ()

    def init(pose: jax.Array, pose_cov: jax.Array) -> Joint:
        return initial_state(pose, pose_cov, capacity, settings)

    def predict(joint: Joint, u: jax.Array, key: jax.Array) -> tuple[Joint, LinearSystem]:
        joint, moved = propagate(joint, u, motion, settings)
        return joint, (moved,)

    def update_map(joint: Joint, scan: Scan, key: jax.Array) -> tuple[Joint, Info, LinearSystem]:
        if make_room is not None and joint.life is None:
            raise ValueError(
                f"ekf_slam: make_room={make_room.name} needs the record that pruning keeps: "
                "expected pruning(ekf_slam(…, make_room=life), life)"
            )
        joint, info, evicted, system = update_by_scan(joint, scan, turns)
        if make_room is not None:
            info = with_removed(info, evicted)
        if sensor.reduced is not None:
            joint, which, reduced = to_points.reduced_where_ready(joint, sensor, square_root)
            info = with_extra(info, "points", to_points.ToPoints(which))
            system = (*system, reduced)
        return joint, info, system

    def estimate(joint: Joint) -> Estimate:
        return estimate_of(joint, sensor, chart, square_root=square_root)

    steps = LinearizedSteps(predict, update_map)
    return Filter(
        name="ekf_slam",
        controls=motion.controls,
        measurements=sensor.measurements,
        init=init,
        predict=steps.predict,
        update=steps.update,
        estimate=estimate,
        chart=chart,
        places=places,
        square_root=square_root,
        landmark=sensor.landmark,
    )


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
