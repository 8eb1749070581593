"""SEIF of the catalog is sparse wherever there is a map to speak of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import catalog, scenarios
from jaxslam.charts import Euclidean
from jaxslam.core.protocols import Filter
from jaxslam.core.record import record
from jaxslam.core.types import Scan
from jaxslam.filters.information.eif_slam import InPieces
from jaxslam.filters.reporting import nothing_of


@pytest.mark.parametrize(("scenario", "active"), [("cloister", 18), ("circle", 10)])
def test_fewer_landmarks_are_active_than_the_map_has(scenario, active):
    world = scenarios.SCENARIOS[scenario](20)
    count = len(world.landmarks)
    filter = catalog.CANONICAL["seif"](world)
    pose, cov = jnp.zeros(3), jnp.eye(3)
    state = jax.eval_shape(filter.init, pose, cov)
    assert state.active.shape == (active,) and active < count
    places = world.places or count
    scan = Scan(jnp.zeros((places, 2)), jnp.arange(places), jnp.ones(places, bool))
    _, info = jax.eval_shape(filter.update, state, scan, jax.random.key(0))
    assert info.status.shape == (places,) and info.innovation_cov.shape == (places, 2, 2)


@record
class Toy(Filter):
    """A filter that adds up what it measures, three measurements at once."""

    controls = ("a", "b", "c")
    measurements = ("x [m]", "y [m]")
    chart = Euclidean()

    def init(self, pose, pose_cov):
        return pose[0]

    def predict(self, state, u, key):
        return state

    def update(self, state, scan, key):
        assert scan.tag.shape == (3,)
        info = nothing_of(scan)._replace(slot=scan.tag, log_likelihood=scan.z.sum())
        return state + jnp.where(scan.valid, scan.z[:, 0], 0.0).sum(), info

    def estimate(self, state):
        return state


def test_a_scan_in_pieces_loses_and_moves_nothing():
    seen = InPieces(Toy(), 3)
    tag = jnp.asarray([7, 3, 9, 1, 4, 8, 0])
    scan = Scan(jnp.stack([tag, -tag], axis=1) * 1.0 + 1.0, tag, tag != 9)
    state, info = jax.jit(seen.update)(jnp.zeros(()), scan, jax.random.key(0))
    np.testing.assert_array_equal(info.slot, tag)
    np.testing.assert_array_equal(info.status != 0, tag != 9)
    assert state == np.asarray(tag)[np.asarray(tag) != 9].sum() + 6
    assert info.log_likelihood == 14 and info.nis.shape == (7,) and info.exhausted.shape == ()
