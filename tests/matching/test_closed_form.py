"""The steps of the ICPs against NumPy: the roots of Censi's polynomial, and a fit by SVD."""

import jax
import numpy as np
from scanned_rooms import by_polynomial, line_cost

from jaxslam.matching.closed_form import align_points, align_to_lines

rng = np.random.default_rng(4)
COUNT, CASES = 12, 6


def clouds():
    source = rng.uniform(-3, 3, (CASES, COUNT, 2))
    target = source + rng.normal(0, 0.3, source.shape)
    normal = rng.normal(size=source.shape)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    weight = rng.uniform(0, 1, (CASES, COUNT))
    weight[:, :3] = 0
    return source, target, normal, weight


def test_the_step_to_lines_is_the_least_root_of_the_polynomial():
    source, target, normal, weight = clouds()
    found = np.asarray(jax.jit(jax.vmap(align_to_lines))(source, target, normal, weight))
    for k in range(CASES):
        value, pose = by_polynomial(source[k], target[k], normal[k], weight[k])
        np.testing.assert_allclose(found[k], pose, atol=1e-8)
        assert line_cost(found[k], source[k], target[k], normal[k], weight[k]) <= value + 1e-9


def test_what_lines_do_not_determine_stays():
    """All normals along y: x stays at 0, whatever the partners."""
    source, target, _, weight = (part[0] for part in clouds())
    normal = np.tile([0.0, 1.0], (COUNT, 1))
    pose = np.asarray(jax.jit(align_to_lines)(source, target, normal, weight))
    assert abs(pose[0]) < 1e-6 and np.all(np.isfinite(pose))
    nothing = jax.jit(align_to_lines)(source, target, normal, 0 * weight)
    np.testing.assert_allclose(nothing, 0, atol=1e-12)


def test_the_step_to_points_is_the_weighted_fit():
    source, target, _, weight = clouds()
    found = np.asarray(jax.jit(jax.vmap(align_points))(source, target, weight))
    for k in range(CASES):
        w = weight[k] / weight[k].sum()
        s0, t0 = w @ source[k], w @ target[k]
        u, _, v = np.linalg.svd(((source[k] - s0) * w[:, None]).T @ (target[k] - t0))
        turn = v.T @ np.diag([1, np.linalg.det(v.T @ u.T)]) @ u.T
        shift = t0 - turn @ s0
        np.testing.assert_allclose(
            found[k], [*shift, np.arctan2(turn[1, 0], turn[0, 0])], atol=1e-12
        )
