"""Factors against plain NumPy and against the models they are made of."""

import jax
import numpy as np
import pytest
import small_graphs
from own_models import made
from reference import graph as plain

from jaxslam import graphs, motion, sensors


def test_the_factors_of_files_are_their_equations():
    graph = small_graphs.drawn(noise=1.0)
    for kind, factor in graphs.REGISTRY.items():
        table = graph.tables[kind]
        values = [
            (graph.poses if of == "pose" else graph.points)[table.who[:, k]]
            for k, of in enumerate(factor.variables)
        ]
        found = jax.jit(jax.vmap(lambda z, *v, f=factor: f.residual(v, z)))(table.z, *values)
        expected = [plain.error(kind, row, z) for *row, z in zip(*values, table.z, strict=True)]
        sign = -1 if kind in ("relative_position", "bearing") else 1  # z - h, which χ² does not see
        np.testing.assert_allclose(found, sign * np.array(expected), atol=1e-12)
        assert found.shape == (len(table.z), len(factor.errors))


@pytest.mark.parametrize("kind", ["relative_pose", "prior"])
def test_jacobians_by_hand(kind, assert_jacobians):
    factor, random = graphs.REGISTRY[kind], np.random.default_rng(0)
    drawn = [random.normal(size=(6, 3)) for _ in (*factor.variables, "z")]
    assert_jacobians(
        lambda *v: factor.residual(v[:-1], v[-1]),
        lambda *v: (*factor.jacobians(v[:-1], v[-1]), _by_measurement(factor)(v)),
        drawn,
    )


def _by_measurement(factor):
    return lambda v: jax.jacfwd(factor.residual, argnums=1)(v[:-1], v[-1])


def test_what_is_predicted_has_no_residual():
    random = np.random.default_rng(1)
    turning = motion.Velocity(np.eye(3))
    kinds = {
        "relative_pose": graphs.RelativePose(),
        "relative_position": graphs.RelativePosition(),
        "bearing": graphs.Bearing(),
        "sensor": graphs.FromSensor(sensors.RangeBearing(np.eye(2), mount=(0.3, 0.1, 0.5))),
        "motion": graphs.FromMotion(turning),
    }
    pose = random.normal(size=3)
    z = {kind: random.uniform(0.5, 1.0, len(f.measurements)) for kind, f in kinds.items()}

    @jax.jit
    def left(pose, z):
        return {k: f.residual((pose, f.predict(pose, z[k])), z[k]) for k, f in kinds.items()}

    for kind, residual in left(pose, z).items():
        assert np.abs(residual).max() < 1e-12, kind
    assert graphs.Prior().predict is None
    assert graphs.FromSensor(sensors.Compass([[1.0]])).variables == ("pose",)


@pytest.mark.parametrize("make", [motion.Odometry, motion.Velocity])
def test_the_residual_of_a_motion_is_its_noise(make):
    """And its derivatives are those of w where step(x, u, w) = x'."""
    model, random = make(np.eye(3)), np.random.default_rng(2)
    factor = graphs.FromMotion(model)
    first, w = random.normal(size=(5, 3)), 0.1 * random.normal(size=(5, 3))
    u = random.uniform(0.4, 1.0, (5, 3))

    @jax.jit
    @jax.vmap
    def all_of(x, u, w):
        second = model.step(x, u, w)
        residual = factor.residual((x, second), u)
        by = jax.jacfwd(lambda x, y: factor.residual((x, y), u), argnums=(0, 1))(x, second)
        return residual, by, model.jacobians(x, u, w)

    found, (by_first, by_second), (by_pose, _, by_noise) = all_of(first, u, w)
    np.testing.assert_allclose(found, w, atol=1e-13)
    np.testing.assert_allclose(by_second, np.linalg.inv(by_noise), atol=1e-11)
    np.testing.assert_allclose(by_first, -np.linalg.inv(by_noise) @ by_pose, atol=1e-11)


def test_the_noise_curves_as_the_motion_does():
    """The residual of a motion at the pose that w leads to is w, so its second derivative is 0."""
    model = motion.Odometry(np.eye(3))
    factor = graphs.FromMotion(model)
    x, u, w = np.array([0.5, -1.0, 2.0]), np.array([0.4, 0.8, -0.3]), np.array([0.1, -0.1, 0.05])

    def around(v):
        return factor.residual((x, model.step(x, u, v)), u)

    def twice(v):
        return jax.jvp(lambda s: jax.jvp(around, (s,), (u,))[1], (v,), (u,))

    slope, curve = jax.jit(twice)(w)
    np.testing.assert_allclose(slope, u, atol=1e-12)
    np.testing.assert_allclose(curve, 0.0, atol=1e-11)


def test_where_the_noise_does_not_move_the_pose_nothing_is_infinite():
    factor = graphs.FromMotion(motion.Odometry(np.eye(3)))
    x, still = np.ones(3), np.zeros(3)
    slopes = jax.jit(jax.jacrev(lambda a, b: factor.residual((a, b), still), argnums=(0, 1)))
    assert np.isfinite(slopes(x, x)).all()


def test_a_variable_is_a_pose_or_a_point():
    names = {"measurements": ("x [m]",), "errors": ("x [m]",)}
    with pytest.raises(ValueError, match="Own: expected variables 'pose' and 'point', got 'place'"):
        made(graphs.Factor, variables=("place",), residual=lambda v, z: z, **names)
    with pytest.raises(ValueError, match="Own: expected a method residual"):
        made(graphs.Factor, variables=("pose",), **names)
    with pytest.raises(
        ValueError, match="FromSensor: expected sensor to be a Sensor, got the class"
    ):
        graphs.FromSensor(sensors.Compass)


def test_a_motion_of_two_noises_is_refused():
    with pytest.raises(ValueError, match=r"3 components.*unicycle with 2: v"):
        graphs.FromMotion(motion.Unicycle(np.eye(2)))
