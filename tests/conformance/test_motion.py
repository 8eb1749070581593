"""What every motion model owes: run over `motion.REGISTRY`, so a new model inherits it all.

Jacobians, `perturb`, the wrapped heading, purity, dtypes and hard states are what `verify` checks:
see test_jacobians. That the map may have any frame is a law of test_properties.
"""

from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from owed import DTYPES, bad_covariances, of_rows, random_covariance

from jaxslam.motion import REGISTRY


def cases_of(model, hard_angles):
    """Robots, controls and noises (C, ·): random, hard headings, large coordinates, no motion."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 8), hard_angles])
    n = len(angles)
    pose = np.concatenate([rng.normal(size=(n, 2)) * 3, angles[:, None]], axis=1)
    u, w = rng.normal(size=(n, len(model.controls))), rng.normal(size=(n, len(model.noises))) * 0.1
    u = np.where([unit.endswith("[s]") for unit in model.controls], np.abs(u), u)  # time passes
    u[:: max(1, n // 6)] = 0
    w[:: max(1, n // 3)] = 0
    pose[1:3, :2] *= 1e4
    further = np.random.default_rng(1).normal(size=(n, len(model.state) - 3))
    pose = np.concatenate([pose, further], axis=1)
    for k, unit in enumerate(model.controls):
        if unit == "steering [rad]":  # wheels do not turn to the side, noise or not
            u[:, k] = np.clip(u[:, k], -1, 1)
            if unit in model.noises:
                j = model.noises.index(unit)
                w[:, j] = np.clip(u[:, k] + w[:, j], -1, 1) - u[:, k]
    return pose, u, w


@pytest.fixture(scope="module", params=swept(REGISTRY, "unicycle", "velocity"))
def made(request, hard_angles):
    """A model of the registry with a random noise covariance, its cases, and one compiled call."""
    factory = REGISTRY[request.param]
    width = len(factory(lambda pose, u: None).noises)
    cov = random_covariance(width, 1)
    weights = np.arange(1.0, width**2 + 1).reshape(width, width)
    model = factory(cov)
    varying = factory(lambda pose, u: (pose[0] ** 2 + jnp.sum(u**2)) * jnp.eye(width))

    def everything(pose, u, w):
        total = jax.grad(lambda cov: jnp.sum(factory(cov).noise_cov(pose, u) * weights))
        return {
            "step": model.step(pose, u, w),
            "cov": model.noise_cov(pose, u),
            "varying": varying.noise_cov(pose, u),
            "noise slopes": total(jnp.asarray(cov, pose.dtype)),
        }

    program = of_rows(everything)
    cases = cases_of(model, hard_angles)

    def call(pose=cases[0], u=cases[1], w=cases[2], dtype=np.float64):
        return program(*(np.asarray(row, dtype) for row in (pose, u, w)))

    return SimpleNamespace(
        name=request.param,
        factory=factory,
        model=model,
        cov=cov,
        weights=weights,
        cases=cases,
        call=call,
        usual=call(),
    )


def assert_stands_still(made, **changes):
    still = made.call(**changes)["step"]
    np.testing.assert_allclose(still[:, :2], made.cases[0][:, :2], rtol=1e-15)
    np.testing.assert_allclose(
        np.exp(1j * still[:, 2]), np.exp(1j * made.cases[0][:, 2]), atol=1e-15
    )
    np.testing.assert_array_equal(still[:, 3:], made.cases[0][:, 3:])


def test_record_is_complete(made):
    model = made.model
    assert model.name == made.name
    assert type(model) is made.factory
    assert model.controls
    assert model.noises
    assert all("[" in unit for unit in (*model.state, *model.controls, *model.noises))


def test_shapes_and_dtypes_and_float32_agrees_with_float64(made):
    pose, _, w = made.cases
    for dtype in DTYPES:
        out = made.call(dtype=dtype)
        chex.assert_shape(out["step"], pose.shape)
        chex.assert_shape(out["cov"], (len(pose), w.shape[1], w.shape[1]))
        chex.assert_tree_all_finite(out)
        assert {leaf.dtype for leaf in jax.tree.leaves(out)} == {np.dtype(dtype)}
        assert np.all(np.abs(out["step"][:, 2]) <= dtype(np.pi))
        turned = np.exp(1j * out["step"][:, 2]) - np.exp(1j * made.usual["step"][:, 2])
        assert np.abs(turned).max() < 1e-5
        for at in (np.s_[:, :2], np.s_[:, 3:]):
            np.testing.assert_allclose(
                out["step"][at], made.usual["step"][at], rtol=1e-6, atol=1e-5
            )


def test_noise_moves_the_robot(made):
    still = made.call(w=0 * made.cases[2])["step"]
    assert np.abs(made.usual["step"] - still).max() > 1e-3


def test_no_control_and_no_noise_is_no_motion(made):
    assert_stands_still(made, u=0 * made.cases[1], w=0 * made.cases[2])


def test_no_time_is_no_motion(made):
    """Whatever the velocities and their noise."""
    if "dt [s]" not in made.model.controls:
        pytest.skip("its control is a displacement")
    assert_stands_still(made, u=made.cases[1] * [c != "dt [s]" for c in made.model.controls])


def test_noise_covariance_is_the_given_one(made):
    cov = made.usual["cov"]
    np.testing.assert_array_equal(cov, np.broadcast_to(made.cov, cov.shape))


def test_noise_covariance_may_be_a_function_of_pose_and_control(made):
    pose, u, _ = made.cases
    scale = pose[:, 0] ** 2 + np.sum(u**2, axis=1)
    expected = scale[:, None, None] * np.eye(len(made.model.noises))
    np.testing.assert_allclose(made.usual["varying"], expected, rtol=1e-14)
    wrong = made.factory(lambda pose, u: jnp.eye(len(made.model.noises) + 1))
    with pytest.raises(ValueError, match=made.factory.__name__):
        jax.eval_shape(wrong.noise_cov, pose[0], u[0])


def test_bad_noise_covariances_are_refused(made):
    for bad in bad_covariances(len(made.model.noises)).values():
        with pytest.raises(ValueError, match=made.factory.__name__):
            made.factory(bad)


def test_gradients_reach_the_noise_through_the_factory(made):
    slopes = made.usual["noise slopes"]
    np.testing.assert_allclose(slopes, np.broadcast_to(made.weights, slopes.shape))
