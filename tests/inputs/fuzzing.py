"""Inputs for readers that are almost right, and a watch on what reading them costs.

A file by a grammar is a few lines of known patterns, some of whose tokens are then replaced by odd
ones. Any reader must answer, or say in one line of ValueError where the file is wrong.
"""

import contextlib
import os
import re
import signal
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, settings

WIDE = int(os.environ.get("JAXSLAM_FUZZ", "1"))
"""How many times as many examples are tried, as by `JAXSLAM_FUZZ=50 make test-all`."""


def fuzz(examples):
    """Settings of a test with so many examples in the suite, the same in each run of it."""
    return settings(
        max_examples=examples * WIDE,
        deadline=None,
        derandomize=WIDE == 1,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


SECONDS, TIMES, CONSTANT = 10.0, 10, 2**25
"""Limits of one read: time, and memory as a multiple of the files and a constant [B]."""

_PROCESS = Path("/proc/self")


def _resident(field):
    """Memory of this process [B], now (`VmRSS`) or at most (`VmHWM`); 0 where the system has none."""
    try:
        text = (_PROCESS / "status").read_text()
    except OSError:
        return 0
    return 1024 * int(re.search(rf"{field}:\s+(\d+)", text)[1])


def watched(read, folder):
    """What a reader returns for a folder; fails beyond the limits of time and memory."""
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    with contextlib.suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5")  # the peak begins anew
    began = _resident("VmRSS")
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"above {SECONDS} s"))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        return read(folder)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        more = _resident("VmHWM") - began
        if more > TIMES * size + CONSTANT:
            pytest.fail(f"{more:,} bytes of memory for {size:,} bytes of files")


def assert_one_line(error, folder):
    """A message of one line that begins with the folder, or a file of it; returns what follows."""
    message = str(error)
    assert len(message.splitlines()) == 1, message
    assert re.match(re.escape(str(folder)) + r"(/[^:]+)?[:, ]", message), message
    return message.removeprefix(str(folder)).lstrip("/")


# --- bytes --------------------------------------------------------------------------------------

VALUES = st.one_of(
    st.sampled_from(b"0123456789.-+eE, \t\n\r#\"'[]=_/\x00\xff\xef"), st.integers(0, 255)
)
EDITS = st.lists(
    st.tuples(st.sampled_from("rids"), st.floats(0, 1, exclude_max=True), VALUES),
    min_size=1,
    max_size=3,
)
FLIPS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 7)), min_size=1, max_size=4
)


def edited(content, edits):
    """Bytes replaced, inserted and deleted, and lines repeated."""
    content = bytearray(content)
    for kind, where, value in edits:
        at = int(where * len(content))
        if kind == "i":
            content.insert(at, value)
        elif content and kind == "r":
            content[at] = value
        elif content and kind == "d":
            del content[at]
        elif content:  # a line twice
            begin = content.rfind(b"\n", 0, at) + 1
            end = (content.find(b"\n", at) + 1) or len(content)
            content[begin:begin] = content[begin:end]
    return bytes(content)


def flipped(content, flips):
    """Some bits of a content flipped."""
    content = bytearray(content)
    for where, bit in flips:
        content[int(where * len(content))] ^= 1 << bit
    return bytes(content)


# --- a grammar ----------------------------------------------------------------------------------

IDS = st.integers(0, 9).map(str)
NUMBERS = st.one_of(
    st.integers(-9, 9).map(str),
    st.floats(-4, 4).map(lambda value: f"{value:.4g}"),
    st.floats(0, 4).map(repr),
)
LONG = "9" * 5000
"""More digits than Python makes a whole number of."""
ODD = st.sampled_from(
    [
        *("", "nan", "inf", "-inf", "1e308", "-1e308", "1e400", "1e-320", "-0", "1_0", "٣", "0x1F"),
        *("4294967296", "-1", "2147483648", "99999999999999999999", "1e18", LONG, "9" * 400),
        *("é", "\0", "\u2028", "\ufeff", "\x0c", "\x1c", '"', "'", "#", "//", "..", "a b", "x" * 2**17 + "x"),
        *("[" * 3000, "{" * 3000, "[]", "{}", "[[1]]", "[1, 2, 3]", "true", "null", "a.b = 1", "{x = 1}"),
        *("1979-05-27", "[motion]", "[[motion]]", "&a", "*a", "!!python/none", "? ", "- ", "|", "%YAML"),
    ]
)  # fmt: skip


@st.composite
def line(draw, pattern):
    """A line of a pattern: `i` becomes an identity, `x` a number, `*` a few numbers."""
    words = []
    for word in pattern.split():
        if word == "*":
            words += draw(st.lists(NUMBERS, max_size=4))
        else:
            words.append(draw({"i": IDS, "x": NUMBERS}.get(word, st.just(word))))
    return " ".join(words)


@st.composite
def lines(draw, *patterns, head=""):
    """A text of up to a dozen lines of some patterns."""
    body = draw(st.lists(st.sampled_from(patterns).flatmap(line), max_size=12))
    return head + "".join(f"{one}\n" for one in body)


@st.composite
def records(draw, head, *kinds):
    """A CSV file with a header, and rows whose times rise."""
    rows = []
    for k in range(draw(st.integers(0, 8))):
        cells = [draw({"i": IDS, "x": NUMBERS, "t": st.just(f"{0.5 * k:g}")}[one]) for one in kinds]
        rows.append(",".join(cells))
    return "\n".join([head, *rows]) + "\n"


@st.composite
def odd(draw, text, token=r"[\w.+-]+|[^\w\s]|\s+"):
    """A text with up to three of its tokens replaced by odd ones, dropped, or repeated."""
    parts = re.findall(token, text)
    for _ in range(draw(st.integers(0, 3))):
        if not parts:
            break
        at = draw(st.integers(0, len(parts) - 1))
        how = draw(st.sampled_from(["odd", "odd", "odd", "drop", "twice", "other"]))
        if how == "other":
            parts[at] = parts[draw(st.integers(0, len(parts) - 1))]
        else:
            parts[at] = {"drop": "", "twice": 2 * parts[at]}.get(how) or (
                draw(ODD) if how == "odd" else ""
            )
    return "".join(parts)
