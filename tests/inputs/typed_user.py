"""A user's program as the pages write them, with annotations: mypy and pyright have nothing to say of it."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax.typing import ArrayLike

import jaxslam
from jaxslam import datasets, graphs, motion, sensors
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Filter, Free, Motion, Sensor
from jaxslam.core.record import record
from jaxslam.math import se2


@record
class Laser(Sensor):
    noise_cov: NoiseCov
    mount: npt.ArrayLike | None = None
    measurements = ("range [m]", "bearing [rad]")

    def observe(self, pose: jax.Array, landmark: jax.Array) -> jax.Array:
        return se2.polar_in_frame(self.frame(pose), landmark)

    def invert(self, pose: jax.Array, z: jax.Array, s: jax.Array) -> jax.Array:
        return se2.from_frame(self.frame(pose), se2.rectangular(z))


@record
class Bearings(Sensor):
    noise_cov: NoiseCov
    free: Free = Free(np.zeros(1), np.eye(1))
    measurements = ("bearing [rad]",)

    def observe(self, pose: jax.Array, landmark: jax.Array) -> jax.Array:
        return se2.polar_in_frame(self.frame(pose), landmark)[1:]

    def invert(self, pose: jax.Array, z: jax.Array, s: jax.Array) -> jax.Array:
        polar = jnp.concatenate([jnp.exp(s), z])
        return se2.from_frame(self.frame(pose), se2.rectangular(polar))


@record
class Wheels(Motion):
    noise_cov: NoiseCov
    base: ArrayLike = 0.5
    controls = ("left [m]", "right [m]")
    noises = ("left [m]", "right [m]")

    def step(self, pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
        left, right = u + w
        turn = (right - left) / self.base
        return se2.compose(pose, se2.exp(jnp.stack([(left + right) / 2, 0 * turn, turn])))


def own_world() -> jaxslam.Scenario:
    return jaxslam.Scenario(
        name="courtyard",
        motion=Wheels(np.diag([0.01, 0.01]) ** 2),
        sensor=Laser(np.diag([0.1, 0.02]) ** 2, mount=(0.3, 0.0, 0.1)),
        landmarks=np.array([[3.0, 1.0], [-1.0, 4.0]]),
        controls=np.tile([0.09, 0.11], (20, 1)),
        filter_options={"correction": "joint"},
    )


def one_run() -> tuple[jax.Array, float]:
    world = jaxslam.scenarios.circle()
    truth, log = jaxslam.simulate(world, jax.random.key(1))
    ekf = jaxslam.filters.EkfSlam(world.motion, world.sensor, capacity=20, correction="joint")
    trace = jaxslam.run(ekf, log, world.pose, world.pose_cov, jax.random.key(0))
    error = jaxslam.metrics.ate(truth.pose, trace.estimate.pose)
    return jnp.asarray(trace.estimate.pose[-1]), float(error.translation.mean())


def likelihood(sigma: jax.Array) -> jax.Array:
    world = jaxslam.scenarios.circle()
    _, log = jaxslam.simulate(world, jax.random.key(1))
    sensor = sensors.RangeBearing(jnp.diag(sigma**2))
    ekf = jaxslam.filters.EkfSlam(world.motion, sensor, 20)
    info = jaxslam.run(ekf, log, (0.0, 0.0, 0.0), np.zeros((3, 3)), jax.random.key(0)).info
    return info.log_likelihood.sum()


def a_campaign(folder: Path) -> dict[str, str]:
    world = own_world()
    filters: dict[str, Filter] = {
        "ekf": jaxslam.filters.EkfSlam(world.motion, world.sensor, capacity=2),
        "invariant": jaxslam.filters.EkfSlam(
            world.motion, world.sensor, capacity=2, chart=jaxslam.charts.RightInvariant()
        ),
        "eif": jaxslam.filters.EifSlam(world.motion, world.sensor, 2),
    }
    campaign = jaxslam.monte_carlo(world, filters, runs=10, key=jax.random.key(0))
    campaign.save(folder, figures=("pdf",), overwrite=True)
    print(campaign.filters["ekf"].measures["nees_pose"].value)
    return {name: summary.verdict for name, summary in campaign.filters.items()}


def a_dictionary_without_annotation() -> jaxslam.Campaign:
    world = jaxslam.scenarios.circle()
    ekf = jaxslam.filters.EkfSlam(world.motion, world.sensor, capacity=20)
    invariant = jaxslam.filters.EkfSlam(
        world.motion, world.sensor, capacity=20, chart=jaxslam.charts.RightInvariant()
    )
    filters = {"ekf": ekf, "invariant": invariant}
    return jaxslam.monte_carlo(world, filters, runs=10, key=jax.random.key(0))


def a_graph(path: Path) -> np.ndarray:
    graph = datasets.read_graph(path)
    solution = graphs.optimize(graph, kernel=graphs.Huber(1.0))
    datasets.write_graph(path.with_suffix(".toro"), solution.graph)
    print(solution.chi2, graphs.Ending(int(solution.status)))
    world = own_world()
    _, log = jaxslam.simulate(world, jax.random.key(0))
    made, factors = graphs.of_log(log, world.motion, world.sensor, world.pose, world.pose_cov)
    return np.asarray(graphs.optimize(made, factors).graph.poses)


def a_data_set(folder: Path) -> np.ndarray:
    data = datasets.table(folder)
    ekf = jaxslam.filters.EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
    trace = jaxslam.run(ekf, data.log, data.pose, data.pose_cov, jax.random.key(0))
    for note in data.assumed:
        print(note)
    return np.asarray(trace.estimate.points)


def models() -> list[Motion]:
    return [motion.Unicycle(np.diag([0.1, 0.1]) ** 2), Wheels(lambda pose, u: 0.1 * jnp.diag(u**2))]


report = jaxslam.verify_jacobians(Laser(np.diag([0.01, 1e-4])))
assert report.passed
