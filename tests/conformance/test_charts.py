"""What every chart owes: run over `charts.REGISTRY`, so a new chart inherits it all."""

from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from owed import DTYPES, of_rows
from reference.plane import assert_same_poses, turn

from jaxslam.charts import REGISTRY


@pytest.fixture(scope="module", params=swept(REGISTRY, "right_invariant"))
def made(request, hard_angles):
    """A chart of the registry, cases (pose, l, dx, dl) with leading C, and one compiled call."""
    chart = REGISTRY[request.param]()
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 8), hard_angles])
    turns = np.concatenate([rng.uniform(-3, 3, 8), rng.permutation(hard_angles)])
    turns = np.clip(turns, -3.1, 3.1)  # an error beyond half a turn is another error
    n = len(angles)
    pose = np.concatenate([rng.normal(size=(n, 2)) * 3, angles[:, None]], axis=1)
    dx = np.concatenate([rng.normal(size=(n, 2)), turns[:, None]], axis=1)
    landmark, dl = rng.normal(size=(n, 2)) * 4, rng.normal(size=(n, 2))
    dx[0], dl[0] = 0, 0

    def total(*arguments):
        moved = chart.retract(*arguments)
        back = chart.local(*moved, *arguments[:2])
        return sum(jnp.sum(part) for part in (*moved, *back))

    def everything(pose, landmark, dx, dl, other, other_landmark):
        moved = chart.retract(pose, landmark, dx, dl)
        away = chart.local(pose, landmark, other, other_landmark)
        return {
            "moved": moved,
            "back": chart.local(pose, landmark, *moved),
            "away": away,
            "there": chart.retract(pose, landmark, *away),
            "slopes": jax.jacfwd(chart.retract, argnums=(0, 1, 2, 3))(pose, landmark, dx, dl),
            "reverse": jax.grad(total, argnums=(0, 1, 2, 3))(pose, landmark, dx, dl),
            "basis": () if chart.basis is None else tuple(chart.basis(pose, landmark)),
        }

    program = of_rows(everything)

    def call(pose=pose, landmark=landmark, dx=dx, dl=dl, other=None, dtype=np.float64):
        other = (np.roll(pose, 3, axis=0), np.roll(landmark, 3, axis=0)) if other is None else other
        return program(*(a.astype(dtype) for a in (pose, landmark, dx, dl, *other)))

    return SimpleNamespace(
        name=request.param,
        chart=chart,
        cases=(pose, landmark, dx, dl),
        call=call,
        usual=call(),
        at_zero=call(dx=0 * dx, dl=0 * dl, other=(pose, landmark)),
    )


def test_name(made):
    assert made.chart.name == made.name


@pytest.mark.parametrize("dtype", DTYPES)
def test_shapes_dtypes_and_finite_derivatives(made, dtype):
    pose, landmark = (a.copy() for a in made.cases[:2])
    landmark[1] = pose[1, :2]  # a landmark at the robot
    landmark[2], pose[2] = 0, 0
    out = made.call(pose, landmark, dtype=dtype)
    for pair in ("moved", "back"):
        assert [a.shape for a in out[pair]] == [pose.shape, landmark.shape]
    chex.assert_tree_all_finite(out)
    assert {leaf.dtype for leaf in jax.tree.leaves(out)} == {np.dtype(dtype)}
    assert np.all(np.abs(out["moved"][0][:, 2]) <= dtype(np.pi))


def test_jit_is_no_jit_and_vmap_is_a_loop(made):
    pose, landmark, dx, dl = (jnp.asarray(a[9]) for a in made.cases)
    moved = made.chart.retract(pose, landmark, dx, dl)
    one = {"moved": moved, "back": made.chart.local(pose, landmark, *moved)}
    batch = {name: jax.tree.map(lambda leaf: leaf[9], made.usual[name]) for name in one}
    chex.assert_trees_all_close(one, batch, rtol=1e-12, atol=1e-12)


def test_local_and_retract_undo_each_other(made):
    pose, landmark, dx, dl = made.cases
    chex.assert_trees_all_close(made.usual["back"], (dx, dl), atol=1e-11)
    assert_same_poses(made.usual["there"][0], np.roll(pose, 3, axis=0), 1e-11)
    np.testing.assert_allclose(made.usual["there"][1], np.roll(landmark, 3, axis=0), atol=1e-11)


def test_zero_error_is_the_place_itself(made):
    pose, landmark, _, _ = made.cases
    assert_same_poses(made.at_zero["moved"][0], pose)
    np.testing.assert_allclose(made.at_zero["moved"][1], landmark, atol=1e-12)
    for part in made.at_zero["away"]:
        np.testing.assert_allclose(part, np.zeros_like(part), atol=1e-12)


def test_basis_is_the_derivative_of_retract_at_zero(made, differences):
    (_, _, pose_dx, pose_dl), (_, _, land_dx, land_dl) = made.at_zero["slopes"]
    eye3, eye2 = (np.broadcast_to(np.eye(n), (len(pose_dx), n, n)) for n in (3, 2))
    by_pose, cross, by_landmark = made.at_zero["basis"] or (eye3, np.zeros_like(land_dx), None)
    by_landmark = eye2 if by_landmark is None else by_landmark
    np.testing.assert_allclose(by_pose, pose_dx, atol=1e-12)
    np.testing.assert_allclose(cross, land_dx, atol=1e-12)
    np.testing.assert_allclose(by_landmark, land_dl, atol=1e-12)
    np.testing.assert_array_equal(pose_dl, np.zeros_like(pose_dl))
    # … and autodiff is differences, at zero and away from it.
    pose, landmark, dx, dl = made.cases
    for arguments, slopes in (
        ((pose, landmark, 0 * dx, 0 * dl), made.at_zero["slopes"]),
        (made.cases, made.usual["slopes"]),
    ):
        for k in (2, 3):
            numeric = differences(
                lambda *a: np.concatenate(made.call(*a)["moved"], axis=1), arguments, k
            )
            auto = np.concatenate([slopes[0][k], slopes[1][k]], axis=1)
            np.testing.assert_allclose(auto, numeric, atol=1e-7)


def test_the_pose_does_not_depend_on_the_landmark(made):
    pose, landmark, dx, dl = made.cases
    _, by_landmark, _, by_dl = made.usual["slopes"][0]
    np.testing.assert_array_equal(by_landmark, np.zeros_like(by_landmark))
    np.testing.assert_array_equal(by_dl, np.zeros_like(by_dl))
    moved = made.usual["moved"][0]
    elsewhere = made.call(pose, landmark[::-1] + 7, dx, dl[::-1] - 3, (moved, landmark))
    np.testing.assert_array_equal(elsewhere["moved"][0], moved)
    np.testing.assert_allclose(elsewhere["away"][0], made.usual["back"][0], atol=1e-13)


def test_euclidean_error_is_the_difference_of_coordinates():
    chart = REGISTRY["euclidean"]()
    pose, landmark = np.array([1.0, 2.0, 3.0]), np.array([5.0, 6.0])
    moved, moved_l = chart.retract(pose, landmark, np.array([0.1, 0.2, 0.5]), np.array([1.0, -1.0]))
    np.testing.assert_allclose(moved, [1.1, 2.2, 3.5 - 2 * np.pi], atol=1e-15)
    np.testing.assert_allclose(moved_l, [6, 5], atol=1e-15)
    dx, _ = chart.local(pose, landmark, moved, moved_l)
    np.testing.assert_allclose(dx, [0.1, 0.2, 0.5], atol=1e-15)


def test_rays_go_as_their_place_and_direction():
    """Of l = (x0, y0, α, ρ): a retraction undoes `local`, its derivative at zero is the basis, and
    it is the same in every map frame."""
    chart, rng = REGISTRY["right_invariant"](rays=True), np.random.default_rng(4)

    points = REGISTRY["right_invariant"]()

    def end(ray):
        return ray[:2] + np.array([np.cos(ray[2]), np.sin(ray[2])]) / ray[3]

    @jax.jit
    def everything(pose, ray, dx, dl, at):
        moved = chart.retract(pose, ray, dx, dl)
        return (
            chart.local(pose, ray, *moved),
            jax.jacfwd(chart.retract, argnums=(2, 3))(pose, ray, 0 * dx, 0 * dl),
            chart.basis(pose, ray),
            chart.retract(pose, ray, dx, 0 * dl)[1],
            points.retract(pose, at, dx, jnp.zeros(2))[1],
        )

    for _ in range(5):
        pose, ray, dx, dl = (rng.normal(size=n) for n in (3, 4, 3, 4))
        found = jax.device_get(everything(pose, ray, dx, dl, end(ray)))
        again, slopes, basis, turned, there = found
        for back, error in zip(again, (dx, dl), strict=True):
            np.testing.assert_allclose(back, error, atol=1e-12)
        np.testing.assert_allclose(slopes[0][0], basis.pose, atol=1e-12)
        np.testing.assert_allclose(slopes[1][0], basis.cross, atol=1e-12)
        np.testing.assert_allclose(slopes[1][1], np.eye(4), atol=1e-12)
        # A motion of the whole takes the point at the ray's end where it takes points.
        np.testing.assert_allclose(end(turned), there, atol=1e-11)


def test_right_invariant_error_is_unchanged_when_the_world_turns_and_shifts():
    """What gives the chart its name and its use: local(g·x̂, g·x) = Ad_g local(x̂, x), so a turn of
    robot and map together about the origin is the error (0, 0, φ), (0, 0) wherever they are."""
    chart, rng = REGISTRY["right_invariant"](), np.random.default_rng(3)
    angle = 0.8
    r = turn(angle)
    local = jax.jit(chart.local)
    for _ in range(5):
        pose, landmark = rng.normal(size=3), rng.normal(size=2)
        turned = np.array([*(r @ pose[:2]), pose[2] + angle])
        dx, dl = local(pose, landmark, turned, r @ landmark)
        np.testing.assert_allclose(dx, [0, 0, angle], atol=1e-13)
        np.testing.assert_allclose(dl, [0, 0], atol=1e-13)
        shifted = pose + [0.3, -0.2, 0]
        dx, dl = local(pose, landmark, shifted, landmark + [0.3, -0.2])
        np.testing.assert_allclose(dx, [0.3, -0.2, 0], atol=1e-13)
        np.testing.assert_allclose(dl, [0.3, -0.2], atol=1e-13)
