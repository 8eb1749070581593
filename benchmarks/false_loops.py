"""Robust kernels with false loops in public graphs: `python -m benchmarks.false_loops`.

To the loops of a graph false ones are added, a share of their number: between poses at random, at
the relative pose of a true loop. A run is right if its positions are those of the optimum without
them, to 0.1 m root mean square. Rows "several" are what `jaxslam optimize --kernel NAME` does: the
lowest robust cost of its starts. GTSAM's graduated non-convexity has the same threshold and trusts
the odometry as well; without GTSAM its rows are left out.

The files are looked for in the folder JAXSLAM_DATA, by default ../shared/data beside the checkout,
and left out where absent. A kernel and start that were wrong in all draws of the two shares before
are not run at a larger one, and count as wrong.
"""

from collections import defaultdict
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from benchmarks.gate import Metric, alone
from benchmarks.graphs.worlds import with_false_loops
from benchmarks.real_data import DATA
from jaxslam import graphs
from jaxslam.cli.optimize import SEVERAL
from jaxslam.graphs import starts
from jaxslam.graphs.graph import LOOPS
from jaxslam.math import stats

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
        clean = graphs.with_loops_apart(graphs.with_gauge(graphs.read(path)))
        best, best_of_log = (_optimum(clean, factors) for factors in (None, LOG))
        for share in SHARES:
            count = 1 if quick or share == 0 else draws
            merits = defaultdict(list)
            for seed in range(count):
                wanted = int(np.ceil(share * len(clean.tables[LOOPS].z)))
                mixed = with_false_loops(clean, wanted, seed)
                tried = {row for row, of in right.items() if _hopeful(of, name, share)}
                for row, poses in _solved(mixed, tried if share else None).items():
                    off = (poses - (best_of_log if row[0] == "GTSAM" else best))[:, :2]
                    merits[row].append(float((off**2).sum(axis=1).mean()) < NEAR**2)
            for row in merits | dict.fromkeys(right):
                right[row][name, share] = float(np.mean(merits.get(row, [False])))
            print(f"{name}, {share:.0%}: {count} draws", flush=True)
    if not right:
        return []
    print(f"\nshare of runs right to {NEAR} m; {_versions()}")
    names = list(dict.fromkeys(name for name, _ in right[DEFAULT]))
    shares = [f"{share:.0%}" for share in SHARES]
    print("".join(f"{head:>10}" for head in ("kernel", "start", *names, *shares, "all")))
    total = {row: np.mean(list(of.values())) for row, of in right.items()}
    for (kernel, start), of in right.items():
        cells = [np.mean([v for (file, _), v in of.items() if file == name]) for name in names]
        cells += [np.mean([v for (_, s), v in of.items() if s == share]) for share in SHARES]
        cells = "".join(f"{cell:>10.2f}" for cell in (*cells, total[kernel, start]))
        print(f"{kernel:>10}{start:>14}"[:24].rjust(20) + cells)
    rest = max(value for row, value in total.items() if row != DEFAULT)
    return [
        Metric("right by default", total[DEFAULT], low=rest, note="the gate is the best other row"),
    ]


def _optimum(clean: graphs.Graph, factors: dict | None) -> np.ndarray:
    """The poses of the lowest χ² from some starts."""
    found = [graphs.optimize(starts.STARTS[start](clean), factors) for start in SEVERAL]
    return np.asarray(min(found, key=lambda each: float(each.chi2)).graph.poses)


def _hopeful(of: dict[tuple[str, float], float], name: str, share: float) -> bool:
    """Whether a row was right in some draw of the two shares before."""
    before = [of[name, each] for each in SHARES if each < share][-2:]
    return len(before) < 2 or any(before)


def _solved(mixed: graphs.Graph, tried: set | None) -> dict[tuple[str, str], np.ndarray]:
    """Poses by kernel and start, of the rows to try."""
    found, begins = {}, {}

    def asked(*row: str) -> bool:
        return tried is None or row in tried

    for start, place in starts.STARTS.items():
        begins[start] = place(mixed)
    for name, kernel in KERNELS.items():
        costs = {}
        for start, begin in begins.items():
            if not asked(name, start):
                continue
            same = [e for e in costs if np.allclose(begins[e].poses, begin.poses, atol=1e-9)]
            if same:  # in some files the given poses are the odometry
                costs[start], found[name, start] = costs[same[0]], found[name, same[0]]
                continue
            solution = graphs.optimize(begin, kernel=kernel)
            costs[start] = float(np.nan_to_num(solution.chi2, nan=np.inf))
            found[name, start] = np.asarray(solution.graph.poses)
        if several := [start for start in SEVERAL if start in costs]:
            found[name, "several"] = found[name, min(several, key=costs.__getitem__)]
    if _gtsam_version():
        for start in GTSAM_STARTS:
            if asked("GTSAM", start):
                found["GTSAM", start] = _gtsam(begins[start])
    return found


def _gtsam_version() -> str:
    try:
        return version("gtsam")
    except PackageNotFoundError:
        return ""


def _versions() -> str:
    return f"GTSAM {_gtsam_version()}" if _gtsam_version() else "GTSAM is not installed"


def _gtsam(mixed: graphs.Graph) -> np.ndarray:
    """Poses by GTSAM's graduated non-convexity from those of a graph, its odometry trusted."""
    import gtsam

    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for name in ("relative_pose", LOOPS):
        table = mixed.tables[name]
        for (i, j), z, information in zip(table.who, table.z, table.information, strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(np.asarray(information))
            factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
    for k, pose in enumerate(np.asarray(mixed.poses)):
        start.insert(k, gtsam.Pose2(*pose))
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    fixed = int(np.asarray(mixed.fixed_pose).argmax())
    factors.add(gtsam.PriorFactorPose2(fixed, gtsam.Pose2(*mixed.poses[fixed]), held))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    trusted = len(mixed.tables["relative_pose"].z)
    parameters.setKnownInliers([*range(trusted), factors.size() - 1])
    solver = gtsam.GncLMOptimizer(factors, start, parameters)
    solver.setInlierCostThresholds(0.5 * float(stats.chi2_quantile(0.99, 3)))
    found = solver.optimize()
    poses = [found.atPose2(k) for k in range(len(mixed.poses))]
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


if __name__ == "__main__":
    raise SystemExit(alone("false_loops", measure, quick={"action": "store_true"}))
