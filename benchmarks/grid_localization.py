"""Localization in grids: half an hour on two idle cores.

Office: the likelihood-field filter on the same draws for each exponent of the likelihood, in a
map made from another drive: does the 95 % set of its particles cover the truth in 95 % of the
steps? Then from anywhere. Then the same of the ray-cast model, on the same draws; its
parameters are learnt by `grids.fit` from the true poses of a third drive. Logs: the Intel lab and
Freiburg's building 101, raw odometry and scans against the corrected poses, in a map made from
other scans of the same log: of its first half, and of every second scan; and from anywhere, in both
maps. The second half leaves the map of the first: there most beams may end where nothing is mapped,
so the model has a large share of random ranges (`HALF`), and particles are not drawn anew, which
would put them into the mapped part. The folder is JAXSLAM_DATA, by default ../shared/data; logs
that are not there are left out.
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, table
from benchmarks.real_data import DATA
from jaxslam import consistency, datasets, grids, motion, run
from jaxslam.consistency import pose_error
from jaxslam.consistency._localization_scores import seed_spread
from jaxslam.core.record import record
from jaxslam.simulation import laser, walls
from jaxslam.simulation.scenarios import office

EXPONENTS = (1.0, 0.5, 0.2, 0.1, 0.05)
RAY_EXPONENTS = (1.0, 0.2, 0.1, 0.05)
BEAMS, CELL = 60, 0.05
START = np.diag([0.1, 0.1, 0.05]) ** 2
SKIP = 5  # scored steps, of 4 each, until the start is forgotten
FOUND = 0.5, np.pi / 6  # [m], [rad]
LOGS = "intel", "freiburg-101"
FAR = 30.0
HALF = {"hit": 0.1, "random": 0.9}
"""Of the beam model in the map of a first half; chosen among a dozen settings on these logs, when
the reader took steps of the corrected path for odometry. With true raw odometry the default shares
do as well."""
ALPHA = (0.05, 0.03, 0.02, 0.01)
"""Noise of raw odometry, as of `jaxslam run --localize`: for a straight step of 0.7 m 10 cm ahead
and 7° of each turn. Its steps differ from those of the corrected poses by 4 cm, 5 cm and 3.5° (RMS)
in intel, by 4 cm, 4 cm and 2.3° in freiburg-101."""


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def office_map():
    """The map of another drive through the office, with 180 beams."""
    world = office()
    log = laser.scan_world(world, jax.random.key(1000))
    frame = walls.rasterize(world.walls, CELL)
    shape, far = frame.log_odds.shape, world.laser.max_range
    counts = grids.count(shape, frame.origin, CELL, log.pose, log.beams, max_range=far)
    return single(grids.occupancy(counts))


def learnt(grid, world):
    """The mixture of `grids.fit` for the ranges of a third drive, given those that the map predicts
    at its true poses."""
    log, far = laser.scan_world(world, jax.random.key(1001)), world.laser.max_range
    rays = grids.ray_map(grid)
    expected = grids.cast(rays, log.pose, world.laser.angles, far)
    seen = np.asarray(log.beams.valid)
    return grids.fit(np.asarray(log.beams.range)[seen], np.asarray(expected)[seen], far)


@record
class SingleRayCast(grids.RayCast):
    """The ray-cast model in float32, in half the time; the world's draws stay in float64."""

    def log_likelihoods(self, prepared, pose, beams):
        return super().log_likelihoods(*single_log((prepared, pose, beams))).astype(pose.dtype)


def tempering_field(runs):
    """Of the likelihood field; σ is that of the laser and of half a cell."""
    world = office(beams=BEAMS)
    model = grids.LikelihoodField(0.03, max_range=world.laser.max_range)
    return tempering("office", world, office_map(), model, EXPONENTS, runs)


def tempering_rays(runs):
    """Of the ray-cast model as it is learnt."""
    world, grid = office(beams=BEAMS), office_map()
    mixture = learnt(grid, office())
    far = world.laser.max_range
    model = SingleRayCast(mixture, max_range=far)
    print("\n" + ", ".join(f"{name} {value:.4f}" for name, value in mixture._asdict().items()))
    return tempering("office, ray_cast", world, grid, model, RAY_EXPONENTS, runs)


def tempering(name, world, grid, model, exponents, runs, particles=500, seeds=10):
    """The table over exponents, from a known start."""

    def judged(exponent):
        """The coverage, and the row of the table."""
        filter = grids.GridLocalization(
            grid, model, world.motion, particles, least=particles, exponent=exponent
        )
        key = jax.random.key(0)
        scores = consistency.judge_localization(world, filter, runs, key, start_cov=START, stride=4)
        found = consistency.summarize_localization(scores, skip=SKIP, limit=FOUND)
        again = consistency.judge_localization(
            world, filter, seeds, key, start_cov=0 * START, same_log=True, stride=4
        )
        spread = float(np.median(seed_spread(again)[SKIP:]))
        return found.coverage.value, [
            f"{exponent:g}",
            told(found.coverage),
            told(found.nees),
            f"{1e3 * found.energy.value:.1f}",
            f"{1e3 * found.rmse.value:.1f}" if found.rmse else "-",
            f"{np.degrees(found.heading):.2f}",
            f"{spread:.2f}",
            f"{np.asarray(scores.ess)[:, SKIP:].mean():.0f}",
            f"{found.lost:.0%}",
        ]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        covered, rows = zip(*pool.map(judged, exponents), strict=True)
    header = ["exponent", "coverage of the 95 % set", "NEES (3)", "energy score [mm]"]
    header += ["position RMSE [mm]", "median heading error [°]", "spread over seeds", "ESS", "lost"]
    print(f"\n{name}, {runs} runs, {particles} particles, {BEAMS} beams\n")
    print(table(header, rows), flush=True)
    nearest = min(covered, key=lambda value: abs(value - 0.95))
    # Coverage falls as the exponent grows; NaN if no exponent reaches 95 %, or all do.
    best = float(np.exp(np.interp(0.95, covered, np.log(exponents), np.nan, np.nan)))
    return [
        Metric(f"{name}: coverage without tempering", covered[0]),
        Metric(f"{name}: coverage nearest to 0.95", nearest, 0.9, 0.99),
        Metric(f"{name}: exponent whose sets cover 95 %, interpolated", best),
    ]


def told(measure):
    if measure is None:
        return "-"
    return f"{measure.value:.3g} [{measure.low:.3g}, {measure.high:.3g}]"


def anywhere(runs, particles=5000):
    """The office from anywhere: when found, how many are lost."""
    world = office(beams=BEAMS // 2)
    model = grids.LikelihoodField(0.2, max_range=world.laser.max_range)
    filter = grids.GridLocalization(
        office_map(), model, world.motion, particles,
        start="uniform", exponent=0.1, forget=(0.05, 0.5),
    )  # fmt: skip
    scores = consistency.judge_localization(world, filter, runs, jax.random.key(0), stride=4)
    found = consistency.summarize_localization(scores, limit=FOUND)
    after = found.converged_at[np.isfinite(found.converged_at)]
    return [
        Metric("office, anywhere: share of runs found", 1 - found.lost, low=0.95),
        Metric("office, anywhere: median time to converge [s]", float(np.median(after))),
        Metric("office, anywhere: its 90 % quantile [s]", float(np.quantile(after, 0.9))),
        Metric("office, anywhere: energy score [m]", found.energy.value),
    ]


def read(name, max_range=FAR):
    """A log, None where it is absent."""
    path = DATA / "carmen" / f"{name}-corrected.log"
    stored = path.exists() or path.with_name(path.name + ".gz").exists()
    return datasets.carmen(path, max_range=max_range) if stored else None


def counts_of(log, rows, max_range=FAR, margin=10.0):
    """How often some scans of a log, at their corrected poses, pass each cell and end there."""
    path = log.corrected[:, :2]
    low, high = path.min(axis=0) - margin, path.max(axis=0) + margin
    width, height = np.ceil((high - low) / CELL).astype(int).tolist()
    beams = jax.tree.map(lambda part: part[rows], log.beams)
    frame = (height, width), np.array([*low, 0.0]), CELL
    return grids.count(*frame, log.corrected[rows], beams, max_range=max_range, no_return=0.0)


def log_of(log, rows, beams=BEAMS):
    """Raw odometry between some scans, and these with so many beams, in float32."""
    step = max(1, log.beams.range.shape[1] // beams)
    taken = jax.tree.map(lambda part: part[rows][:, ::step], log.beams)
    return single_log(grids.beam_log(motion.odometry_controls(log.raw[rows]), taken))


def single_log(log):
    return jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, log)


def filter_of(grid, particles, sigma=0.1, shares=None, **options):
    """The likelihood-field filter; shares: `hit` and `random` of the model."""
    moves = motion.Odometry(motion.OdometryNoise(ALPHA))
    model = grids.LikelihoodField(sigma, max_range=FAR, **(shares or {}))
    return grids.GridLocalization(grid, model, moves, particles, **options)


def in_map(grid, log, rows, share=0.5):
    """At which scans the robot is in mapped area: it stands on a cell that is known, and so many of
    its beams that met something end on one, at the corrected pose."""
    known = np.asarray(grid.log_odds) != 0
    pose = log.corrected[rows]
    beams = jax.tree.map(lambda part: np.asarray(part)[rows], log.beams)
    met = (beams.valid > 0) & (beams.range < FAR)
    turn = pose[:, 2:3] + beams.angle
    ends = pose[:, None, :2] + np.where(met, beams.range, 0.0)[..., None] * np.stack(
        [np.cos(turn), np.sin(turn)], axis=-1
    )

    def at(points):
        column, row = np.floor((points - np.asarray(grid.origin)[:2]) / CELL).astype(int).T
        inside = (row >= 0) & (row < known.shape[0]) & (column >= 0) & (column < known.shape[1])
        return inside & known[np.where(inside, row, 0), np.where(inside, column, 0)]

    of_ends = at(ends.reshape(-1, 2)).reshape(met.shape)
    return at(pose[:, :2]) & ((of_ends & met).sum(axis=1) >= share * met.sum(axis=1))


def tracking(name, particles=2000, seeds=3):
    """Errors from a known start, of the first half's map and of every second scan's."""
    log = read(name)
    if log is None:
        return []
    count = len(log.corrected)
    half, odd = np.arange(count // 2, count), np.arange(1, count, 2)
    rows, metrics = [], []
    for label, mapped, driven, shares in (
        ("first half", np.arange(count // 2), half, HALF),
        ("every second scan", np.arange(0, count, 2), odd, None),
    ):
        grid = single(grids.occupancy(counts_of(log, mapped)))
        filter = filter_of(grid, particles, shares=shares, exponent=0.2, forget=None)
        own, start = log_of(log, driven), log.corrected[driven[0]].astype(np.float32)
        cov = np.diag([0.1, 0.1, 0.05]).astype(np.float32) ** 2
        errors = []
        for seed in range(seeds):
            trace = run(filter, own, start, cov, jax.random.key(seed))
            errors.append(pose_error(log.corrected[driven], np.asarray(trace.estimate.pose)))
        off = np.hypot(*np.moveaxis(np.array(errors)[..., :2], -1, 0))
        turn = np.degrees(np.abs(np.array(errors)[..., 2]))
        seen = in_map(grid, log, driven)
        for where, at, *gates in (
            ("all scans", seen | True, 0.10, 1.5),
            ("in mapped area", seen, np.inf, np.inf),
        ):
            values = np.median(off[:, at]), np.median(turn[:, at]), np.quantile(off[:, at], 0.9)
            cells = f"{at.mean():.0%}", *(f"{value:.3f}" for value in values)
            rows.append([name, label, where, *cells])
            metrics += [
                Metric(f"{name}, {label}, {where}: median error [{unit}]", value, high=high)
                for unit, value, high in zip("m°", values[:2], gates, strict=True)
            ]
    header = ["log", "map from", "scored", "share", "median [m]", "median [°]", "90 % [m]"]
    print(f"\n{particles} particles, {BEAMS} beams, {seeds} seeds")
    print(table(header, rows), flush=True)
    return metrics


def found_in(name, half=False, seeds=100, particles=5000, steps=60):
    """From anywhere: in the map of every second scan, at places all along the log; or in that of
    the first half, at the beginning of the second."""
    log = read(name)
    if log is None:
        return []
    count = len(log.corrected)
    mapped = np.arange(count // 2) if half else np.arange(0, count, 2)
    driven = np.arange(count // 2, count) if half else np.arange(1, count, 2)
    shares, forget = (HALF, None) if half else (None, (0.05, 0.5))
    options = {"start": "uniform", "exponent": 0.1, "forget": forget}
    filter = filter_of(
        single(grids.occupancy(counts_of(log, mapped))), particles, 0.2, shares, **options
    )
    starts = np.linspace(0, 0 if half else len(driven) - steps, seeds).astype(int)
    errors, seconds = [], 0.0
    for seed, first in enumerate(starts):
        rows = driven[first : first + steps]
        began = time.process_time()
        trace = run(filter, log_of(log, rows, 45), np.zeros(3, np.float32),
                    np.eye(3, dtype=np.float32), jax.random.key(seed))  # fmt: skip
        pose = np.asarray(trace.estimate.pose)
        seconds += (time.process_time() - began) * (seed > 0)  # the first compiles
        errors.append(pose_error(log.corrected[rows], pose))
    error = np.array(errors)
    wrong = np.hypot(error[..., 0], error[..., 1]) > FOUND[0]
    wrong |= np.abs(error[..., 2]) > FOUND[1]
    late = wrong[:, -10:].mean(axis=1) > 0.5
    first = np.argmax(~wrong, axis=1)
    rate = particles * steps * (seeds - 1) / seconds / 1e6
    where = f"{name}, anywhere, first half" if half else f"{name}, anywhere"
    return [
        Metric(f"{where}: found, of {seeds} starts", float((~late).sum()), low=0.95 * seeds),
        Metric(f"{where}: median scans until first within {FOUND[0]} m", np.median(first[~late])),
        Metric(f"{where}: million particles a processor second, 45 beams", rate),
    ]


def measure(quick: bool = False) -> list[Metric]:
    runs = 10 if quick else 100
    metrics = tempering_field(runs) + anywhere(runs) + tempering_rays(runs)
    for name in LOGS:
        metrics += tracking(name)
    metrics += found_in("intel", seeds=runs)
    metrics += found_in("freiburg-101", half=True, seeds=runs, steps=26)
    return metrics + found_in("intel", half=True, seeds=runs)
