"""The documentation, as far as it is held without building it: `make docs` runs its code."""

import contextlib
import importlib.util
import inspect
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from jaxslam import cli

ROOT = Path(__file__).parents[2]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
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
            cli._parser().parse_args(arguments)
        except SystemExit as stop:
            status = stop.code
    assert not status, said.getvalue()


def test_every_block_of_python_is_run():
    """A code cell is run by the build; a plain block would not be."""
    plain = [page for page, text in PAGES.items() if page != "README.md" and "```python" in text]
    assert plain == []


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


def test_the_reference_misses_no_public_name():
    """Each name that a package lists stands in the reference, under some path; and has a docstring.

    After a build the extension compares the pages with this list (`missing`).
    """
    extension = reference()
    pages = extension.public_names()
    shown = {id(getattr(sys.modules[n.module], n.name)) for names in pages.values() for n in names}
    for module in extension.modules():
        for name in getattr(module, "__all__", []):
            value = getattr(module, name)
            assert inspect.ismodule(value) or id(value) in shown, f"{module.__name__}.{name}"
    undocumented = [
        f"{n.module}.{n.name}"
        for names in pages.values()
        for n in names
        if n.kind != "data" and not inspect.getdoc(getattr(sys.modules[n.module], n.name))
    ]
    assert undocumented == []


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
    modules = {module.__name__ for module in reference().modules()}
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
