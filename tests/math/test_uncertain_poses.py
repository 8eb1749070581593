"""Uncertain frames: resistors in series and in parallel, Monte Carlo, and textbook distances."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxslam import se2
from jaxslam.math import uncertain_poses
from jaxslam.math.uncertain_poses import Frame

compound, merge, reverse = map(
    jax.jit, (uncertain_poses.compound, uncertain_poses.merge, uncertain_poses.reverse)
)
bhattacharyya, mahalanobis_squared = map(
    jax.jit, (uncertain_poses.bhattacharyya, uncertain_poses.mahalanobis_squared)
)
BOXMINUS = jax.jit(se2.boxminus)
numbers = st.floats(0.01, 100.0)


def some(seed, size=0.1):
    rng = np.random.default_rng(seed)
    root = size * rng.normal(size=(3, 3))
    return Frame(rng.normal(size=3), root @ root.T + 1e-4 * np.eye(3))


def resistor(variance):
    return Frame(np.zeros(3), variance * np.eye(3))


@settings(max_examples=50, deadline=None)
@given(numbers, numbers)
def test_series_and_parallel(r1, r2):
    """Frames at the origin: variances of x and y of pure translations add, conductances add."""
    flat = np.diag([1.0, 1.0, 0.0])
    a, b = (Frame(np.zeros(3), r * flat) for r in (r1, r2))
    np.testing.assert_allclose(compound(a, b).cov, (r1 + r2) * flat, rtol=1e-12)
    merged, regular = merge(resistor(r1), resistor(r2))
    assert regular
    np.testing.assert_allclose(np.diagonal(merged.cov), r1 * r2 / (r1 + r2), rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_compounding_is_associative_and_merging_commutes(seed):
    a, b, c = (some(seed + i) for i in range(3))
    left, right = compound(compound(a, b), c), compound(a, compound(b, c))
    np.testing.assert_allclose(left.cov, right.cov, atol=1e-12)
    np.testing.assert_allclose(BOXMINUS(left.pose, right.pose), 0, atol=1e-12)
    near = Frame(a.pose + 0.1, b.cov)
    one, other = merge(a, near)[0], merge(near, a)[0]
    np.testing.assert_allclose(one.cov, other.cov, atol=1e-10)
    np.testing.assert_allclose(one.pose, other.pose, atol=1e-10)
    np.testing.assert_allclose(
        np.linalg.inv(one.cov), np.linalg.inv(a.cov) + np.linalg.inv(b.cov), rtol=1e-5
    )
    again = reverse(reverse(a))
    np.testing.assert_allclose(again.cov, a.cov, atol=1e-12)


def test_cross_terms_are_those_of_monte_carlo():
    rng = np.random.default_rng(0)
    root = 0.02 * rng.normal(size=(6, 6))
    both = root @ root.T
    a = Frame(np.array([1.0, 2.0, 0.7]), both[:3, :3])
    b = Frame(np.array([0.5, -1.0, -2.0]), both[3:, 3:])
    draws = rng.normal(size=(200_000, 6)) @ root.T
    composed = jax.jit(jax.vmap(lambda e: se2.compose(a.pose + e[:3], b.pose + e[3:])))
    poses = np.asarray(composed(draws)) - np.asarray(composed(np.zeros((1, 6))))
    found = np.cov(poses.T)
    with_cross = compound(a, b, both[:3, 3:]).cov
    scale = np.abs(found).max()
    np.testing.assert_allclose(with_cross, found, atol=0.02 * scale)
    assert np.abs(compound(a, b).cov - found).max() > 0.1 * scale


def test_merging_across_the_seam_of_the_heading():
    a = Frame(np.array([0.0, 0.0, np.pi - 0.1]), np.eye(3))
    b = Frame(np.array([0.0, 0.0, -np.pi + 0.1]), np.eye(3))
    assert abs(abs(float(merge(a, b)[0].pose[2])) - np.pi) < 1e-12
    np.testing.assert_allclose(mahalanobis_squared(a, b)[0], 0.2**2 / 2)


def test_a_cross_covariance_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"cross of shape \(3, 3\)"):
        uncertain_poses.compound(some(1), some(2), np.ones(3))


def test_distances():
    a, b = some(1), some(2)
    near, regular = mahalanobis_squared(a, b)
    delta = np.asarray(a.pose - b.pose)
    np.testing.assert_allclose(near, delta @ np.linalg.solve(a.cov + b.cov, delta))
    assert regular
    middle = np.asarray(a.cov + b.cov) / 2
    det = np.linalg.det
    textbook = delta @ np.linalg.solve(middle, delta) / 8
    textbook += 0.5 * np.log(det(middle) / np.sqrt(det(a.cov) * det(b.cov)))
    np.testing.assert_allclose(bhattacharyya(a, b)[0], textbook)
    np.testing.assert_allclose(bhattacharyya(a, a)[0], 0, atol=1e-12)
    assert bhattacharyya(a, Frame(a.pose, 100 * a.cov))[0] > 1


def test_certain_frames():
    exact = Frame(np.array([1.0, 2.0, 0.3]), np.zeros((3, 3)))
    vague = some(3)
    merged, regular = merge(vague, exact)
    assert regular
    np.testing.assert_allclose(merged.pose, exact.pose, atol=1e-12)
    same, regular = merge(exact, exact)
    assert not regular
    np.testing.assert_array_equal(same.pose, exact.pose)
    distance, regular = bhattacharyya(exact, exact)
    assert not regular
    assert distance == 0
    slope = jax.jit(jax.grad(lambda cov: merge(Frame(exact.pose, cov), exact)[0].pose.sum()))
    slopes = slope(exact.cov)
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_batches_and_dtypes(dtype):
    a = jax.tree.map(lambda *x: np.stack(x).astype(dtype), some(1), some(2))
    b = jax.tree.map(lambda *x: np.stack(x).astype(dtype), some(3), some(4))
    both = jax.jit(jax.vmap(uncertain_poses.compound))(a, b)
    assert both.cov.dtype == dtype
    first = jax.tree.map(lambda x: x[0], (a, b))
    np.testing.assert_allclose(both.cov[0], compound(*first).cov, rtol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_vague_frame_does_not_cancel_a_sharp_one(dtype):
    sharp = Frame(np.array([1, 2, 0.5], dtype), np.diag(np.array([1e-4, 1e-4, 1e-6], dtype)))
    for vague in (1e2, 1e4, 1e8):
        other = Frame(np.zeros(3, dtype), vague * np.eye(3, dtype=dtype))
        for pair in ((sharp, other), (other, sharp)):
            merged, regular = merge(*pair)
            assert regular
            np.testing.assert_allclose(merged.cov, sharp.cov, rtol=1e-5, atol=1e-12)
            np.testing.assert_allclose(merged.pose, sharp.pose, rtol=2e-5)
