"""se2 against 3×3 homogeneous matrices, hand Jacobians against autodiff and differences.

That exp and log, ⊞ and ⊖ undo each other are laws of conformance/test_properties.
"""

import inspect

import jax
import numpy as np
import pytest
import scipy.linalg
from reference.plane import assert_same_poses, matrix, pose_of

from jaxslam import se2
from jaxslam.math import numpy_poses
from jaxslam.math.angles import wrap


def poses_of(angles, rng, spread=3.0):
    xy = rng.normal(size=(len(angles), 2)) * spread
    return np.concatenate([xy, np.asarray(angles)[:, None]], axis=1)


@pytest.fixture(scope="module")
def cases(hard_angles):
    """Poses (C, 3): random ones, hard angles, large coordinates; and points (C, 2) to go along."""
    rng = np.random.default_rng(1)
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 10), hard_angles])
    near, far = poses_of(angles, rng), poses_of(angles, rng, 1e4)
    poses = np.concatenate([near, far])
    return poses, rng.permutation(poses), rng.normal(size=(len(poses), 2)) * 3


def twist_matrix(tau):
    return np.array([[0, -tau[2], tau[0]], [tau[2], 0, tau[1]], [0, 0, 0]])


def batched(function, *arguments):
    return np.asarray(jax.jit(jax.vmap(function))(*arguments))


# --- hand-derived Jacobians ---------------------------------------------------------------------

# Which kind of argument each function takes; a test below holds that none is left out.
ARGUMENTS = {
    "compose": "pose pose",
    "inverse": "pose",
    "between": "pose pose",
    "exp": "pose",
    "log": "pose off the seam",
    "to_frame": "pose point",
    "from_frame": "pose point",
    "polar": "point",
    "rectangular": "point",
}


def test_every_hand_jacobian_is_verified():
    names = {n.removesuffix("_jacobians") for n in vars(se2) if n.endswith("_jacobians")}
    assert names == set(ARGUMENTS)


@pytest.mark.parametrize("name", ARGUMENTS)
def test_hand_jacobian_is_autodiff_is_differences(name, cases, assert_jacobians):
    first, second, points = cases
    kinds = ARGUMENTS[name]
    if kinds == "pose off the seam":  # log jumps by a whole turn's worth of translation there
        first = np.where(np.abs(first[:, 2:]) > 3.1, [0, 0, 3.1] + first * [1, 1, 0], first)
    arguments = {
        "pose pose": (first, second),
        "pose point": (first, points),
        "point": (points,),
    }.get(kinds, (first,))
    function, hand = getattr(se2, name), getattr(se2, f"{name}_jacobians")
    assert len(inspect.signature(function).parameters) == len(arguments)
    assert_jacobians(function, hand, arguments)


def test_log_jacobian_is_autodiff_up_to_the_seam(cases):
    first = cases[0]
    (hand,) = jax.jit(jax.vmap(se2.log_jacobians))(first)
    auto = batched(jax.jacfwd(se2.log), first)
    np.testing.assert_allclose(hand, auto, atol=1e-12 * np.abs(auto).max())


def test_exp_jacobians_beyond_one_turn(assert_jacobians):
    tau = np.array([[1.0, 2.0, w] for w in (3.5, -4.0, 6.2, 7.0, -20.0)])
    assert_jacobians(se2.exp, se2.exp_jacobians, (tau,))


def test_polar_jacobians_far_and_near(assert_jacobians):
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.normal(size=(10, 2)) * 1e4, [[-5.0, 0.0], [-5.0, 1e-12]]])
    assert_jacobians(se2.polar, se2.polar_jacobians, (points,))
    close = rng.normal(size=(10, 2)) * 1e-6
    (hand,) = jax.jit(jax.vmap(se2.polar_jacobians))(close)
    np.testing.assert_allclose(hand, batched(jax.jacfwd(se2.polar), close), rtol=1e-12)


# --- the group ----------------------------------------------------------------------------------


def test_compose_inverse_and_between_are_matrix_products(cases):
    a, b, _ = cases
    for function, arguments, product in (
        (se2.compose, (a, b), lambda p, q: matrix(p) @ matrix(q)),
        (se2.inverse, (a,), lambda p: np.linalg.inv(matrix(p))),
        (se2.between, (a, b), lambda p, q: np.linalg.inv(matrix(p)) @ matrix(q)),
    ):
        expected = np.array([pose_of(product(*row)) for row in zip(*arguments, strict=True)])
        assert_same_poses(batched(function, *arguments), expected, 1e-11)


def test_rotation_is_orthogonal_and_counter_clockwise(hard_angles):
    r = batched(se2.rotation, hard_angles)
    np.testing.assert_allclose(
        r @ r.transpose(0, 2, 1), np.broadcast_to(np.eye(2), r.shape), atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(r), 1, atol=1e-15)
    np.testing.assert_allclose(
        r[:, :, 0], np.stack([np.cos(hard_angles), np.sin(hard_angles)], axis=1), atol=1e-15
    )


def test_frames_are_matrix_products(cases):
    a, _, points = cases
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    expected = np.array([(matrix(p) @ h)[:2] for p, h in zip(a, homogeneous, strict=True)])
    world = batched(se2.from_frame, a, points)
    np.testing.assert_allclose(world, expected, atol=1e-11 * np.abs(expected).max())


# --- exp, log, boxes, adjoint -------------------------------------------------------------------


def test_exp_is_the_matrix_exponential(hard_angles):
    rng = np.random.default_rng(3)
    tau = poses_of(np.concatenate([hard_angles, [4.0, -5.0, 12.0]]), rng)
    expected = np.array([scipy.linalg.expm(twist_matrix(t)) for t in tau])
    moved = batched(se2.exp, tau)
    np.testing.assert_allclose([matrix(p) for p in moved], expected, atol=1e-12)
    assert np.all(np.abs(moved[:, 2]) <= np.pi)


def test_boxplus_increments_are_in_the_local_frame(hard_angles):
    at = np.array([[1.0, 2.0, theta] for theta in hard_angles])
    moved = batched(se2.boxplus, at, np.tile([0.5, 0.0, 0.0], (len(at), 1)))
    ahead = np.stack([np.cos(hard_angles), np.sin(hard_angles)], axis=1)
    np.testing.assert_allclose(moved[:, :2], at[:, :2] + 0.5 * ahead, atol=1e-15)


# --- polar coordinates --------------------------------------------------------------------------


def test_polar_is_range_and_bearing(cases):
    points = cases[2]
    expected = np.stack([np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])], axis=1)
    polar = batched(se2.polar, points)
    np.testing.assert_allclose(polar, expected, rtol=1e-14)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_polar_at_the_origin_is_zero_with_zero_derivatives(dtype):
    tiny = dtype(1e-30) if dtype is np.float32 else dtype(1e-200)  # its square underflows
    points = np.array([[0, 0], [-0.0, 0], [-0.0, -0.0], [0, tiny], [tiny, -tiny]], dtype)

    def everything(p):
        return (
            se2.polar(p),
            jax.jacfwd(se2.polar)(p),
            jax.jacrev(se2.polar)(p),
            *se2.polar_jacobians(p),
        )

    for part in jax.jit(jax.vmap(everything))(points):
        assert part.dtype == dtype
        np.testing.assert_array_equal(part, np.zeros_like(part))


# --- alignment ----------------------------------------------------------------------------------


def test_align_minimises_the_squared_distances():
    rng = np.random.default_rng(5)
    source = rng.normal(size=(7, 2)) * 5
    target = source @ matrix([1, -2, 2.5])[:2, :2].T + rng.normal(size=(7, 2))

    def cost(pose):
        moved = source @ matrix(pose)[:2, :2].T + np.asarray(pose)[:2]
        return ((moved - target) ** 2).sum()

    best = np.asarray(jax.jit(se2.align)(source, target))
    for direction in np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(10, 3))]):
        assert cost(best + 1e-3 * direction) > cost(best)
    # … and it is the global one: over a grid of headings with the best shift for each.
    for theta in np.linspace(-np.pi, np.pi, 181):
        shift = target.mean(0) - matrix([0, 0, theta])[:2, :2] @ source.mean(0)
        assert cost([*shift, theta]) >= cost(best) - 1e-9


def test_align_of_one_point_is_a_translation():
    moved = jax.jit(se2.align)(np.array([[1.0, 2.0]]), np.array([[4.0, -2.0]]))
    np.testing.assert_allclose(moved, [3, -4, 0], atol=1e-15)


def test_on_the_host_the_same(cases):
    a, b, _ = cases
    for name, of in {"compose": (a, b), "between": (a, b), "inverse": (a,)}.items():
        assert_same_poses(getattr(numpy_poses, name)(*of), batched(getattr(se2, name), *of), 1e-13)
    np.testing.assert_allclose(numpy_poses.adjoint(a), batched(se2.adjoint, a), rtol=1e-14)
    angle = np.concatenate([a[:, 2], a[:, 2] + 6 * np.pi, [np.pi, -np.pi]])
    np.testing.assert_allclose(numpy_poses.wrapped(angle), jax.jit(wrap)(angle), atol=1e-14)
    steps = numpy_poses.between(a[:-1], a[1:])
    assert_same_poses(numpy_poses.chain(a[0], steps), a)
