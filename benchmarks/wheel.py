"""The wheel in a clean environment away from the checkout, `python -m benchmarks.wheel`.

Builds it, installs it with its dependencies from pip's index into a new environment, and runs both
commands there with an empty PYTHONPATH. Left out where pip has no index.
"""

import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

from benchmarks.gate import Metric, alone

ROOT = Path(__file__).parents[1]
COMMANDS = {
    "jaxslam consistency": "consistency --runs 8 --steps 20 --filters ekf --out campaign",
    "jaxslam verify": "verify --states 4 --out verified",
}


def measure() -> list[Metric]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        build = [*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
        built = subprocess.run(build, capture_output=True, text=True)
        if built.returncode and "No matching distribution" in built.stderr:
            print("left out: pip has no index from which to build")
            return []
        if built.returncode:
            raise RuntimeError(built.stderr)
        (wheel,) = folder.glob("*.whl")
        with zipfile.ZipFile(wheel) as content:
            names = [n for n in content.namelist() if not n.endswith("/")]
        print(f"{wheel.name}: {wheel.stat().st_size:,} bytes, {len(names)} files")
        strange = [n for n in names if not n.startswith("jaxslam") or "/tests/" in n]
        subprocess.run([sys.executable, "-m", "venv", str(folder / "env")], check=True)
        there = folder / "env" / ("Scripts" if os.name == "nt" else "bin")
        subprocess.run(
            [there / "python", "-m", "pip", "--quiet", "install", str(wheel)], check=True
        )
        env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        away = {"cwd": folder, "env": env | {"XDG_CACHE_HOME": str(folder / "cache")}}
        where = [there / "python", "-c", "import jaxslam; print(jaxslam.__file__)"]
        found = subprocess.run(where, check=True, capture_output=True, text=True, **away).stdout
        metrics = [
            Metric("files of the wheel outside the package", len(strange), high=0),
            Metric("imported from the checkout", str(ROOT) in found, high=0),
        ]
        for command, arguments in COMMANDS.items():
            began = time.perf_counter()
            status = subprocess.run([there / "jaxslam", *arguments.split()], **away).returncode
            print(f"{command}: {time.perf_counter() - began:.0f} s", flush=True)
            metrics.append(Metric(f"{command} of the wheel: status", status, high=0))
        written = (folder / "campaign" / "report.html").exists()
        return [*metrics, Metric("report.html is written", written, low=1)]


if __name__ == "__main__":
    raise SystemExit(alone("wheel", measure))
