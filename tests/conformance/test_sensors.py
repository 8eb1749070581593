"""What every sensor owes: run over `sensors.REGISTRY`, so a new sensor inherits it all.

Jacobians of `observe` and `invert`, their round trips, dtypes and hard states, the residual and the
noise are what `verify` checks: see test_jacobians. That the map may have any frame is a law of
test_properties.
"""

from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from owed import DTYPES, bad_covariances, of_rows, random_covariance
from reference.plane import mounted, wrap

from jaxslam.core.protocols import Free
from jaxslam.sensors import REGISTRY

MOUNT = np.array([0.4, -0.3, 0.9])


@pytest.fixture(
    scope="module", params=swept(REGISTRY, "range_bearing", "bearing_inverse_depth", "compass")
)
def made(request, hard_angles):
    """A sensor of the registry, mounted off the robot's centre, its cases and one compiled call."""
    factory = REGISTRY[request.param]
    width = len(factory(lambda z: None).measurements)
    rng = np.random.default_rng(0)
    cov = random_covariance(width, 0)
    has_mount = "mount" in factory.__dataclass_fields__

    def on(mount):
        return {"mount": mount} if has_mount else {}

    sensor = factory(cov, **on(MOUNT))
    bare = factory(cov)
    weights = np.arange(1.0, width**2 + 1).reshape(width, width)

    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 12), hard_angles])
    pose = np.concatenate([rng.normal(size=(len(angles), 2)) * 3, angles[:, None]], axis=1)
    point = pose[:, :2] + rng.normal(size=(len(angles), 2)) * 4
    pose[1:3, :2] += 1e4
    point[1:3] += 1e4
    # Landmarks were first seen from elsewhere: one that remembers from where must not depend on it.
    first = pose + np.random.default_rng(7).normal(size=pose.shape) * [2, 2, 1]
    # The further numbers that it asks for follow the pose.
    velocity = np.random.default_rng(8).normal(size=(len(pose), len(sensor.robot)))

    def placed(pose, point):
        return sensor.position(sensor.embed(pose, point))

    def noise(cov, z):
        return jnp.sum(weights * factory(cov).noise_cov(z))

    def everything(mount, first, pose, velocity, point, there):
        """`there`: where a robot without a mount would stand."""
        landmark = sensor.embed(first, point)
        pose, there = jnp.concatenate([pose, velocity]), jnp.concatenate([there, velocity])
        there = there[: 3 + len(bare.robot)]
        z, s = sensor.observe(pose, landmark), jnp.asarray(sensor.free.mean, pose.dtype)
        inverted = sensor.invert(pose, z, s)

        def by_mount(mount):
            return factory(cov, **on(mount)).observe(pose, landmark)

        return {
            "landmark": landmark,
            "z": z,
            "cov": sensor.noise_cov(z),
            "inverted": inverted,
            "position": sensor.position(landmark),
            "residual": sensor.residual(z, z + 1),
            "bare": sensor.residual(bare.observe(there, landmark), z),
            "at mount": by_mount(mount),
            "embed slopes": jax.jacfwd(sensor.embed, argnums=(0, 1))(first, point),
            "placed slopes": jax.jacrev(placed, argnums=(0, 1))(first, point),
            "invert slopes": jax.jacfwd(sensor.invert, argnums=(0, 1, 2))(pose, z, s),
            "position slopes": jax.jacfwd(sensor.position)(inverted),
            "residual slopes": jax.jacfwd(sensor.residual, argnums=(0, 1))(z, z[::-1]),
            "mount slopes": jax.jacrev(by_mount)(mount),
            "noise slopes": jax.grad(noise)(jnp.asarray(cov, pose.dtype), z),
        }

    program = of_rows(everything)

    def call(first=first, pose=pose, point=point, mount=MOUNT, dtype=np.float64):
        mounts = np.broadcast_to(mount, pose.shape)
        rows = (mounts, first, pose, velocity, point, mounted(pose, MOUNT))
        return program(*(row.astype(dtype) for row in rows))

    return SimpleNamespace(
        name=request.param,
        factory=factory,
        sensor=sensor,
        cov=cov,
        weights=weights,
        pose=pose,
        first=first,
        point=point,
        absolute=not sensor.landmark,
        has_mount=has_mount,
        free=len(sensor.free.mean),
        call=call,
        usual=call(),
    )


def test_record_is_complete(made):
    sensor = made.sensor
    assert sensor.name == made.name
    assert type(sensor) is made.factory
    assert all("[" in unit for unit in sensor.measurements + sensor.landmark)
    assert sensor.free.mean.shape == (made.free,)
    assert sensor.free.cov.shape == (made.free, made.free)
    if made.free:
        assert np.linalg.eigvalsh(sensor.free.cov)[0] > 0
    if made.absolute:
        assert made.free == 0
        assert made.usual["landmark"].shape == made.usual["inverted"].shape == (len(made.pose), 0)
        np.testing.assert_array_equal(made.usual["position"], np.zeros_like(made.point))
        return
    # Enough to invert: where the landmark stands follows from what is measured and what is free, and
    # all of its parameters from these and the pose.
    assert len(sensor.measurements) + made.free >= 2
    by_all = np.concatenate(made.usual["invert slopes"], axis=2)
    assert np.all(np.linalg.matrix_rank(by_all) == len(sensor.landmark))
    by_seen = made.usual["position slopes"] @ by_all[:, :, 3 + len(sensor.robot) :]
    assert np.all(np.linalg.matrix_rank(by_seen) == 2)
    # position undoes embed
    np.testing.assert_allclose(made.usual["position"], made.point, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("dtype", DTYPES)
def test_dtypes_and_finite_derivatives_also_of_a_landmark_at_the_robot_or_at_the_sensor(
    made, dtype
):
    hit = made.pose.copy()
    hit[0] = 0  # hit to the last bit
    at_robot, at_sensor = hit[:, :2], mounted(hit, MOUNT)[:, :2]
    cases = [(made.first, made.pose, made.point)]
    cases += [(first, hit, at) for at in (at_robot, at_sensor) for first in (hit, made.first)]
    for case in cases:
        out = made.call(*case, dtype=dtype)
        chex.assert_tree_all_finite(out)
        assert {leaf.dtype for leaf in jax.tree.leaves(out)} == {np.dtype(dtype)}


def test_float32_agrees_with_float64(made):
    near = np.abs(made.pose).max(axis=1) < 100
    angular = [unit.endswith("[rad]") for unit in made.sensor.measurements]
    gap = made.call(dtype=np.float32)["z"].astype(float) - made.usual["z"]
    gap = np.where(angular, wrap(gap), gap)
    assert np.abs(gap[near]).max() < 1e-4


def test_jit_is_no_jit_and_vmap_is_a_loop(made):
    """Of what `verify` does not call by itself."""
    sensor, usual = made.sensor, jax.tree.map(lambda leaf: leaf[5], made.usual)
    z, landmark = jnp.asarray(usual["z"]), jnp.asarray(usual["landmark"])
    one = {
        "cov": sensor.noise_cov(z),
        "residual": sensor.residual(z, z + 1),
        "position": sensor.position(landmark),
        "landmark": sensor.embed(jnp.asarray(made.first[5]), jnp.asarray(made.point[5])),
    }
    chex.assert_trees_all_close(one, {name: usual[name] for name in one}, rtol=1e-12, atol=1e-12)


def test_a_mounting_pose_is_a_robot_that_stands_there(made):
    """observe with mount m from pose = observe without mount from pose ∘ m; but not a rate, since
    a sensor beside the centre moves otherwise than a robot that stands there."""
    at_rest = [not unit.endswith("/s]") for unit in made.sensor.measurements]
    np.testing.assert_allclose(made.usual["bare"][:, at_rest], 0, atol=1e-10)


def test_residual_has_slope_one_in_the_measurement(made):
    by_z, by_z_hat = made.usual["residual slopes"]
    eye = np.broadcast_to(np.eye(by_z.shape[1]), by_z.shape)
    np.testing.assert_allclose(by_z, eye, atol=1e-14)
    np.testing.assert_allclose(by_z_hat, -eye, atol=1e-14)


# --- noise and parameters -----------------------------------------------------------------------


def test_noise_covariance_is_the_given_one(made):
    cov = made.usual["cov"]
    np.testing.assert_array_equal(cov, np.broadcast_to(made.cov, cov.shape))


def test_noise_covariance_may_be_a_function_of_the_measurement(made):
    width = len(made.sensor.measurements)
    sensor = made.factory(lambda z: (1 + jnp.sum(z**2)) * jnp.eye(width))
    z = np.arange(1.0, width + 1)
    np.testing.assert_allclose(jax.jit(sensor.noise_cov)(z), (1 + np.sum(z**2)) * np.eye(width))
    assert jax.eval_shape(sensor.noise_cov, z.astype("f4")).dtype == np.float32
    wrong = made.factory(lambda z: jnp.eye(width + 1))
    with pytest.raises(ValueError, match=made.factory.__name__):
        jax.eval_shape(wrong.noise_cov, z)


def test_bad_noise_covariances_and_mounting_poses_are_refused(made):
    for bad in bad_covariances(len(made.sensor.measurements)).values():
        with pytest.raises(ValueError, match=made.factory.__name__):
            made.factory(bad)
    bad_mounts = ((0.0, 0.0), np.eye(3), (0.0, np.nan, 0.0), (np.inf, 0.0, 0.0))
    for mount in bad_mounts if made.has_mount else ():
        with pytest.raises(ValueError, match=f"{made.factory.__name__}.*mounting pose"):
            made.factory(made.cov, mount=mount)


def prior(made, free):
    return {"inverse_distance" if made.name == "bearing_inverse_depth" else "free": free}


def test_the_prior_is_the_given_one_in_any_dtype(made):
    if made.free == 0:
        pytest.skip("nothing is free")
    k = made.free
    mean, cov = np.arange(1.0, k + 1) / 3, np.eye(k) / 7
    for free in (Free(mean, cov), (mean, cov), (list(mean), cov.tolist())):
        kept = made.factory(made.cov, **prior(made, free)).free
        # Not in the width JAX happens to have when the factory is called.
        assert isinstance(kept.mean, np.ndarray) and isinstance(kept.cov, np.ndarray)
        np.testing.assert_array_equal(kept.mean, mean, strict=True)
        np.testing.assert_array_equal(kept.cov, cov, strict=True)

    def total(free):
        mean, cov = made.factory(made.cov, **prior(made, free)).free
        return 2 * jnp.sum(mean) + 3 * jnp.sum(cov)

    slopes = jax.jit(jax.grad(total))((mean, cov))
    for slope, weight in zip(slopes, (2, 3), strict=True):
        np.testing.assert_array_equal(slope, np.full(slope.shape, weight))


def test_bad_priors_are_refused(made):
    if made.free == 0:
        pytest.skip("nothing is free")
    k = made.free
    mean, cov = np.ones(k), np.eye(k)
    bad = {
        "mean shape": (np.ones(k + 1), cov),
        "mean nan": (np.full(k, np.nan), cov),
        "mean infinite": (np.full(k, np.inf), cov),
        "mean text": (np.array(["a"] * k), cov),
        "cov shape": (mean, np.ones(k)),
        "cov nan": (mean, np.nan * cov),
        "cov negative": (mean, -cov),
        "cov zero": (mean, 0 * cov),
        "not a pair": 3.0,
        "three": (mean, cov, cov),
    }
    for free in bad.values():
        with pytest.raises(ValueError, match=f"^{made.factory.__name__}: "):
            made.factory(made.cov, **prior(made, free))


def test_gradients_reach_noise_and_mount_through_the_factory(made, differences):
    slopes = made.usual["noise slopes"]
    np.testing.assert_allclose(slopes, np.broadcast_to(made.weights, slopes.shape), rtol=1e-14)
    if not made.has_mount:
        return
    by_mount = made.usual["mount slopes"]
    mounts = np.broadcast_to(MOUNT, made.pose.shape)
    by_differences = differences(lambda mount: made.call(mount=mount)["at mount"], (mounts,), 0)
    near = np.abs(made.pose).max(axis=1) < 100
    np.testing.assert_allclose(by_mount[near], by_differences[near], atol=1e-8)
    assert np.abs(by_mount).max() > 0.1
