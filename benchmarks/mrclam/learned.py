"""Does learned noise help? `examples/learned_noise.py` on five robots of MRCLAM 6.

The systematic errors of each robot are those that its own log tells (`datasets.fit`). Rows of
a log are its scans, and others a quarter of a second apart; measurements beyond 5 σ of the noise of
`MRCLAM_CALIBRATION` are left out, the same ones for all. Then three noises, found on robots 1 and 2
by the filter's likelihood: constant ones (`fit_noise`), and networks trained on the whole logs, and
on their first two minutes. Robots 3 to 5 are the test. log L is that of a measured component; NEES
and ATE are against the true path. The gates hold what the page says of the test robots.
"""

import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, save, table
from benchmarks.mrclam.benchmark import own_log
from benchmarks.mrclam.replays import from_first_scan
from benchmarks.real_data import DATA
from jaxslam import charts, datasets
from jaxslam.calibration import as_associated, fit_noise
from jaxslam.consistency import block_nees, pose_error
from jaxslam.core.types import Log, Scan
from jaxslam.math.stats import sigma_gate
from jaxslam.results.plot import PAGE, caption, curve, panels_of, titled

TRAIN, TEST = (1, 2), (3, 4, 5)
SHORT = 120.0
"""Seconds of the short training logs."""
START = np.array([0.01, 0.05, 0.1, 0.02])
SLOTS, CAPACITY = 8, 15


def example() -> Any:
    """The module of the example."""
    path = Path(__file__).parents[2] / "examples" / "learned_noise.py"
    spec = importlib.util.spec_from_file_location("learned_noise", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def thinned(log: Any, time: np.ndarray, every: float = 0.25) -> tuple[np.ndarray, Any]:
    """Rows with a scan, and others at least `every` seconds apart, with the mean velocities."""
    keep, last = np.array(log.scan.valid).any(axis=1), time[0]
    for k, now in enumerate(time):
        keep[k] |= k == 0 or now - last >= every
        last = now if keep[k] else last
    rows = np.flatnonzero(keep)
    v, omega, dt = np.asarray(log.control)[: rows[-1] + 1].T
    of = np.searchsorted(rows, np.arange(len(dt)))
    total = np.bincount(of, dt)
    means = [np.bincount(of, x * dt) / np.where(total > 0, total, 1.0) for x in (v, omega)]
    scan = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], log.scan)
    return rows, log._replace(control=np.column_stack([*means, total]), scan=scan)


class Robot(NamedTuple):
    """A log without outliers, its rows' times and true poses, and where these are known."""

    log: Log
    time: np.ndarray
    path: np.ndarray
    known: np.ndarray
    mount: np.ndarray
    cov: np.ndarray


def without_errors(log: Any, own: Any) -> Any:
    """The log with travel and turn corrected, whose noise is left."""
    control = jax.vmap(own.motion.control)(jnp.asarray(log.control))
    return log._replace(control=np.asarray(control))


def read(folder: Path, robot: int) -> Robot:
    own = own_log(folder, robot).robot
    data = datasets.mrclam(folder, robot, calibration=own)
    first, log = from_first_scan(data)
    rows, short = thinned(without_errors(log, own), data.time[first:])
    cov, camera = own.motion.motion.noise_cov, own.sensor
    motion = jaxslam.motion.Velocity(lambda pose, u: jnp.zeros((3, 3)).at[:2, :2].set(cov(pose, u)))
    options = {"gate": sigma_gate(5, 2), "chart": charts.RightInvariant()}
    ekf = jaxslam.filters.EkfSlam(motion, camera, CAPACITY, **options)
    path = data.true_path[first:][rows]
    found = jaxslam.run(ekf, short, path[0], data.pose_cov, jax.random.key(0))
    clean = jax.tree.map(np.asarray, as_associated(short, found.info))
    known = data.true_at[first:][rows]
    return Robot(clean, data.time[first:][rows], path, known, camera.mount, data.pose_cov)


def stacked(robots: list[Robot], span: float = np.inf) -> tuple[Log, np.ndarray, np.ndarray]:
    """Logs of one length, padded with rows in which nothing happens; first poses, mounts."""
    logs = [jax.tree.map(lambda x, r=r: x[r.time - r.time[0] < span], r.log) for r in robots]
    length = max(len(log.control) for log in logs)

    def padded(log: Log) -> Log:
        rows, slots = length - len(log.control), SLOTS - log.scan.tag.shape[1]
        grow = (0, rows), (0, slots)
        z = np.pad(log.scan.z, (*grow, (0, 0)), constant_values=1.0)
        tag = np.pad(log.scan.tag, grow, constant_values=-1)
        return Log(
            np.pad(log.control, ((0, rows), (0, 0))), Scan(z, tag, np.pad(log.scan.valid, grow))
        )

    whole = jax.tree.map(lambda *leaves: np.stack(leaves), *map(padded, logs))
    return whole, np.stack([r.path[0] for r in robots]), np.stack([r.mount for r in robots])


def follow(noises: Any, log: Log, start: Any, mount: Any, cov: Any) -> Any:
    motion = jaxslam.motion.Velocity(noises[0])
    sensor = jaxslam.sensors.RangeBearing(noises[1], mount=mount)
    ekf = jaxslam.filters.EkfSlam(
        motion, sensor, CAPACITY, chart=charts.RightInvariant(), correction="joint"
    )
    return jaxslam.run(ekf, log, start, cov, jax.random.key(0))


class Score(NamedTuple):
    likelihood: float
    nis: float
    nees: float
    ate: float


def score(run: Any, noises: Any, robot: Robot) -> Score:
    trace = run(noises, *jax.tree.map(lambda x: x[0], stacked([robot])), robot.cov)
    info, known = trace.info, robot.known
    pose, cov = (np.asarray(x)[known] for x in (trace.estimate.pose, trace.estimate.pose_cov))
    error = pose_error(robot.path[known], pose)
    nees, regular = block_nees(pose, error, error, cov)["pose"]
    dof = float(info.dof.sum())
    ate = float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
    middle = float(np.median(nees[regular]))
    return Score(float(info.log_likelihood.sum()) / dof, float(info.nis.sum()) / dof, middle, ate)


def draw(noises: dict[str, Any]) -> None:
    """The standard deviations by range, bearing and turn."""
    figure, panels = panels_of(PAGE, 2.6, 1, 4, share=(False, False))
    distance, bearing, turn = (
        np.linspace(0.3, 5, 60),
        np.linspace(-0.45, 0.45, 60),
        np.linspace(-1, 1, 60),
    )
    one = np.ones(60)
    for i, (name, (of_control, of_measurement)) in enumerate(noises.items()):
        sigma = jax.vmap(of_measurement.sigma)
        rate = jax.vmap(of_control.sigma)(np.stack([0.15 * one, turn], axis=1))
        curve(
            panels[0],
            i,
            distance,
            100 * np.asarray(sigma(np.stack([distance, 0 * one], 1)))[:, 0],
            name,
        )
        curve(
            panels[1],
            i,
            bearing,
            1000 * np.asarray(sigma(np.stack([2 * one, bearing], 1)))[:, 1],
            name,
        )
        curve(panels[2], i, turn, 1000 * np.asarray(rate)[:, 0], name)
        curve(panels[3], i, turn, 1000 * np.asarray(rate)[:, 1], name)
    for axes, label, title in zip(
        panels,
        ("range [m]", "bearing [rad]", "turn rate [rad/s]", "turn rate [rad/s]"),
        ("σ of range [cm]", "σ of bearing [mrad]", "σ of travel [mm/√s]", "σ of heading [mrad/√s]"),
        strict=True,
    ):
        axes.set(xlabel=label, ylim=(0, None))
        titled(axes, title)
    caption(figure, "Noise of robots 1 and 2 of MRCLAM 6, at 0.15 m/s, 2 m and straight ahead")
    save(figure, "learned_noise")


def measure(quick: bool = False) -> list[Metric]:
    module, folder = example(), DATA / "mrclam6"
    robots = {robot: read(folder, robot) for robot in ((*TRAIN, 3) if quick else (*TRAIN, *TEST))}
    every = jax.vmap(follow, (None, 0, 0, 0, None))
    cov = robots[1].cov
    training = [robots[robot] for robot in TRAIN]

    def found(span: float) -> tuple[Any, Any]:
        few = stacked(training, span)
        fit = fit_noise(
            lambda sigma, *data: every(module.constant(sigma), *data, cov).info, START, *few
        )
        first = module.constant(fit.parameters)

        def cost(noises: Any) -> jax.Array:
            return -every(noises, *few, cov).info.log_likelihood.sum() / fit.dof

        return first, module.train(cost, first, steps=20 if quick else 120)

    _, hasty = found(SHORT)
    steady, learned = found(SHORT if quick else np.inf)
    noises = {"constant": steady, "learned": learned, "learned on two minutes": hasty}
    run, scores = jax.jit(follow), {}
    rows = []
    for robot, data in robots.items():
        for name, each in noises.items():
            scores[robot, name] = s = score(run, each, data)
            cells = (
                str(robot),
                name,
                f"{s.likelihood:.3f}",
                f"{s.nis:.2f}",
                f"{s.nees:.2f}",
                f"{s.ate:.3f}",
            )
            rows.append(cells)
    print(table(("robot", "noise", "log L / dof", "NIS/dof", "NEES median", "ATE [m]"), rows))
    if not quick:
        draw({"constant": steady, "learned": learned})
    test = [robot for robot in TEST if robot in robots]
    gain = [scores[r, "learned"].likelihood - scores[r, "constant"].likelihood for r in test]
    loss = [
        scores[r, "learned on two minutes"].likelihood - scores[r, "constant"].likelihood
        for r in test
    ]
    nees = [scores[r, "learned"].nees / scores[r, "constant"].nees for r in test]
    ate = [scores[r, "learned"].ate / scores[r, "constant"].ate for r in test]
    gate = -np.inf if quick else 0.1
    return [
        Metric("learned noise: least gain of log L / dof, test robots", min(gain), low=gate),
        Metric("learned on two minutes: largest gain, test robots", max(loss), high=0.0),
        Metric(
            "learned noise: largest ratio of the median NEES",
            max(nees),
            high=np.inf if quick else 1.0,
        ),
        Metric("learned noise: ratio of the ATE, mean of test robots", float(np.mean(ate))),
    ]
