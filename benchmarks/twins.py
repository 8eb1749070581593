"""Twins of a log: p-values of logs of the models, faults that are planted, time, and real logs.

A robot drives figures of eight among nine posts, 900 rows, as in the tutorial on one's own log; its
logs are drawn in NumPy. Over logs drawn from the models every p-value should be uniform, and a
corrected one below 0.05 should be in at most 5 % of logs. Then one fault at a time is planted; it
is found where a corrected p-value is below 0.05, and named where the worst statistic is one that
says so. JAXSLAM_DATA is the folder of the data of real logs, without which they are left out.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from scipy import stats

import jaxslam
from benchmarks.gate import Metric, save, show
from benchmarks.plaza import STORED
from benchmarks.real_data import DATA
from jaxslam import catalog, datasets, motion, sensors
from jaxslam.consistency import ModelCheck, block_nees, check_models, pose_error
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Log, Scan
from jaxslam.filters import DelayedSlam
from jaxslam.results.plot import check_figure
from jaxslam.simulation import Twin, twin

DT, STEPS, EVERY, REACH = 0.1, 900, 5, 7.0
NOISES = {"v": 0.15, "omega": 0.05, "range": 0.04, "bearing": 0.015}
MOUNT = np.array([0.25, 0.0])
GOALS = np.array([(3, 2), (5, 0), (3, -2), (0, 0), (-3, 2), (-5, 0), (-3, -2), (0, 0)], float)
LOGS, PLANTED, TWINS = 200, 40, 100
LONG = 12_609
"""Rows of *Lost in the woods*."""


def posts() -> np.ndarray:
    rng = np.random.default_rng(8)
    around = 0.7 * np.arange(9)
    circle = np.stack([6 * np.cos(around), 5 * np.sin(around)], axis=1)
    return circle + rng.normal(size=(9, 2))


def moved(pose: np.ndarray, v: float, omega: float, dt: float) -> np.ndarray:
    """The pose after an arc."""
    turn = omega * dt
    chord = v * dt * np.sinc(turn / 2 / np.pi)
    toward = pose[2] + turn / 2
    return pose + [chord * np.cos(toward), chord * np.sin(toward), turn]


def wrap(angle: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * np.asarray(angle)))


def drawn(
    seed: int,
    steps: int = STEPS,
    *,
    delay: float = 0.0,
    longer: float = 1.0,
    outliers: float = 0.0,
    persistence: float = 0.0,
    turned: float = 0.0,
    slip: float = 0.0,
) -> Log:
    """The log of a drive; without a fault it is of the models.

    Args:
        delay: by which measurements are stamped late [s].
        longer: factor of the ranges.
        outliers: share of measurements of five times the noise.
        persistence: correlation of the errors of a range from scan to scan.
        turned: of the scanner [rad].
        slip: share of the travel that is lost in a tenth of the path.
    """
    rng, points = np.random.default_rng(seed), posts()
    noise, goal = rng.normal(size=(steps, 2)) * [NOISES["v"], NOISES["omega"]], 0
    pose, path, controls = np.array([0.0, 0.0, 0.5]), [], []
    planned = pose  # steering by the true pose would tell the odometry of its own noise
    begin = int(rng.uniform(0.1, 0.8) * steps)
    for k in range(steps):
        way = GOALS[goal % len(GOALS)] - planned[:2]
        goal += int(np.hypot(*way) < 0.8)
        omega = float(np.clip(wrap(np.arctan2(way[1], way[0]) - planned[2]), -0.7, 0.7))
        slips = slip if begin <= k < begin + steps // 10 else 0.0
        pose = moved(pose, (1 - slips) * 0.7 + noise[k, 0], omega + noise[k, 1], DT)
        planned = moved(planned, 0.7, omega, DT)
        path.append(pose)
        controls.append([0.7, omega, DT])
    now = DT * np.arange(1, steps + 1)
    seen_at = np.stack([np.interp(now - delay, now, part) for part in np.array(path).T], axis=1)
    c, s = np.cos(seen_at[:, 2]), np.sin(seen_at[:, 2])
    eye = seen_at[:, :2] + np.stack([c * MOUNT[0] - s * MOUNT[1], s * MOUNT[0] + c * MOUNT[1]], 1)
    gap = points[None] - eye[:, None]
    far = np.hypot(gap[..., 0], gap[..., 1])
    valid = (far < REACH) & (np.arange(1, steps + 1) % EVERY == 0)[:, None]
    error = rng.normal(size=(steps, len(points), 2))
    error *= np.where(rng.random(far.shape) < outliers, 5.0, 1.0)[..., None]
    if persistence:
        for k in range(EVERY, steps):  # from scan to scan
            fresh = np.sqrt(1 - persistence**2) * error[k, :, 0]
            error[k, :, 0] = persistence * error[k - EVERY, :, 0] + fresh
    ranges = longer * far + NOISES["range"] * error[..., 0]
    bearing = np.arctan2(gap[..., 1], gap[..., 0]) - seen_at[:, None, 2] - turned
    z = np.stack([ranges, wrap(bearing + NOISES["bearing"] * error[..., 1])], axis=-1)
    tag = np.where(valid, np.arange(len(points)), -1).astype(np.int32)
    return Log(np.array(controls), Scan(np.where(valid[..., None], z, 0.0), tag, valid))


def as_dataset(log: Log) -> datasets.Dataset:
    """The data set of a log, with the models that it is of where it has no fault."""
    steps = len(log.control)
    return datasets.Dataset(
        name="yard",
        log=log,
        time=DT * np.arange(1, steps + 1),
        motion=motion.Velocity(np.diag([NOISES["v"], NOISES["omega"], 0.0]) ** 2),
        sensor=sensors.RangeBearing(
            np.diag([NOISES["range"], NOISES["bearing"]]) ** 2, mount=(*MOUNT, 0.0)
        ),
        tags=tuple(range(log.scan.tag.shape[1])),
        pose=np.array([0.0, 0.0, 0.5]),
        filter_options={"correction": "sequential"},
    )


def check_of(data: datasets.Dataset, seed: int, name: str = "ekf") -> ModelCheck:
    world = twin(data)
    filter = catalog.FILTERS[name](world)
    key = jax.random.key(seed)
    return check_models(world, filter, data.log, twins=TWINS, key=key, filter_name=name)


FAULTS: dict[str, tuple[dict[str, float], Callable[[str], bool]]] = {
    "delay of 60 ms": ({"delay": 0.06}, lambda name: name == "fault, delay"),
    "ranges 2 % long": ({"longer": 1.02}, lambda name: name == "fault, longer"),
    "ranges 4 % long": ({"longer": 1.04}, lambda name: name == "fault, longer"),
    "5 % of five times the noise": (
        {"outliers": 0.05},
        lambda name: name.startswith(("kurtosis", "tail")),
    ),
    "range errors correlated by 0.9": (
        {"persistence": 0.9},
        lambda name: name.startswith("autocorrelation"),
    ),
    "mount turned by 3°": ({"turned": np.deg2rad(3.0)}, lambda name: name == "fault, turned"),
    "slip of 20 % in a tenth": ({"slip": 0.2}, lambda name: name == "fault, slip"),
}
"""The fault, and whether the name of a statistic says it."""


LEAST = {"ranges 2 % long": 0.2}
"""Gates other than 0.9. The odometry of such a log, 63 m with 0.015 m of noise a row, tells the
scale of its ranges to 0.7 %: 2 % are 2.8 deviations, and a corrected p-value of 0.05 is at 3.1."""


def calibration(logs: int) -> list[Metric]:
    """p-values of logs that are drawn from the models."""
    checks = [check_of(as_dataset(drawn(seed)), seed) for seed in range(logs)]
    p: dict[str, list[float]] = {}
    for check in checks:
        for each in check.statistics:
            p.setdefault(each.statistic.name, []).append(each.p)
    uniform = {name: float(stats.kstest(values, "uniform").pvalue) for name, values in p.items()}
    worst = sorted(uniform, key=lambda name: uniform[name])[:5]
    rows = {
        name: {"KS p": uniform[name], "below 0.05": float(np.mean(np.array(p[name]) < 0.05))}
        for name in worst
    }
    show(f"{len(p)} statistics over {logs} logs of the models, the least uniform", rows)
    alarms = float(np.mean([bool(check.findings) for check in checks]))
    return [
        Metric("statistics", len(p)),
        Metric("logs of the models", logs),
        Metric("least Kolmogorov-Smirnov p of a statistic", min(uniform.values()), low=0.001),
        Metric("share of logs with a corrected p below 0.05", alarms, high=0.08),
    ]


def planted(logs: int) -> list[Metric]:
    """Faults that are found, and named."""
    rows, metrics = {}, []
    for fault, (options, says) in FAULTS.items():
        found, named, worst = 0, 0, []
        for seed in range(logs):
            check = check_of(as_dataset(drawn(1000 + seed, **options)), seed)
            first = check.statistics[0]
            found += first.contradicts
            named += first.contradicts and says(first.statistic.name)
            worst.append(first.statistic.name)
        most = max(set(worst), key=worst.count)
        rows[fault] = {"found": found / logs, "named": named / logs, "mostly the worst": most}
        low = LEAST.get(fault, 0.9)
        metrics.append(Metric(f"{fault}: found", found / logs, low=low))
        metrics.append(Metric(f"{fault}: found and named", named / logs, low=low))
    show(f"Faults planted in {logs} logs each", rows)
    return metrics


def speed() -> list[Metric]:
    """Seconds of 100 twins of a log as long as *Lost in the woods*, beyond compilation."""
    data = as_dataset(drawn(7, LONG))
    world = twin(data)
    filter = catalog.FILTERS["ekf"](world)
    seconds = []
    for twins in (20, TWINS):  # the first run compiles
        began = time.perf_counter()
        check_models(
            world, filter, data.log, twins=twins, key=jax.random.key(0), block=len_of_block()
        )
        seconds.append(time.perf_counter() - began)
    return [Metric(f"check of a log of {LONG:,} rows by 100 twins [s]", seconds[1], high=60.0)]


def len_of_block() -> int:
    """Runs a device, so that blocks of 20 and of 100 twins have one shape."""
    return -(-TWINS // (4 * jax.local_device_count()))


Filters = Mapping[str, Callable[[Twin], Filter]]

LANDMARK: Filters = {name: catalog.FILTERS[name] for name in ("ekf", "right_invariant")}


def real_logs() -> Iterator[tuple[str, datasets.Dataset, Filters]]:
    """Data sets by name, of the folder and of GTSAM, and the filters for them."""
    woods = DATA / "lost_in_the_woods" / "dataset2.mat"
    if woods.is_file():
        from benchmarks.woods import CALIBRATED, tables

        with tempfile.TemporaryDirectory() as home:
            recorded = tables(Path(home) / "recorded", 0.0, True)
            yield "Lost in the woods, as recorded", recorded, LANDMARK
            spaced = tables(Path(home) / "spaced", 3.0)
            fitted = datasets.fit(spaced, calibrate=CALIBRATED, fixed=("range scale",))
            assert spaced.adjustable is not None
            log, moves, sensor = jax.device_get(spaced.adjustable.at(fitted.values))
            fitted_log = replace(spaced, log=log, motion=moves, sensor=sensor)
            yield "Lost in the woods, fitted", fitted_log, LANDMARK
    if (DATA / "mrclam6").is_dir():
        yield "MRCLAM 6, robot 1", datasets.mrclam(DATA / "mrclam6", 1), LANDMARK
    if (DATA / "bonn").is_dir():
        yield "Bonn", datasets.bonn(DATA / "bonn"), LANDMARK
    try:
        import gtsam
    except ImportError:
        return
    park = datasets.victoria_park(gtsam.findExampleDataFile("victoria_park.txt"))
    yield "Victoria Park", park, LANDMARK
    # Ranges alone: the EKF would be lost, and its innovations say nothing.
    plaza = datasets.plaza(gtsam.findExampleDataFile("Plaza1_.mat"))

    def delayed(world: Twin) -> Filter:
        return DelayedSlam(plaza.motion, plaza.sensor, plaza.capacity, stored=STORED)

    yield "Plaza", plaza, {"delayed": delayed}


def median_nees(truth: np.ndarray, pose: np.ndarray, cov: np.ndarray) -> float:
    """The median pose NEES of the rows with a truth; truth: (…, T, 3)."""
    known = np.isfinite(truth).all(axis=-1)
    error = pose_error(np.where(known[..., None], truth, pose), pose)
    nees, regular = block_nees(pose, error, error, cov)["pose"]
    return float(np.median(nees[known & regular]))


def nees_beside_twins(data: datasets.Dataset, world: Twin, filter: Filter) -> dict[str, float]:
    """The median pose NEES of a log, where its truth is known, and of some twins."""
    key = jax.random.key(1)
    row = {}
    if data.true_path is not None and data.one_frame:
        estimate = jaxslam.run(filter, data.log, data.pose, data.pose_cov, key).estimate
        row["log"] = median_nees(data.true_path, *map(np.asarray, estimate[:2]))

    def of_twin(key):
        truth, log = world.draw(key)
        estimate = jaxslam.run(filter, log, world.pose, world.pose_cov, key).estimate
        return truth.pose, estimate.pose, estimate.pose_cov

    many = jax.device_get(jax.jit(jax.vmap(of_twin))(jax.random.split(key, 16)))
    row["twins"] = float(np.mean([median_nees(*each) for each in zip(*many, strict=True)]))
    return row


def real(quick: bool) -> list[Metric]:
    """What the statistics say of real logs; nothing is chosen by the truth."""
    metrics = []
    for name, data, filters in real_logs():
        if quick and data.steps > 5000:
            continue
        began = time.perf_counter()
        world = twin(data)
        smoothing = time.perf_counter() - began
        rows = {}
        for label, make in filters.items():
            began, filter = time.perf_counter(), make(world)
            key = jax.random.key(0)
            check = check_models(world, filter, data.log, twins=TWINS, key=key, filter_name=label)
            spent = time.perf_counter() - began
            print(f"\n{name}: {check}  [{smoothing:.0f} + {spent:.0f} s]", flush=True)
            rows[label] = nees_beside_twins(data, world, filter)
            metrics.append(Metric(f"{name}, {label}: statistics that fail", len(check.findings)))
            metrics += [
                Metric(f"{name}, {label}: median pose NEES, {which}", value)
                for which, value in rows[label].items()
            ]
            if not quick and label == next(iter(filters)):
                save(check_figure(check), f"twins_{file_name(name)}")
        show(f"{name}: median pose NEES (2.37 is honest)", rows)
    return metrics


def file_name(name: str) -> str:
    return "_".join(name.lower().replace(",", "").split())


def measure(quick: bool = False) -> list[Metric]:
    metrics = calibration(20 if quick else LOGS)
    metrics += planted(4 if quick else PLANTED)
    if not quick:
        metrics += speed()
    return metrics + real(quick)
