"""What type checkers say of a user's program."""

import subprocess
import sys
from pathlib import Path

import broken
import pytest

PROGRAM = Path(__file__).parent / "inputs" / "typed_user.py"

pytestmark = pytest.mark.sweep  # half a minute without a cache


def test_mypy_has_nothing_to_say_of_a_users_program(monkeypatch):
    api = broken.optional("mypy.api")
    monkeypatch.chdir(PROGRAM.parents[2])  # where pyproject.toml has mypy's settings
    said, problem, status = api.run(["--strict", str(PROGRAM)])
    assert (status, problem) == (0, ""), said


def test_pyright_has_nothing_to_say_of_a_users_program():
    def pyright(*arguments):
        command = [sys.executable, "-m", "pyright", *arguments]
        return subprocess.run(command, capture_output=True, text=True)

    if pyright("--version").returncode:  # at its first run it fetches itself from npm
        pytest.skip("pyright is not installed, or npm is out of reach")
    found = pyright("--pythonpath", sys.executable, str(PROGRAM))
    assert found.returncode == 0, found.stdout
