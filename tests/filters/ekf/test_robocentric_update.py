"""A map and its last motion corrected side by side are the map composed anew for each measurement."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import charts, filters, motion, sensors
from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.filters.ekf.update import correct, correct_in_turn
from jaxslam.types import Scan

SEES = sensors.range_bearing(np.diag([0.04, 0.01]))
POINTS = np.array([[4.0, 1.0], [3.0, -2.0], [-1.0, 3.0]])


def test_corrections_in_turn_are_those_one_by_one():
    chart = charts.robocentric()
    ekf = filters.ekf_slam(
        motion.pose_increment(np.diag([0.04, 0.02, 0.01])), SEES, 4, chart=chart, watch=True
    )
    settings = EkfSettings(SEES, chart, gate=60.0)
    seen = jax.vmap(SEES.observe, (None, 0))
    key = jax.random.key(0)

    @jax.jit
    def moved(noise):
        joint = ekf.init(jnp.asarray([0.3, -0.2, 0.5]), 0.01 * jnp.eye(3))
        z = seen(joint.pose, jnp.asarray(POINTS)) + noise
        scan = Scan(z, jnp.arange(3), jnp.ones(3, bool))
        joint, _ = ekf.update(ekf.predict(joint, jnp.asarray([0.5, 0.0, 0.4]), key), scan, key)
        return ekf.predict(joint, jnp.asarray([0.6, 0.1, -0.5]), key)

    joint = moved(0.1 * jax.random.normal(key, (3, 2)))
    z = seen(joint.pose, joint.landmarks[jnp.asarray([2, 0, 1, 0])])
    z = z + jnp.asarray([[0.2, 0.1], [-0.3, 0.05], [0.1, -0.1], [40.0, 0.0]])  # the last is wild
    slot, known = jnp.asarray([2, 0, 1, 0]), jnp.asarray([True, True, False, True])

    alone = jax.jit(lambda joint, *part: correct(joint, *part, settings))
    wanted = joint
    for i in range(4):
        wanted, _ = alone(wanted, z[i : i + 1], slot[i : i + 1], known[i : i + 1])
    turns = jax.jit(lambda joint, *part: correct_in_turn(joint, *part, settings))
    got, done = turns(joint, z, slot, known)

    assert list(done.inside & known) == [True, True, False, False]
    assert np.abs(np.asarray(wanted.pose - joint.pose)).max() > 1e-2
    chex.assert_trees_all_close(got, wanted, rtol=1e-9, atol=1e-11)
    chex.assert_trees_all_equal(turns(joint, z, slot, jnp.zeros(4, bool))[0], joint)
