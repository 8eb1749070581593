"""Public logs by `laser_slam.solve`, beside raw odometry and laser odometry."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.gate import FIGURES, Metric, show
from benchmarks.real_data import DATA
from jaxslam import datasets, laser_slam, metrics
from jaxslam.laser.laser_slam import LoopOutcome
from jaxslam.math.stats import chi2_quantile
from jaxslam.results import plot

METRES = (1.0, 2.0, 5.0, 10.0)
"""Lengths of path of the relations to the file's poses, of each as many as there are scans."""
DRAWN = ("intel", "csail", "fhw", "orebro")
TOLERANCE = 1e-4
"""[s] within which the stamp of a hand-checked relation is that of a scan."""
LONG = 60.0
"""[s] between the ends of a relation that shows whether loops are closed."""


class PublicLog(NamedTuple):
    """A log, its relations that were checked by hand, and what is asked of it."""

    read: Callable[[], datasets.LaserLog]
    relations: str | None = None
    scored: bool = True
    """whether the poses in the file are a reference"""
    high: float = np.inf
    """of the mean error of the relations that were checked by hand, else to the file's poses [m]"""
    seconds: float = np.inf


def carmen_log(name: str, odometry: str | None = None) -> Callable[[], datasets.LaserLog]:
    def read() -> datasets.LaserLog:
        raw = None if odometry is None else DATA / "relations" / odometry
        return datasets.carmen(DATA / "carmen" / f"{name}-corrected.log", odometry=raw)

    return read


def csail() -> datasets.LaserLog:
    return datasets.carmen(
        DATA / "laser_graphs" / "mit-cscail.log",
        odometry=DATA / "relations" / "csail_raw_odometry.txt",
    )


LOGS = {  # the first compiles what the others run
    "freiburg-101": PublicLog(carmen_log("freiburg-101"), high=0.042),
    "intel": PublicLog(carmen_log("intel"), high=0.05, seconds=20.0),
    "intel, raw log's stamps": PublicLog(
        carmen_log("intel", "intel_raw_odometry.txt"), "intel.relations", high=0.0229
    ),
    "csail": PublicLog(csail, "mit-csail.relations", scored=False, high=0.0319),
    "edmonton": PublicLog(carmen_log("edmonton"), high=0.059),
    "fhw": PublicLog(carmen_log("fhw")),
    "orebro": PublicLog(carmen_log("orebro")),
}


def measure(quick: bool = False) -> list[Metric]:
    found: list[Metric] = []
    for name in ("intel",) if quick else LOGS:
        try:
            log = LOGS[name].read()
        except ValueError as problem:
            print(f"{name}: left out: {problem}")
            continue
        began, busy = time.perf_counter(), time.process_time()
        solved = laser_slam.solve(log)
        seconds, busy = time.perf_counter() - began, time.process_time() - busy
        tally = ", ".join(
            f"{int((solved.loops.outcome == o).sum())} {o.name.lower()}" for o in LoopOutcome
        )
        print(f"\n{name}: {len(log.time)} scans, {len(solved.keyframe)} keyframes; loops: {tally}")
        stages = ", ".join(f"{stage} {value:.1f}" for stage, value in solved.seconds.items())
        print(f"seconds: {stages}", flush=True)
        ratio = solved.chi2 / max(solved.dof, 1)
        off = f"residuals {ratio**0.5:.1f} times the σ of the edges"
        found += [
            Metric(f"{name}, chi2 / degrees of freedom", ratio, 0.5, 2.0, off),
            Metric(f"{name}, seconds", seconds, high=LOGS[name].seconds),
            Metric(f"{name}, processor seconds, all cores", busy),
        ]
        if LOGS[name].relations is not None:
            found += by_relations(name, log, solved)
        if LOGS[name].scored:
            found += by_file(name, log, solved)
        if name in DRAWN and not quick:
            plot.maps_before_after(solved).savefig(FIGURES / f"laser_slam_{name}.png")
    return found


def by_file(name: str, log: datasets.LaserLog, solved: laser_slam.Solved) -> list[Metric]:
    """Errors to the poses in the file, and loops that agree with them."""
    means, rows = {}, {}
    for what, path in paths(solved).items():
        errors = [metrics.rpe(log.corrected, path, metres=m) for m in METRES]
        every = np.concatenate([each.translation for each in errors])
        turn = np.degrees(np.concatenate([each.rotation for each in errors]).mean())
        means[what] = every.mean()
        rows[what] = {"relation error [m]": f"{every.mean():.4f}", "heading [deg]": f"{turn:.2f}"}
        for m, of_length in zip(METRES, errors, strict=True):
            rows[what][f"of {m:g} m"] = f"{of_length.translation.mean():.3f}"
    show(f"{name}, errors to the poses in the file", rows)
    ate = metrics.ate(log.corrected, solved.poses).translation
    score = laser_slam.closure_score(solved, log.corrected)
    high = LOGS[name].high if LOGS[name].relations is None else np.inf
    return [
        Metric(f"{name}, relation error to 10 m [m]", means["laser SLAM"], high=high),
        Metric(f"{name}, of laser odometry [m]", means["laser odometry"]),
        Metric(f"{name}, of raw odometry [m]", means["raw odometry"]),
        Metric(f"{name}, ATE [m]", np.sqrt((ate**2).mean())),
        Metric(f"{name}, precision of loops", score.precision, low=0.98, note=f"of {score.kept}"),
        Metric(f"{name}, recall of revisits", score.recall, note=f"of {score.revisits}"),
    ]


def by_relations(name: str, log: datasets.LaserLog, solved: laser_slam.Solved) -> list[Metric]:
    """Errors of relations that were checked by hand, as their benchmark has them."""
    read = datasets.relation_file(DATA / "relations" / str(LOGS[name].relations))
    of, lost = metrics.relations_at_stamps(
        log.time, read.first, read.second, read.pose, tolerance=TOLERANCE
    )
    far = np.abs(log.time[of.first] - log.time[of.second]) > LONG
    inside = laser_slam.relation_nees(solved, *of) <= chi2_quantile(0.95, 3)
    found, table = [], {}
    for what, path in paths(solved).items():
        errors = metrics.relation_errors(of, path)
        for which, rows in (("all", np.ones(len(far), bool)), (f"over {LONG:g} s", far)):
            t, r = errors.translation[rows], np.degrees(errors.rotation[rows])
            columns = {"translation [m]": t, "squared [m²]": t**2, "rotation [deg]": r}
            table[f"{what}, {which}"] = {
                head: f"{x.mean():.4f} ± {x.std():.4f}" for head, x in columns.items()
            }
            if what != "laser SLAM":
                continue
            of_name, high = f"{name}, {which} relations", LOGS[name].high
            high, note = high if which == "all" else np.inf, f"± {t.std():.4f}, of {len(t)}"
            apart = "errors of the relations themselves are not in it"
            found += [
                Metric(f"{of_name} [m]", t.mean(), high=high, note=note),
                Metric(f"{of_name} [deg]", r.mean(), note=f"± {r.std():.3f}"),
                Metric(f"{of_name} in the 95 % ellipse", inside[rows].mean(), note=apart),
            ]
    count = len(of.pose)
    title = f"{name}: {count} relations of {count + lost} join, {far.sum()} over {LONG:g} s"
    show(title, table)
    return found


def paths(solved: laser_slam.Solved) -> dict[str, np.ndarray]:
    return {
        "raw odometry": solved.raw,
        "laser odometry": solved.odometry,
        "laser SLAM": solved.poses,
    }
