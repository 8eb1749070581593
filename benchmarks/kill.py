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

    def start(self) -> subprocess.Popen[str]:
        """Begin it, or resume it where there is a manifest."""
        command = [sys.executable, "-m", "jaxslam", "consistency", "--cache", str(self.cache)]
        if (self.out / MANIFEST).exists():
            command += ["--resume", str(self.out)]
        else:
            asked = "--scenario cloister --steps 40 --filters dead_reckoning,ekf"
            command += [*asked.split(), "--runs", str(self.runs), "--block", str(BLOCK)]
            command += ["--out", str(self.out)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([*command, "--devices", "1"], **quiet)

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


def kill_once(campaign: Campaign, rng: np.random.Generator, start: float) -> bool:
    """Run it and kill it at a random time; False where it ended before.

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
    if process.returncode not in (0, -signal.SIGKILL):
        raise RuntimeError(f"the command failed: {said}")
    return process.returncode != 0


def differing(campaign: Campaign, expected: dict[str, object]) -> int:
    """The number of files that are not as they would be."""
    found = campaign.content()
    return sum(found.get(name) != expected.get(name) for name in found.keys() | expected.keys())


def on_a_full_disk(undisturbed: Campaign, folder: Path) -> list[Metric]:
    """How many files differ once a full file system has room again; none without the right to
    mount one, in memory."""
    disk = folder / "disk"
    disk.mkdir()
    campaign = Campaign(disk / "out", undisturbed.runs, undisturbed.cache)
    size = sum(path.stat().st_size for path in undisturbed.blocks()) // 2
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        print("a full disk: left out, mounting is not permitted")
        return []
    try:
        process = campaign.start()
        said = process.communicate()[1]
        left = list(campaign.out.rglob("*.tmp"))
        if process.returncode != 2 or "cannot write" not in said or left:
            raise RuntimeError(f"a full disk: status {process.returncode}, {left}, {said}")
        room = ["mount", "-o", f"remount,size={100 * size + 2**26}", str(disk)]
        subprocess.run(room, check=True)
        campaign.finish()
        what = f"files that differ, a full disk (a file system of {size:,} bytes)"
        return [Metric(what, differing(campaign, undisturbed.content()), high=0)]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


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
        killed = resumed = 0
        while killed < kills:
            campaign.forget_results()
            there = campaign.blocks()
            if killed >= 0.9 * kills:  # while results are written
                if len(there) * BLOCK < runs:
                    campaign.finish()
                    continue
            elif len(there) > 0.9 * runs / BLOCK:  # too soon: some are lost
                for path in rng.choice(there, len(there) // 2, replace=False):
                    path.unlink()
            killed += kill_once(campaign, rng, start)
            resumed += 1
        campaign.finish()
        print(f"{runs} runs in blocks of {BLOCK}; {resumed} processes, {killed} killed", flush=True)
        metrics = [
            Metric("files that differ after kills", differing(campaign, expected), high=0),
            Metric("kills", killed, low=kills),
            *on_a_full_disk(whole, folder),
        ]

        def again(what: str, count: int = 1) -> None:
            campaign.finish(count)
            wrong = differing(campaign, expected)
            metrics.append(Metric(f"files that differ, {what}", wrong, high=0))

        for path in rng.choice(campaign.blocks(), 20, replace=False):
            os.truncate(path, int(rng.integers(0, path.stat().st_size)))
        again("20 blocks truncated")
        for path in [*campaign.out.rglob("*")]:
            os.utime(path, (0, 0) if rng.random() < 0.5 else (4e9, 4e9))
        for path in rng.choice(campaign.blocks(), 20, replace=False):
            path.unlink()
        again("a clock set back, 20 blocks lost")
        for path in campaign.blocks()[::2]:
            path.unlink()
        again("two processes at once", count=2)
        return metrics
