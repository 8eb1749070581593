"""The commands as a user runs them, the wheel in a clean environment, and the fuzzed tests."""

import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

from benchmarks.gate import Metric

ROOT = Path(__file__).parents[1]
OF_WHEEL = {
    "jaxslam consistency": "consistency --runs 8 --steps 20 --filters ekf --out campaign",
    "jaxslam verify": "verify --states 4 --out verified",
}
FUZZED = {
    "logs": ("tests/conformance/test_fuzzed_logs.py", 20),
    "files, bytes changed": ("tests/datasets/test_mutated.py", 50),
    "files of a grammar": ("tests/datasets/test_grammars.py", 50),
    "ROS bags": ("tests/datasets/test_fuzzed_bags.py", 50),
    "campaigns": ("tests/results/test_fuzzed_store.py", 50),
}
"""File of tests, and how many times as many examples as in the suite; 200 there are of a reader."""


def measure(quick: bool = False) -> list[Metric]:
    """Seconds, with imports and compilation."""
    metrics = []
    for name, what in (("consistency", "100 runs"), ("verify", "every model")):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            subprocess.run([sys.executable, "-m", "jaxslam", name, "--out", folder], check=True)
        seconds = time.perf_counter() - began
        metrics.append(Metric(f"jaxslam {name}, {what} [s]", seconds, high=60.0))
    return metrics


def wheel(quick: bool = False) -> list[Metric]:
    """Builds the sdist, and the wheel from it; twine and check-wheel-contents check them.
    Installs the wheel with its dependencies from pip's index into a new environment, and runs the
    commands and the selftest there with an empty PYTHONPATH. Left out where pip has no index."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
        built = subprocess.run(build, capture_output=True, text=True)
        if built.returncode and "No matching distribution" in built.stdout + built.stderr:
            print("left out: pip has no index from which to build")
            return []
        if built.returncode:
            raise RuntimeError(built.stdout + built.stderr)
        (file,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
        with zipfile.ZipFile(file) as content:
            names = [n for n in content.namelist() if not n.endswith("/")]
        print(f"{file.name}: {file.stat().st_size:,} bytes, {len(names)} files")
        print(f"{source.name}: {source.stat().st_size:,} bytes")
        strange = [n for n in names if not n.startswith("jaxslam") or "/tests/" in n]
        beside = Path(sys.executable).parent
        checked = {
            "twine check": [sys.executable, "-m", "twine", "check", "--strict", file, source],
            "check-wheel-contents": [beside / "check-wheel-contents", file],
        }
        metrics = [
            Metric(f"{what}: status", subprocess.run(command, cwd=ROOT).returncode, high=0)
            for what, command in checked.items()
        ]
        subprocess.run([sys.executable, "-m", "venv", str(folder / "env")], check=True)
        programs = folder / "env" / "bin"
        subprocess.run([programs / "python", "-m", "pip", "-q", "install", str(file)], check=True)
        env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        away = {"cwd": folder, "env": env | {"XDG_CACHE_HOME": str(folder / "cache")}}
        where = [programs / "python", "-c", "import jaxslam; print(jaxslam.__file__)"]
        found = subprocess.run(where, check=True, capture_output=True, text=True, **away).stdout
        metrics += [
            Metric("files of the wheel outside the package", len(strange), high=0),
            Metric("imported from the checkout", str(ROOT) in found, high=0),
        ]
        began = time.perf_counter()
        tested = subprocess.run([programs / "python", "-m", "jaxslam.selftest"], **away)
        metrics += [
            Metric("selftest of the wheel: status", tested.returncode, high=0),
            Metric("selftest of the wheel [s]", time.perf_counter() - began, high=60.0),
        ]
        for command, arguments in OF_WHEEL.items():
            status = subprocess.run([programs / "jaxslam", *arguments.split()], **away).returncode
            metrics.append(Metric(f"{command} of the wheel: status", status, high=0))
        written = (folder / "campaign" / "report.html").exists()
        return [*metrics, Metric("report.html is written", written, low=1)]


def fuzz(quick: bool = False) -> list[Metric]:
    """The suite's fuzzed tests with more examples, 10,000 files for each reader: logs of any
    numbers through every filter of the catalogue; files with bytes changed and bits flipped, and
    files of a grammar with odd words, which a reader answers or refuses in one line of ValueError,
    within 10 s and ten times the memory of the file."""
    metrics = []
    for what, (path, times) in FUZZED.items():
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", path]
        env = os.environ | {"JAXSLAM_FUZZ": str(2 if quick else times)}
        done = subprocess.run(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, text=True)
        said = done.stdout.splitlines()
        print("\n".join(said if done.returncode else said[-1:]), flush=True)
        found = re.search(r"(\d+) passed", done.stdout)
        metrics += [
            Metric(f"fuzzed {what}: status of the tests", done.returncode, high=0),
            Metric(f"fuzzed {what}: tests passed", int(found[1]) if found else 0, low=1),
        ]
    return metrics
