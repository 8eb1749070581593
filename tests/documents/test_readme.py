"""The README: its Python runs as it stands, it is short, and what it names is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_readme_is_a_page():
    assert len(README.encode()) <= 8192


@pytest.mark.sweep
@pytest.mark.filterwarnings("default")
def test_the_readme_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 1
    code = blocks[0].replace("circle()", "circle(steps=12)").replace("runs=100", "runs=3")
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "ekf" in printed
    assert "invariant" in printed


def test_the_example_of_the_readme_is_caught():
    """The lines of `jaxslam verify` that it shows are those that the command prints, up to a …"""
    shown = README.split("$ jaxslam verify")[1].split("```")[0].splitlines()
    command = [sys.executable, "-m", "jaxslam", "verify", shown[0].strip()]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    for line in shown[1:]:
        assert line.strip().removesuffix("…") in done.stdout


def test_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
