"""What every sensor owes: run over `sensors.REGISTRY`, so a new sensor inherits it all."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.sensors import REGISTRY

DTYPES = [np.float32, np.float64]
MOUNT = np.array([0.4, -0.3, 0.9])


def random_covariance(rng, n):
    root = rng.normal(size=(n, n)) * 0.1
    return root @ root.T


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
    embed = jax.jit(jax.vmap(sensor.embed))
    landmark = np.asarray(embed(pose, point))

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
            "residual": sensor.residual(z, z + 1),
        }

    return SimpleNamespace(
        name=request.param,
        factory=factory,
        sensor=sensor,
        cov=cov,
        pose=pose,
        point=point,
        landmark=landmark,
        angular=np.array([unit.endswith("[rad]") for unit in sensor.measurements]),
        batched=jax.jit(jax.vmap(everything)),
        embed=embed,
        observe=jax.jit(jax.vmap(sensor.observe)),
        residual=jax.jit(jax.vmap(sensor.residual)),
        invert=jax.jit(jax.vmap(sensor.invert)),
    )


def free_parameters(made, count):
    mean, cov = (np.asarray(part) for part in made.sensor.free)
    if len(mean) == 0:
        return np.zeros((count, 0))
    return np.random.default_rng(5).multivariate_normal(mean, cov, count)


def test_record_is_complete(made):
    sensor = made.sensor
    assert sensor.name == made.name == made.factory.__name__
    assert all("[" in unit for unit in sensor.measurements)
    free = len(sensor.free.mean)
    assert sensor.free.cov.shape == (free, free)
    assert len(sensor.measurements) + free >= len(sensor.landmark)  # enough to invert
    if free:
        assert np.linalg.eigvalsh(sensor.free.cov)[0] > 0


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
        np.testing.assert_allclose(a[near], b[near], atol=1e-4 * np.abs(b).max())


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


def test_forward_and_reverse_derivatives_agree(made):
    out = made.batched(made.pose, made.landmark)
    for kind in ("", "invert "):
        for a, b in zip(out[f"{kind}forward"], out[f"{kind}reverse"], strict=True):
            atol = 1e-12 * np.abs(a).max(initial=0)
            np.testing.assert_allclose(a.sum(axis=1), b, rtol=1e-12, atol=atol)


def test_autodiff_is_differences(made, differences):
    """Of every argument of observe and invert, with or without hand-derived Jacobians."""
    pose, landmark = made.pose, made.landmark
    # Differences lose digits to coordinates of 1e4 m.
    atol = np.where(np.abs(pose).max(axis=1) < 100, 1e-7, 1e-5)[:, None, None]
    out = made.batched(pose, landmark)
    for k, auto in enumerate(out["forward"]):
        by_differences = differences(made.observe, (pose, landmark), k)
        assert np.all(np.abs(auto - by_differences) < atol * (1 + np.abs(auto).max()))
    s = np.tile(np.asarray(made.sensor.free.mean), (len(pose), 1))
    for k, auto in enumerate(out["invert forward"]):
        by_differences = differences(made.invert, (pose, np.asarray(out["z"]), s), k)
        assert auto.shape == by_differences.shape
        assert np.all(np.abs(auto - by_differences) < atol * (1 + np.max(np.abs(auto), initial=0)))


def test_hand_jacobians_are_autodiff(made):
    sensor = made.sensor
    if sensor.observe_jacobians is None and sensor.invert_jacobians is None:
        pytest.skip("brings no hand-derived Jacobians")
    out = made.batched(made.pose, made.landmark)
    s = np.tile(np.asarray(sensor.free.mean), (len(made.pose), 1))
    calls = []
    if sensor.observe_jacobians is not None:
        calls.append((sensor.observe_jacobians, (made.pose, made.landmark), out["forward"]))
    if sensor.invert_jacobians is not None:
        arguments = (made.pose, np.asarray(out["z"]), s)
        calls.append((sensor.invert_jacobians, arguments, out["invert forward"]))
    for hand, arguments, auto in calls:
        by_hand = jax.jit(jax.vmap(hand))(*arguments)
        assert len(by_hand) == len(auto)
        for a, b in zip(by_hand, auto, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * np.max(np.abs(b), initial=1))
        single = jax.eval_shape(jax.vmap(hand), *(a.astype("f4") for a in arguments))
        assert {j.dtype for j in single} == {np.dtype("f4")}


# --- invert, embed, position --------------------------------------------------------------------


def test_observe_undoes_invert_whatever_the_free_parameters(made):
    z = np.asarray(made.observe(made.pose, made.landmark))
    s = free_parameters(made, len(z))
    again = made.observe(made.pose, made.invert(made.pose, z, s))
    np.testing.assert_allclose(made.residual(np.asarray(again), z), 0, atol=1e-11)


def test_invert_undoes_observe_for_a_full_measurement(made):
    if len(made.sensor.free.mean):
        pytest.skip("a measurement does not determine the landmark")
    out = made.batched(made.pose, made.landmark)
    np.testing.assert_allclose(out["inverted"], made.landmark, rtol=1e-12, atol=1e-11)


def test_position_undoes_embed(made):
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
    pose, point = made.pose, made.point
    carried = np.concatenate([pose[:, :2] @ r.T + [5, -2], pose[:, 2:] + turn], axis=1)
    landmark = np.asarray(made.embed(carried, point @ r.T + [5, -2]))
    before, after = made.observe(pose, made.landmark), made.observe(carried, landmark)
    np.testing.assert_allclose(made.residual(np.asarray(after), np.asarray(before)), 0, atol=1e-10)


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
        landmark = np.asarray(made.embed(pose, point))
        for leaf in jax.tree.leaves(made.batched(pose, landmark)):
            assert leaf.dtype == dtype
            assert np.isfinite(leaf).all()
        if made.sensor.observe_jacobians is not None:
            for leaf in made.sensor.observe_jacobians(
                jnp.asarray(pose[0]), jnp.asarray(landmark[0])
            ):
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
