"""The house rules, read from the source: who may import whom, and that public names say what they are.

Imports go downward only (the figure in CONTRIBUTING.md); within a floor they may go sideways but not round.
"""

import ast
import importlib
from pathlib import Path

import pytest

import jaxslam

PACKAGE = Path(jaxslam.__file__).parent

FLOORS = [
    "math",
    "core",
    "motion sensors charts linearize association resampling life",
    "run filters graphs laser simulation",
    "consistency verify catalog calibration",
    "datasets results cli __main__",
]
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names.split()}
ROOF = len(FLOORS)  # jaxslam/__init__.py sees everything, and nothing sees it

# Methods of these modules may import what is above, when they are called: `print(campaign)` and
# `campaign.save(folder)` are where a user looks for them, and results are drawn and written above;
# so are `graphs.read(path)` and `grids.read_map(path)`, and files are read above.
WITHIN_CALLS = {
    "graphs.graph": "datasets",
    "laser.grids.grid": "datasets",
    "consistency.campaign.record": "results",
}

# What only these modules may touch.
KEPT = {
    "matplotlib": {"results.plot", "datasets.ros_map"},
    "argparse": {"cli"},
    "jax.config": {"cli", "__main__", "verify"},  # verify: float64 within a block, then as before
}


def read(folder):
    """{dotted name: source} of every module of a package folder; the package itself is ''."""
    sources = {}
    for path in sorted(Path(folder).rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        sources[".".join(parts)] = path.read_text(encoding="utf-8")
    return sources


def is_package(name, sources):
    return name == "" or any(other.startswith(f"{name}.") for other in sources)


def imported(name, tree, sources):
    """(modules of the package, outside names) that a module imports, wherever in it."""
    inside, outside = set(), set()

    def add(dotted):
        if dotted != "jaxslam" and not dotted.startswith("jaxslam."):
            outside.add(dotted)
            return
        parts = dotted.split(".")[1:]
        while parts and ".".join(parts) not in sources:
            parts.pop()  # a name inside the module
        target = ".".join(parts)
        inside.add(target)
        # Python runs the packages above it too, unless we are in them already.
        for depth in range(1, len(parts)):
            package = ".".join(parts[:depth])
            if not f"{name}.".startswith(f"{package}."):
                inside.add(package)

    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                add(alias.name)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = ["jaxslam", *(name.split(".") if name else [])]
                up = node.level - is_package(name, sources)
                base = ".".join([*here[: len(here) - up], *([base] if base else [])])
            for alias in node.names:
                add(f"{base}.{alias.name}")
    return inside - {name}, outside


class AtImport(ast.NodeTransformer):
    """A module without the bodies of its functions: what is executed when it is imported."""

    def visit_FunctionDef(self, node):
        return ast.copy_location(ast.Pass(), node)


def touches(tree, outside):
    """Which of the kept things a module touches."""
    found = {kept for kept in KEPT for o in outside if f"{o}.".startswith(f"{kept}.")}
    docstrings = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr in ("config", "enable_x64"):
            owner = ast.unparse(node.value)
            if owner == "jax" or owner.startswith("jax."):
                found.add("jax.config")
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in docstrings
            and "JAX_ENABLE_X64" in node.value
        ):
            found.add("jax.config")
    return found


def cycle(edges):
    """A path that returns to its start, or None."""
    done, path = set(), []

    def visit(node):
        if node in path:
            return [*path[path.index(node) :], node]
        if node in done:
            return None
        path.append(node)
        for after in sorted(edges.get(node, ())):
            if found := visit(after):
                return found
        done.add(path.pop())
        return None

    for node in sorted(edges):
        if found := visit(node):
            return found
    return None


def violations(sources):
    """Every breach of the rules, as a sentence."""
    out, edges = [], {}
    for name, source in sources.items():
        unit = name.split(".")[0]
        if name and unit not in FLOOR:
            out.append(f"{name}: has no floor")
            continue
        tree = ast.parse(source)
        inside, outside = imported(name, tree, sources)
        if name in WITHIN_CALLS:
            above = {t for t in inside if t.split(".")[0] == WITHIN_CALLS[name]}
            inside -= above - imported(name, AtImport().visit(ast.parse(source)), sources)[0]
        edges[name] = inside
        for target in sorted(inside):
            floor = FLOOR.get(target.split(".")[0], ROOF)
            if floor > (FLOOR[unit] if name else ROOF):
                out.append(f"{name} imports {target or 'the package itself'}, a floor above")
        for kept in sorted(touches(tree, outside)):
            if not any(f"{name}.".startswith(f"{owner}.") for owner in KEPT[kept]):
                out.append(f"{name or '__init__'}: touches {kept}")
    if found := cycle(edges):
        out.append(f"imports go round: {' -> '.join(found)}")
    return out


def undocumented(sources):
    """Modules, and the public functions and classes they define, that have no docstring."""
    out = []
    for name, source in sources.items():
        tree = ast.parse(source)
        if source.strip() and not ast.get_docstring(tree):
            out.append(f"{name or '__init__'}: module without a docstring")
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                if not node.name.startswith("_") and not ast.get_docstring(node):
                    out.append(f"{name}.{node.name}: no docstring")
    return out


# --- the package --------------------------------------------------------------------------------


def test_imports_go_downward_only():
    assert violations(read(PACKAGE)) == []


def test_public_names_have_docstrings():
    assert undocumented(read(PACKAGE)) == []


def test_all_names_exist_and_are_documented():
    """What `__all__` exports, followed to the objects themselves."""
    sources, checked = read(PACKAGE), 0
    for name in sources:
        if name.startswith(("cli", "__main__", "results.plot")):
            continue  # heavy to import, and they export by their definitions
        module = importlib.import_module(f"jaxslam.{name}" if name else "jaxslam")
        for exported in getattr(module, "__all__", ()):
            value = getattr(module, exported)
            checked += 1
            if callable(value):
                assert value.__doc__, f"{name}.{exported}"
    assert checked > 10


def test_packages_export_a_sorted_explicit_list():
    """Those that export anything; others are folders."""
    sources = read(PACKAGE)
    for name, source in sources.items():
        if name and is_package(name, sources) and len(ast.parse(source).body) > 1:
            lists = [
                ast.literal_eval(node.value)
                for node in ast.parse(source).body
                if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
            ]
            assert len(lists) == 1, name
            assert sorted(lists[0]) == sorted(set(lists[0])), name


# --- the checker is no rubber stamp -------------------------------------------------------------

RECORD = "consistency.campaign.record"
HOUSE = {
    "": "from jaxslam.run import run",
    "math": "",
    "math.se2": "import jax.numpy as jnp\nfrom jaxslam.math.angles import wrap",
    "math.angles": "import jax",
    "sensors": "from jaxslam.sensors.laser import laser",
    "sensors.laser": "from jaxslam.math import se2\nfrom jaxslam.sensors.mounting import mounting",
    "sensors.mounting": "from . import noise_helper",
    "sensors.noise_helper": "from jaxslam.math.se2 import compose",
    "run": "from jaxslam.sensors import laser",
    "results": "",
    "results.plot": "import matplotlib.pyplot as plt",
    "cli": "import argparse\nimport jax\njax.config.update('jax_enable_x64', True)",
}


def test_a_sound_house_passes():
    assert violations(HOUSE) == []


def test_only_the_methods_of_a_record_look_up_and_only_to_results():
    within = "class Campaign:\n    def save(self):\n        from jaxslam.results import report"
    house = HOUSE | {"results.report": "from jaxslam.consistency.campaign.record import Campaign"}
    assert violations(house | {"consistency.campaign": "", RECORD: within}) == []
    for source in ("from jaxslam.results import report", within.replace("results", "cli")):
        above = source.split("jaxslam.")[1].split()[0]
        assert any(
            f"{RECORD} imports {above}" in breach
            for breach in violations(house | {"consistency.campaign": "", RECORD: source})
        )


@pytest.mark.parametrize(
    ("module", "source", "message"),
    [
        ("math", "from jaxslam.sensors import laser", "math imports sensors, a floor above"),
        ("math", "from jaxslam import sensors", "math imports sensors, a floor above"),
        ("math", "import jaxslam.sensors.laser as s", "math imports sensors.laser, a floor above"),
        ("math", "from ..run import run", "math imports run, a floor above"),
        (
            "math.se2",
            "def f():\n    from jaxslam.run import run",
            "math.se2 imports run, a floor above",
        ),
        ("sensors.laser", "from ..run import run", "sensors.laser imports run, a floor above"),
        ("sensors.laser", "from jaxslam import run", "sensors.laser imports run, a floor above"),
        ("run", "from jaxslam import something", "run imports the package itself, a floor above"),
        ("run", "import jaxslam", "run imports the package itself, a floor above"),
        (
            "math.angles",
            "from jaxslam.math import se2",
            "imports go round: math.se2 -> math.angles -> math.se2",
        ),
        (
            "sensors.mounting",
            "from jaxslam.sensors import laser",
            "imports go round: sensors.laser -> sensors.mounting -> sensors.laser",
        ),
        ("gadgets", "import jax", "gadgets: has no floor"),
        ("sensors.laser", "import matplotlib.pyplot", "sensors.laser: touches matplotlib"),
        ("run", "from matplotlib import pyplot", "run: touches matplotlib"),
        ("results.plot", "import argparse", "results.plot: touches argparse"),
        ("run", "import jax\njax.config.update('x', 1)", "run: touches jax.config"),
        ("run", "from jax import config", "run: touches jax.config"),
        ("run", "import jax\njax.experimental.enable_x64()", "run: touches jax.config"),
        ("run", "import os\nos.environ['JAX_ENABLE_X64'] = '1'", "run: touches jax.config"),
        ("", "import jax\njax.config.update('x', 1)", "__init__: touches jax.config"),
    ],
)
def test_the_checker_catches(module, source, message):
    assert message in violations(HOUSE | {module: source})


def test_the_docstring_checker_catches():
    bare = {"run": '"""Module."""\ndef run():\n    pass\nclass _Hidden:\n    pass', "se2": "x = 1"}
    assert undocumented(bare) == ["run.run: no docstring", "se2: module without a docstring"]
