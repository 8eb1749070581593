"""A map and its last motion corrected side by side are the map composed anew for each measurement."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import charts, filters, motion, sensors
from jaxslam.filters.ekf.observability import after
from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.filters.ekf.steps.scan import linear_corrections
from jaxslam.filters.ekf.steps.sequential_update import correct_in_turn
from jaxslam.types import Scan

SEES = sensors.RangeBearing(np.diag([0.04, 0.01]))
POINTS = np.array([[4.0, 1.0], [3.0, -2.0], [-1.0, 3.0]])


def test_corrections_in_turn_are_those_one_by_one():
    chart = charts.robocentric()
    ekf = filters.ekf_slam(motion.PoseIncrement(np.diag([0.04, 0.02, 0.01])), SEES, 4, chart=chart)
    ekf = filters.monitored(ekf)
    settings = EkfSettings(SEES, chart, gate=60.0)
    seen = jax.vmap(SEES.observe, (None, 0))
    key = jax.random.key(0)

    @jax.jit
    def moved(noise):
        state = ekf.init(jnp.asarray([0.3, -0.2, 0.5]), 0.01 * jnp.eye(3))
        z = seen(state.state.pose, jnp.asarray(POINTS)) + noise
        scan = Scan(z, jnp.arange(3), jnp.ones(3, bool))
        state, _ = ekf.update(ekf.predict(state, jnp.asarray([0.5, 0.0, 0.4]), key), scan, key)
        return ekf.predict(state, jnp.asarray([0.6, 0.1, -0.5]), key)

    joint, monitor = moved(0.1 * jax.random.normal(key, (3, 2)))
    z = seen(joint.pose, joint.landmarks[jnp.asarray([2, 0, 1, 0])])
    z = z + jnp.asarray([[0.2, 0.1], [-0.3, 0.05], [0.1, -0.1], [40.0, 0.0]])  # the last is wild
    slot, known = jnp.asarray([2, 0, 1, 0]), jnp.asarray([True, True, False, True])

    def by(covariance):
        form = dataclasses.replace(settings, covariance=covariance)

        @jax.jit
        def corrected(joint, monitor, known):
            joint, done = correct_in_turn(joint, z, slot, known, form)
            system = linear_corrections(z, slot, known, done, form)
            return (joint, after(monitor, system)), done

        return corrected

    wanted, _ = by("joseph")(joint, monitor, known)  # one by one
    side_by_side = by("plain")
    got, done = side_by_side(joint, monitor, known)

    assert list(done.inside & known) == [True, True, False, False]
    assert np.abs(np.asarray(wanted[0].pose - joint.pose)).max() > 1e-2
    assert np.abs(np.asarray(wanted[1].directions - monitor.directions)).max() > 1e-2
    assert (np.diag(wanted[1].information) > np.diag(monitor.information)).all()
    chex.assert_trees_all_close(got, wanted, rtol=1e-9, atol=1e-11)
    same, _ = side_by_side(joint, monitor, jnp.zeros(4, bool))
    chex.assert_trees_all_equal(same, (joint, monitor))
