"""The documentation, as far as it is held without building it: `make docs` runs all that it shows."""

import ast
import contextlib
import importlib
import importlib.util
import inspect
import io
import operator
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import jaxslam
from jaxslam import _cli as cli

ROOT = Path(__file__).parents[2]
OUTSIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md")]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [*OUTSIDE, *sorted((ROOT / "docs").rglob("*.md"))]
    if "_build" not in path.parts
}


def commands():
    """(page, command line) of every `jaxslam …` that a page shows."""
    for page, text in PAGES.items():
        for kind, block in re.findall(r"^```([^\n]*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            start = r"^!" if kind.startswith("{code-cell}") else r"^(?:\$ )?"
            if kind in ("", "console") or start == "^!":
                block = block.replace("\\\n", "")
                yield from (
                    (page, line)
                    for line in re.findall(rf"{start}(jaxslam .*)$", block, re.MULTILINE)
                )


@pytest.mark.parametrize(("page", "line"), list(commands()))
def test_a_command_that_a_page_shows_is_understood(page, line):
    arguments = shlex.split(line.replace("…", ""), comments=True)[1:]
    said, status = io.StringIO(), 0
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            cli._parser().parse_args(cli._laser_command(arguments))
        except SystemExit as stop:
            status = stop.code
    assert not status, said.getvalue()


def test_every_block_of_python_is_run():
    """A code cell is run by the build; a plain block would not be."""
    plain = [page for page, text in PAGES.items() if page != "README.md" and "```python" in text]
    assert plain == []


def test_a_page_that_shows_a_refusal_fails_without_it():
    """A `try` in a cell has an `else` that raises."""
    code_of, trials = executed().code_of, 0
    for page, text in PAGES.items():
        code = re.sub(r"^[%!].*$", "", code_of(text), flags=re.MULTILINE)
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Try):
                trials += 1
                assert any(isinstance(each, ast.Raise) for each in node.orelse), page
    assert trials


def test_links_between_pages_lead_somewhere():
    """Sphinx checks those within docs/; these lead out of it, or are read where files are shown."""
    lost = []
    for page, text in PAGES.items():
        prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\((?!https?:)([^)#\s]+)", prose):
            if not ((ROOT / page).parent / link).exists():
                lost.append((page, link))
    assert lost == []


def reference():
    """The extension that writes the pages of the reference."""
    path = ROOT / "docs" / "_ext" / "reference.py"
    spec = importlib.util.spec_from_file_location("reference", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def public():
    """(module, name) of every public name, by the files alone: `__all__` of a module whose path has
    no underscore."""
    for path in sorted((ROOT / "jaxslam").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if any(part.startswith("_") for part in parts):
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                yield from ((".".join(parts), name) for name in ast.literal_eval(node.value))


def test_the_reference_misses_no_public_name(tmp_path, monkeypatch):
    """Each stands on a page of the reference, under some path; and has a docstring.

    After a build the extension compares the pages with its own list (`missing`).
    """
    extension = reference()
    monkeypatch.setattr(extension, "FOLDER", tmp_path)
    extension.write_pages()
    pages = "\n".join(path.read_text(encoding="utf-8") for path in tmp_path.iterdir())
    written = re.findall(r"^\.\. auto(\w+):: ([\w.]+)::(\w+)$", pages, re.MULTILINE)
    named = {(name, id(getattr(sys.modules[module], name))) for _, module, name in written}
    renamed = {value for _, value in named}
    lost = []
    for module, name in public():
        value = getattr(importlib.import_module(module), name)
        plain = isinstance(value, int | float | str)  # equal ones may be one object
        shown = (name, id(value)) in named or (not plain and id(value) in renamed)
        if not shown and not inspect.ismodule(value):
            lost.append(f"{module}.{name}")
    assert lost == []
    undocumented = [
        f"{module}.{name}"
        for kind, module, name in written
        if kind != "data" and not inspect.getdoc(getattr(sys.modules[module], name))
    ]
    assert undocumented == []


def test_pages_and_examples_import_public_names_only():
    sources = dict(PAGES)
    for path in (ROOT / "examples").rglob("*.py"):
        sources[str(path.relative_to(ROOT))] = path.read_text(encoding="utf-8")
    known = set(public())
    for page, source in sources.items():
        for of, names in re.findall(
            r"^[ \t]*from (jaxslam[\w.]*) import (\([^)]*\)|[^\n#]+)", source, re.MULTILINE
        ):
            for name in (
                each.split()[0] for each in names.strip("() \n").split(",") if each.strip()
            ):
                value = getattr(importlib.import_module(of), name)
                is_public_module = inspect.ismodule(value) and "._" not in f"{of}.{name}"
                assert is_public_module or (of, name) in known, (page, of, name)


def test_a_name_in_a_public_docstring_is_public():
    """`filters.Closing` is `jaxslam.filters.Closing`, which a reader can import."""
    packages = {name.split(".")[1] for name, _ in public() if "." in name} | set(dir(jaxslam))
    lost, checked = [], 0
    for names in reference().public_names().values():
        for module, name, _ in names:
            value = getattr(sys.modules[module], name)
            if not (inspect.isclass(value) or inspect.isroutine(value)):
                continue
            members = vars(value).values() if inspect.isclass(value) else ()
            texts = [inspect.getdoc(each) or "" for each in (value, *members) if callable(each)]
            for path in re.findall(r"`(?:jaxslam\.)?(\w+(?:\.\w+)+)", "\n".join(texts)):
                if path.split(".")[0] in packages and not path.endswith((".json", ".csv", ".toml")):
                    checked += 1
                    if not is_reached(path):
                        lost.append((module, name, path))
    assert lost == [], lost
    assert checked > 40


def is_reached(path):
    """Whether a dotted path below `jaxslam`, of a name or a field, leads without an underscore."""
    owner, _, name = path.rpartition(".")
    try:
        value = operator.attrgetter(owner)(jaxslam)
    except AttributeError:
        return False
    there = hasattr(value, name) or name in getattr(value, "__annotations__", ())
    return there and "._" not in f".{path}"


def test_a_dotted_path_in_the_text_is_reached_after_one_import():
    """In a process of its own: here other tests have imported everything."""
    text = "\n".join(PAGES.values())
    named = sorted(set(re.findall(r"(?<!\})`(jaxslam(?:\.\w+)+)(?:\(.*?\))?`", text)))
    assert named
    code = "import jaxslam\n" + "\n".join(named)
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_a_link_into_the_reference_leads_somewhere():
    """Sphinx says nothing of a name that it does not know."""
    shown = {f"{n.module}.{n.name}" for names in reference().public_names().values() for n in names}
    modules = {module for module, names in reference().public_names().items() if names}
    modules |= set(reference().INTRODUCED)
    lost = []
    for page, text in PAGES.items():
        for target in re.findall(r"\{py:\w+\}`(?:[^`<]*<)?~?([\w.]+)>?`", text):
            owner, _, field = target.rpartition(".")
            if target not in shown | modules and owner not in shown:
                lost.append((page, target))
            elif owner in shown and target not in shown:
                module, _, name = owner.rpartition(".")
                assert field in dir(getattr(sys.modules[module], name)), (page, target)
    assert lost == []


def executed():
    """The extension that says what code the cells of a page reach."""
    path = ROOT / "docs" / "_ext" / "executed.py"
    spec = importlib.util.spec_from_file_location("executed", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_page_is_run_again_when_code_that_it_reaches_has_changed(tmp_path):
    extension = executed()
    names = extension.named(ast.parse("import jaxslam\nf = jaxslam.filters.Seif"))
    assert names == {"jaxslam:filters.Seif"}
    files = {p.relative_to(ROOT / "jaxslam").as_posix() for p in extension.reached(names)}
    assert "filters/_information/seif.py" in files
    assert "filters/_information/marginals.py" in files  # a step of it
    assert "math/_linalg/factors.py" in files
    assert not any(name.startswith(("filters/particles", "results", "cli")) for name in files)
    page = PAGES["docs/getting_started.md"]
    everything = page.replace("print(campaign)", "!jaxslam verify")
    assert len({extension.digest(text) for text in (page, page + "\n", everything)}) == 2
    assert extension.digest("prose alone") is None
    said = {}
    for name, code in {
        "first": 'def f(x):\n    """Twice x."""\n    return 2 * x\n',
        "told otherwise": 'def f(x):\n    """x and x."""\n    # a comment\n    return (2 * x)\n',
        "another": 'def f(x):\n    """Twice x."""\n    return 3 * x\n',
    }.items():
        (tmp_path / f"{name}.py").write_text(code)
        said[name] = extension.content(tmp_path / f"{name}.py")
    assert said["first"] == said["told otherwise"] != said["another"]
