"""The README: its Python runs as it stands, and its reference names what there is."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxslam

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
MODULES = {name for name in jaxslam.__all__ if hasattr(getattr(jaxslam, name), "__path__")}


def reference():
    """(module, name) pairs of the reference table."""
    for module, row in rows():
        for name in re.findall(r"`(\w+)`", row):
            yield module, name


def rows():
    """(module, what it has) of the reference table."""
    table = README.split("## Reference")[1]
    return re.findall(r"^\| `(jaxslam[.\w]*)` \|(.*)\|$", table, re.MULTILINE)


@pytest.mark.filterwarnings("default")
def test_the_readme_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 3
    code = "\n".join(blocks).replace("steps=500", "steps=12").replace("runs=100", "runs=3")
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "ekf" in printed
    assert "invariant" in printed


@pytest.mark.parametrize(("module", "name"), [p for p in reference() if p[1] != "f_jacobians"])
def test_every_name_of_the_reference_exists_and_is_documented(module, name):
    owner = importlib.import_module(module)
    assert hasattr(owner, name)
    if callable(getattr(owner, name)):
        assert getattr(owner, name).__doc__


def test_what_is_not_reached_as_it_reads_says_how_to_import_it():
    """`jaxslam.monte_carlo`, say, is a function, and so hides the module of that name."""
    for module, row in rows():
        importlib.import_module(module)
        owner = jaxslam
        for part in module.split(".")[1:]:
            owner = getattr(owner, part)
        if inspect.ismodule(owner) == (f"from {module} import" in row):
            pytest.fail(f"{module}: {row}")


def test_a_gradient_is_shown_compiled():
    """Alone, it is traced and compiled anew at every call."""
    assert README.count("jax.jit(jax.grad(cost))(0.1)") == 1


def test_every_public_factory_is_in_the_reference():
    listed = set(reference())
    for module in sorted(MODULES):
        package = getattr(jaxslam, module)
        for name in getattr(package, "__all__", []):
            if name != "REGISTRY":
                assert (package.__name__, name) in listed


def test_a_dotted_path_in_the_text_is_reached_after_one_import():
    """In a process of its own: here other tests have imported everything."""
    text = README.split("## Reference")[0]
    called = sorted(set(re.findall(r"`[^`]*?\b(jaxslam(?:\.\w+)+)\(", text)))
    assert called
    code = "import jaxslam\n" + "\n".join(called)
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
