"""What CI runs of the sweeps and of the pages for a commit: `python .ci/portion.py` prints it.

A test function or a page belongs to the third of its name's checksum, and commit number n of the
history runs third n mod 3, so that three commits in a row run everything. What the last day changed
is run as well: the sweeps of the rooms whose code changed, and the pages whose code did; but the
third alone after a day that changed more than half of them, which CI has no time for. CI_THIRD=0, 1
or 2 chooses another third, CI_THIRD=all everything.
"""

import ast
import functools
import os
import re
import subprocess
import zlib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
DAY = 86400
"""seconds"""
ROOMS = dict.fromkeys(
    ("association", "charts", "life", "linearize", "motion", "resampling", "sensors"), "models"
) | {"calibration": "consistency"}
"""parts of the package whose tests are in a folder of another name"""
CODE = re.compile(r"^```(?:console|\{code-cell\}|\{literal).*?^```$", re.DOTALL | re.MULTILINE)
"""the blocks of a page that are run"""
NONE = "none, or more than half of all"


def git(*arguments: str) -> str:
    """The output of a command of git in the checkout, or "" where it fails."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=False)
    return done.stdout.decode(errors="replace").strip() if done.returncode == 0 else ""


@functools.cache
def third() -> int | None:
    """The third of this commit: 0, 1 or 2; None for everything, as outside of a repository."""
    asked = os.environ.get("CI_THIRD", "")
    if not asked and git("rev-parse", "--is-shallow-repository") == "true":
        asked = str(int(git("rev-parse", "HEAD"), 16))  # a shallow clone cannot count its commits
    asked = asked or git("rev-list", "--count", "HEAD")
    return int(asked) % 3 if asked.isdigit() else None


@functools.cache
def changed() -> frozenset[str]:
    """The files whose code the last day up to the last commit changed: not docstrings, comments,
    layout or the prose of pages. In a shallow clone that has no older commit: none."""
    before = git("log", "-1", "--format=%ct")
    base = before and git("rev-list", "-1", f"--before={int(before) - DAY}", "HEAD")
    if not base:
        return frozenset()
    return frozenset(
        name
        for name in git("diff", "--name-only", base, "HEAD").splitlines()
        if code(name, git("show", f"{base}:{name}")) != code(name, git("show", f"HEAD:{name}"))
    )


def code(name: str, text: str) -> object:
    """What of a file's text decides what it does."""
    if name.endswith(".md"):
        return CODE.findall(text)
    if not name.endswith(".py"):
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [line for line in node.body if not _is_text(line)]
    return ast.dump(tree)


def _is_text(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)


@functools.cache
def rooms() -> frozenset[str]:
    """The folders of tests of the changed code: of `jaxslam/filters/_ekf/scan.py`
    `tests/filters/ekf`, of a file without a folder of its own the nearest above."""
    folders = set()
    for name in changed():
        top, *parts = Path(name).parts
        if top == "jaxslam":
            parts = [part.removeprefix("_").removesuffix(".py") for part in parts]
            parts[0] = ROOMS.get(parts[0], parts[0])
            while parts and not (ROOT / "tests" / Path(*parts)).is_dir():
                parts.pop()
            folders.add(str(Path("tests", *parts)))
        elif top == "tests":
            folders.add(str(Path(name).parent))
    every = {str(path.parent.relative_to(ROOT)) for path in (ROOT / "tests").rglob("test_*.py")}
    return _if_few(folders, every)


@functools.cache
def pages() -> frozenset[str]:
    """The pages whose code changed."""
    every = {str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")}
    return _if_few({name for name in changed() if name.endswith(".md")}, every)


def _if_few(touched: set[str], every: set[str]) -> frozenset[str]:
    return frozenset(touched & every if 2 * len(touched & every) <= len(every) else ())


def chosen(name: str, touched: bool) -> bool:
    """Whether a test function or a page is run for this commit."""
    return touched or third() is None or zlib.crc32(name.encode()) % 3 == third()


def left_out(files: Iterable[Path]) -> list[Path]:
    """Those of some pages that are not run for this commit."""
    names = ((file, str(file.relative_to(ROOT))) for file in files)
    return [file for file, name in names if not chosen(name, name in pages())]


def told() -> str:
    """What is run for this commit, and how to run everything."""
    if third() is None:
        return "sweeps and pages: all"
    return "\n".join(
        (
            f"sweeps and pages: third {third()} of 0, 1, 2 (number of the commit modulo 3), and",
            f"sweeps of rooms that changed in a day: {', '.join(sorted(rooms())) or NONE}",
            f"pages whose code changed in a day: {', '.join(sorted(pages())) or NONE}",
            "everything: CI_THIRD=all .ci/run, or make test-all and make docs",
        )
    )


if __name__ == "__main__":
    print(told())
