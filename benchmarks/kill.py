"""Campaigns that are killed.

`jaxslam consistency` with small blocks is killed by `kill -9` at random times, and each time
resumed. Then the same on a full disk, with truncated blocks, with a clock that was set back, and by
two processes at once. The files of results and every block must have the bytes of an undisturbed
campaign. A part of the kills comes while the process starts, a part while results are written.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.gate import Metric

BLOCK = 2
MANIFEST, RESULT, CURVES = "blocks/manifest.json", "consistency.json", "consistency.csv"
TIMED = ("seconds", "compile_seconds", "step_seconds", "command")
"""entries of the results that differ from one command to the next"""


class Campaign:
    """A campaign in a folder, by the command; `cache` holds its compiled programs."""

    def __init__(self, out: Path, runs: int, cache: Path) -> None:
        self.out, self.runs, self.cache = out, runs, cache

    def start(self, **options: object) -> subprocess.Popen[str]:
        """Begin it, or resume it where there is a manifest."""
        command = [sys.executable, "-m", "jaxslam", "consistency", "--cache", str(self.cache)]
        if (self.out / MANIFEST).exists():
            command += ["--resume", str(self.out)]
        else:
            asked = "--scenario cloister --steps 40 --filters dead_reckoning,ekf"
            command += [*asked.split(), "--runs", str(self.runs), "--block", str(BLOCK)]
            command += ["--out", str(self.out)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([*command, "--devices", "1"], **quiet | options)

    def finish(self, count: int = 1) -> float:
        """Resume it to its end, in so many processes at once; seconds."""
        began = time.perf_counter()
        processes = [self.start() for _ in range(count)]
        for process in processes:
            said = process.communicate()[1]
            if process.returncode:
                raise RuntimeError(f"the command failed: {said}")
        return time.perf_counter() - began

    def blocks(self) -> list[Path]:
        return sorted((self.out / "blocks").glob("block-*.npz"))

    def content(self) -> dict[str, object]:
        """Results without what was timed, and the bytes of every block."""
        found = json.loads((self.out / RESULT).read_text())
        results = {name: value for name, value in found.items() if name not in TIMED}
        files = {path.name: path.read_bytes() for path in [self.out / CURVES, *self.blocks()]}
        return {RESULT: results} | files

    def forget_results(self) -> None:
        """Delete the files of results, so that the next command writes them again."""
        for name in (RESULT, CURVES):
            (self.out / name).unlink(missing_ok=True)


def stage(campaign: Campaign, before: int) -> str:
    """What a process was doing, by the files it left."""
    if not (campaign.out / MANIFEST).exists():
        return "no manifest"
    if len(campaign.blocks()) * BLOCK >= campaign.runs:
        return "all blocks"
    return "blocks" if len(campaign.blocks()) > before else "start"


def kill_once(campaign: Campaign, rng: np.random.Generator, start: float) -> str | None:
    """Run it and kill it at a random time; the stage, or None where it ended before.

    start: about how many seconds it takes to start, and to write results.
    """
    process, before = campaign.start(), len(campaign.blocks())
    if before * BLOCK >= campaign.runs or rng.random() < 0.3:
        wait = rng.uniform(0, 1.5 * start)
    else:
        more = before + rng.integers(1, 8)
        while process.poll() is None and len(campaign.blocks()) < more:
            time.sleep(0.001)
        wait = rng.uniform(0, 0.02)
    try:
        process.wait(wait)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    said = process.communicate()[1]
    if process.returncode == -signal.SIGKILL:
        return stage(campaign, before)
    if process.returncode:
        raise RuntimeError(f"the command failed: {said}")
    return None


def differing(campaign: Campaign, expected: dict[str, object]) -> int:
    """The number of files that are not as they would be."""
    found = campaign.content()
    return sum(found.get(name) != expected.get(name) for name in found.keys() | expected.keys())


def on_a_full_disk(undisturbed: Campaign, folder: Path) -> tuple[str, int]:
    """How the disk was made full, and how many files differ once it has room again.

    A file system in memory where this user may mount one, else a limit on the size of files.
    """
    disk = folder / "disk"
    disk.mkdir()
    campaign = Campaign(disk / "out", undisturbed.runs, undisturbed.cache)
    size = sum(path.stat().st_size for path in undisturbed.blocks()) // 2
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
    with ExitStack() as after:
        mounted = os.name == "posix" and not subprocess.run(mount, capture_output=True).returncode
        limit = {}
        if mounted:
            after.callback(subprocess.run, ["umount", str(disk)], check=True)
        else:
            import resource

            limits = resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY)
            limit = {"preexec_fn": lambda: resource.setrlimit(*limits)}
        process = campaign.start(**limit)
        said = process.communicate()[1]
        left = list(campaign.out.rglob("*.tmp"))
        if process.returncode != 2 or "cannot write" not in said or left:
            raise RuntimeError(f"a full disk: status {process.returncode}, {left}, {said}")
        if mounted:
            room = ["mount", "-o", f"remount,size={100 * size + 2**26}", str(disk)]
            subprocess.run(room, check=True)
        campaign.finish()
        how = f"a file system of {size:,} bytes" if mounted else "files of at most 2,000 bytes"
        return how, differing(campaign, undisturbed.content())


def measure(quick: bool = False) -> list[Metric]:
    kills, rng = 10 if quick else 100, np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        runs = BLOCK * (60 + 4 * kills)
        whole = Campaign(folder / "whole", runs, folder / "cache")
        whole.finish()
        expected = whole.content()
        whole.forget_results()
        start = whole.finish()  # and writes
        campaign = Campaign(folder / "killed", runs, whole.cache)
        stages: Counter[str] = Counter()
        resumed = 0
        while stages.total() < kills:
            campaign.forget_results()
            there = campaign.blocks()
            if stages.total() >= 0.9 * kills:  # while results are written
                if len(there) * BLOCK < runs:
                    campaign.finish()
                    continue
            elif len(there) > 0.9 * runs / BLOCK:  # too soon: some are lost
                for path in rng.choice(there, len(there) // 2, replace=False):
                    path.unlink()
            at = kill_once(campaign, rng, start)
            resumed += 1
            if at is not None:
                stages[at] += 1
                print(f"\r{stages.total()} of {kills} kills", end="", file=sys.stderr, flush=True)
        campaign.finish()
        print(f"\n{runs} runs in blocks of {BLOCK}; {resumed} processes, of which were killed")
        for what, count in stages.most_common():
            print(f"  {count:4} with {what}")
        metrics = [
            Metric("files that differ after kills", differing(campaign, expected), high=0),
            Metric("kills", stages.total(), low=kills),
        ]

        def also(what: str, count: int) -> None:
            metrics.append(Metric(f"files that differ, {what}", count, high=0))

        how, count = on_a_full_disk(whole, folder)
        also(f"a full disk ({how})", count)
        for path in rng.choice(campaign.blocks(), 20, replace=False):
            os.truncate(path, int(rng.integers(0, path.stat().st_size)))
        campaign.finish()
        also("20 blocks truncated", differing(campaign, expected))
        for path in [*campaign.out.rglob("*")]:
            os.utime(path, (0, 0) if rng.random() < 0.5 else (4e9, 4e9))
        for path in rng.choice(campaign.blocks(), 20, replace=False):
            path.unlink()
        campaign.finish()
        also("a clock set back, 20 blocks lost", differing(campaign, expected))
        for path in campaign.blocks()[::2]:
            path.unlink()
        campaign.finish(count=2)
        also("two processes at once", differing(campaign, expected))
        return metrics
