"""A GPU beside all cores of the CPU of one machine; left out where JAX finds no GPU.

- Campaigns of `cloister`: runs a second after the first block, which compiles, and those of the
  filter without draws and scores; how far the pose NEES differ between the two, run by run. The EKF
  has 10⁵ runs on the GPU, in float64 and float32.
- Rays in a grid of 2,000 × 2,000 cells, float32.
- Pose graphs, float64: 256 of the pattern of `ring` in one batch, and `input_M3500_g2o` alone, from
  JAXSLAM_DATA as in `benchmarks.graphs.speed`.

The cores are as many devices of JAX, and each takes its share of the rays and graphs of a batch.
`python -m benchmarks.accelerator PLATFORM DTYPE WHAT …` measures one of them; one line of JSON.
"""

import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, child, table
from benchmarks.real_data import DATA

BLOCK = 4096
CAMPAIGNS = {
    ("ekf", "float64"): (25 * BLOCK, 3072),
    ("ekf", "float32"): (25 * BLOCK, 3072),
    ("fastslam2", "float64"): (3072, 512),
}
"""Runs on the GPU, and on the cores: the first of these."""

GRAPHS = 256


def campaign(name, runs):
    """Runs a second, those of the filter alone, seconds until the first block, pose NEES by run."""
    from jaxslam import catalog, monte_carlo, scenarios

    runs, world = int(runs), scenarios.cloister()
    marks = [(time.perf_counter(), 0)]
    found = monte_carlo(
        world,
        {name: catalog.ALL[name](world)},
        runs,
        jax.random.key(0),
        devices=jax.devices(),
        block=None if jax.devices()[0].platform == "cpu" else min(BLOCK, runs // 3),
        progress=lambda done, total: marks.append((time.perf_counter(), done)),
    )
    blocks = [mark for mark in marks if mark[1]]
    rate = (blocks[-1][1] - blocks[0][1]) / (blocks[-1][0] - blocks[0][0])
    alone = len(jax.devices()) / (found.step_seconds[name] * found.steps)
    nees = np.asarray(found.filters[name].per_run["nees_pose"]).tolist()
    return rate, alone, blocks[0][0] - marks[0][0], nees


def shared_out(function):
    """The function of a batch, compiled; each device computes a part, in a thread of its own."""
    compiled, devices = jax.jit(function), jax.devices()
    pool = ThreadPoolExecutor(len(devices))

    def of_parts(rows):
        parts = map(jax.device_put, jnp.split(rows, len(devices)), devices)
        done = pool.map(lambda part: jax.block_until_ready(compiled(part)), parts)
        return np.concatenate([np.asarray(part) for part in done])

    return of_parts


def fastest(function, *arguments):
    """Seconds of the fastest of three calls after the first, and what it returned."""
    out, seconds = jax.block_until_ready(function(*arguments)), []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - began)
    return min(seconds), out


def rays(poses):
    """Million rays a second and mean range by method."""
    from benchmarks.grids.maps import maps
    from jaxslam import grids

    grid, far = maps()["2000 × 2000"]
    rng, poses = np.random.default_rng(1), int(poses)
    free = np.argwhere(grid.log_odds < 0)
    cells = free[rng.integers(len(free), size=poses)][:, ::-1] + rng.random((poses, 2))
    heading = rng.uniform(-np.pi, np.pi, poses)
    start = jnp.asarray(np.column_stack([0.05 * cells, heading]), jnp.float32)
    angles = jnp.linspace(0, 2 * jnp.pi, 360, endpoint=False, dtype=jnp.float32)
    single, found = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), grid), {}
    for method in ("surface", "cells"):
        ray_map = grids.ray_map(single, method=method, skip=True)
        go = shared_out(lambda pose, ray_map=ray_map: grids.cast(ray_map, pose, angles, far))
        seconds, ranges = fastest(go, start)
        found[method] = poses * len(angles) / 1e6 / seconds, float(np.mean(ranges))
    return found


def pose_graphs(count):
    """Graphs a second of a batch and the greatest χ² of it; seconds of a large graph and its χ²."""
    from jaxslam import datasets, graphs

    factors = {"relative_pose": graphs.RelativePoseLog()}
    graph = graphs.with_gauge(datasets.read_graph(DATA / "graphs" / "ring.g2o"))
    truth = datasets.read_graph(DATA / "graphs" / "ring_groundTruth.g2o")
    rows, count = graph.tables["relative_pose"], int(count)
    root = np.linalg.cholesky(np.linalg.inv(rows.information))
    exact, rng = np.asarray(truth.tables["relative_pose"].z), np.random.default_rng(0)
    z = exact + np.einsum("eij,nej->nei", root, rng.normal(size=(count, *exact.shape)))
    plan = graphs.plan(graph, factors)

    def solve(z):
        one = graph._replace(tables={"relative_pose": rows._replace(z=z)})
        return graphs.optimize(one, factors, plan=plan, tolerance=5e-7).chi2

    seconds, chi2 = fastest(shared_out(jax.vmap(solve)), jnp.asarray(z))
    large = graphs.with_gauge(datasets.read_graph(DATA / "graphs" / "input_M3500_g2o.g2o"))
    of_large = graphs.plan(large, factors)
    go = jax.jit(partial(graphs.optimize, factors=factors, plan=of_large, tolerance=5e-7))
    large_seconds, found = fastest(go, jax.device_put(large))
    return count / seconds, float(np.max(chi2)), large_seconds, float(found.chi2)


def measure(quick: bool = False) -> list[Metric]:
    """Rates by device, and how far its results are from the cores'."""
    # In another process: one that has seen a GPU keeps most of its memory.
    seen = "import json, jax; d = jax.devices()[0]; print(json.dumps([d.platform, d.device_kind]))"
    (platform, kind), cores = child("-c", seen), len(os.sched_getaffinity(0))
    if platform != "gpu":
        print("no GPU", file=sys.stderr)
        return []
    print(f"\n{kind}, {cores} cores beside it\n\nIn a cell: the GPU, the cores.\n")
    metrics, rows = [], []
    for (name, dtype), (runs, few) in CAMPAIGNS.items():
        *gpu, nees = on("cuda", dtype, "campaign", name, runs)
        *cpu, nees_cpu = on("cpu", dtype, "campaign", name, few)
        nees, nees_cpu = np.array(nees[: len(nees_cpu)]), np.array(nees_cpu)
        pairs = [*zip(gpu, cpu, strict=True), (nees.mean(), nees_cpu.mean())]
        rows.append([name, dtype, f"{runs:,}", *(f"{a:.4g}, {b:.4g}" for a, b in pairs)])
        metrics.append(Metric(f"{name}, {dtype}, GPU / all cores", gpu[0] / cpu[0]))
        off = np.abs(nees / nees_cpu - 1)
        note = f"median; at most {off.max():.2g}"
        what = f"{name}, {dtype}, NEES of a run, GPU / CPU - 1"
        metrics.append(Metric(what, float(np.median(off)), note=note))
    header = ["filter", "precision", "runs", "runs/s", "filter alone [runs/s]", "first block [s]"]
    print(table([*header, "mean pose NEES"], rows))
    gpu, cpu = (on(where, "float32", "rays", 16000) for where in ("cuda", "cpu"))
    for method in gpu:
        (rate, mean), (rate_cpu, mean_cpu) = gpu[method], cpu[method]
        print(f"rays, {method} [million/s]: {rate:.4g}, {rate_cpu:.4g}")
        metrics.append(Metric(f"rays, {method}, GPU / all cores", rate / rate_cpu))
        metrics.append(Metric(f"rays, {method}, mean range, GPU / CPU - 1", mean / mean_cpu - 1))
    gpu, cpu = (on(where, "float64", "pose_graphs", GRAPHS) for where in ("cuda", "cpu"))
    print(f"{GRAPHS} graphs of `ring` in a batch [graphs/s]: {gpu[0]:.4g}, {cpu[0]:.4g}")
    print(f"`input_M3500_g2o` [s]: {gpu[2]:.4g}, {cpu[2]:.4g} (one core)")
    metrics.append(Metric("graphs of a batch a second, GPU / all cores", gpu[0] / cpu[0]))
    metrics.append(Metric("a graph of 3,500 poses, rate, GPU / one core", cpu[2] / gpu[2]))
    for name, of in (("batch", 1), ("3,500 poses", 3)):
        metrics.append(Metric(f"χ², {name}, GPU / CPU - 1", gpu[of] / cpu[of] - 1))
    return metrics


def on(platform, dtype, *what):
    """What is measured in a process of its own, on a device."""
    found = child("-m", "benchmarks.accelerator", platform, dtype, *what)
    print(platform, dtype, *what, str(found)[:100], file=sys.stderr)
    return found


if __name__ == "__main__":
    platform, dtype, what, *arguments = sys.argv[1:]
    if platform == "cpu":
        jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    jax.config.update("jax_platforms", platform)
    jax.config.update("jax_enable_x64", dtype == "float64")
    parts = {"campaign": campaign, "rays": rays, "pose_graphs": pose_graphs}
    print(json.dumps(parts[what](*arguments)))
