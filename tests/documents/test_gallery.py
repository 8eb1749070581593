"""The gallery shows everything.

The scripts are run by `make docs` and `python -m benchmarks.gallery`; here one of them is, and the
names in the others are looked up.
"""

import ast
import re
import runpy
from pathlib import Path

import pytest

import jaxslam
from benchmarks import gallery
from jaxslam import datasets, plot
from jaxslam.catalog import KINDS
from jaxslam.simulation.scenarios import SCENARIOS

ROOT = Path(__file__).parents[2]
SCRIPTS = gallery.scripts()

IN_KINDS = {"ekf", "information", "particles", "known"}
"""Folders of filters whose members are in the kinds of the catalog."""


def families():
    """The kinds of the catalog, and the folders of filters that have none there."""
    folders = {
        path.parent.name.removeprefix("_")
        for path in (ROOT / "jaxslam" / "filters").glob("*/__init__.py")
    }
    return {kind.lower().replace(" ", "_") for kind in KINDS} | (folders - IN_KINDS)


def test_every_scenario_family_and_data_set_has_a_script():
    kinds = {kind: set() for kind in gallery.PARTS}
    for name, path in SCRIPTS.items():
        kinds[path.parent.name].add(name)
    assert kinds["scenarios"] == set(SCENARIOS)
    assert kinds["filters"] == families()
    assert kinds["methods"]
    others = {"carmen", "carmen_freiburg", "lost_in_the_woods", "mrclam_team"}
    assert kinds["datasets"] == set(datasets.READERS) | others


def test_the_page_shows_every_script_with_its_picture():
    """In the order of the folders, the docstring of a script as the picture's description."""
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    included = re.findall(r"\{literalinclude\} \.\./examples/gallery/\w+/(\w+)\.py", text)
    shown = re.findall(r"!\[(.*)\]\(\.\./benchmarks/figures/gallery/(\w+)\.png\)", text)
    said = [ast.get_docstring(ast.parse(path.read_text())) for path in SCRIPTS.values()]
    assert shown == list(zip(said, SCRIPTS, strict=True))
    assert included == list(SCRIPTS)
    given = re.findall(r"argument=data/(\w+) -->\n.*/(\w+)\.py", text)
    assert [(gallery.FOLDERS[name], name) for name in SCRIPTS if name in gallery.FOLDERS] == given


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_short_and_names_what_there_is(name):
    tree = ast.parse(SCRIPTS[name].read_text(encoding="utf-8"))
    said = ast.get_docstring(tree)
    assert said and "\n" not in said
    body = [node for node in tree.body[1:] if not isinstance(node, ast.Import | ast.ImportFrom)]
    assert len(body) <= 14
    assert (gallery.PICTURES / f"{name}.png").stat().st_size < 60_000
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            path = ast.unparse(node)
            if re.fullmatch(r"jaxslam(\.\w+)+", path):
                at = jaxslam
                for part in path.split(".")[1:]:
                    at = getattr(at, part)


def test_a_script_makes_a_figure_by_itself():
    assert isinstance(runpy.run_path(str(SCRIPTS["table"]))["figure"], plot.Figure)
