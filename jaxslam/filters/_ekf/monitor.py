"""The observability monitor: information gained along directions that should stay unobservable."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxslam.core._record import record
from jaxslam.core.protocols import Filter, Wrapper
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField
from jaxslam.filters._ekf.linear_system import LinearLandmarks, LinearMeasurements, LinearSystem
from jaxslam.math import _linalg as linalg

# Floor of a variance, for a measurement without noise: its root, 1e-15, is a float32 that divides.
_TINY = 1e-30


class Monitor(NamedTuple):
    """The directions that may be unobservable, propagated by the linearized system.

    A direction n starts at the robot and is propagated by the transition matrices and by the
    Jacobians of new landmarks. It is unobservable as long as H n = 0 for all later measurements;
    these directions span the unobservable subspace. Three of the pose should stay so; one of a
    further number of the robot (R = 3 + E), as a bias, stays so while nothing tells it.
    """

    directions: Float[Array, "D R"]
    """in the filter's chart; rows of the robot begin as the unit matrix. Those of a free slot mean
    nothing"""
    information: Float[Array, "R R"]
    """Σ (H n)ᵀ R⁻¹ (H n) of all corrections"""
    scale: Float[Array, "R"]
    """Σ of the same with absolute values, the scale of rounding errors"""
    turn: Float[Array, "R"]
    """the combination of directions that rotates robot and map about the origin by 1 rad"""


class MonitoredState(NamedTuple):
    """The state of a monitored filter."""

    state: PyTree
    """of the filter itself"""
    monitor: Monitor


@record
class Monitored(Wrapper):
    """The filter with an observability monitor of its linearized system, for campaigns.

    The state is a `MonitoredState`; estimates and infos are the filter's. A landmark merged into
    another is not a measurement here.

    Raises ValueError on a filter of another type, or that does not return its linear system.
    """

    filter: Filter
    """an `EkfSlam`, or one merged or with loops closed"""
    square_root = False
    landmark = ()
    further = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.filter.linearized is None:
            raise InvalidField(
                "filter",
                f"the steps of {self.filter.name} do not return the linear system they "
                "use, as those of EkfSlam do; wrap that first",
            )

    def init(self, pose: Array, pose_cov: Array) -> MonitoredState:
        state, chart = self.filter.init(pose, pose_cov), self.chart
        # The derivative of the pose by a rotation about the origin; that of a landmark follows from
        # it, since the directions of a new landmark are linear in those of the robot.
        n = len(pose)
        turn = jnp.stack([-pose[1], pose[0], jnp.ones_like(pose[0])])
        if chart.basis is not None:
            turn = linalg.inverse(chart.pose_basis(pose[:3] if n > 3 else pose)) @ turn
        turn = jnp.pad(turn, (0, n - 3)) if n > 3 else turn
        nothing = jnp.zeros((n, n), pose.dtype)
        # (D, R): the identity for the robot; rows of landmarks are set when they are started.
        directions = jnp.eye(state.cov.shape[0], n, dtype=pose.dtype)
        return MonitoredState(state, Monitor(directions, nothing, nothing[0], turn))

    def predict(self, state: MonitoredState, u: Array, key: Array) -> MonitoredState:
        inner, system = self.filter.linearized.predict(state.state, u, key)
        return MonitoredState(inner, after(state.monitor, system))

    def update(self, state: MonitoredState, scan: Scan, key: Array) -> tuple[MonitoredState, Info]:
        inner, info, system = self.filter.linearized.update(state.state, scan, key)
        return MonitoredState(inner, after(state.monitor, system)), info

    def estimate(self, state: MonitoredState) -> Estimate:
        return self.filter.estimate(state.state)


def after(monitor: Monitor, system: LinearSystem) -> Monitor:
    """The monitor after a linear system."""
    n = monitor.directions.shape[1]
    for part in system:
        if isinstance(part, LinearMeasurements):
            monitor = _with_information(monitor, part)
        elif isinstance(part, LinearLandmarks):
            # Rows of new landmarks; beyond the last, which `mode="drop"` ignores, where no landmark
            # was started.
            directions = monitor.directions
            rows = _rows(n, part.slot, part.by_pose.shape[1])
            rows = jnp.where(part.granted[:, None], rows, len(directions))
            new = part.by_pose @ directions[:n]
            monitor = monitor._replace(directions=directions.at[rows].set(new, mode="drop"))
        else:
            monitor = monitor._replace(directions=part.times(monitor.directions))
    return monitor


def _with_information(monitor: Monitor, seen: LinearMeasurements) -> Monitor:
    """The monitor with the information of these measurements added."""
    n = monitor.directions.shape[1]
    rows = _rows(n, seen.slot, seen.jacobian.shape[2] - n)
    # (m, R + L, R): what robot and landmark of each measurement change along each direction.
    robot = jnp.broadcast_to(monitor.directions[:n], (len(rows), n, n))
    local = jnp.concatenate([robot, monitor.directions[rows]], axis=1)
    if seen.basis is not None:
        local = _product(seen.basis, local)
    signed = _product(seen.jacobian, local)
    # Absolute values of the same product: |H| |n| bounds what rounding can make of H n = 0.
    size = _product(jnp.abs(seen.jacobian), jnp.abs(local))

    def whiten(cov: Float[Array, "Z Z"], y: Float[Array, "Z k"]) -> Float[Array, "Z k"]:
        return linalg.solve_lower(linalg.cholesky(cov)[0], y)

    signed = jax.vmap(whiten)(seen.noise, signed)
    # By each entry's σ alone: only a scale, which needs no correlations.
    variances = jnp.diagonal(seen.noise, axis1=1, axis2=2)
    size = size / jnp.sqrt(jnp.maximum(variances, _TINY))[:, :, None]
    signed, size = (jnp.where(seen.fused[:, None, None], part, 0.0) for part in (signed, size))
    return monitor._replace(
        information=monitor.information
        + (signed[:, :, :, None] * signed[:, :, None, :]).sum(axis=(0, 1)),
        scale=monitor.scale + (size**2).sum(axis=(0, 1)),
    )


def _rows(first: int, slot: Array, size: int) -> Array:
    """The rows (m, L) of the errors of landmarks in slot (m,), after `first` of the robot."""
    return first + slot[:, None] * size + jnp.arange(size)[None, :]


def _product(a: Float[Array, "m i j"], b: Float[Array, "m j k"]) -> Float[Array, "m i k"]:
    """The product of each pair of matrices."""
    return a @ b
