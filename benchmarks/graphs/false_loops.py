"""Robust kernels with false loops in public graphs.

To the loops of a graph false ones are added, a share of their number: between poses at random, at
the relative pose of a true loop. A run is right if its positions are those of the optimum without
them, to 0.1 m root mean square. Rows "several" are what `jaxslam optimize --kernel NAME` does: the
lowest robust cost of its starts. GTSAM's graduated non-convexity has the same threshold and trusts
the odometry as well.

The files are looked for in the folder JAXSLAM_DATA, by default ../shared/data beside the checkout,
and left out where absent. A kernel and start that were wrong in all draws of the two shares before
are not run at a larger one, and count as wrong.
"""

from collections import defaultdict

import numpy as np

from benchmarks.gate import Metric, show
from benchmarks.graphs import peer
from benchmarks.graphs.worlds import with_false_loops
from benchmarks.real_data import DATA
from jaxslam import datasets, graphs
from jaxslam._cli.optimize import ROBUST_STARTS
from jaxslam.graphs import starts
from jaxslam.graphs._graph import LOOPS

FILES = {
    "intel": ("intel.g2o", 1),
    "M3500": ("input_M3500_g2o.g2o", 1),
    "MIT": ("MIT.g2o", 3),
    "FRH": ("FRH_P_toro.graph", 1),
}
"""The file of each graph, and the number of draws: large graphs take long."""
SHARES = (0.0, 0.01, 0.05, 0.1, 0.3)
NEAR = 0.1
"""[m]"""
LOG = {"relative_pose": graphs.RelativePoseLog()}
"""GTSAM's residual: its runs are compared with the optimum of this one, ours with that of g2o's."""
KERNELS = {name: {LOOPS: make()} for name, make in graphs.KERNELS.items()}
DEFAULT = ("truncated", "several")
GTSAM_STARTS = ("odometry", "chordal")


def measure(quick: bool = False) -> list[Metric]:
    right: dict[tuple[str, str], dict[tuple[str, float], float]] = defaultdict(dict)
    for name, (file, draws) in FILES.items():
        path = DATA / "graphs" / file
        if not path.exists() or (quick and name != "MIT"):
            continue
        clean = graphs.with_loops_apart(graphs.with_gauge(datasets.read_graph(path)))
        best, best_of_log = (optimum(clean, factors) for factors in (None, LOG))
        for share in SHARES:
            count = 1 if quick or share == 0 else draws
            merits = defaultdict(list)
            for seed in range(count):
                wanted = int(np.ceil(share * len(clean.tables[LOOPS].z)))
                mixed = with_false_loops(clean, wanted, seed)
                tried = {row for row, of in right.items() if hopeful(of, name, share)}
                for row, poses in solved(mixed, tried if share else None).items():
                    off = (poses - (best_of_log if row[0] == "GTSAM" else best))[:, :2]
                    merits[row].append(float((off**2).sum(axis=1).mean()) < NEAR**2)
            for row in merits | dict.fromkeys(right):
                right[row][name, share] = float(np.mean(merits.get(row, [False])))
            print(f"{name}, {share:.0%}: {count} draws", flush=True)
    if not right:
        return []
    total = {row: float(np.mean(list(of.values()))) for row, of in right.items()}
    rows = {
        f"{kernel}, {start}": average_by(0, of)
        | {f"{share:.0%}": value for share, value in average_by(1, of).items()}
        | {"all": total[kernel, start]}
        for (kernel, start), of in right.items()
    }
    show(f"share of runs right to {NEAR} m", rows)
    rest = max(value for row, value in total.items() if row != DEFAULT)
    return [
        Metric("right by default", total[DEFAULT], low=rest, note="the gate is the best other row"),
    ]


def average_by(part: int, of: dict[tuple[str, float], float]) -> dict:
    """Averages over the files and shares of a row, by the file (part 0) or by the share (1)."""
    kinds = dict.fromkeys(key[part] for key in of)
    return {kind: np.mean([v for key, v in of.items() if key[part] == kind]) for kind in kinds}


def optimum(clean: graphs.Graph, factors: dict | None) -> np.ndarray:
    """The poses of the lowest χ² from some starts."""
    found = [graphs.optimize(starts.STARTS[start](clean), factors) for start in ROBUST_STARTS]
    return np.asarray(min(found, key=lambda each: float(each.chi2)).graph.poses)


def hopeful(of: dict[tuple[str, float], float], name: str, share: float) -> bool:
    """Whether a row was right in some draw of the two shares before."""
    before = [of[name, each] for each in SHARES if each < share][-2:]
    return len(before) < 2 or any(before)


def solved(mixed: graphs.Graph, tried: set | None) -> dict[tuple[str, str], np.ndarray]:
    """Poses by kernel and start, of the rows to try; None: of all."""
    found, begins = {}, {start: place(mixed) for start, place in starts.STARTS.items()}
    for name, kernel in KERNELS.items():
        costs = {}
        for start, begin in begins.items():
            if tried is not None and (name, start) not in tried:
                continue
            same = [e for e in costs if np.allclose(begins[e].poses, begin.poses, atol=1e-9)]
            if same:  # in some files the given poses are the odometry
                costs[start], found[name, start] = costs[same[0]], found[name, same[0]]
                continue
            solution = graphs.optimize(begin, kernel=kernel)
            costs[start] = float(np.nan_to_num(solution.chi2, nan=np.inf))
            found[name, start] = np.asarray(solution.graph.poses)
        if several := [start for start in ROBUST_STARTS if start in costs]:
            found[name, "several"] = found[name, min(several, key=costs.__getitem__)]
    for start in GTSAM_STARTS:
        if tried is None or ("GTSAM", start) in tried:
            found["GTSAM", start], *_ = peer.graduated(begins[start])
    return found
