"""Speed of jaxslam: `python -m benchmarks.speed [--quick] [--long] [--write]`.

Workload `cloister` (36 landmarks, all measured every step, about 6,500 rank-2 corrections of a
75×75 covariance a run), on one core beside a hand-written C++ program, textbook NumPy, and MRPT and
dynamax where they are; scaling with landmarks, visible landmarks and steps; whole campaigns. Every
gate is a ratio measured in one run; `baseline.json` has those of the last recorded run, and a ratio
may fall behind it by its tolerance. `--write` records a new one. Leave the machine alone meanwhile.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from benchmarks.gate import Metric, report
from benchmarks.results import processor
from benchmarks.speed.campaigns import campaign, processes

BASELINE = Path(__file__).with_name("baseline.json")

# Name: (whether more is better, what issue and roofline ask for, tolerance against the baseline).
GATES = {
    "float64, limit / ours": (True, 1.0, 0.25),
    "float32, limit / ours": (True, 1.0, 0.25),
    "float64, limit / ours, one trajectory": (True, 0.25, 0.3),
    "float32, limit / ours, one trajectory": (True, 0.25, 0.3),
    "float64, NumPy / ours, a run": (True, 10, 0.5),
    "float64, MRPT / ours, a run": (True, 10, 0.5),
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


def measure(quick: bool = False, long: bool = False) -> dict[str, float]:
    """All numbers by name."""
    found: dict[str, float] = {}
    for dtype in ("float64", "float32"):
        command = [sys.executable, "-m", "benchmarks.speed.single", dtype]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        found |= json.loads(done.stdout.splitlines()[-1])
    if quick:
        return found
    rate, memory, _ = campaign(1000)
    many, memory_many, _ = campaign(100_000 if long else 5_000)
    one_core, _, alone = campaign(1000, "pinned")
    found["campaign on one core / its filter alone, time of a run"] = alone / one_core
    found["campaign, 1000 runs [runs/s]"] = rate
    found["campaign, memory of 1000 [MB]"] = memory
    found["campaign, memory of the long one [MB]"] = memory_many
    found["campaign, rate of the long one / that of 1000"] = many / rate
    if len(os.sched_getaffinity(0)) > 1:
        # One, two, one, and that three times: the machine's own speed drifts.
        ratios = []
        for _ in range(3):
            one, two, again = processes(1, 1280), processes(2, 2560), processes(1, 1280)
            ratios.append((one + again) / 2 / two)
        found["campaign, two processes on two cores / one on one"] = statistics.median(ratios)
    return found


def gated(found: dict[str, float]) -> list[Metric]:
    """The numbers with the range each must lie in."""
    kept = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    metrics = []
    for name, value in found.items():
        more, asked, tolerance = GATES.get(name, (True, None, None))
        low, high, note = float("-inf"), float("inf"), ""
        if asked is not None:
            low, high = (asked, high) if more else (low, asked)
        if tolerance is not None and name in kept:
            note = f"recorded: {kept[name]:.4g}"
            if more:
                low = max(low, kept[name] * (1 - tolerance))
            else:
                high = min(high, kept[name] * (1 + tolerance))
        metrics.append(Metric(name, value, low, high, note))
    return metrics


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed")
    parser.add_argument("--quick", action="store_true", help="one core only, no campaigns")
    parser.add_argument("--long", action="store_true", help="100,000 runs for the long campaign")
    parser.add_argument("--write", action="store_true", help="record the ratios as the baseline")
    options = parser.parse_args()
    found = measure(options.quick, options.long)
    print(processor())
    status = report(gated(found))
    if options.write:
        ratios = {
            name: round(found[name], 4) for name, gate in GATES.items() if name in found and gate[2]
        }
        BASELINE.write_text(json.dumps({"processor": processor()} | ratios, indent=2) + "\n")
    return status


if __name__ == "__main__":
    raise SystemExit(main())
