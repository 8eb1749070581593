"""Factors and kernels are records: their numbers are leaves, and derivatives reach them."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_graphs
import worlds
from pose_rings import ring

from jaxslam import graphs, motion, sensors
from jaxslam.core.record import record

MOUNT = np.array([0.3, -0.2, 0.1])
SEEN = sensors.RelativePosition(np.eye(2), MOUNT)
DRIVEN = motion.Velocity(np.diag([0.1, 0.2, 0.3]))
MADE = {
    **{name: make() for name, make in graphs.KERNELS.items()},
    **graphs.REGISTRY,
    "relative_pose_log": graphs.RelativePoseLog(),
    "from_sensor": graphs.FromSensor(SEEN),
    "from_motion": graphs.FromMotion(DRIVEN),
    "nominal_motion": graphs.factor.NominalMotion(motion.Unicycle(np.eye(2))),
}
PARTS = {"from_sensor": SEEN, "from_motion": DRIVEN, "nominal_motion": motion.Unicycle(np.eye(2))}


@pytest.mark.parametrize("name", MADE)
def test_the_numbers_of_a_record_are_its_leaves_and_pickles_keep_them(name):
    made, again = MADE[name], pickle.loads(pickle.dumps(MADE[name]))
    expected = [made.width] if name in graphs.KERNELS else jax.tree.leaves(PARTS.get(name))
    for one in (made, again):
        leaves = jax.tree.leaves(one)
        assert len(leaves) == len(expected)
        for leaf, number in zip(leaves, expected, strict=True):
            np.testing.assert_array_equal(leaf, number)
    assert type(again) is type(made) and again.name == made.name
    assert jax.tree.structure(again) == jax.tree.structure(made)


TRACED = []


@record
class Counted(sensors.RelativePosition):
    """A sensor that counts how often it is traced."""

    def observe(self, pose, landmark):
        TRACED.append(1)
        return super().observe(pose, landmark)


GRAPH = small_graphs.only(small_graphs.drawn(noise=0.1), "relative_pose", "relative_position")
WIDE = graphs.Huber(50.0)


def factors_of(mount):
    return graphs.REGISTRY | {"relative_position": graphs.FromSensor(Counted(np.eye(2), mount))}


def optimum(mount, width):
    kernel = {"relative_pose": graphs.Cauchy(width)}
    return graphs.optimize(GRAPH, factors_of(mount), kernel=kernel, tolerance=0.0)


def test_other_numbers_of_factor_and_kernel_cost_no_trace_and_no_program():
    first = optimum(MOUNT, 20.0)
    TRACED.clear()
    with worlds.compilations() as compiled:
        second = optimum(2 * MOUNT, 30.0)
        assert compiled() == 0
    assert not TRACED
    assert not np.allclose(first.graph.poses, second.graph.poses)


def test_derivatives_by_mount_and_width_are_differences():
    """Of a graph that is no tracer itself, so that it is planned and padded as outside a trace."""

    def seen(mount, width):
        found = optimum(mount, width)
        return found.graph.poses[:, :2].sum() + found.graph.points[0, 1] + 0.1 * found.chi2

    by_mount, by_width = jax.jit(jax.grad(seen, (0, 1)))(MOUNT, 20.0)
    h = 1e-5
    moved = [(seen(MOUNT + h * e, 20.0) - seen(MOUNT - h * e, 20.0)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(by_mount, moved, rtol=1e-5)
    wider = (seen(MOUNT, 20.0 + 1e-2) - seen(MOUNT, 20.0 - 1e-2)) / 2e-2
    np.testing.assert_allclose(by_width, wider, rtol=1e-4)
    assert np.all(by_mount != 0) and by_width != 0


def test_a_gradient_by_a_factor_is_a_factor():
    factor = graphs.FromSensor(SEEN)
    pose, point, z = np.array([1.0, 2.0, 0.5]), np.array([4.0, 3.0]), np.array([2.0, 1.0])
    slope = jax.jit(jax.grad(lambda f: (f.residual((pose, point), z) ** 2).sum()))(factor)
    assert type(slope) is graphs.FromSensor and type(slope.sensor) is sensors.RelativePosition
    assert np.all(slope.sensor.mount != 0) and np.all(slope.sensor.noise_cov.cov == 0)
    found = jax.grad(lambda kernel: kernel.cost(jnp.asarray(9.0)))(graphs.Huber(2.0))
    np.testing.assert_allclose(found.width, 2 * 3 - 2 * 2)  # of 2 k √s - k²


def test_a_graph_within_a_trace_is_solved_as_outside():
    graph = ring()
    outside = graphs.optimize(graph)

    @jax.jit
    def within():
        found = graphs.optimize(graph)
        return found, graphs.squared_residuals(found.graph), graphs.squared_residuals(graph)

    found, squared, before = within()
    np.testing.assert_allclose(found.graph.poses, outside.graph.poses, atol=1e-9)
    np.testing.assert_allclose(squared["relative_pose"].sum(), outside.chi2, rtol=1e-9)
    np.testing.assert_allclose(before["relative_pose"].sum(), graphs.chi2(graph), rtol=1e-9)
    assert found.singular == -1 and found.graph.poses.shape == graph.poses.shape


def test_one_model_for_a_batch():
    plan = graphs.plan(GRAPH)
    widths = jnp.array([1.0, 2.0])
    with pytest.raises(
        ValueError, match=r"^graphs\.optimize: expected the same factors, kernels, plan and"
    ):
        jax.vmap(lambda k: graphs.optimize(GRAPH, plan=plan, kernel=graphs.Huber(k)))(widths)


def test_numbers_in_float64_leave_a_graph_in_float32():
    numbers = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, GRAPH)
    for name in ("cauchy", "truncated"):
        kernel = dataclasses.replace(graphs.KERNELS[name](), width=np.float64(3.0))
        plan = graphs.plan(GRAPH)
        found = jax.eval_shape(
            lambda graph, kernel, plan=plan: graphs.optimize(graph, kernel=kernel, plan=plan),
            numbers,
            kernel,
        )
        assert {leaf.dtype for leaf in jax.tree.leaves(found)}.isdisjoint({np.dtype("f8")})
