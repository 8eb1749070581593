"""A long campaign.

EKF and invariant EKF over 50 steps of `cloister`. The runs are computed in one go, and again by
several processes, each of which is interrupted (the last is not) and resumed by the next. Measured:
whether any number is NaN that is not of a run counted as not finite; whether both give the same
bits; and by how much resident memory grows a run, over what the result holds of each. A million
runs are a campaign of hours, in a folder, so that a second call of the same code goes on where the
first ended, with the records of the processes that are done.
"""

import json
import signal
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gate import Metric, child
from jaxslam.consistency._tally import SHOTS

SHARE = """
import sys
import jax
from benchmarks import soak
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
runs, stop_at, folder = int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
soak.share(runs, stop_at, folder)
"""
Record = dict[str, Any]
PROCESSES = 5
"""of the campaign that is interrupted"""
KEPT = Path(__file__).parents[1] / ".cache" / "soak"
"""where the long campaign goes on from, if it was interrupted"""
FROM_SHOTS = ("noncredibility", "inclination")
STEADY = 4096
"""runs from which memory is measured: before, programs are compiled, and snapshots kept of runs"""


def share(runs: int, stop_at: int, folder: str) -> None:
    """Go on with the campaign in a folder until so many runs are done; prints a record as JSON."""
    import os
    import time

    import jax

    # A process in the background of a shell ignores interrupts, and would never stop.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    from jaxslam import catalog, monte_carlo, scenarios, store
    from jaxslam.consistency.campaign import Interrupted

    world = scenarios.cloister(steps=50)
    filters = {name: catalog.FILTERS[name](world) for name in ("ekf", "right_invariant")}
    page = os.sysconf("SC_PAGE_SIZE")
    keep = store.open(folder, runs=runs)
    before = keep.done()
    marks: list[tuple[float, int, int]] = []

    def told(done: int, total: int) -> None:
        with open("/proc/self/statm", encoding="ascii") as file:
            resident = int(file.read().split()[1]) * page
        marks.append((time.perf_counter(), done, resident))
        if before + done >= stop_at < runs and len(marks) > 1:
            os.kill(os.getpid(), signal.SIGINT)

    record: dict[str, object] = {"digests": None}
    try:
        campaign = monte_carlo(world, filters, runs, jax.random.key(0), keep=keep, progress=told)
    except Interrupted:
        pass
    else:
        record |= {"digests": digests(campaign), **finite(campaign)}
    print(json.dumps(record | {"marks": marks, "done": keep.done()}))


def digests(campaign: object) -> dict[str, str]:
    """Of all numbers of each filter, bit by bit."""
    import hashlib

    found = {}
    for name, summary in campaign.filters.items():
        total = hashlib.sha256(repr((summary.measures, summary.counts, summary.verdict)).encode())
        for part in (summary.coverage, summary.curves, summary.per_run):
            for key in sorted(part):
                total.update(key.encode() + np.asarray(part[key]).tobytes())
        found[name] = total.hexdigest()
    return found


def finite(campaign: object) -> dict[str, int]:
    """Numbers that are NaN without being declared, runs not finite, and bytes the result holds."""
    nan = lost = held = 0
    for summary in campaign.filters.values():
        declared = np.isin(campaign.run_numbers, summary.not_finite_runs)
        lost += int(declared.sum())
        for name, values in summary.per_run.items():
            # Noncredibility is of the first runs alone.
            of = ~declared & (campaign.run_numbers < (SHOTS if name in FROM_SHOTS else np.inf))
            nan += int((np.isnan(values) & of).sum())
            held += values.nbytes
        for part in (summary.coverage, summary.curves):  # at the first step there is no NEES
            nan += sum(int((~np.isfinite(values[1:])).sum()) for values in part.values())
        nan += sum(not np.isfinite(measure).all() for measure in summary.measures.values())
    return {"nan": nan, "not finite": lost, "held": held}


def recorded(file: Path, *arguments: object) -> Record:
    """The record of a process (`share`) in a file, which is made where there is none."""
    if not file.exists():
        new = file.with_suffix(".new")
        new.write_text(json.dumps(child("-c", SHARE, *arguments)), encoding="utf-8")
        new.replace(file)
    record: Record = json.loads(file.read_text(encoding="utf-8"))
    return record


def growth(marks: list[tuple[float, int, int]]) -> tuple[float, float, float]:
    """Bytes that resident memory grows a run, runs a second, and the peak [bytes].

    The first is NaN where there are too few runs to tell.
    """
    time, done, resident = np.array(marks, float).reshape(-1, 3).T
    peak, some, late = float(np.max(resident, initial=0.0)), len(done) // 4, done > STEADY
    if len(done) < 8:
        return np.nan, np.nan, peak
    rate = (done[-1] - done[some]) / (time[-1] - time[some])
    grown = np.polyfit(done[late], resident[late], 1)[0] if late.sum() > 20 else np.nan
    return float(grown), float(rate), peak


def measure(quick: bool = False) -> list[Metric]:
    with tempfile.TemporaryDirectory() as folder:
        return campaigns(6_000 if quick else 20_000, Path(folder))


def million(quick: bool = False) -> list[Metric]:
    KEPT.mkdir(parents=True, exist_ok=True)
    return campaigns(1_000_000, KEPT)


def campaigns(runs: int, folder: Path) -> list[Metric]:
    print(f"cloister, 50 steps, EKF and invariant EKF: {runs:,} runs")
    print(f"{'':24}{'runs done':>12}{'runs/s':>8}{'peak [MB]':>11}{'growth [B/run]':>16}")
    records = {}
    for name, parts in (("one go", 1), ("interrupted", PROCESSES)):
        for number in range(1, parts + 1):
            stop_at = runs * number // parts
            file = folder / f"{name} {number}.json"
            record = recorded(file, folder / "cache", runs, stop_at, folder / name)
            grown, rate, peak = growth(record["marks"])
            label = name if parts == 1 else f"{name}, process {number}"
            cells = f"{record['done']:>12,}{rate:>8.0f}{peak / 1e6:>11.0f}{grown:>16.0f}"
            print(f"{label:24}{cells}", flush=True)
            records[name] = record | ({"growth": grown} if parts == 1 else {})
    whole, resumed = records["one go"], records["interrupted"]
    held = whole["held"] / runs
    print(f"the result holds {held:.0f} B a run; {whole['not finite']} runs are not finite")
    differing = sum(whole["digests"][k] != resumed["digests"][k] for k in whole["digests"])
    metrics = [
        Metric("filters whose bits differ, interrupted", differing, high=0),
        Metric("NaN outside runs counted as not finite", whole["nan"] + resumed["nan"], high=0),
    ]
    if np.isfinite(whole["growth"]):
        over = whole["growth"] / held
        metrics.append(Metric("memory growth over what the result holds", over, high=2.0))
    return metrics
