"""What a type checker says of a user's program."""

from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "inputs" / "typed_user.py"


@pytest.mark.sweep  # half a minute without mypy's cache
def test_a_users_program_is_well_typed(monkeypatch):
    api = pytest.importorskip("mypy.api")
    monkeypatch.chdir(PROGRAM.parents[2])  # where pyproject.toml has mypy's settings
    said, problem, status = api.run(["--strict", str(PROGRAM)])
    assert (status, problem) == (0, ""), said
