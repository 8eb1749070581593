"""The observability monitor as a wrapper: of what it is refused, and of maps that are managed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from jaxslam import catalog, filters, life
from jaxslam.core.record import record
from jaxslam.filters import Closing, EkfSlam, Filter, Monitored, Wrapper
from jaxslam.linearize import FirstEstimate
from jaxslam.run import run

WORLD = worlds.ring(steps=40)
FEJ = catalog.variant(WORLD, linearize=FirstEstimate(), correction="joint")


def managed(rule):
    """The filter with a rule for the life of its landmarks."""
    return dataclasses.replace(FEJ, life=rule)


@record
class Wrapped(Wrapper):
    """A filter as it is, whose steps return no linear system."""

    filter: Filter


@record
class Corrected(EkfSlam):
    """One with an update of its own."""

    def update(self, state, scan, key):
        return super().update(state, scan, key)


def test_landmarks_that_leave_the_map_and_come_back_tell_nothing_of_a_turn():
    """First estimates keep the turn unobservable; a slot begins anew with each landmark."""
    filter = Monitored(managed(life.Existence(lambda pose, point: point[0] < 100.0)))
    _, log = worlds.draw(WORLD)
    valid = log.scan.valid & (np.arange(40) // 5 % 3 == 0)[:, None]
    log = log._replace(scan=log.scan._replace(valid=valid))
    trace = run(filter, log, WORLD.pose, WORLD.pose_cov, jax.random.key(0))
    removed = np.asarray(trace.info.extra["pruning"].removed)
    assert (np.diff(np.asarray(trace.estimate.alive).astype(int), axis=0) > 0)[5:].any()
    assert removed.sum() > 5
    state, monitor = trace.final
    assert state.life is not None
    turn = monitor.turn
    assert float(turn @ monitor.information @ turn) < 1e-12 * float(monitor.scale.max())
    assert float(monitor.scale.min()) > 1.0


@pytest.mark.parametrize(
    ("filter", "why"),
    [
        (filters.DeadReckoning(WORLD.motion, WORLD.sensor), "dead_reckoning do not return"),
        (filters.EifSlam(WORLD.motion, WORLD.sensor, 4), "eif_slam do not return"),
        (Wrapped(FEJ), "wrapped ekf_slam do not return"),
        (Corrected(WORLD.motion, WORLD.sensor, 4), "corrected do not return"),
        (filters.EkfSlam, "expected a filter, got the class EkfSlam: call it"),
    ],
)
def test_a_filter_without_a_linear_system_is_refused(filter, why):
    with pytest.raises(ValueError, match=f"^Monitored: .*{why}"):
        Monitored(filter)


def test_a_map_is_managed_inside_the_monitor():
    outside = Closing(Monitored(managed(life.Recency())))
    with pytest.raises(
        ValueError,
        match=r"^Closing: expected a filter whose state is a slots.Joint, .* got monitored ekf_slam",
    ):
        jax.eval_shape(outside.init, jnp.zeros(3), jnp.eye(3))
