"""SLAM with a grid a particle in a room, over some runs: `python -m benchmarks.grid_slam`.

    python -m benchmarks.grid_slam [--runs 6] [--out FIGURE]

`square`, 60 beams, cells of 0.1 m, with the odometry's noise as it is and three times as large.
The first scan is taken at the known start: a motion before it would turn the whole map, unseen.
Dead reckoning beside particles whose poses come from odometry alone ("motion") or near the best
match of the scan ("scan_matched"), on the same draws. Errors are in the frame of the start, without
alignment. CPU time is of one core, compilation left out; copies are maps overwritten by resampling,
a run. Last, the copies of 30 maps of which half die: in place, as `grid_slam` makes them, and by a
gather of all.

The gates: with 30 particles near the match, the position error is below half of dead reckoning's,
and the best particle's map correlates with the true one by 0.6 and more.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks.gate import Metric, alone
from jaxslam import grids
from jaxslam.consistency.nees import block_nees
from jaxslam.grids.slam.particles import copied_rows
from jaxslam.motion import Unicycle
from jaxslam.results import plot
from jaxslam.results.plot.maps.grids import shades_of_occupancy, shown_occupancy
from jaxslam.results.plot.style import INK, PAGE, caption, panels_of, titled
from jaxslam.simulation.laser import scan_world
from jaxslam.simulation.scenarios import square
from jaxslam.simulation.walls import rasterize

FIGURE = Path(__file__).parent / "figures" / "grid_slam.png"
CELL = 0.1
NOISES = {"odometry as it is": 1.0, "odometry three times as noisy": 3.0}
FILTERS = {
    "motion, 30": {"particles": 30, "proposal": "motion"},
    "motion, 100": {"particles": 100, "proposal": "motion"},
    "scan_matched, 10": {"particles": 10},
    "scan_matched, 30": {"particles": 30},
}


def world_of(noise):
    """The square room with the odometry's standard deviations times `noise`."""
    motion = Unicycle((noise * np.diag([0.05, np.deg2rad(3.0)])) ** 2)
    return dataclasses.replace(square(beams=60), motion=motion)


def filter_of(world, truth, particles, **more):
    far = world.laser.max_range
    frame = truth.log_odds.shape, truth.origin, CELL
    field = grids.likelihood_field(0.05, max_range=far)
    return grids.grid_slam(*frame, field, world.motion, particles, max_range=far, **more)


def driven(log):
    """The path by the odometry alone."""
    start, (v, omega, dt) = log.pose[0], np.asarray(log.control).T
    heading = start[2] + np.cumsum(omega * dt)
    before = np.concatenate([[start[2]], heading[:-1]])
    ahead = (v * dt)[:, None] * np.stack([np.cos(before), np.sin(before)], axis=1)
    return np.column_stack([start[:2] + np.cumsum(ahead, axis=0), heading])


def drawn_log(world, key):
    """A history without a motion before the first scan, and its start."""
    log = jax.device_get(scan_world(world, key))
    control = np.array(log.control)
    control[0] = 0.0  # Δt as well, so that there is no noise
    return log._replace(control=control)


def error_of(found, true):
    error = np.asarray(found) - np.asarray(true)
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    return error


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def judged(truth, filter, log, rows, key):
    """The measures of one run, and its trace."""
    began = time.process_time()
    trace = jax.block_until_ready(jaxslam.run(filter, rows, log.pose[0], np.zeros((3, 3)), key))
    seconds = time.process_time() - began
    error = error_of(trace.estimate.pose, log.pose)
    cov = np.asarray(trace.estimate.pose_cov)
    nees, regular = block_nees(log.pose, error, error, cov)["pose"]
    grid = jax.device_get(grids.best_map(trace.final))
    return {
        "position [m]": rms(np.hypot(*error[:, :2].T)),
        "heading [deg]": np.rad2deg(rms(error[:, 2])),
        "at the end [m]": float(np.hypot(*error[-1, :2])),
        "pose NEES, median": float(np.median(nees[regular])),
        "map correlation": float(grids.correlation(truth, grid)),
        "ESS": float(np.mean(trace.info.extra["particles"].ess)),
        "copies": int(np.sum(trace.info.extra["maps"].copied)),
        "CPU ms a step": 1e3 * seconds / len(log.pose),
    }, trace


def measure(runs=6, out=None):
    """The gates, with a table printed, and the figure where asked for."""
    metrics, drawn = [], None
    for what, noise in NOISES.items():
        world = world_of(noise)
        truth = rasterize(world.walls, CELL)
        logs = [drawn_log(world, jax.random.key(k)) for k in range(runs)]
        table = {"dead reckoning": []}
        for log in logs:
            error = error_of(driven(log), log.pose)
            table["dead reckoning"].append(
                {
                    "position [m]": rms(np.hypot(*error[:, :2].T)),
                    "heading [deg]": np.rad2deg(rms(error[:, 2])),
                    "at the end [m]": float(np.hypot(*error[-1, :2])),
                }
            )
        for name, options in FILTERS.items():
            filter = filter_of(world, truth, **options)
            found = []
            for k, log in enumerate(logs):
                rows = grids.beam_log(log.control, log.beams)
                key = jax.random.key(100 + k)
                if k == 0:  # compiles
                    judged(truth, filter, log, rows, key)
                one, trace = judged(truth, filter, log, rows, key)
                found.append(one)
                if k == 0 and name == "scan_matched, 30" and noise > 1:
                    drawn = world, truth, log, trace
            table[name] = found
        print(f"\nsquare, {what}: mean over {runs} runs of {len(logs[0].pose)} steps", flush=True)
        told(table)
        means = {name: mean_of(rows) for name, rows in table.items()}
        best = means["scan_matched, 30"]
        metrics += [
            Metric(
                f"{what}: position error over dead reckoning's",
                best["position [m]"] / means["dead reckoning"]["position [m]"],
                high=0.5,
            ),
            Metric(f"{what}: map correlation", best["map correlation"], low=0.6),
        ]
    cells = truth.log_odds.size
    print(f"\nstate of 30 maps of {cells:,} cells: {30 * cells * 8 / 2**20:.1f} MiB")
    metrics += copies(truth.log_odds.shape)
    if out is not None:
        draw(*drawn, out)
    return metrics


def mean_of(rows):
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def told(table):
    columns = list(mean_of(table["scan_matched, 30"]))
    print(f"{'':18}" + "".join(f"{name:>19}" for name in columns))
    for name, rows in table.items():
        mean = mean_of(rows)
        cells = (f"{mean[c]:19.3g}" if c in mean else f"{'-':>19}" for c in columns)
        print(f"{name:18}" + "".join(cells))


def copies(shape):
    """Milliseconds to overwrite half of 30 maps."""
    table = jnp.asarray(np.random.default_rng(0).integers(0, 99, (30, *shape)), jnp.int32)
    source = jnp.where(jnp.arange(30) % 2 == 0, jnp.arange(30), jnp.arange(30) - 1)
    ways = {
        "in place": jax.jit(lambda t, s: copied_rows((t,), s)[0], donate_argnums=0),
        "gather of all": jax.jit(lambda t, s: t[s], donate_argnums=0),
    }
    metrics = []
    for name, way in ways.items():
        held, seconds = way(table + 0, source), []
        for _ in range(50):
            began = time.perf_counter()
            held = way(held, source).block_until_ready()
            seconds.append(time.perf_counter() - began)
        metrics.append(Metric(f"half of 30 maps overwritten, {name} [ms]", 1e3 * min(seconds)))
    return metrics


def draw(world, truth, log, trace, out):
    """The map by odometry alone, and that of the best particle, with the paths."""
    odometry = driven(log)
    counts = grids.count(
        *(truth.log_odds.shape, truth.origin, CELL),
        odometry,
        log.beams,
        max_range=world.laser.max_range,
        no_return=0.0,
    )
    pairs = (
        ("scans at the odometry's poses", grids.occupancy(counts), odometry),
        ("best of 30 particles", grids.best_map(trace.final), np.asarray(trace.estimate.pose)),
    )
    figure, panels = panels_of(PAGE, 0.59 * PAGE, 1, 2, share=(True, True))
    height, width = truth.log_odds.shape
    x, y = np.asarray(truth.origin)[:2]
    extent = (x, x + CELL * width, y, y + CELL * height)
    look = {"cmap": shades_of_occupancy(), "vmin": 0, "vmax": 1, "origin": "lower"}
    for axes, (title, grid, path) in zip(panels, pairs, strict=True):
        axes.grid(visible=False)
        axes.imshow(shown_occupancy(np.asarray(grid.log_odds)), extent=extent, **look)
        axes.plot(*log.pose[:, :2].T, color=INK, lw=1.4, ls="--", label="true path")
        axes.plot(*path[:, :2].T, color=plot.COLORS[0], lw=1.2, label="estimate")
        axes.set(xlabel="x [m]", aspect="equal")
        titled(axes, title)
    panels[0].set_ylabel("y [m]")
    caption(figure, "")
    out.parent.mkdir(exist_ok=True)
    out.write_bytes(plot.png(figure))


if __name__ == "__main__":
    raise SystemExit(
        alone(
            "grid_slam",
            measure,
            runs={"type": int, "default": 6},
            out={"type": Path, "default": FIGURE},
        )
    )
