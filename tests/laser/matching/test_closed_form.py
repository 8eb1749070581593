"""The steps of the ICPs against NumPy: the roots of Censi's polynomial, and a fit by SVD."""

import jax
import numpy as np
from scanned_rooms import by_polynomial, line_cost

from jaxslam.laser.matching import Prior
from jaxslam.laser.matching.closed_form import added, least, of_lines, of_points, of_prior

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


def align_to_lines(*given):
    return least(of_lines(*given))


def align_points(*given):
    return least(of_points(*given))


def test_a_prior_is_a_term_of_the_cost():
    """Of all motions, by the shift that is best for each of 2,000 headings, in NumPy."""
    source, target, normal, weight = (part[0] for part in clouds())
    pose, middle = np.array([0.4, -0.2, 0.3]), np.array([0.1, 0.5])
    root = rng.normal(size=(3, 3))
    prior = Prior(pose + [0.3, 0.2, -0.1], root @ root.T)

    @jax.jit
    def found(prior):
        both = added(of_lines(source, target, normal, weight), of_prior(prior, pose, middle))
        return least(both)

    arm = pose[:2] - middle
    best = np.inf, None
    for angle in np.linspace(-np.pi, np.pi, 2001):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        # Residuals of a shift t: rows of n t + b, weighted.
        rows = np.concatenate([np.sqrt(weight)[:, None] * normal, root.T[:, :2]])
        off = np.array([*(turn @ arm + middle - prior.pose[:2]), 0.1 * c + s])
        rest = np.sqrt(weight) * (normal * (source @ turn.T - target)).sum(axis=1)
        rest = np.concatenate([rest, root.T @ off])
        shift = -np.linalg.lstsq(rows, rest, rcond=None)[0]
        value = ((rows @ shift + rest) ** 2).sum()
        best = min(best, (value, (*shift, angle)))
    np.testing.assert_allclose(found(prior), best[1], atol=4e-3)


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
            found[k], [*shift, np.arctan2(turn[1, 0], turn[0, 0])], atol=1e-10
        )
