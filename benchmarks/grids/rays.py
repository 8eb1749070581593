"""Rays a second on one core beside C++: `python -m benchmarks.grids.rays`; one line of JSON.

The same maps, poses and beams for `limit.cpp` and for each method of `grids.cast`, in float32, in
turns; the fastest pass of each counts.
"""

# ruff: noqa: E402
import json
import subprocess
import tempfile
from pathlib import Path

from benchmarks.speed.timing import compiled_cpp, pin, together

pin()

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.grids.maps import maps
from jaxslam import grids

POSES, BEAMS = 1000, 360
METHODS = {
    "cells": ("cells", False),
    "cells, skipping": ("cells", True),
    "surface": ("surface", True),
}


def measure(name, grid, max_range):
    rng = np.random.default_rng(1)
    free = np.argwhere(np.asarray(grid.log_odds) < 0)
    cells = free[rng.integers(len(free), size=POSES)][:, ::-1] + rng.random((POSES, 2))
    heading = rng.uniform(-np.pi, np.pi, POSES)
    angles = 2 * np.pi * np.arange(BEAMS) / BEAMS
    position = grid.origin[:2] + grid.resolution * cells
    pose = jnp.asarray(np.column_stack([position, heading]), jnp.float32)
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), grid)
    beams = jnp.asarray(angles, jnp.float32)
    actions, means = {}, {}
    for method, (kind, skip) in METHODS.items():
        rays = grids.ray_map(single, method=kind, skip=skip)
        actions[method] = lambda r=rays: grids.cast(r, pose, beams, max_range).block_until_ready()
        means[method] = float(jnp.mean(actions[method]()))
    inside = []
    with tempfile.TemporaryDirectory() as folder:
        program = compiled_cpp(Path(__file__).with_name("limit.cpp"), folder)
        occupied, given = (str(Path(folder) / part) for part in ("map", "rays"))
        (np.asarray(grid.log_odds) > 0).astype(np.uint8).tofile(occupied)
        each = np.repeat(cells, BEAMS, axis=0), (heading[:, None] + angles).ravel()
        np.column_stack(each).tofile(given)
        height, width = grid.log_odds.shape
        size, limit = POSES * BEAMS, max_range / float(grid.resolution)
        command = [program, occupied, str(width), str(height), given, str(size), str(limit), "1"]

        def cpp():
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            inside.append([float(word) for word in out.split()])

        seconds = together(actions | {"C++": cpp})
    found = {
        f"{method}, {name} [million rays/s]": POSES * BEAMS / 1e6 / seconds[method]
        for method in METHODS
    }
    best, mean = min(row[0] for row in inside), float(grid.resolution) * inside[0][1]
    found[f"C++, {name} [million rays/s]"] = POSES * BEAMS / 1e6 / best
    found |= {f"C++ / {method}, time, {name}": best / seconds[method] for method in METHODS}
    found[f"mean range by C++ - cells, {name} [m]"] = mean - means["cells"]
    return found


if __name__ == "__main__":
    numbers = {}
    for name, (grid, max_range) in maps().items():
        numbers |= measure(name, grid, max_range)
    print(json.dumps(numbers))
