"""Workflows and hooks call the targets and tools of the project, on Pythons that it supports."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
pytestmark = pytest.mark.skipif(not WORKFLOWS, reason="not in an sdist")


def jobs():
    """Of each job of each workflow the commands and the Pythons."""
    for path in WORKFLOWS:
        for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values():
            pythons = job.get("strategy", {}).get("matrix", {}).get("python", [])
            steps = [step.get("with", {}).get("python-version") for step in job["steps"]]
            asked = [*pythons, *(each for each in steps if each and "{{" not in each)]
            yield [step["run"] for step in job["steps"] if "run" in step], asked


def test_workflows_call_targets_of_the_makefile():
    targets = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    commands = [command for of_job, _ in jobs() for command in of_job]
    assert {command.split()[1] for command in commands} == {"test", "check", "docs"}
    assert all(command.startswith("make ") for command in commands)
    assert {"test", "check", "docs"} <= set(targets[0].split())


def test_workflows_test_the_oldest_and_the_newest_python():
    said = [line.rsplit(" ", 1)[1] for line in PROJECT["project"]["classifiers"] if ":: 3." in line]
    assert {python for _, pythons in jobs() for python in pythons} == {said[0], said[-1]}


def test_hooks_are_the_tools_of_make_check():
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    entries = [hook["entry"] for repo in config["repos"] for hook in repo["hooks"]]
    checked = re.findall(
        r"^\t\$\(BIN\)/((?:ruff|mypy)[\w ]*)", (ROOT / "Makefile").read_text(), re.M
    )
    assert [
        entry.removeprefix(".venv/bin/").removesuffix(" --force-exclude") for entry in entries
    ] == [command.strip() for command in checked]
    dev = [each for each in PROJECT["dependency-groups"]["dev"] if isinstance(each, str)]
    assert {re.match(r"[\w-]+", each)[0] for each in dev} >= {"ruff", "mypy", "pre-commit"}


def test_the_status_is_that_of_the_page_of_stability():
    page = (ROOT / "docs" / "background" / "stability.md").read_text(encoding="utf-8")
    status = re.search(r"development status is \*(\w+)\*", page)[1]
    assert any(line.endswith(f"- {status}") for line in PROJECT["project"]["classifiers"])
