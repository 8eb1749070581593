"""Sphinx extension: the build runs the commands that pages show, and the scripts that they include.

The `console` blocks of a page run in order, in bash, in a scratch folder. It has `examples/` of the
repository, `data/` (the folder JAXSLAM_DATA, by default ../shared/data beside the checkout),
`gtsam/` (the data of that wheel), and `cells/PAGE.py`, the code cells of a page before the first
`!`. Temporary files are there, too. An included Python file is a command of its own. A comment in
the line above says how a block is run, if at all:

    <!-- not run: two hosts -->
    <!-- run: FOLDER=data/bonn 100000=32 exit=1 -->    words replaced, and the exit status
    <!-- run: first=cells/guide/own_data.py -->        a Python file that is run before
    <!-- run: argument=data/bonn -->                   the argument of an included file

Commands that name `data/` are left out where there is no such folder. A traceback of Python is
a failure, whatever the exit status. What has passed is run again when it, or code that it reaches,
has changed (`executed.py`).
"""

import ast
import functools
import importlib.util
import json
import os
import re
import subprocess
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import executed

ROOT = executed.ROOT
DATA = Path(os.environ.get("JAXSLAM_DATA", ROOT.parent / "shared" / "data")).absolute()
OTHERS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md")]
"""pages outside of docs/"""
RECORD = ROOT / ".cache" / "commands.json"
"""digests of what has passed"""
LIMIT = 900
"""seconds that a block may take"""
BEGINS = {
    "consistency": "jaxslam._cli.campaigns.consistency:",
    "draws": "jaxslam._cli.campaigns.draws:",
    "fit": "jaxslam._cli.recorded.fit:",
    "judge": "jaxslam._cli.judge:",
    "localize": "jaxslam._cli.recorded.localize:",
    "map": "jaxslam._cli.recorded.make_map:",
    "optimize": "jaxslam._cli.optimize:",
    "run": "jaxslam._cli.recorded.run:",
    "slam": "jaxslam._cli.recorded.slam:",
    "verify": "jaxslam._cli.verify:",
}
"""where the code of a subcommand begins"""
KEYS = {"exit": "0", "argument": "", "first": ""}
"""what a comment may say beside words that are replaced"""
SHOWN = re.compile(
    r"^(?:<!-- (?P<how>(?:not )?run): (?P<said>[^\n]*) -->\n)?"
    r"```(?:console|\{literalinclude\} (?P<file>[^\n]*\.py))\n(?P<body>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    """Commands that a page shows, as they are run."""

    page: Path
    line: int
    script: str
    status: int = 0
    left_out: str = ""
    """why they are not run"""


def groups(page: Path) -> Iterator[list[Block]]:
    """Blocks of a page that share a scratch folder: its console blocks; each included file."""
    text, console = page.read_text(encoding="utf-8"), []
    for found in SHOWN.finditer(text):
        how, said, file, body = found.group("how", "said", "file", "body")
        line = text.count("\n", 0, found.start()) + 1
        words = dict(word.split("=", 1) for word in (said or "").split()) if how == "run" else {}
        status, argument, first = (words.pop(key, default) for key, default in KEYS.items())
        if file:
            name = (page.parent / file).resolve().relative_to(ROOT)
            script = f"python {name} {argument}".strip()
        else:
            script = "".join(re.findall(r"^\$ ((?:.*\\\n)*.*\n)", body, re.MULTILINE))
            if not script:
                raise ValueError(f"{page}:{line}: no line of the block begins with `$ `")
        for word, other in words.items():
            script = re.sub(rf"(?<![\w./-]){re.escape(word)}(?![\w./-])", other, script)
        script = f"python {first}\n{script}" if first else script
        lacks = re.search(r"\bdata/", script) and not DATA.is_dir()
        left_out = said if how == "not run" else "no data" if lacks else ""
        block = Block(page, line, script, int(status), left_out)
        if file:
            yield [block]
        else:
            console.append(block)
    yield console


def cells(script: str) -> dict[str, str]:
    """The files of cells that a script names."""
    found = {}
    for name in re.findall(r"\bcells/([\w/]+)\.py", script):
        page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
        before = re.split(r"^!", executed.code_of(page), maxsplit=1, flags=re.MULTILINE)[0]
        found[f"cells/{name}.py"] = re.sub(r"^%.*$", "", before, flags=re.MULTILINE)
    return found


def digest(group: list[Block]) -> str:
    """Of some commands, and of what they reach."""
    script = "".join(f"{block.script}{block.status}" for block in group)
    files = {ROOT / name for name in re.findall(r"\bexamples/[\w/]+\.py", script)}
    code = [*cells(script).values(), *(path.read_text(encoding="utf-8") for path in files)]
    names = frozenset().union(*(executed.named(ast.parse(text)) for text in code))
    if commands := re.findall(r"\bjaxslam (\w+)", script):
        names |= {BEGINS[command] for command in commands} | {"jaxslam._cli.cache:"}
        files |= {executed.home("jaxslam._cli:main")}
    return executed.hashed(files | executed.reached(names), "".join([script, *code]))


@functools.cache
def linked() -> dict[str, Path]:
    """What a scratch folder has, by name."""
    gtsam = importlib.util.find_spec("gtsam")
    folders = {"examples": ROOT / "examples", "data": DATA}
    if gtsam and gtsam.origin:
        folders["gtsam"] = Path(gtsam.origin).parent / "Data"
    return {name: path for name, path in folders.items() if path.is_dir()}


def run(group: list[Block]) -> tuple[Block, str] | None:
    """Run commands; those that fail, with what they said."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for link, target in linked().items():
            (folder / link).symlink_to(target)
        for block in group:
            for file, text in cells(block.script).items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_text(text, encoding="utf-8")
            done = subprocess.run(
                ["timeout", str(LIMIT), "bash", "-exo", "pipefail", "-c", block.script],
                cwd=folder,
                env=os.environ | {"MPLBACKEND": "Agg", "TMPDIR": name},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            if done.returncode != block.status:
                return block, f"exit status {done.returncode}, not {block.status}\n{done.stdout}"
            if "Traceback (most recent call last)" in done.stdout:
                return block, f"a traceback of Python\n{done.stdout}"
    return None


def check(
    pages: list[Path], record: Path, left_out: Collection[Path] = ()
) -> tuple[list[tuple[Block, str]], Counter[str]]:
    """Run what pages show and has not passed, but for pages left out; what failed, and what was
    counted."""
    passed = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else []
    counted: Counter[str] = Counter()
    todo, kept = {}, []
    for group in (group for page in pages for group in groups(page)):
        if group and group[0].page in left_out:
            group = [block._replace(left_out="of another third") for block in group]
        counted.update(block.left_out for block in group if block.left_out)
        group = [block for block in group if not block.left_out]
        if group and (key := digest(group)) in passed:
            kept.append(key)
            counted["passed before"] += len(group)
        elif group:
            counted["run"] += len(group)
            todo[key] = group
    failed = []
    with ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 2)) as pool:
        for key, failure in zip(todo, pool.map(run, todo.values()), strict=True):
            if failure is None:
                kept.append(key)
            else:
                failed.append(failure)
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(sorted(kept)), encoding="utf-8")
    return failed, counted


def after_build(app: Any, exception: Exception | None) -> None:
    """Run the commands of all pages; one that fails is a warning."""
    from sphinx.util.logging import getLogger  # the suite imports this file without Sphinx

    if exception is not None or app.builder.name != "html":
        return
    pages = [*OTHERS, *(Path(app.env.doc2path(page)) for page in sorted(app.env.found_docs))]
    left_out: list[Path] = []
    if app.tags.has("portion"):
        import portion  # of `.ci`, which conf.py put on the path

        left_out = portion.left_out(pages)
    failed, counted = check(pages, RECORD, left_out)
    for block, said in failed:
        getLogger(__name__).warning(said, location=f"{block.page}:{block.line}")
    done = [f"{counted.pop(what, 0)} {what}" for what in ("run", "passed before")]
    why = ", ".join(f"{count} {what}" for what, count in counted.items())
    print(f"commands: {', '.join(done)}, {counted.total()} not run ({why})")


def setup(app: Any) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("build-finished", after_build)
    return {"parallel_read_safe": True}
