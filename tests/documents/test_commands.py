"""The extension that runs the commands of pages, on toy pages whose commands are the shell's."""

import importlib.util
import re
import sys

import pytest
from test_docs import PAGES, ROOT

EXTENSIONS = ROOT / "docs" / "_ext"


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """The extension, with a data folder in which there is a log."""
    monkeypatch.syspath_prepend(EXTENSIONS)
    spec = importlib.util.spec_from_file_location("commands", EXTENSIONS / "commands.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "commands", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "DATA", tmp_path / "logs")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "log.txt").write_text("a log\n")
    return module


TOY = """# A page

```console
$ echo one > file
$ test -e file && \\
    echo two >> file
said by the command
```

Later blocks find what earlier ones have written.

<!-- run: FILE=file LINES=2 -->
```console
$ test $(cat FILE | wc -l) = LINES
```

<!-- run: LOG=data/log.txt -->
```console
$ cat LOG
```

<!-- run: exit=3 -->
```console
$ exit 3
```

<!-- not run: takes a year -->
```console
$ false
```
"""
FAILS = """# Another

```console
$ echo it went wrong
$ false
$ echo never said
```
"""


def test_what_passes_is_run_once_and_what_fails_is_told_with_its_place(commands, tmp_path):
    good, bad, record = tmp_path / "good.md", tmp_path / "bad.md", tmp_path / "record.json"
    good.write_text(TOY)
    bad.write_text(FAILS)
    ((block, said),), counted = commands.check([good, bad], record)
    assert (block.page, block.line) == (bad, 3)
    assert "exit status 1, not 0" in said
    assert "\nit went wrong\n" in said
    assert "never said" not in said
    assert counted == {"run": 5, "takes a year": 1}

    bad.write_text(FAILS.replace("false", "true"))
    failed, counted = commands.check([good, bad], record)
    assert failed == []
    assert counted == {"passed before": 4, "run": 1, "takes a year": 1}

    good.write_text(TOY.replace("$ exit 3", "$ exit 4"))
    ((block, said),), _ = commands.check([good, bad], record)
    assert block.line == TOY[: TOY.index("<!-- run: exit")].count("\n") + 1
    assert "exit status 4, not 3" in said


def test_without_data_a_command_that_needs_them_is_counted(commands, monkeypatch, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(TOY)
    monkeypatch.setattr(commands, "DATA", tmp_path / "nowhere")
    failed, counted = commands.check([page], tmp_path / "record.json")
    assert failed == []
    assert counted == {"run": 3, "no data": 1, "takes a year": 1}


def test_what_is_run_again_after_a_change_of_the_code(commands):
    """That which reaches it: a script what it calls, a command what it can call."""
    (script,) = (
        group
        for group in commands.groups(ROOT / "docs" / "gallery.md")
        if group and "scenarios/circle.py" in group[0].script
    )
    assert script[0].script == "python examples/gallery/scenarios/circle.py"
    (verify,) = commands.groups(ROOT / "README.md")
    before = commands.digest(script), commands.digest(verify[-1:])

    def changed(name):
        """Which of the two has another digest where a file of the package does something else."""
        content = commands.executed.content
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                commands.executed,
                "content",
                lambda path: content(path) + b"!" * path.match(f"jaxslam/{name}"),
            )
            after = commands.digest(script), commands.digest(verify[-1:])
        return [one != other for one, other in zip(before, after, strict=True)]

    assert changed("simulation/scenarios/_published.py") == [True, False]
    assert changed("verify/_verifier.py") == [False, True]
    assert changed("_cli/recorded/slam.py") == [False, False]


def test_each_block_is_a_directive_or_is_run(commands):
    """Else it would be read by no one: a block of no language, or of another shell's name.

    An indented fence, or one of other characters, is refused: no one would find its block.
    """
    shown = {("README.md", "python"), ("CONTRIBUTING.md", "text")}
    shown |= {("docs/guide/judge.md", "text"), ("docs/guide/judge.md", "cpp")}
    for page, text in PAGES.items():
        kinds = re.findall(r"^```(.*)\n(?:.*\n)*?```$", text, re.MULTILINE)
        others = {(page, kind) for kind in kinds if not re.match(r"console$|\{[\w-]+\}", kind)}
        assert others <= shown
        fences = [line for line in text.split("\n") if re.search(r"```|~~~|^\s*:::", line)]
        assert [line for line in fences if not re.fullmatch(r"```[^`]*", line)] == [], page
        assert len(fences) == 2 * len(kinds), page
        assert all(block.script for group in commands.groups(ROOT / page) for block in group)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("$ false | cat", "exit status 1, not 0"),
        ("$ python -c 'int([])' || true", "a traceback of Python"),
    ],
)
def test_a_failure_that_the_exit_status_of_a_line_hides_is_told(commands, tmp_path, script, said):
    page = tmp_path / "page.md"
    page.write_text(f"```console\n{script}\n```\n")
    ((_, told),), _ = commands.check([page], tmp_path / "record.json")
    assert said in told


def test_a_block_without_a_command_is_refused(commands, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n```console\njaxslam verify\n```\n")
    with pytest.raises(ValueError, match=r"page\.md:3: no line of the block begins with `\$ `"):
        commands.check([page], tmp_path / "record.json")


def test_what_is_marked_exists(commands):
    """A mark stands right above a block, and its words are words of it."""
    for page, text in PAGES.items():
        marks = re.findall(r"^<!-- (?:not )?run: ", text, re.MULTILINE)
        above = [found for found in commands.SHOWN.finditer(text) if found["how"]]
        assert len(marks) == len(above), page
        for found in above:
            if found["how"] == "run":
                words = [word.partition("=")[0] for word in found["said"].split()]
                assert all(word in found["body"] for word in words if word not in commands.KEYS), (
                    page,
                    found["said"],
                )
