"""The canonical form is the same filter: EIF-SLAM against the EKF, number by number."""

import dataclasses
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from worlds import draw

from jaxslam import filters, run, sensors
from jaxslam.core.types import Status
from jaxslam.simulation.scenarios import BetweenRanges, cloister

KEY = jax.random.key(0)
P0 = np.diag([0.1, 0.1, 0.05]) ** 2
UNGATED = 1 - 1e-15


def world(steps=60, **changes):
    """Three metres of sight in the cloister, from a start that is not exactly known, with a noise
    that grows with the range."""
    sensor = sensors.RangeBearing(sensors.RangeBearingNoise(0.05, np.deg2rad(1.0), share=0.1))
    changes = {"sensor": sensor, "pose_cov": P0} | changes
    changes = {"visible": BetweenRanges(0.0, 3.0), "places": 14} | changes
    return dataclasses.replace(cloister(steps), **changes)


@cache
def drawn():
    """A log of the world, for all tests that change no model."""
    return draw(world())[1]


@cache
def pair(gate):
    """The two filters of 36 landmarks, for all tests; the floor is of a singular start alone."""
    scene = world()
    ekf = filters.EkfSlam(scene.motion, scene.sensor, 36, correction="joint", gate=gate)
    return ekf, filters.EifSlam(scene.motion, scene.sensor, 36, gate=gate, floor=1e-3)


def driven(filter, scene, log, dtype=np.float64, pose_cov=None):
    cov = scene.pose_cov if pose_cov is None else pose_cov
    inputs = jax.tree.map(np.asarray, (log, scene.pose, cov))
    inputs = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == np.float64 else x, inputs)
    return jax.device_get(run(filter, *inputs, KEY))


def assert_same(a, b):
    """Traces of the EKF and of the EIF."""
    for name in ("pose", "pose_cov", "points", "point_covs", "alive", "tag"):
        np.testing.assert_allclose(
            getattr(b.estimate, name), getattr(a.estimate, name), rtol=0, atol=1e-8, err_msg=name
        )
    np.testing.assert_array_equal(a.info.status, b.info.status)
    np.testing.assert_array_equal(a.info.slot, b.info.slot)
    np.testing.assert_array_equal(a.info.dof, b.info.dof)
    for name in ("nis", "innovation", "innovation_cov", "log_likelihood"):
        np.testing.assert_allclose(
            getattr(b.info, name), getattr(a.info, name), rtol=1e-7, atol=1e-8, err_msg=name
        )
    final = b.final
    mean = np.concatenate([final.pose, np.ravel(final.landmarks)])
    np.testing.assert_allclose(np.linalg.solve(final.omega, final.xi), mean, atol=1e-8)
    assert int(final.refused) == 0


@pytest.mark.parametrize("gate", swept([UNGATED, 0.95], 0.95))
def test_eif_is_the_ekf(gate):
    """Without a gate: `test_other_models_full_maps_unknown_tags_and_empty_scans`."""
    a, b = (driven(filter, world(), drawn()) for filter in pair(gate))
    assert_same(a, b)
    assert ((a.info.status == Status.REJECTED).sum() > 0) == (gate == 0.95)


@pytest.mark.parametrize("dtype", swept([jnp.float32, jnp.float64], jnp.float64))
def test_a_certain_start_gets_the_floor(dtype):
    """P0 = 0 has no inverse: the filter is the EKF that starts with floor² I."""
    ekf, eif = pair(UNGATED)
    a = driven(ekf, world(), drawn(), pose_cov=1e-6 * np.eye(3))
    b = driven(eif, world(), drawn(), dtype, pose_cov=np.zeros((3, 3)))
    assert b.estimate.pose.dtype == dtype
    atol = 1e-8 if dtype == jnp.float64 else 1e-3
    np.testing.assert_allclose(b.estimate.pose, a.estimate.pose, atol=atol)
    np.testing.assert_allclose(b.estimate.points, a.estimate.points, atol=10 * atol)
    assert int(b.final.refused) == 0


@pytest.mark.sweep
def test_other_models_full_maps_unknown_tags_and_empty_scans():
    """Landmarks of three parameters, in the canonical form as in the other, in too small a map."""
    sensor = sensors.RangeBearingSignature(np.diag([0.1, 0.02, 0.1]) ** 2)
    points = np.concatenate([cloister().landmarks, np.arange(36)[:, None] * 0.3], axis=1)
    scene = world(15, sensor=sensor, landmarks=points)
    log = draw(scene, 3)[1]
    tag, valid = log.scan.tag.copy(), log.scan.valid.copy()
    tag[:, 0] = -1
    valid[7] = False
    log = log._replace(scan=log.scan._replace(tag=tag, valid=valid))
    a = driven(filters.EkfSlam(scene.motion, scene.sensor, 5, correction="joint"), scene, log)
    b = driven(filters.EifSlam(scene.motion, scene.sensor, 5), scene, log)
    assert_same(a, b)
    assert (b.info.status == Status.OVERFLOW).any()
    assert (b.info.status == Status.UNMATCHED).any()
    np.testing.assert_allclose(b.final.landmarks, a.final.landmarks, atol=1e-8)


def test_a_lost_definiteness_is_refused_counted_and_recovered():
    log, eif = drawn(), pair(UNGATED)[1]
    update = jax.jit(eif.update)
    state = driven(eif, world(), log).final
    omega = state.omega.copy()
    omega[0, 0] = -1.0
    bad = state._replace(omega=omega)
    scan = jax.tree.map(lambda leaf: leaf[-1], log.scan)
    after, info = update(bad, scan, KEY)
    assert int(after.refused) == 1
    np.testing.assert_array_equal(after.pose, bad.pose)
    assert np.all(np.asarray(info.status)[np.asarray(scan.valid)] == Status.SINGULAR)
    # One that is indefinite by rounding alone comes back with what the next scan brings.
    part = np.flatnonzero(np.concatenate([[True] * 3, np.repeat(state.alive, 2)]))
    omega = np.array(state.omega)
    size, axes = np.linalg.eigh(omega[np.ix_(part, part)])
    slip = size[0] + 1e-12 * size[-1]
    omega[np.ix_(part, part)] -= slip * np.outer(axes[:, 0], axes[:, 0])
    bad = state._replace(omega=omega)
    after, _ = update(bad, scan, KEY)
    assert int(after.refused) == 1
    after, info = update(after, scan, KEY)
    assert int(after.refused) == 1
    assert (np.asarray(info.status) == Status.FUSED).any()


@pytest.mark.sweep
def test_gradients_and_batches():
    """Of six steps, which are as in the run of all, alone."""
    log = jax.tree.map(lambda leaf: leaf[:6], drawn())

    def eif(sigma):
        sensor = sensors.RangeBearing(jnp.diag(jnp.stack([sigma, np.deg2rad(1.0)])) ** 2)
        return filters.EifSlam(world().motion, sensor, 36, floor=1e-3)

    def loss(sigma, z):
        changed = log._replace(scan=log.scan._replace(z=z))
        return run(eif(sigma), changed, world().pose, P0, KEY).estimate.pose[-1, :2].sum()

    step = 1e-5
    sigma = np.array([0.1, 0.1 + step, 0.1 - step, 0.1])
    z = np.stack([log.scan.z] * 3 + [log.scan.z + 0.01])
    batch, slopes = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1))))(sigma, z)
    chex.assert_tree_all_finite(slopes)
    np.testing.assert_allclose(slopes[0][0], (batch[1] - batch[2]) / (2 * step), rtol=1e-4)
    alone = driven(eif(0.1), world(), drawn()).estimate.pose[5, :2].sum()
    np.testing.assert_allclose(batch[0], alone, rtol=1e-9)
    assert batch[3] != batch[0]


@refused(
    ({"capacity": 0}, "capacity"),
    ({"gate": 0.0}, "gate: expected a probability above 0 and below 1"),
    ({"floor": 0.0}, "floor: expected a number above 0"),
    ({"sensor": sensors.Compass([[1e-4]])}, "a sensor of landmarks"),
)
def test_refusals(changes):
    scene = world(2)
    options = {"motion": scene.motion, "sensor": scene.sensor, "capacity": 36} | changes
    filters.EifSlam(**options)
