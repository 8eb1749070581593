"""What every sensor owes: run over `sensors.REGISTRY`, so a new sensor inherits it all."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.protocols import Free
from jaxslam.sensors import REGISTRY

DTYPES = [np.float32, np.float64]
MOUNT = np.array([0.4, -0.3, 0.9])
NO_LANDMARK = "an absolute sensor has no landmark"

# How the measurement of an absolute sensor moves when the map is turned by `turn` (r its matrix) and
# then shifted. A new absolute sensor says so here.
MOVED = {
    "compass": lambda z, r, turn, shift: z + turn,
    "position_fix": lambda z, r, turn, shift: z @ r.T + shift,
}


def random_covariance(rng, n):
    root = rng.normal(size=(n, n)) * 0.1
    return root @ root.T


def compiled(function):
    """The function of one row as one of a batch, in NumPy."""
    batched = jax.jit(jax.vmap(function))
    return lambda *rows: jax.device_get(batched(*rows))


@pytest.fixture(scope="module", params=REGISTRY)
def made(request, hard_angles):
    """A sensor of the registry, mounted off the robot's centre, and its compiled functions."""
    factory = REGISTRY[request.param]
    width = len(factory(lambda z: None).measurements)
    rng = np.random.default_rng(0)
    cov = random_covariance(rng, width)
    sensor = factory(cov, mount=MOUNT)

    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 12), hard_angles])
    pose = np.concatenate([rng.normal(size=(len(angles), 2)) * 3, angles[:, None]], axis=1)
    point = pose[:, :2] + rng.normal(size=(len(angles), 2)) * 4
    pose[1:3, :2] += 1e4
    point[1:3] += 1e4
    # Landmarks were first seen from elsewhere: one that remembers from where must not depend on it.
    first = pose + np.random.default_rng(7).normal(size=pose.shape) * [2, 2, 1]
    embed = compiled(sensor.embed)
    landmark = embed(first, point)

    def total(*arguments):
        return jnp.sum(sensor.observe(*arguments))

    def total_inverted(*arguments):
        return jnp.sum(sensor.invert(*arguments))

    def everything(pose, landmark):
        z, s = sensor.observe(pose, landmark), jnp.asarray(sensor.free.mean, pose.dtype)
        return {
            "z": z,
            "cov": sensor.noise_cov(z),
            "inverted": sensor.invert(pose, z, s),
            "position": sensor.position(landmark),
            "forward": jax.jacfwd(sensor.observe, argnums=(0, 1))(pose, landmark),
            "reverse": jax.grad(total, argnums=(0, 1))(pose, landmark),
            "invert forward": jax.jacfwd(sensor.invert, argnums=(0, 1, 2))(pose, z, s),
            "invert reverse": jax.grad(total_inverted, argnums=(0, 1, 2))(pose, z, s),
            "position forward": jax.jacfwd(sensor.position)(sensor.invert(pose, z, s)),
            "residual": sensor.residual(z, z + 1),
        }

    def placed(pose, point):
        return sensor.position(sensor.embed(pose, point))

    def placing(pose, point):
        return {
            "embed": jax.jacfwd(sensor.embed, argnums=(0, 1))(pose, point),
            "position": jax.jacrev(placed, argnums=(0, 1))(pose, point),
        }

    return SimpleNamespace(
        name=request.param,
        factory=factory,
        sensor=sensor,
        cov=cov,
        pose=pose,
        first=first,
        point=point,
        landmark=landmark,
        absolute=not sensor.landmark,
        free=len(sensor.free.mean),
        angular=np.array([unit.endswith("[rad]") for unit in sensor.measurements]),
        batched=compiled(everything),
        placing=compiled(placing),
        embed=embed,
        observe=compiled(sensor.observe),
        residual=compiled(sensor.residual),
        invert=compiled(sensor.invert),
        carried=compiled(sensor.carried),
    )


def free_parameters(made, count):
    """s (count, K) from the bulk of the prior, so that a range with mean 2 σ is positive."""
    mean, cov = (np.asarray(part) for part in made.sensor.free)
    if len(mean) == 0:
        return np.zeros((count, 0))
    spread = np.random.default_rng(5).uniform(-1.9, 1.9, (count, len(mean)))
    return mean + spread @ np.linalg.cholesky(cov).T


def test_record_is_complete(made):
    sensor = made.sensor
    assert sensor.name == made.name == made.factory.__name__
    assert all("[" in unit for unit in sensor.measurements + sensor.landmark)
    assert sensor.free.mean.shape == (made.free,)
    assert sensor.free.cov.shape == (made.free, made.free)
    if made.free:
        assert np.linalg.eigvalsh(sensor.free.cov)[0] > 0
    if made.absolute:
        assert made.free == 0
        return
    # Enough to invert: where the landmark stands follows from what is measured and what is free, and
    # all of its parameters from these and the pose.
    assert len(sensor.measurements) + made.free >= 2
    out = made.batched(made.pose, made.landmark)
    by_all = np.concatenate(out["invert forward"], axis=2)
    assert np.all(np.linalg.matrix_rank(by_all) == len(sensor.landmark))
    by_seen = out["position forward"] @ by_all[:, :, 3:]
    assert np.all(np.linalg.matrix_rank(by_seen) == 2)


@pytest.mark.parametrize("dtype", DTYPES)
def test_shapes_and_dtypes(made, dtype):
    out = made.batched(made.pose.astype(dtype), made.landmark.astype(dtype))
    count, z, size = len(made.pose), len(made.sensor.measurements), len(made.sensor.landmark)
    free = len(made.sensor.free.mean)
    assert out["z"].shape == out["residual"].shape == (count, z)
    assert out["cov"].shape == (count, z, z)
    assert out["inverted"].shape == (count, size)
    assert out["position"].shape == (count, 2)
    assert [j.shape for j in out["forward"]] == [(count, z, 3), (count, z, size)]
    shapes = [(count, size, 3), (count, size, z), (count, size, free)]
    assert [j.shape for j in out["invert forward"]] == shapes
    for leaf in jax.tree.leaves(out):
        assert leaf.dtype == dtype
        assert np.isfinite(leaf).all()


def test_float32_agrees_with_float64(made):
    near = np.abs(made.pose).max(axis=1) < 100
    single = made.batched(made.pose.astype("f4"), made.landmark.astype("f4"))
    double = made.batched(made.pose, made.landmark)
    gap = np.abs(made.residual(np.asarray(single["z"], float), np.asarray(double["z"])))
    assert gap[near].max() < 1e-4
    for a, b in zip(single["forward"], double["forward"], strict=True):
        np.testing.assert_allclose(a[near], b[near], atol=1e-4 * np.max(np.abs(b), initial=0))


def test_jit_is_no_jit_and_vmap_is_a_loop(made):
    batched = made.batched(made.pose, made.landmark)
    sensor = made.sensor
    for i in (0, 5):
        pose, landmark = jnp.asarray(made.pose[i]), jnp.asarray(made.landmark[i])
        z, s = sensor.observe(pose, landmark), jnp.asarray(sensor.free.mean, pose.dtype)
        one = {"z": z, "cov": sensor.noise_cov(z), "residual": sensor.residual(z, z + 1)}
        one |= {"inverted": sensor.invert(pose, z, s), "position": sensor.position(landmark)}
        for name, value in one.items():
            np.testing.assert_allclose(value, batched[name][i], rtol=1e-12, atol=1e-12)


# --- invert, embed, position --------------------------------------------------------------------


def test_observe_undoes_invert_whatever_the_free_parameters(made):
    z = np.asarray(made.observe(made.pose, made.landmark))
    s = free_parameters(made, len(z))
    again = made.observe(made.pose, made.invert(made.pose, z, s))
    np.testing.assert_allclose(made.residual(np.asarray(again), z), 0, atol=1e-11)


def test_invert_undoes_observe_for_a_full_measurement(made):
    if made.free:
        pytest.skip("a measurement does not determine the landmark; see the next test")
    if made.absolute:
        pytest.skip(NO_LANDMARK)
    out = made.batched(made.pose, made.landmark)
    np.testing.assert_allclose(out["inverted"], made.landmark, rtol=1e-12, atol=1e-11)


def test_invert_undoes_observe_for_some_value_of_what_is_free(made):
    """Found by Gauss-Newton from a few places in the prior; the best of them must be exact."""
    if made.free == 0:
        pytest.skip("nothing is free")
    sensor = made.sensor
    angular = np.array([unit.endswith("[rad]") for unit in sensor.landmark])
    landmark = np.asarray(made.embed(made.pose, made.point))
    z = np.asarray(made.observe(made.pose, landmark))

    def gap(s, pose, z, landmark):
        difference = sensor.invert(pose, z, s) - landmark
        return jnp.where(angular, (difference + np.pi) % (2 * np.pi) - np.pi, difference)

    def solve(pose, z, landmark, start):
        def step(_, s):
            slope = jax.jacfwd(gap)(s, pose, z, landmark)
            return s - jnp.linalg.solve(slope.T @ slope, slope.T @ gap(s, pose, z, landmark))

        s = jax.lax.fori_loop(0, 20, step, start)
        return jnp.max(jnp.abs(gap(s, pose, z, landmark)))

    several = jax.vmap(jax.vmap(solve, (0, 0, 0, None)), (None, None, None, 0))
    left = jax.jit(several)(made.pose, z, landmark, free_parameters(made, 8)).min(axis=0)
    assert np.all(left < 1e-11 * (1 + np.abs(landmark).max(axis=1)))


def test_an_absolute_sensor_has_no_landmark(made):
    if not made.absolute:
        pytest.skip("has one")
    out = made.batched(made.pose, made.landmark)
    count = len(made.pose)
    assert made.landmark.shape == out["inverted"].shape == (count, 0)
    np.testing.assert_array_equal(out["position"], np.zeros((count, 2)))


def test_position_undoes_embed(made):
    if made.absolute:
        pytest.skip(NO_LANDMARK)
    placed = made.batched(made.pose, made.landmark)["position"]
    np.testing.assert_allclose(placed, made.point, rtol=1e-12, atol=1e-11)


def test_a_mounting_pose_is_a_robot_that_stands_there(made):
    """observe with mount m from pose = observe without mount from pose ∘ m."""
    bare = made.factory(made.cov)
    c, s = np.cos(made.pose[:, 2]), np.sin(made.pose[:, 2])
    there = np.stack(
        [
            made.pose[:, 0] + c * MOUNT[0] - s * MOUNT[1],
            made.pose[:, 1] + s * MOUNT[0] + c * MOUNT[1],
            made.pose[:, 2] + MOUNT[2],
        ],
        axis=1,
    )
    moved = jax.jit(jax.vmap(bare.observe))(there, made.landmark)
    mounted = made.observe(made.pose, made.landmark)
    np.testing.assert_allclose(made.residual(np.asarray(mounted), np.asarray(moved)), 0, atol=1e-10)


def test_what_is_seen_does_not_depend_on_where_the_world_puts_its_origin(made):
    turn = 2.2
    r = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    pose = made.pose
    carried = np.concatenate([pose[:, :2] @ r.T + [5, -2], pose[:, 2:] + turn], axis=1)
    landmark = made.carried(np.tile([5, -2, turn], (len(pose), 1)), made.landmark)
    before = np.asarray(made.observe(pose, made.landmark))
    after = np.asarray(made.observe(carried, landmark))
    if made.absolute:  # it sees the map's axes: the measurement moves along
        assert np.abs(made.residual(after, before)).min() > 1e-3
        before = MOVED[made.name](before, r, turn, np.array([5, -2]))
    np.testing.assert_allclose(made.residual(after, before), 0, atol=1e-10)


# --- the residual -------------------------------------------------------------------------------


def test_residual_is_zero_at_equality_and_antisymmetric(made):
    z = np.asarray(made.observe(made.pose, made.landmark))
    np.testing.assert_array_equal(made.residual(z, z), np.zeros_like(z))
    other = z[::-1] + 0.1
    np.testing.assert_allclose(made.residual(z, other), -made.residual(other, z), atol=1e-12)


def test_residual_wraps_the_angles_and_nothing_else(made):
    z = np.asarray(made.observe(made.pose, made.landmark))
    other = z[::-1] + np.where(made.angular, 40.0, 0.0)
    out = np.asarray(made.residual(z, other))
    for turns in (1, -3):
        whole = np.where(made.angular, 2 * np.pi * turns, 0.0)
        np.testing.assert_allclose(made.residual(z + whole, other), out, atol=1e-10)
    np.testing.assert_allclose(out[:, ~made.angular], (z - other)[:, ~made.angular], atol=1e-12)
    assert np.all(np.abs(out[:, made.angular]) <= np.pi)
    # To the number: a difference below half a turn comes out as it is.
    small = np.random.default_rng(1).uniform(-3, 3, z.shape)
    np.testing.assert_allclose(made.residual(z + small, z), small, atol=1e-11)


def test_residual_has_slope_one_in_the_measurement(made):
    z = np.asarray(made.observe(made.pose, made.landmark))
    by_z, by_z_hat = jax.jit(jax.vmap(jax.jacfwd(made.sensor.residual, argnums=(0, 1))))(z, z[::-1])
    eye = np.broadcast_to(np.eye(z.shape[1]), by_z.shape)
    np.testing.assert_allclose(by_z, eye, atol=1e-14)
    np.testing.assert_allclose(by_z_hat, -eye, atol=1e-14)


# --- singular places ----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_landmark_at_the_robot_or_at_the_sensor_is_finite_with_all_derivatives(made, dtype):
    c, s = np.cos(made.pose[:, 2]), np.sin(made.pose[:, 2])
    at_sensor = made.pose[:, :2] + np.stack(
        [c * MOUNT[0] - s * MOUNT[1], s * MOUNT[0] + c * MOUNT[1]], axis=1
    )
    for at, there in (([0, 0], made.pose[:, :2]), (MOUNT[:2], at_sensor)):
        pose, point = made.pose.astype(dtype), there.astype(dtype)
        pose[0], point[0] = 0, at  # hit to the last bit
        for first in (pose, made.first.astype(dtype)):
            landmark = np.asarray(made.embed(first, point))
            leaves = jax.tree.leaves((made.batched(pose, landmark), made.placing(first, point)))
            if made.sensor.observe_jacobians is not None:
                hand = made.sensor.observe_jacobians
                leaves += hand(jnp.asarray(pose[0]), jnp.asarray(landmark[0]))
            for leaf in leaves:
                assert leaf.dtype == dtype
                assert np.isfinite(leaf).all()


# --- noise and parameters -----------------------------------------------------------------------


def test_noise_covariance_is_the_given_one(made):
    cov = made.batched(made.pose, made.landmark)["cov"]
    np.testing.assert_array_equal(cov, np.broadcast_to(made.cov, cov.shape))


def test_noise_covariance_may_be_a_function_of_the_measurement(made):
    width = len(made.sensor.measurements)
    sensor = made.factory(lambda z: (1 + jnp.sum(z**2)) * jnp.eye(width))
    z = np.arange(1.0, width + 1)
    np.testing.assert_allclose(sensor.noise_cov(z), (1 + np.sum(z**2)) * np.eye(width))
    assert sensor.noise_cov(jnp.asarray(z, "f4")).dtype == np.float32
    wrong = made.factory(lambda z: jnp.eye(width + 1))
    with pytest.raises(ValueError, match=made.name):
        jax.eval_shape(wrong.noise_cov, z)


def bad_covariances(n):
    skew, broken = np.eye(n), np.eye(n)
    skew[0, -1] += 0.5
    broken[0, 0] = np.nan
    return {
        "shape": np.eye(n + 1),
        "vector": np.ones(n),
        "scalar": 0.1,
        "asymmetric": skew if n > 1 else np.array([[np.nan]]),
        "negative": np.diag([1.0] * (n - 1) + [-0.1]),
        "nan": broken,
    }


@pytest.mark.parametrize("case", bad_covariances(2))
def test_bad_noise_covariances_are_refused(made, case):
    with pytest.raises(ValueError, match=made.name):
        made.factory(bad_covariances(len(made.sensor.measurements))[case])


def test_the_prior_is_the_given_one_in_any_dtype(made):
    if made.free == 0:
        pytest.skip("nothing is free")
    k = made.free
    mean, cov = np.arange(1.0, k + 1) / 3, np.eye(k) / 7
    for free in (Free(mean, cov), (mean, cov), (list(mean), cov.tolist())):
        kept = made.factory(made.cov, free=free).free
        # Not in the width JAX happens to have when the factory is called.
        assert isinstance(kept.mean, np.ndarray) and isinstance(kept.cov, np.ndarray)
        np.testing.assert_array_equal(kept.mean, mean, strict=True)
        np.testing.assert_array_equal(kept.cov, cov, strict=True)

    def total(free):
        mean, cov = made.factory(made.cov, free=free).free
        return 2 * jnp.sum(mean) + 3 * jnp.sum(cov)

    slopes = jax.jit(jax.grad(total))((jnp.asarray(mean), jnp.asarray(cov)))
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
        with pytest.raises(ValueError, match=f"{made.name}: "):
            made.factory(made.cov, free=free)


@pytest.mark.parametrize("mount", [(0.0, 0.0), np.eye(3), (0.0, np.nan, 0.0), (np.inf, 0.0, 0.0)])
def test_bad_mounting_poses_are_refused(made, mount):
    with pytest.raises(ValueError, match=f"{made.name}.*mounting pose"):
        made.factory(made.cov, mount=mount)


def test_gradients_reach_noise_and_mount_through_the_factory(made, differences):
    pose, landmark = made.pose[:1], made.landmark[:1]
    width = len(made.sensor.measurements)
    weights = np.arange(1.0, width**2 + 1).reshape(width, width)

    def noise(cov):
        return jnp.sum(weights * made.factory(cov).noise_cov(jnp.ones(width)))

    np.testing.assert_allclose(jax.grad(noise)(made.cov), weights, rtol=1e-14)

    def observe(mount):
        return made.factory(made.cov, mount=mount).observe(pose[0], landmark[0])

    by_mount = jax.jit(jax.vmap(jax.jacrev(observe)))(MOUNT[None])
    by_differences = differences(jax.jit(jax.vmap(observe)), (MOUNT[None],), 0)
    np.testing.assert_allclose(by_mount, by_differences, atol=1e-8)
    assert np.abs(by_mount).max() > 0.1
