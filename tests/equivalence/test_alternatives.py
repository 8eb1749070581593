"""Localization by other libraries gives the same estimates; each is skipped where it is absent."""

import importlib
import pkgutil

import broken
import jax
import numpy as np
import pytest

from benchmarks import alternatives

# TensorFlow Probability, which dynamax imports, uses names that JAX has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def task():
    return alternatives.task(steps=40)


@pytest.mark.parametrize("name", alternatives.OTHERS)
def test_another_library_gives_the_same_localization(name, task):
    if not alternatives.installed(name):
        pytest.skip(f"{name} is not installed")
    ours = alternatives.PEER.get(name, alternatives.with_jaxslam)(*task)
    pose, cov = alternatives.difference(alternatives.OTHERS[name](*task), ours)
    assert pose < 1e-6 and cov < 1e-4


def test_dynamax_gives_the_same_localization_with_a_bias():
    broken.optional("dynamax")
    task = alternatives.biased_task(steps=40)
    ours, theirs = alternatives.biased_with_jaxslam(*task), alternatives.biased_with_dynamax(*task)
    state, variance = alternatives.difference(theirs, ours)
    assert state < 1e-6 and variance < 1e-6


def test_the_reset_of_gtsam_is_what_differs(task):
    broken.optional("gtsam")
    ours = alternatives.left_invariant(*task)
    assert alternatives.difference(alternatives.with_gtsam(*task, reset=False), ours)[0] < 1e-12
    assert alternatives.difference(alternatives.with_gtsam(*task, reset=True), ours)[0] > 1e-5


def test_who_has_a_nees():
    """As the page that compares the libraries says."""
    stats = broken.optional("filterpy.stats")
    assert callable(stats.NEES)
    metrics = broken.optional("stonesoup.metricgenerator")
    names = [
        name
        for module in pkgutil.iter_modules(metrics.__path__)
        for name in dir(importlib.import_module(f"stonesoup.metricgenerator.{module.name}"))
    ]
    assert "SIAPMetrics" in names and not [name for name in names if "nees" in name.lower()]


def test_dynamax_has_gradients_too(task):
    broken.optional("dynamax")
    world, log = task

    def last(scale):
        return alternatives.with_dynamax(world, log._replace(control=scale * log.control))[0][-1, 0]

    assert np.isfinite(jax.grad(last)(1.0))
