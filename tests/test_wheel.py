"""The sdist, and the wheel that is built from it: checked, installed by itself, and run."""

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = "build", "twine", "check_wheel_contents"
pytestmark = [
    pytest.mark.sweep,
    pytest.mark.skipif(not all(map(find_spec, TOOLS)), reason="needs the group package"),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True)
    said = done.stdout + done.stderr
    if done.returncode and "No matching distribution" in said:
        pytest.skip("pip has no index from which to build")
    assert done.returncode == 0, said
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, source


def test_twine_and_check_wheel_contents_find_nothing(built):
    beside = Path(sys.executable).parent
    for command in (
        [sys.executable, "-m", "twine", "check", "--strict", *built],
        [beside / "check-wheel-contents", built[0]],
    ):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_wheel_has_the_package_alone(built):
    with zipfile.ZipFile(built[0]) as content:
        names = [name for name in content.namelist() if not name.endswith("/")]
    assert len(names) > 100
    assert [name for name in names if not name.startswith("jaxslam") or "/tests/" in name] == []


def test_the_wheel_runs_in_an_environment_of_its_own(built, tmp_path):
    """Commands and selftest, with nothing of the checkout on the path."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "env")], check=True)
    programs = tmp_path / "env" / "bin"
    subprocess.run([programs / "python", "-m", "pip", "-q", "install", str(built[0])], check=True)
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    away = {"cwd": tmp_path, "env": env | {"XDG_CACHE_HOME": str(tmp_path / "cache")}}
    where = [programs / "python", "-c", "import jaxslam; print(jaxslam.__file__)"]
    found = subprocess.run(where, check=True, capture_output=True, text=True, **away).stdout
    assert str(ROOT) not in found
    subprocess.run([programs / "python", "-m", "jaxslam.selftest"], check=True, **away)
    for arguments in (
        "consistency --runs 8 --steps 20 --filters ekf --out campaign",
        "verify --states 4 --out verified",
    ):
        subprocess.run([programs / "jaxslam", *arguments.split()], check=True, **away)
    assert (tmp_path / "campaign" / "report.html").exists()
