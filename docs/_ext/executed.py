"""Sphinx extension: a page is run again when its cells, or the code that they reach, have changed.

What a page printed and drew is kept by its cells and its kernel's description (jupyter-cache). This
extension adds to that description a digest of the files of the package that the cells reach: those
that define a name in a cell, those that define a name in these, and so on; for `!jaxslam …` those
of the command, and the exit statuses that tags say (`exit_status.py`). Docstrings, comments and
layout do not count.
"""

import ast
import functools
import hashlib
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PACKAGE = "jaxslam"
COMMAND = {"jaxslam._cli:main"}
KINDS = (".css", ".js")
"""files beside those of Python that code reads"""
KERNEL = "  name: python3\n"
"""The line of a page's head after which the digest is put"""


def digest(page: str) -> str | None:
    """Of what the cells of a page reach; None for a page without cells."""
    code = code_of(page)
    if not code:
        return None
    names = named(ast.parse(re.sub(r"^[%!].*$", "", code, flags=re.MULTILINE)))
    shell = re.search(r"^!", code, re.MULTILINE)
    files = reached(names | COMMAND if shell else names)
    if "examples" in code:
        files |= set((ROOT / "examples").glob("*.py"))
    return hashed(files, str(re.findall(r"\bexit-\d+", page)) if shell else "")


def code_of(page: str) -> str:
    """The text of all cells of a page."""
    cells = re.findall(r"^```\{code-cell\}[^\n]*\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    return "".join(line for cell in cells for line in cell.splitlines(True) if line[:1] != ":")


def hashed(files: set[Path], text: str = "") -> str:
    """A digest of what files do, and of a text."""
    found = hashlib.sha256(text.encode())
    for path in sorted(files):
        found.update(content(path))
    return found.hexdigest()[:16]


def reached(names: frozenset[str]) -> set[Path]:
    """The files that define these names, or names in such files; and what lies beside them."""
    files: set[Path] = set()
    ahead = {home(name) for name in names}
    while ahead:
        path = ahead.pop()
        files.add(path)
        ahead |= {home(name) for name in named_in(path)} - files
    folders = {file.parent for file in files}
    return files | {path for each in folders for path in each.iterdir() if path.suffix in KINDS}


@functools.cache
def named_in(path: Path) -> frozenset[str]:
    """The names of the package in a file; a package is asked for by name what it imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(aliases(tree).values()) if path.name == "__init__.py" else named(tree)


def named(tree: ast.AST) -> frozenset[str]:
    """What code uses of the package, module and attributes, as `jaxslam:filters.ekf_slam`."""
    return frozenset(_used(tree, aliases(tree)))


def aliases(tree: ast.AST) -> dict[str, str]:
    """What the names that code imports from the package stand for."""
    alias = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for each in node.names:
                if each.name.split(".")[0] == PACKAGE:
                    alias[each.asname or PACKAGE] = f"{each.name if each.asname else PACKAGE}:"
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
            for each in node.names:
                alias[each.asname or each.name] = f"{node.module}:{each.name}"
    return alias


def _used(node: ast.AST, alias: dict[str, str]) -> Iterator[str]:
    chain, inner = [], node
    while isinstance(inner, ast.Attribute):
        chain.append(inner.attr)
        inner = inner.value
    if isinstance(inner, ast.Name) and inner.id in alias:
        yield ".".join([alias[inner.id], *reversed(chain)]).replace(":.", ":")
    else:
        for child in ast.iter_child_nodes(node):
            yield from _used(child, alias)


@functools.cache
def home(name: str) -> Path:
    """The file that defines a name, or what it is an attribute of."""
    within, _, attributes = name.partition(":")
    module = value = importlib.import_module(within)
    for part in filter(None, attributes.split(".")):
        if hasattr(value, part):
            value = getattr(value, part)
        else:
            value = importlib.import_module(f"{value.__name__}.{part}")
        if not inspect.ismodule(value):
            break
        module = value
    # A public name says that it is of a public module; its source is in a private one.
    owner = getattr(value, "__source_module__", None) or getattr(value, "__module__", None) or ""
    if not inspect.ismodule(value) and owner.split(".")[0] == PACKAGE:
        module = sys.modules[owner]
    return Path(module.__file__ or "")


@functools.cache
def content(path: Path) -> bytes:
    """What of a file decides what it does."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [
                each
                for each in node.body
                if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
            ]
    return ast.dump(tree).encode()


def outdated(app: Any, env: Any, added: Any, changed: Any, removed: Any) -> list[str]:
    """Pages that are read again since what they reach has changed."""
    before = getattr(env, "page_digests", {})
    env.page_digests = {
        page: digest(Path(env.doc2path(page)).read_text(encoding="utf-8"))
        for page in env.found_docs
        if not page.startswith("reference/api")
    }
    return [page for page, value in env.page_digests.items() if before.get(page) != value]


def marked(app: Any, page: str, source: list[str]) -> None:
    """Put the digest of a page into its head."""
    value = app.env.page_digests.get(page)
    if value is not None:
        assert KERNEL in source[0], f"{page}: no kernel in its head"
        source[0] = source[0].replace(KERNEL, f"{KERNEL}  reached: {value}\n", 1)


def setup(app: Any) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("env-get-outdated", outdated)
    app.connect("source-read", marked)
    return {"parallel_read_safe": True}
