"""The same localization by filterpy, Stone Soup, dynamax, GTSAM and this package.

`circle`, 500 steps, the map known: a unicycle whose odometry is noisy, and the positions of two or
three landmarks in its frame. An extended Kalman filter with one update a scan; in GTSAM the
left-invariant one, which it has for the poses of the plane, beside this package's with the
chart `left_invariant`. Each function is what a user writes after the library's own documentation;
its lines are counted, one for a statement, without imports:

- filterpy: `ExtendedKalmanFilter` with `predict_x` overridden, https://filterpy.readthedocs.io
- Stone Soup: `ExtendedKalmanPredictor` and `ExtendedKalmanUpdater` with models of one's own, whose
  Jacobians are its difference quotients, https://stonesoup.readthedocs.io
- dynamax: `extended_kalman_filter`, whose dynamics have additive noise of a given covariance: that
  of the odometry is put into the state; a scan has a fixed number of places, and an empty one is
  predicted and measured as zero, https://probml.github.io/dynamax
- GTSAM: `InvariantEKFPose2`, https://gtsam.org, without its reset, which carries the covariance to
  the corrected pose, as this package's charts do not; how far that leads apart is reported

With dynamax also a gyroscope's bias is estimated, in the same world (`BiasedOdometry`).

Times are of the processor, after compilation, in turns, the median; runs a second of this package
and of dynamax are those of a batch of 100 by `jax.vmap`. A library that is not
installed is left out: `pip install --group alternatives`, which is apart from `dev` because dynamax
requires a nightly build of TensorFlow Probability. GTSAM's graphs are in `graph_speed`.
"""

import ast
import inspect
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, show

MANY = 100
DISTRIBUTIONS = {
    "filterpy": "filterpy",
    "Stone Soup": "stonesoup",
    "dynamax": "dynamax",
    "GTSAM": "gtsam",
}


def with_jaxslam(world, log):
    ekf = jaxslam.filters.Localization(
        world.motion, world.sensor, world.landmarks, correction="joint"
    )
    estimate = jaxslam.run(ekf, log, world.pose, world.pose_cov, jax.random.key(0)).estimate
    return estimate.pose, estimate.pose_cov


def left_invariant(world, log):
    ekf = jaxslam.filters.Localization(
        world.motion,
        world.sensor,
        world.landmarks,
        correction="joint",
        chart=jaxslam.charts.LeftInvariant(),
    )
    estimate = jaxslam.run(ekf, log, world.pose, world.pose_cov, jax.random.key(0)).estimate
    return estimate.pose, estimate.pose_cov


def with_filterpy(world, log):
    from filterpy.kalman import ExtendedKalmanFilter
    from scipy.linalg import block_diag

    class Robot(ExtendedKalmanFilter):
        def predict_x(self, u=0):
            v, omega, dt = u
            c, s = np.cos(self.x[2]), np.sin(self.x[2])
            self.F = np.array([[1, 0, -v * dt * s], [0, 1, v * dt * c], [0, 0, 1]])
            g = dt * np.array([[c, 0], [s, 0], [0, 1]])
            self.Q = g @ odometry_noise @ g.T
            self.x = self.x + dt * np.array([v * c, v * s, omega])

    def relative(pose, landmarks):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return ((landmarks - pose[:2]) @ np.array([[c, -s], [s, c]])).ravel()

    def relative_by_pose(pose, landmarks):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ahead, left = relative(pose, landmarks).reshape(-1, 2).T
        rows = [[[-c, -s, a], [s, -c, b]] for a, b in zip(left, -ahead, strict=True)]
        return np.array(rows).reshape(-1, 3)

    odometry_noise, sensor_noise = world.motion.noise_cov.cov, world.sensor.noise_cov.cov
    robot = Robot(dim_x=3, dim_z=2)
    robot.x, robot.P = np.array(world.pose, float), np.array(world.pose_cov, float)
    poses, covs = [], []
    for u, z, tag, valid in zip(log.control, *log.scan, strict=True):
        robot.predict(u)
        if valid.any():
            seen = world.landmarks[tag[valid]]
            noise = block_diag(*[sensor_noise] * len(seen))
            robot.update(
                z[valid].ravel(), relative_by_pose, relative, noise, args=seen, hx_args=seen
            )
        poses.append(robot.x)
        covs.append(robot.P)
    return np.array(poses), np.array(covs)


def with_stonesoup(world, log):
    from scipy.linalg import block_diag
    from stonesoup.base import Property
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.models.transition.nonlinear import GaussianTransitionModel
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.array import StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    class Robot(GaussianTransitionModel):
        noise: np.ndarray = Property()
        ndim_state = 3

        def function(self, state, noise=False, control=None, **kwargs):
            x, y, heading = np.asarray(state.state_vector, float)
            v, omega, dt = control
            moved = [x + v * dt * np.cos(heading), y + v * dt * np.sin(heading)]
            return StateVectors(np.stack([*moved, heading + omega * dt]))

        def covar(self, control=None, heading=None, **kwargs):
            c, s, dt = np.cos(heading), np.sin(heading), control[2]
            g = dt * np.array([[c, 0], [s, 0], [0, 1]])
            return g @ self.noise @ g.T

    class Relative(NonLinearGaussianMeasurement):
        landmarks: np.ndarray = Property()

        @property
        def ndim_meas(self):
            return 2 * len(self.landmarks)

        def function(self, state, noise=False, **kwargs):
            x, y, heading = np.asarray(state.state_vector, float)
            c, s = np.cos(heading), np.sin(heading)
            rows = []
            for px, py in self.landmarks:
                rows += [c * (px - x) + s * (py - y), c * (py - y) - s * (px - x)]
            return StateVectors(np.stack(rows))

    predictor = ExtendedKalmanPredictor(Robot(noise=world.motion.noise_cov.cov))
    updater, sensor_noise = ExtendedKalmanUpdater(), world.sensor.noise_cov.cov
    state = GaussianState(np.array(world.pose, float), np.array(world.pose_cov, float))
    poses, covs = [], []
    for u, z, tag, valid in zip(log.control, *log.scan, strict=True):
        heading = float(state.state_vector[2])
        state = predictor.predict(state, control=tuple(u), heading=heading)
        if valid.any():
            seen = world.landmarks[tag[valid]]
            noise = block_diag(*[sensor_noise] * len(seen))
            model = Relative(ndim_state=3, mapping=(0, 1, 2), noise_covar=noise, landmarks=seen)
            detection = Detection(StateVector(z[valid].ravel()), measurement_model=model)
            state = updater.update(SingleHypothesis(state, detection))
        poses.append(np.array(state.state_vector, float).ravel())
        covs.append(np.array(state.covar))
    return np.array(poses), np.array(covs)


def with_dynamax(world, log):
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter
    from jax.scipy.linalg import block_diag

    places = log.scan.tag.shape[-1]
    landmarks = jnp.asarray(world.landmarks)

    def move(state, row):
        x, y, heading, v_noise, omega_noise = state
        v, omega, dt = row[:3]
        ahead, c, s = (v + v_noise) * dt, jnp.cos(heading), jnp.sin(heading)
        turned = heading + (omega + omega_noise) * dt
        return jnp.stack([x + ahead * c, y + ahead * s, turned, 0.0, 0.0])

    def observe(state, row):
        tag, valid = row[3:].reshape(2, places)
        c, s = jnp.cos(state[2]), jnp.sin(state[2])
        offset = landmarks[tag.astype(int)] - state[None, :2]
        z = offset @ jnp.array([[c, -s], [s, c]])
        return jnp.where(valid[:, None] > 0, z, 0.0).ravel()

    scan, noise = log.scan, jnp.asarray(world.motion.noise_cov.cov)
    seen = jnp.where(scan.valid, scan.tag, 0)
    rows = jnp.concatenate([log.control, seen, scan.valid], axis=1)
    z = jnp.where(scan.valid[..., None], scan.z, 0.0).reshape(len(rows), -1)
    # It begins with an update: a row without measurements goes before the first control.
    rows = jnp.concatenate([jnp.zeros_like(rows[:1]), rows])
    z = jnp.concatenate([jnp.zeros_like(z[:1]), z])
    params = ParamsNLGSSM(
        initial_mean=jnp.concatenate([jnp.asarray(world.pose, z.dtype), jnp.zeros(2)]),
        initial_covariance=block_diag(world.pose_cov, noise),
        dynamics_function=move,
        dynamics_covariance=block_diag(jnp.zeros((3, 3)), noise),
        emission_function=observe,
        emission_covariance=jnp.kron(jnp.eye(places), world.sensor.noise_cov.cov),
    )
    found = extended_kalman_filter(params, z, rows)
    return found.filtered_means[1:, :3], found.filtered_covariances[1:, :3, :3]


def biased_with_jaxslam(world, log):
    ekf = jaxslam.filters.Localization(
        world.motion, world.sensor, world.landmarks, correction="joint"
    )
    estimate = jaxslam.run(ekf, log, world.pose, world.pose_cov, jax.random.key(0)).estimate
    state = jnp.concatenate([estimate.pose, estimate.further[:, :1]], axis=1)
    return state, estimate.further_cov[:, :1, :1]


def biased_with_dynamax(world, log):
    """State: the pose, the bias, and the noises of v and omega over one interval."""
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter
    from jax.scipy.linalg import block_diag

    places, dt = log.scan.tag.shape[-1], log.control[0, 2]
    landmarks, sigma = jnp.asarray(world.landmarks), jnp.asarray(world.motion.noise_cov.sigma)

    def move(state, row):
        x, y, heading, bias, v_noise, omega_noise = state
        v, omega, dt = row[:3]
        travel, turn = (v + v_noise) * dt, (omega + omega_noise - bias) * dt
        # Along an arc; without a turn (row 0) straight ahead, as sin(t/2)/(t/2) is 1 there.
        half = jnp.where(turn == 0, 1.0, turn / 2)
        chord = travel * jnp.where(turn == 0, 1.0, jnp.sin(half) / half)
        along = heading + turn / 2
        moved = [x + chord * jnp.cos(along), y + chord * jnp.sin(along), heading + turn]
        return jnp.stack([*moved, bias, 0.0, 0.0])

    def observe(state, row):
        tag, valid = row[3:].reshape(2, places)
        c, s = jnp.cos(state[2]), jnp.sin(state[2])
        offset = landmarks[tag.astype(int)] - state[None, :2]
        z = offset @ jnp.array([[c, -s], [s, c]])
        return jnp.where(valid[:, None] > 0, z, 0.0).ravel()

    scan, noise = log.scan, jnp.diag(sigma[:2] ** 2) / dt
    seen = jnp.where(scan.valid, scan.tag, 0)
    rows = jnp.concatenate([log.control, seen, scan.valid], axis=1)
    z = jnp.where(scan.valid[..., None], scan.z, 0.0).reshape(len(rows), -1)
    # It begins with an update: a row without measurements goes before the first control.
    rows = jnp.concatenate([jnp.zeros_like(rows[:1]), rows])
    z = jnp.concatenate([jnp.zeros_like(z[:1]), z])
    walk = sigma[2:3, None] ** 2 * dt
    params = ParamsNLGSSM(
        initial_mean=jnp.concatenate([jnp.asarray(world.pose[:4], z.dtype), jnp.zeros(2)]),
        initial_covariance=block_diag(jnp.asarray(world.pose_cov)[:4, :4], noise),
        dynamics_function=move,
        dynamics_covariance=block_diag(jnp.zeros((3, 3)), walk, noise),
        emission_function=observe,
        emission_covariance=jnp.kron(jnp.eye(places), world.sensor.noise_cov.cov),
    )
    found = extended_kalman_filter(params, z, rows)
    return found.filtered_means[1:, :4], found.filtered_covariances[1:, 3:4, 3:4]


def with_gtsam(world, log, reset=False):
    import gtsam
    from scipy.linalg import block_diag

    sensor_noise = np.array(world.sensor.noise_cov.cov)
    ekf = gtsam.InvariantEKFPose2(gtsam.Pose2(*world.pose), np.array(world.pose_cov, float))
    poses, covs = [], []
    for (v, omega, dt), z, tag, valid in zip(log.control, *log.scan, strict=True):
        c, s = np.cos(omega * dt), np.sin(omega * dt)
        g = dt * np.array([[c, 0], [-s, 0], [0, 1]])
        ekf.predict(gtsam.Pose2(v * dt, 0, omega * dt), g @ world.motion.noise_cov.cov @ g.T)
        if valid.any():
            predicted, jacobians, pose = [], [], ekf.state()
            for landmark in world.landmarks[tag[valid]]:
                h = np.zeros((2, 3), order="F")
                predicted.append(pose.transformTo(landmark, h, np.zeros((2, 2), order="F")))
                jacobians.append(h)
            noise = block_diag(*[sensor_noise] * len(predicted))
            h = np.concatenate(jacobians)
            ekf.updateWithVector(np.concatenate(predicted), h, z[valid].ravel(), noise, reset)
        pose = ekf.state()
        turn = block_diag(pose.rotation().matrix(), 1.0)
        poses.append([pose.x(), pose.y(), pose.theta()])
        covs.append(turn @ ekf.covariance() @ turn.T)
    return np.array(poses), np.array(covs)


OTHERS = {
    "filterpy": with_filterpy,
    "Stone Soup": with_stonesoup,
    "dynamax": with_dynamax,
    "GTSAM": with_gtsam,
}
PEER = {"GTSAM": left_invariant}
"""ours that a library is compared with, if it is not `with_jaxslam`"""
COMPILED = {"jaxslam": with_jaxslam, "dynamax": with_dynamax}


def task(steps: int):
    """A world and a log as NumPy arrays."""
    world = jaxslam.scenarios.circle(steps=steps)
    _, log = jaxslam.simulate(world, jax.random.key(0))
    return world, jax.tree.map(np.asarray, log)


def biased_task(steps: int):
    """The same world by odometry whose gyroscope has a bias that wanders, and a log."""
    density = np.array([0.05, 0.02, 0.005, 0.0])
    world = replace(
        jaxslam.scenarios.circle(steps=steps),
        motion=jaxslam.motion.BiasedOdometry(jaxslam.motion.NoiseDensity(density)),
        noise_on="robot",
        pose=np.array([0.0, 0.0, 0.0, 0.0, 1.0]),
        pose_cov=np.diag([0.0, 0.0, 0.0, 0.05, 0.0]) ** 2,
    )
    _, log = jaxslam.simulate(world, jax.random.key(0))
    return world, jax.tree.map(np.asarray, log)


def installed(name: str) -> bool:
    """Whether a library can be used; one that is there may fail to load."""
    try:
        import_module(DISTRIBUTIONS[name])
    except Exception:
        return False
    return True


def difference(found, ours) -> tuple[float, float]:
    """The greatest difference of poses [m, rad], and of covariances over their greatest entry."""
    (pose, cov), (pose_, cov_) = (tuple(map(np.asarray, each)) for each in (found, ours))
    off = pose - pose_
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    scale = np.abs(cov_).max(axis=(1, 2), keepdims=True)
    return float(np.abs(off).max()), float((np.abs(cov - cov_) / scale).max())


def code_lines(function: Callable) -> int:
    """Lines of a function, one for a statement, without imports, comments and docstrings."""
    lines = ast.unparse(ast.parse(inspect.getsource(function))).splitlines()
    return sum(1 for line in lines if line and not line.lstrip().startswith(("from ", "import ")))


def processor_seconds(work) -> float:
    began = time.process_time()
    jax.block_until_ready(work())
    return time.process_time() - began


def measure(quick: bool = False) -> list[Metric]:
    world, log = task(500)
    steps, repeats, metrics = len(log.control), 3 if quick else 9, []
    there = {name: work for name, work in OTHERS.items() if installed(name)}
    for name in sorted(set(OTHERS) - set(there)):
        print(f"{name} is not installed: left out")
    single = {
        name: partial(work, world) for name, work in {"jaxslam": with_jaxslam, **there}.items()
    }
    if "dynamax" in there:  # `jaxslam.run` compiles itself
        single["dynamax"] = jax.jit(single["dynamax"])
    rows = {name: {"lines": float(code_lines(OTHERS.get(name, with_jaxslam)))} for name in single}
    for name in there:
        off, spread = difference(single[name](log), PEER.get(name, with_jaxslam)(world, log))
        rows[name] |= {"pose apart": off, "covariance apart": spread}
        metrics += [
            Metric(f"{name}: greatest difference of a pose [m, rad]", off, high=1e-6),
            Metric(f"{name}: of a covariance, over its greatest entry", spread, high=1e-4),
        ]
    if "dynamax" in there:
        biased, its_log = biased_task(500)
        off, spread = difference(
            biased_with_dynamax(biased, its_log), biased_with_jaxslam(biased, its_log)
        )
        metrics += [
            Metric("dynamax, a gyroscope's bias in the state: greatest difference", off, high=1e-6),
            Metric("dynamax: of its variance, over the variance", spread, high=1e-6),
        ]
    if "GTSAM" in there:
        off, _ = difference(with_gtsam(world, log, reset=True), left_invariant(world, log))
        metrics.append(Metric("GTSAM with its reset: greatest difference of a pose [m, rad]", off))
    single["jaxslam"](log)  # compiles
    times = {name: [] for name in single}
    for _ in range(repeats):
        for name, work in single.items():
            times[name].append(processor_seconds(lambda work=work: work(log)))
    draw = jax.vmap(lambda key: jaxslam.simulate(world, key)[1])
    logs = jax.block_until_ready(draw(jax.random.split(jax.random.key(1), MANY)))
    batches = {name: [] for name in single if name in COMPILED}
    compiled = {name: jax.jit(jax.vmap(partial(COMPILED[name], world))) for name in batches}
    for work in compiled.values():
        jax.block_until_ready(work(logs))
    for _ in range(repeats):
        for name, work in compiled.items():
            batches[name].append(processor_seconds(lambda work=work: work(logs)))
    for name, found in times.items():
        seconds = float(np.median(found))
        rows[name]["a step [µs]"] = 1e6 * seconds / steps
        rate = MANY / np.median(batches[name]) if name in batches else 1 / seconds
        rows[name]["runs a second and core"] = float(rate)
    show(f"circle, {steps} steps, the map known", rows)
    print(*(f"{name} {version(DISTRIBUTIONS[name])}" for name in there), sep=", ")
    for name, row in rows.items():
        metrics += [
            Metric(f"{name}: lines", row["lines"]),
            Metric(f"{name}: a step [µs]", row["a step [µs]"]),
            Metric(f"{name}: runs a second and core", row["runs a second and core"]),
        ]
    if there:
        rate = max(rows[name]["runs a second and core"] for name in there)
        gained = rows["jaxslam"]["runs a second and core"] / rate
        metrics.append(Metric("runs a second and core over the best of the others", gained, low=1))
    return metrics
