"""Speed of jaxslam beside what a hand-written program does.

Workload `cloister` (36 landmarks, all measured every step, about 6,500 rank-2 corrections of a
75×75 covariance a run), on one core beside a hand-written C++ program and textbook NumPy; scaling
with landmarks, visible landmarks and steps; whole campaigns. Every gate is a ratio measured in one
run. A ratio may fall behind the record by its tolerance. Leave the machine alone meanwhile.
"""

import os
import statistics

from benchmarks.gate import Metric, child
from benchmarks.results import recorded
from benchmarks.speed.campaigns import campaign, processes

# Name: (whether more is better, what issue and roofline ask for, tolerance against the record).
GATES = {
    "float64, limit / ours": (True, 1.0, 0.25),
    "float32, limit / ours": (True, 1.0, 0.25),
    "float64, limit / ours, one trajectory": (True, 0.25, 0.3),
    "float32, limit / ours, one trajectory": (True, 0.25, 0.3),
    "float64, NumPy / ours, a run": (True, 10, 0.5),
    "float64, largest difference from NumPy": (False, 1e-9, None),
    "float64, exponent in landmarks, 36 to 1000, 20 visible": (False, 2.1, 0.15),
    "float64, compressed, exponent in landmarks, 36 to 1000, 20 visible": (False, 1.3, 0.5),
    "float64, ordinary / compressed, a step, 1000 landmarks": (True, 5, 0.5),
    "float64, exponent in steps, 10 to 40": (False, 1.2, 0.15),
    "float64, exponent in visible landmarks, 4 to 32 of 300": (False, 1.2, 0.25),
    "float64, 100 places for 20 measurements / 20 places": (False, 1.1, 0.15),
    "campaign on one core / its filter alone, time of a run": (False, 1.2, None),
    "campaign, memory of the long one [MB]": (False, 1500, None),
    "campaign, rate of the long one / that of 1000": (True, 0.95, None),
    "campaign, two processes on two cores / one on one": (True, 1.8, None),
}


def measure(quick: bool = False) -> list[Metric]:
    """All numbers with the range each must lie in; quick: one core alone, no campaigns."""
    found: dict[str, float] = {}
    for dtype in ("float64", "float32"):
        found |= child("-m", "benchmarks.speed.single", dtype)
    found |= {} if quick else of_campaigns()
    before, metrics = recorded("speed"), []
    for name, value in found.items():
        more, asked, tolerance = GATES.get(name, (True, float("-inf"), None))
        limit, note = asked, ""
        if tolerance is not None and name in before:
            note = f"recorded: {before[name]:.4g}"
            reached = before[name] * (1 - tolerance if more else 1 + tolerance)
            limit = max(asked, reached) if more else min(asked, reached)
        metrics.append(Metric(name, value, **{"low" if more else "high": limit}, note=note))
    return metrics


def of_campaigns() -> dict[str, float]:
    rate, memory, _ = campaign(1000)
    many, memory_many, _ = campaign(5000)
    one_core, _, alone = campaign(1000, "pinned")
    found = {
        "campaign on one core / its filter alone, time of a run": alone / one_core,
        "campaign, 1000 runs [runs/s]": rate,
        "campaign, memory of 1000 [MB]": memory,
        "campaign, memory of the long one [MB]": memory_many,
        "campaign, rate of the long one / that of 1000": many / rate,
    }
    if len(os.sched_getaffinity(0)) > 1:
        # One, two, one, and that three times: the machine's own speed drifts.
        ratios = []
        for _ in range(3):
            one, two, again = processes(1, 1280), processes(2, 2560), processes(1, 1280)
            ratios.append((one + again) / 2 / two)
        found["campaign, two processes on two cores / one on one"] = statistics.median(ratios)
    return found
