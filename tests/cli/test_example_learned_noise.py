"""`examples/learned_noise.py`: noise by a network that the filter's likelihood trains."""

import importlib.util
from pathlib import Path

import broken
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import filters, motion, run, sensors

EXAMPLE = Path(__file__).parents[2] / "examples" / "learned_noise.py"
SIGMA = np.array([0.03, 0.06, 0.1, 0.02])


@pytest.fixture(scope="module")
def example():
    broken.optional("optax")
    spec = importlib.util.spec_from_file_location("learned_noise", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def short(example):
    """Logs, and the likelihood of networks with weights w (2, 2, 8) of the last layer."""
    logs = example.simulated(2, seed=3, steps=20)
    first = example.constant(SIGMA)

    def likelihood(w):
        noises = tuple(
            type(each)(each.base, each.hidden, out, each.scale)
            for each, out in zip(first, w, strict=True)
        )
        return example.info(noises, logs).log_likelihood.sum()

    return logs, jax.jit(jax.value_and_grad(likelihood))


def test_an_untrained_network_is_constant_noise(example, short):
    logs, likelihood = short

    def by_constants(logs):
        def cov(pose, u):
            return jnp.diag(jnp.append(SIGMA[:2] ** 2, 0.0)) / u[2]

        moves, sees = motion.Velocity(cov), sensors.RangeBearing(np.diag(SIGMA[2:] ** 2))
        ekf = filters.EkfSlam(moves, sees, len(example.POSTS), correction="joint")
        start = np.zeros(3), np.zeros((3, 3)), jax.random.key(0)
        return jax.vmap(lambda log: run(ekf, log, *start).info.log_likelihood.sum())(logs).sum()

    np.testing.assert_allclose(
        likelihood(np.zeros((2, 2, 8)))[0], jax.jit(by_constants)(logs), rtol=1e-10
    )


def test_the_gradient_reaches_the_weights(short):
    _, likelihood = short
    random = np.random.default_rng(0)
    w, direction, h = 0.1 * random.normal(size=(2, 2, 8)), random.normal(size=(2, 2, 8)), 1e-6
    slope = float((likelihood(w)[1] * direction).sum())
    ends = [float(likelihood(w + sign * h * direction)[0]) for sign in (1, -1)]
    assert abs((ends[0] - ends[1]) / (2 * h) / slope - 1) < 1e-5


@pytest.mark.sweep
def test_training_finds_the_noise_of_the_simulation(example):
    """Standard deviations by range and by turn rate, to 25 % where the logs have data; and another
    log is likelier than by constants of the right size."""
    logs, others = example.simulated(4, seed=0), example.simulated(8, seed=5)
    first = example.constant([0.02, 0.05, 0.1, 0.02])
    learned = example.train(lambda n: -example.info(n, logs).log_likelihood.sum() / 4000, first)
    seen = np.linspace(1, 5, 9)
    z = np.stack([seen, 0 * seen], axis=1)
    found, true = (np.array(jax.vmap(f)(z)) for f in (learned[1].sigma, example.true_sigma))
    assert np.abs(np.log(found / true)).max() < np.log(1.25)
    u = np.array([[0.3, 0.1, 0.2], [0.3, 0.8, 0.2]])
    found, true = (
        np.array(jax.vmap(f)(x)) for f, x in ((learned[0].sigma, u[:, :2]), (example.true_rate, u))
    )
    assert np.abs(np.log(found[:, 1] / true[:, 1])).max() < np.log(1.25)
    before, after = (
        jax.jit(example.info)(n, others).log_likelihood.sum() for n in (first, learned)
    )
    assert after > before + 300
