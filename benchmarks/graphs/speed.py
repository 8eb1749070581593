"""Time of an optimization beside GTSAM's, and by poses.

`input_M3500_g2o` and `city10000`, one graph at a time, from the file's own start, by
Levenberg-Marquardt; and 256 graphs of the pattern of `ring` in one batch, its measurements drawn
again about its true relative poses with the file's information, beside Gauss-Newton in GTSAM. (A
group of 16 takes as many steps as its slowest graph, which are 70 for one in thirty of these.)

Both libraries minimize the same cost, of the logarithm of the error. GTSAM stops, by its defaults,
after a step that lowered χ² by less than 1e-5 of it, and ours before one that would lower it by
less than 5e-7, so that both have χ² to 1e-6: Gauss-Newton converges linearly, and the steps left
out after that one would lower χ² by a few per cent more. Compilation and plan are apart, as is the
building of GTSAM's graph. Both are timed in turns; a time is the median, in seconds of the
processor.

The exponent is that of one step, linearization, factor and χ², from 500 to 10,000 poses: of a world
of fixed connectivity (`lanes`), and of the first poses of `city10000`, which have 1.2 to 2.1 edges
a pose, so that its exponent is also that of the fill. The files are looked for in the folder
JAXSLAM_DATA, by default ../shared/data.
"""

import resource
import time
from functools import partial

import gtsam
import jax
import numpy as np

from benchmarks.gate import Metric, show
from benchmarks.graphs import peer
from benchmarks.graphs.worlds import at
from benchmarks.real_data import DATA
from jaxslam import datasets, graphs
from jaxslam.math import numpy_poses

FACTORS = {"relative_pose": graphs.RelativePoseLog()}
TOLERANCE = 5e-7
MANY = 256
SIZES = (500, 1000, 2000, 5000, 10000)


def processor_seconds(work) -> tuple[float, object]:
    began = time.process_time()
    out = jax.block_until_ready(work())
    return time.process_time() - began, out


def of_gtsam(graph, kind="GaussNewton"):
    """A function that solves the graph by GTSAM: processor seconds, χ², iterations."""
    factors, start = peer.problem(graph, held=gtsam.noiseModel.Constrained.All(3))
    method, parameters = (getattr(gtsam, f"{kind}{part}") for part in ("Optimizer", "Params"))

    def solve():
        solver = method(factors, start, parameters())
        began = time.process_time()
        solver.optimize()
        return time.process_time() - began, 2 * solver.error(), solver.iterations()

    return solve


def one_graph(name: str, high: float, repeats: int) -> list[Metric]:
    graph = graphs.with_gauge(datasets.read_graph(DATA / "graphs" / f"{name}.g2o"))
    plan = graphs.plan(graph, FACTORS)

    def ours():
        seconds, found = processor_seconds(
            lambda: graphs.optimize(graph, FACTORS, plan=plan, tolerance=TOLERANCE)
        )
        return seconds, float(found.chi2), int(found.iterations)

    ours()  # compiles
    solvers = {
        "jaxslam": ours,
        "GTSAM's LM": of_gtsam(graph, "LevenbergMarquardt"),
        "GTSAM's GN": of_gtsam(graph),
    }
    turns = [{who: solve() for who, solve in solvers.items()} for _ in range(repeats)]
    rows = {
        who: {
            "ms": 1e3 * np.median([turn[who][0] for turn in turns]),
            "χ²": turns[-1][who][1],
            "steps": turns[-1][who][2],
        }
        for who in solvers
    }
    show(name, rows)
    own, metrics = rows.pop("jaxslam"), []
    for who, row in rows.items():
        off = own["χ²"] / row["χ²"] - 1
        metrics.append(Metric(f"{name}: time / {who}", own["ms"] / row["ms"], high=high))
        metrics.append(Metric(f"{name}: χ² / {who} - 1", off, high=1e-6))
    return metrics


def many_graphs(repeats: int) -> list[Metric]:
    graph = graphs.with_gauge(datasets.read_graph(DATA / "graphs" / "ring.g2o"))
    truth = datasets.read_graph(DATA / "graphs" / "ring_groundTruth.g2o")
    table, random = graph.tables["relative_pose"], np.random.default_rng(0)
    root = np.linalg.cholesky(np.linalg.inv(table.information))
    exact = np.asarray(truth.tables["relative_pose"].z)
    noise = np.einsum("eij,nej->nei", root, random.normal(size=(MANY, *exact.shape)))
    batch = jax.tree.map(lambda x: np.broadcast_to(x, (MANY, *np.shape(x))), graph)
    z = exact + noise
    batch = batch._replace(tables={"relative_pose": batch.tables["relative_pose"]._replace(z=z)})
    plan = graphs.plan(graph, FACTORS)

    @jax.jit
    def ours(batch):
        return jax.vmap(
            lambda graph: graphs.optimize(graph, FACTORS, plan=plan, tolerance=TOLERANCE)
        )(batch)

    batch = jax.device_put(batch)
    found = jax.block_until_ready(ours(batch))
    single = [graph._replace(tables={"relative_pose": table._replace(z=rows)}) for rows in z]
    theirs = [of_gtsam(one) for one in single]
    own, other, off = [], [], []
    for _ in range(repeats):
        own.append(processor_seconds(lambda: ours(batch))[0])
        solved = [solve() for solve in theirs]
        other.append(sum(row[0] for row in solved))
        off.append(np.max(np.asarray(found.chi2) / [row[1] for row in solved] - 1))
    rates = f"{MANY / np.median(own):.0f}, GTSAM {MANY / np.median(other):.0f}"
    print(f"ring: graphs a second and core: {rates}; statuses {np.bincount(found.status)}")
    gained = np.median(np.array(other) / own)
    return [
        Metric("ring: graphs a second and core / GTSAM's", gained, low=2.5),
        Metric("ring: greatest χ² / GTSAM's - 1", float(np.max(off)), high=1e-6),
    ]


def first_poses(graph, size: int):
    """The graph of the first poses, and of the edges between them."""
    table = graph.tables["relative_pose"]
    inside = (np.asarray(table.who) < size).all(axis=1)
    kept = type(table)(*(np.asarray(field)[inside] for field in table))
    return graph._replace(
        poses=graph.poses[:size],
        fixed_pose=graph.fixed_pose[:size],
        pose_id=graph.pose_id[:size],
        tables={"relative_pose": kept},
    )


def lanes(size: int, length: int = 20):
    """A Manhattan world of fixed connectivity: two edges a pose, none longer than two lanes.

    A robot drives lanes of so many steps of 1 m to and fro, side by side, and measures from each
    pose the one beside it in the lane before; it starts along its odometry.
    """
    lane, step = np.divmod(np.arange(size), length)
    up = lane % 2 == 0
    x, y, theta = lane, np.where(up, step, length - 1 - step), np.where(up, 1, -1) * np.pi / 2
    truth = np.stack([x, y, theta], axis=1).astype(float)
    beside = np.arange(size) - 2 * step - 1
    there = (beside >= 0) & (step > 0)
    first = np.concatenate([np.arange(size - 1), beside[there]])
    second = np.concatenate([np.arange(1, size), np.flatnonzero(there)])
    sigma = np.array([0.02, 0.02, 0.01])
    noise = sigma * np.random.default_rng(0).normal(size=(len(first), 3))
    z = numpy_poses.between(truth[first], truth[second]) + noise
    information = np.tile(np.diag(sigma**-2), (len(z), 1, 1))
    table = graphs.Table(np.stack([first, second], axis=1), z, information, np.ones(len(z), bool))
    return graphs.starts.odometry(at(truth, {"relative_pose": table}))


def growth(name: str, of_size, repeats: int, high: float = np.inf) -> Metric:
    """The exponent of a step's time by the poses of a family of graphs."""
    times = []
    for size in SIZES:
        graph = of_size(size)
        plan = graphs.plan(graph, FACTORS)
        go = jax.jit(lambda g: graphs.optimize(g, FACTORS, plan=plan, iterations=3, tolerance=0.0))
        graph = jax.device_put(graph)
        jax.block_until_ready(go(graph))
        seconds = np.median([processor_seconds(lambda: go(graph))[0] for _ in range(repeats)])
        times.append(seconds / 4)
        edges, blocks = len(graph.tables["relative_pose"].z), len(plan.block_row)
        print(f"  {size:6} poses, {edges:6} edges, {blocks:7} blocks: {1e3 * times[-1]:8.2f} ms")
    power = float(np.polyfit(np.log(SIZES), np.log(times), 1)[0])
    return Metric(f"{name}: a step as a power of the poses", power, high=high)


def measure(quick: bool = False) -> list[Metric]:
    """Nothing where the files are absent."""
    repeats = 3 if quick else 9
    if not (DATA / "graphs").is_dir():
        print(f"{DATA / 'graphs'} is not there")
        return []
    metrics = one_graph("input_M3500_g2o", 1.0, repeats)
    metrics += one_graph("city10000", 1.5, repeats)
    metrics += many_graphs(repeats)
    print("a step in lanes, of fixed connectivity:")
    metrics.append(growth("lanes", lanes, repeats, high=1.2))
    print("a step over the first poses of city10000, whose connectivity grows:")
    whole = graphs.with_gauge(datasets.read_graph(DATA / "graphs" / "city10000.g2o"))
    metrics.append(growth("city10000", partial(first_poses, whole), repeats))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return [*metrics, Metric("peak memory of the process [GB]", peak)]
