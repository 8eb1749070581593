"""The house rules, read from the source: who may import whom, and that public names say what they are.

Imports go downward only (the figure in CONTRIBUTING.md); within a floor they may go sideways but not round.
"""

import ast
import graphlib
import importlib
import pickle
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import jaxslam
from jaxslam.core.validation import InvalidField
from jaxslam.math import _linalg as linalg
from jaxslam.math import _series

PACKAGE = Path(jaxslam.__file__).parent

FLOORS = [
    "_public math",
    "core",
    "motion sensors charts linearize association resampling life",
    "_driver _origin _rounding filters graphs laser simulation",
    "consistency verify catalog calibration",
    "datasets results _cli selftest __main__",
]
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names.split()}
FLOOR[""] = len(FLOORS)  # jaxslam/__init__.py sees everything, and nothing sees it

# Methods of these modules may import what is above, when they are called: `print(campaign)` and
# `campaign.save(folder)` are where a user looks for them, and results are drawn and written above.
WITHIN_CALLS = {
    "consistency.campaign._result": "results",
}

# What only these modules may touch.
KEPT = {
    "matplotlib": ("results.plot", "datasets._ros_map"),
    "argparse": ("_cli",),
    # arrays: float64 within a block, then as before; remote: in a worker, as where it is called
    "jax.config": ("_cli", "__main__", "math._arrays", "consistency.campaign._remote"),
}

CONFIG = {"jax.config", "jax.enable_x64", "jax.experimental.enable_x64"}


def read(folder):
    """{dotted name: source} of every module of a package folder; the package itself is ''."""
    sources = {}
    for path in sorted(Path(folder).rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        sources[".".join(parts)] = path.read_text(encoding="utf-8")
    return sources


def imported(name, tree, sources):
    """(modules of the package, outside names) that a module imports, wherever in it."""
    dotted = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            of = f"{node.module or ''}." if isinstance(node, ast.ImportFrom) else ""
            dotted |= {f"{of}{alias.name}" for alias in node.names}
    inside = set()
    for target in (each for each in dotted if f"{each}.".startswith("jaxslam.")):
        parts = target.split(".")[1:]
        while parts and ".".join(parts) not in sources:
            parts.pop()  # a name inside the module
        inside.add(".".join(parts))
        # Python runs the packages above it too, unless we are in them already.
        above = (".".join(parts[:depth]) for depth in range(1, len(parts)))
        inside |= {package for package in above if not f"{name}.".startswith(f"{package}.")}
    return inside - {name}, {each for each in dotted if not f"{each}.".startswith("jaxslam.")}


class AtImport(ast.NodeTransformer):
    """A module without the bodies of its functions: what is executed when it is imported."""

    def visit_FunctionDef(self, node):
        return ast.copy_location(ast.Pass(), node)


def touches(tree, outside):
    """Which of the kept things a module touches."""
    found = {kept for kept in KEPT for each in outside if f"{each}.".startswith(f"{kept}.")}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node) in CONFIG:
            found.add("jax.config")
        if isinstance(node, ast.Constant) and node.value == "JAX_ENABLE_X64":
            found.add("jax.config")
    return found


def violations(sources):
    """Every breach of the rules, as a sentence."""
    out, edges = [], {}
    for name, source in sources.items():
        unit = name.split(".")[0]
        if unit not in FLOOR:
            out.append(f"{name}: has no floor")
            continue
        tree = ast.parse(source)
        inside, outside = imported(name, tree, sources)
        if name in WITHIN_CALLS:
            above = {t for t in inside if t.split(".")[0] == WITHIN_CALLS[name]}
            inside -= above - imported(name, AtImport().visit(ast.parse(source)), sources)[0]
        edges[name] = sorted(inside)
        for target in sorted(inside):
            if FLOOR.get(target.split(".")[0], -1) > FLOOR[unit]:
                out.append(f"{name} imports {target or 'the package itself'}, a floor above")
        out += [f"{name}: imports {each}, which is relative" for each in outside if each[0] == "."]
        for kept in sorted(touches(tree, outside)):
            if not any(f"{name}.".startswith(f"{owner}.") for owner in KEPT[kept]):
                out.append(f"{name or '__init__'}: touches {kept}")
    try:
        graphlib.TopologicalSorter(edges).prepare()
    except graphlib.CycleError as error:
        out.append(f"imports go round: {' -> '.join(error.args[1])}")
    return out


def undocumented(sources):
    """Modules, and the public functions and classes they define, that have no docstring."""
    out = []
    for name, source in sources.items():
        tree = ast.parse(source)
        if source.strip() and not ast.get_docstring(tree):
            out.append(f"{name or '__init__'}: module without a docstring")
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                if not ast.get_docstring(node):
                    out.append(f"{name}.{node.name}: no docstring")
    return out


def shadowed(sources):
    """Functions, and classes of lower case, that share the name of the module that defines them."""
    out = []
    for name, source in sources.items():
        stem = name.split(".")[-1].lower()
        for node in ast.parse(source).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == stem:
                out.append(f"{name}.{node.name}: shares the name of its module")
    return out


# --- the package --------------------------------------------------------------------------------


def test_imports_go_downward_only():
    assert violations(read(PACKAGE)) == []


FILLERS = frozenset(
    [
        "found",
        "one",
        "each",
        "given",
        "known",
        "other",
        "here",
        "what",
        "whole",
        "made",
        "there",
        "more",
        "own",
        "taken",
        "every",
        "told",
        "asked",
    ]
)
"""words that do not say what a name holds"""


def fillers(sources):
    """Every variable, parameter, field and function that has such a name, as "module:line name"."""
    names = []
    for name, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.append((name, node.lineno, node.id))
            elif isinstance(node, ast.arg):
                names.append((name, node.lineno, node.arg))
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.append((name, node.lineno, node.name))
    return [f"{name}:{line} {bound}" for name, line, bound in names if bound in FILLERS]


def test_names_say_what_they_hold():
    assert fillers(read(PACKAGE)) == []
    source = "def f(found, x):\n    for each in x:\n        known: int = each\n\ndef given(): pass"
    assert fillers({"a": source}) == ["a:5 given", "a:1 found", "a:2 each", "a:3 known"]


def test_no_module_shares_its_functions_name():
    """Else `from package import name` gives the module or the function, by the order of imports."""
    assert shadowed(read(PACKAGE)) == []


def test_no_two_modules_share_a_name():
    stems = [path.stem for path in PACKAGE.rglob("*.py") if not path.stem.startswith("__")]
    assert sorted(stems) == sorted(set(stems))


def test_public_names_have_docstrings():
    assert undocumented(read(PACKAGE)) == []


def test_nothing_imports_private_jax_or_asks_for_its_version():
    private = re.compile(r"jax\._src|jax\.extend|jaxlib\.|jax\.__version|version\(.jax.\) [<>=]")
    found = [name for name, source in read(PACKAGE).items() if private.search(source)]
    assert found == ["_cli.environment"]  # --version


def public_definitions(source):
    """Names without an underscore that a module defines: functions, classes, constants."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
            found |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return {name for name in found if not name.startswith("_")}


def test_what_is_not_public_has_an_underscore():
    """In its name or in its path. `__all__` names what a module without one defines or passes on."""
    checked = 0
    for name, source in read(PACKAGE).items():
        if any(part.startswith("_") for part in name.split(".")):
            continue
        module = importlib.import_module(f"jaxslam.{name}" if name else "jaxslam")
        names = getattr(module, "__all__", [])
        assert len(names) == len(set(names)), name
        assert public_definitions(source) <= set(names), name
        assert all(hasattr(module, each) for each in names), name
        checked += len(names)
    assert checked > 400


def test_names_are_imported_on_demand_from_where_type_checkers_read_them():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    homes = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] == "jaxslam"
        for alias in node.names
    }
    assert set(homes) == set(jaxslam.__all__)
    for name, home in homes.items():
        value = getattr(jaxslam, name)
        if isinstance(value, types.ModuleType):
            assert value.__name__ == f"{home}.{name}"
        else:
            assert value is getattr(importlib.import_module(home), name)


def test_the_import_alone_loads_no_module_of_the_package():
    script = "import sys, jaxslam; print(sum(name.startswith('jaxslam.') for name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "0\n", done.stderr


def public_values():
    """(public module, name, value) of all classes and functions that the package lists."""
    for name in read(PACKAGE):
        if not any(part.startswith("_") for part in name.split(".")):
            module = importlib.import_module(f"jaxslam.{name}" if name else "jaxslam")
            for listed in getattr(module, "__all__", []):
                value = getattr(module, listed)
                if hasattr(value, "__qualname__") and value.__module__.startswith("jaxslam"):
                    yield module.__name__, listed, value


def test_what_is_public_says_so():
    """`help`, tracebacks, `repr` and pickles show the path that stays."""
    count = 0
    for module, name, value in public_values():
        assert "._" not in value.__module__, (module, name, value.__module__)
        home = importlib.import_module(value.__module__)
        assert getattr(home, value.__name__) is value, (module, name)
        source = getattr(value, "__source_module__", value.__module__)
        assert hasattr(importlib.import_module(source), value.__name__), (module, name)
        count += 1
    assert count > 400
    assert repr(jaxslam.filters.EkfSlam) == "<class 'jaxslam.filters.EkfSlam'>"
    assert repr(jaxslam.Scenario) == "<class 'jaxslam.Scenario'>"


def test_pickles_have_public_paths_and_load_in_a_fresh_process():
    model = jaxslam.motion.Unicycle(np.eye(2))
    values = (
        jaxslam.filters.EkfSlam(model, jaxslam.sensors.RangeBearing(np.eye(2)), 3),
        jaxslam.scenarios.circle(steps=3).sensor,
        jaxslam.run,
        InvalidField("gate", "expected a number, got None", owner="Own"),
    )
    data = pickle.dumps(values)
    for path in re.findall(rb"jaxslam[.\w]*", data):
        assert b"._" not in path, path
    script = (
        "import pickle, sys; values = pickle.load(sys.stdin.buffer); "
        "print(*(type(value).__name__ for value in values), values[3])"
    )
    done = subprocess.run([sys.executable, "-c", script], input=data, capture_output=True)
    text = "EkfSlam RelativePosition function InvalidField Own: gate: expected a number, got None\n"
    assert done.stdout.decode() == text, done.stderr.decode()


def test_shapes_in_signatures_are_checked_in_the_package():
    with pytest.raises(TypeError, match=r"cholesky: matrix is no .*: float64\(3,\)"):
        linalg.cholesky(np.ones(3))
    assert _series.horner.__code__.co_filename == _series.__file__  # no array enters by name


# --- the checker is no rubber stamp -------------------------------------------------------------

RECORD = "consistency.campaign._result"
HOUSE = {
    "": "from jaxslam._driver import run",
    "math": "",
    "math.se2": "import jax.numpy as jnp\nfrom jaxslam.math.angles import wrap",
    "math.angles": "import jax",
    "sensors": "from jaxslam.sensors.laser import laser",
    "sensors.laser": "from jaxslam.math import se2\nfrom jaxslam.sensors.mounting import mounting",
    "sensors.mounting": "from jaxslam.math.se2 import compose",
    "_driver": "from jaxslam.sensors import laser",
    "results": "",
    "results.plot": "import matplotlib.pyplot as plt",
    "_cli": "import argparse\nimport jax\njax.config.update('jax_enable_x64', True)",
}


def test_a_sound_house_passes_and_only_methods_of_a_record_look_up():
    assert violations(HOUSE) == []
    within = "class Campaign:\n    def save(self):\n        from jaxslam.results import report"
    house = HOUSE | {"results.report": "from jaxslam.consistency.campaign._result import Campaign"}
    house |= {"consistency.campaign": ""}
    assert violations(house | {RECORD: within}) == []
    for source in ("from jaxslam.results import report", within.replace("results", "_cli")):
        above = source.split("jaxslam.")[1].split()[0]
        breaches = violations(house | {RECORD: source})
        assert any(f"{RECORD} imports {above}" in breach for breach in breaches)


@pytest.mark.parametrize(
    ("module", "source", "message"),
    [
        ("math", "from jaxslam import sensors", "math imports sensors, a floor above"),
        ("math", "import jaxslam.sensors.laser as s", "math imports sensors.laser, a floor above"),
        (
            "math",
            "def f():\n    from jaxslam._driver import run",
            "math imports _driver, a floor above",
        ),
        ("_driver", "from . import sensors", "_driver: imports .sensors, which is relative"),
        ("_driver", "import jaxslam", "_driver imports the package itself, a floor above"),
        ("math.angles", "from jaxslam.math import se2", "imports go round: "),
        ("gadgets", "import jax", "gadgets: has no floor"),
        ("_driver", "from matplotlib import pyplot", "_driver: touches matplotlib"),
        ("results.plot", "import argparse", "results.plot: touches argparse"),
        ("_driver", "from jax import config", "_driver: touches jax.config"),
        ("_driver", "import jax\njax.experimental.enable_x64()", "_driver: touches jax.config"),
        ("_driver", "import os\nos.environ['JAX_ENABLE_X64'] = '1'", "_driver: touches jax.config"),
        ("", "import jax\njax.config.update('x', 1)", "__init__: touches jax.config"),
    ],
)
def test_the_checker_catches(module, source, message):
    found = violations(HOUSE | {module: source})
    assert any(breach.startswith(message) for breach in found), found


def test_the_docstring_checker_catches():
    bare = {"run": '"""Module."""\ndef run():\n    pass\nclass _Hidden:\n    pass', "se2": "x = 1"}
    assert undocumented(bare) == ["run.run: no docstring", "se2: module without a docstring"]


def test_the_name_checker_catches():
    sources = {"driver": "def run(): pass", "math.align": "class Align: pass\ndef align(): pass"}
    assert shadowed(sources) == ["math.align.align: shares the name of its module"]
