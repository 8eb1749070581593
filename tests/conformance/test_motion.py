"""What every motion model owes: run over `motion.REGISTRY`, so a new model inherits it all."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.motion import REGISTRY

DTYPES = [np.float32, np.float64]


def random_covariance(rng, n):
    root = rng.normal(size=(n, n)) * 0.1
    return root @ root.T


def cases_of(model, hard_angles):
    """Poses, controls and noises (C, ·): random, hard headings, large coordinates, no motion."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 8), hard_angles])
    n = len(angles)
    pose = np.concatenate([rng.normal(size=(n, 2)) * 3, angles[:, None]], axis=1)
    u, w = rng.normal(size=(n, len(model.controls))), rng.normal(size=(n, len(model.noises))) * 0.1
    u = np.where([unit.endswith("[s]") for unit in model.controls], np.abs(u), u)  # time passes
    u[:: max(1, n // 6)] = 0
    w[:: max(1, n // 3)] = 0
    pose[1:3, :2] *= 1e4
    for k, unit in enumerate(model.controls):
        if unit == "steering [rad]":  # wheels do not turn to the side, noise or not
            u[:, k] = np.clip(u[:, k], -1, 1)
            if unit in model.noises:
                j = model.noises.index(unit)
                w[:, j] = np.clip(u[:, k] + w[:, j], -1, 1) - u[:, k]
    return pose, u, w


@pytest.fixture(scope="module", params=REGISTRY)
def made(request, hard_angles):
    """A model of the registry with a random noise covariance, its cases, and one compiled call."""
    factory = REGISTRY[request.param]
    width = len(factory(lambda pose, u: None).noises)
    cov = random_covariance(np.random.default_rng(1), width)
    model = factory(cov)

    def everything(pose, u, w):
        out = {"step": model.step(pose, u, w), "cov": model.noise_cov(pose, u)}
        out["forward"] = jax.jacfwd(model.step, argnums=(0, 1, 2))(pose, u, w)
        total = jax.grad(lambda *a: jnp.sum(model.step(*a)), argnums=(0, 1, 2))
        out["reverse"] = total(pose, u, w)
        if model.perturb is not None:
            out["perturbed"] = model.step(pose, model.perturb(u, w), jnp.zeros_like(w))
        return out

    return SimpleNamespace(
        name=request.param,
        factory=factory,
        model=model,
        cov=cov,
        cases=cases_of(model, hard_angles),
        batched=jax.jit(jax.vmap(everything)),
    )


def test_record_is_complete(made):
    model = made.model
    assert model.name == made.name == made.factory.__name__
    assert model.controls
    assert model.noises
    assert all("[" in unit for unit in (*model.controls, *model.noises))


@pytest.mark.parametrize("dtype", DTYPES)
def test_shapes_and_dtypes(made, dtype):
    pose, u, w = (a.astype(dtype) for a in made.cases)
    out = made.batched(pose, u, w)
    count, widths = len(pose), (3, u.shape[1], w.shape[1])
    assert out["step"].shape == (count, 3)
    assert out["cov"].shape == (count, w.shape[1], w.shape[1])
    assert [j.shape for j in out["forward"]] == [(count, 3, n) for n in widths]
    for leaf in jax.tree.leaves(out):
        assert leaf.dtype == dtype
        assert np.isfinite(leaf).all()
    assert np.all(np.abs(out["step"][:, 2]) <= dtype(np.pi))


def test_float32_agrees_with_float64(made):
    single = made.batched(*(a.astype("f4") for a in made.cases))
    double = made.batched(*made.cases)
    turned = np.exp(1j * single["step"][:, 2]) - np.exp(1j * double["step"][:, 2])
    assert np.abs(turned).max() < 1e-5
    np.testing.assert_allclose(single["step"][:, :2], double["step"][:, :2], rtol=1e-6, atol=1e-5)
    for a, b in zip(single["forward"], double["forward"], strict=True):
        np.testing.assert_allclose(a, b, atol=3e-6)


def test_jit_is_no_jit_and_vmap_is_a_loop(made):
    batched = made.batched(*made.cases)
    for i in (0, 1, -1):
        pose, u, w = (jnp.asarray(a[i]) for a in made.cases)
        one = made.model.step(pose, u, w)
        np.testing.assert_allclose(one, batched["step"][i], rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal(made.model.noise_cov(pose, u), batched["cov"][i])


def test_noise_enters_through_the_control_where_the_model_says_so(made):
    if made.model.perturb is None:
        pytest.skip("its noise does not act on the control")
    out = made.batched(*made.cases)
    np.testing.assert_allclose(out["perturbed"], out["step"], rtol=1e-13, atol=1e-13)
    moved = np.abs(
        np.asarray(out["step"]) - made.batched(*made.cases[:2], 0 * made.cases[2])["step"]
    )
    assert moved.max() > 1e-3  # the noise does move the robot


def test_no_control_and_no_noise_is_no_motion(made):
    pose, u, w = made.cases
    still = np.asarray(made.batched(pose, 0 * u, 0 * w)["step"])
    np.testing.assert_allclose(still[:, :2], pose[:, :2], rtol=1e-15)
    np.testing.assert_allclose(np.exp(1j * still[:, 2]), np.exp(1j * pose[:, 2]), atol=1e-15)


def test_no_time_is_no_motion(made):
    """Whatever the velocities and their noise."""
    if "dt [s]" not in made.model.controls:
        pytest.skip("its control is a displacement")
    pose, u, w = made.cases
    still = np.asarray(
        made.batched(pose, u * [c != "dt [s]" for c in made.model.controls], w)["step"]
    )
    np.testing.assert_allclose(still[:, :2], pose[:, :2], rtol=1e-15)
    np.testing.assert_allclose(np.exp(1j * still[:, 2]), np.exp(1j * pose[:, 2]), atol=1e-15)


def test_motion_is_the_same_wherever_the_world_puts_its_origin(made):
    """Robots know no map: step(g ∘ pose, u, w) = g ∘ step(pose, u, w) for any rigid motion g."""
    pose, u, w = made.cases
    turn = 0.7
    r = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def carry(poses):
        return np.concatenate([poses[:, :2] @ r.T + [5, -2], poses[:, 2:] + turn], axis=1)

    after = np.asarray(made.batched(carry(pose), u, w)["step"])
    expected = carry(np.asarray(made.batched(pose, u, w)["step"]))
    np.testing.assert_allclose(after[:, :2], expected[:, :2], rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(np.exp(1j * after[:, 2]), np.exp(1j * expected[:, 2]), atol=1e-12)


def test_noise_covariance_is_the_given_one(made):
    cov = made.batched(*made.cases)["cov"]
    np.testing.assert_array_equal(cov, np.broadcast_to(made.cov, cov.shape))


def test_noise_covariance_may_be_a_function_of_pose_and_control(made):
    pose, u, _ = (a[0] for a in made.cases)
    width = len(made.model.noises)
    model = made.factory(lambda pose, u: (pose[0] ** 2 + jnp.sum(u**2)) * jnp.eye(width))
    expected = (pose[0] ** 2 + np.sum(u**2)) * np.eye(width)
    np.testing.assert_allclose(model.noise_cov(pose, u), expected, rtol=1e-14)
    single = model.noise_cov(jnp.asarray(pose, "f4"), jnp.asarray(u, "f4"))
    assert single.dtype == np.float32
    wrong = made.factory(lambda pose, u: jnp.eye(width + 1))
    with pytest.raises(ValueError, match=made.name):
        jax.eval_shape(wrong.noise_cov, pose, u)


def bad_covariances(n):
    skew = np.eye(n)
    skew[0, -1] += 0.5
    broken = np.eye(n)
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
        made.factory(bad_covariances(len(made.model.noises))[case])


def test_gradients_reach_the_noise_through_the_factory(made):
    pose, u, _ = (a[3] for a in made.cases)
    width = len(made.model.noises)

    def total(cov):
        noise = made.factory(cov).noise_cov(pose, u)
        return jnp.sum(noise * jnp.arange(1.0, width**2 + 1).reshape(width, width))

    slope = jax.jit(jax.grad(total))(made.cov)
    np.testing.assert_allclose(slope, np.arange(1.0, width**2 + 1).reshape(width, width))
