"""Rays a second on one core beside a traversal in C++ (`rays.py`), the error of ranges against
exact walls, and the distance field of 4 million cells beside SciPy's.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from benchmarks.gate import Metric, child
from benchmarks.grid_localization import counts_of, read
from benchmarks.speed.timing import together
from jaxslam import grids
from jaxslam.simulation._wall_geometry import exact_ranges
from jaxslam.simulation.scenarios import ROOMS
from jaxslam.simulation.walls import rasterize

CELL = 0.05


def distance() -> list[Metric]:
    rng = np.random.default_rng(0)
    cells = rng.random((2000, 2000)) < 5e-4
    cells[::200] = cells[:, ::250] = True
    grid = grids.Grid(jnp.where(cells, 2.0, -2.0), jnp.zeros(3), jnp.asarray(1.0))
    actions = {
        "ours": lambda: grids.distance_field(grid).values.block_until_ready(),
        "SciPy": lambda: ndimage.distance_transform_edt(~cells),
    }
    error = np.abs(actions["ours"]() - actions["SciPy"]()).max()
    seconds = together(actions)
    return [
        Metric("distance field, 4 million cells [s]", seconds["ours"], high=0.5),
        Metric("distance field, 4 million cells, SciPy [s]", seconds["SciPy"]),
        Metric("distance field, largest difference from SciPy [cells]", error, high=1e-9),
    ]


def accuracy() -> list[Metric]:
    """Errors in cells over beams whose exact range changes by less than three cells under a shift
    of one and a half to either side, so none that passes an edge, or more than 63° from the normal
    of a wall; the share of these beams. Gates are for those that end one and a half cells or more
    from the corners of the room as well, which the grid rounds. Of all beams, with those beside an
    edge, which the grid may hit or miss wrongly, how many are wrong by more than half a cell.
    """
    metrics = []
    for name, make in ROOMS.items():
        world = make(90)
        angles, far = jnp.asarray(world.laser.angles), world.laser.max_range
        rng = np.random.default_rng(2)
        coarse = rasterize(world.walls, 0.4)  # spots half a coarse cell or more from the walls
        spots = np.asarray(grids.centers(coarse))[np.asarray(coarse.probability) < 0.01]
        spots = spots[rng.integers(len(spots), size=400)] + rng.uniform(-0.1, 0.1, (400, 2))
        pose = np.column_stack([spots, rng.uniform(-3, 3, len(spots))])
        heading = pose[:, 2, None] + np.asarray(angles)
        across = 1.5 * CELL * np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=-1)

        def one(pose, angle, walls=world.walls, far=far):
            return exact_ranges(walls, pose, angle[None], far)[0]

        of_beams = jax.jit(lambda poses: jax.lax.map(lambda row: jax.vmap(one)(row, angles), poses))
        left, middle, right = (
            np.asarray(of_beams(pose[:, None] + side * across)) for side in (1.0, 0.0, -1.0)
        )
        steady = (np.maximum(abs(left - middle), abs(right - middle)) < 3 * CELL) & (middle < far)
        unit = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        ends = pose[:, None, :2] + middle[..., None] * unit
        apart = np.full(middle.shape, np.inf)
        for corner in world.walls.segments[:, 0]:
            apart = np.minimum(apart, np.linalg.norm(ends - corner, axis=-1))
        plain = steady & (apart > 1.5 * CELL)
        for method in ("surface", "cells"):
            rays = grids.ray_map(rasterize(world.walls, CELL, yaw=0.3), method=method)
            found = np.asarray(grids.cast(rays, pose, angles, far))
            error = np.abs(found - middle) / CELL
            wrong = np.mean(error > 0.5)
            most, median = (0.5, 0.1) if method == "surface" else (np.inf, np.inf)
            what = f"{method}, {name} [cells]"
            metrics += [
                Metric(f"largest error of a range, {what}", error[plain].max(), high=most),
                Metric(f"median error of a range, {what}", np.median(error[plain]), high=median),
                Metric(f"largest error, corners too, {what}", error[steady].max()),
                Metric(f"median error, all beams, {what}", np.median(error)),
                Metric(f"largest error, all beams, {what}", error.max()),
                Metric(f"share of all beams wrong by over half a cell, {method}, {name}", wrong),
            ]
        metrics.append(Metric(f"share of beams counted, {name}", plain.mean()))
    return metrics


def passed_walls() -> list[Metric]:
    """The share of the beams of a log that a map of all its scans predicts over 0.5 m too far."""
    far = 20.0
    log = read("freiburg-101", far)
    if log is None:
        return []
    counts = counts_of(log, slice(None), far, margin=far + 1)
    every = slice(None, None, 6)
    ranges, angles, valid = (np.asarray(part)[every] for part in log.beams)
    hit, metrics = valid & (ranges < far), []
    for kind, make in (("occupancy", grids.occupancy), ("reflection", grids.reflection)):
        grid = make(counts)
        trinary = grid._replace(log_odds=4 * jnp.sign(grid.log_odds))
        for what, of, method in (
            ("surface", grid, "surface"),
            ("surface, trinary", trinary, "surface"),
            ("cells", grid, "cells"),
        ):
            rays = grids.ray_map(of, method=method)
            found = np.asarray(grids.cast(rays, log.corrected[every], angles[0], far))
            share = (found - ranges > 0.5)[hit].mean()
            metrics.append(Metric(f"beams over 0.5 m too far, {kind}, {what}", share))
    return metrics


def measure(quick: bool = False) -> list[Metric]:
    metrics = []
    for name, value in child("-m", "benchmarks.grids.rays").items():
        low, high = -np.inf, np.inf
        if name.startswith(("cells, skipping", "surface")):
            low = 6.0  # of CDDT: Walsh & Karaman 2018, "CDDT: fast approximate 2D ray casting"
        elif name.startswith(("C++ / cells, skipping", "C++ / surface")):
            low = 0.5
        elif name.startswith("mean range"):
            low, high = -1e-3, 1e-3
        metrics.append(Metric(name, value, low, high))
    return metrics + accuracy() + passed_walls() + distance()
