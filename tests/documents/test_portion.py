"""What CI leaves out of a commit is run for another commit."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / ".ci" / "portion.py"
pytestmark = pytest.mark.skipif(not FILE.is_file(), reason="not in an sdist")


@pytest.fixture
def portion():
    spec = importlib.util.spec_from_file_location("portion", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_three_commits_in_a_row_run_everything(portion, monkeypatch):
    names = [f"tests/test_{i}.py::test" for i in range(300)]
    runs = []
    for number in ("100", "101", "102"):
        portion.third.cache_clear()
        monkeypatch.setattr(portion, "git", lambda *arguments, n=number: n)
        runs.append({name for name in names if portion.chosen(name, touched=False)})
    assert set.union(*runs) == set(names)
    assert sum(map(len, runs)) == len(names)
    assert all(len(run) > 60 for run in runs)


def test_without_a_repository_everything_is_run(portion, monkeypatch):
    monkeypatch.setattr(portion, "git", lambda *arguments: "")
    assert portion.chosen("tests/test_a.py::test", touched=False)
    assert portion.told() == "sweeps and pages: all"


def test_what_changed_in_the_last_day_is_always_run(portion, monkeypatch):
    before = {
        "jaxslam/math/se2.py": 'def f():\n    "Old."\n    return 1\n',
        "docs/gallery.md": "Old.\n",
    }
    after = {
        "jaxslam/math/se2.py": 'def f():\n    "New."  # words alone\n    return 1\n',
        "docs/gallery.md": "New.\n\n```{code-cell}\nx = 1\n```\n",
        "jaxslam/filters/_ekf/scan.py": "x = 1\n",
        "jaxslam/calibration/_delay.py": "x = 1\n",
        "jaxslam/_driver.py": "x = 1\n",
    }

    def git(command, *arguments):
        if command == "show":
            revision, _, name = arguments[0].partition(":")
            return {"base": before, "HEAD": after}[revision].get(name, "")
        return {"log": "1000000", "rev-list": "base", "diff": "\n".join(after)}[command]

    monkeypatch.setattr(portion, "git", git)
    assert portion.changed() == set(after) - {"jaxslam/math/se2.py"}
    assert portion.rooms() == {"tests/filters/ekf", "tests/consistency", "tests"}
    assert portion.pages() == {"docs/gallery.md"}
    assert portion.left_out([portion.ROOT / "docs/gallery.md"]) == []


def test_after_a_day_that_changed_more_than_half_the_third_is_run_alone(portion):
    every = {f"tests/{i}" for i in range(4)}
    assert portion._if_few({"tests/0", "tests/1", "elsewhere"}, every) == {"tests/0", "tests/1"}
    assert portion._if_few({"tests/0", "tests/1", "tests/2"}, every) == set()
