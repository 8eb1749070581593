"""The text of a `dataset.toml`: where a key is, and the text with other numbers in it."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

_Changes = Mapping[str, Mapping[str, Sequence[float]]]
"""numbers by section and key"""


def toml_lines(changes: _Changes, comments: Mapping[str, str] | None = None) -> str:
    """The changes as TOML, ready to paste. comments: by "section.key"."""
    told = comments or {}
    parts = []
    for section, keys in changes.items():
        lines = [
            f"{key} = {_list(numbers)}"
            + (f"  # {told[f'{section}.{key}']}" if f"{section}.{key}" in told else "")
            for key, numbers in keys.items()
        ]
        parts.append("\n".join([f"[{section}]", *lines]) + "\n")
    return "\n".join(parts)


def changed(path: Path, changes: _Changes) -> str:
    """The text of a file of settings with these numbers, else as it is; of no file, the fragment.

    A list of numbers that stands on one line is replaced, its comment stays; others are inserted
    below the head of their section, or at the end.

    Raises ValueError where the result would not read as asked.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return toml_lines(changes)
    before = tomllib.loads(text)
    lines = text.split("\n")
    for section, keys in changes.items():
        head = _head(lines, section)
        if head is None:
            lines = [*"\n".join(lines).rstrip("\n").split("\n"), ""]
            lines += toml_lines({section: keys}).split("\n")
            continue
        for key, numbers in keys.items():
            at = _find(lines, rf"\s*{key}\s*=", head + 1, _end(lines, head))
            if at is None:
                lines.insert(head + 1, f"{key} = {_list(numbers)}")
            else:
                lines[at] = re.sub(r"\[[^\]#]*\]", _list(numbers), lines[at], count=1)
    wanted = {name: dict(part) if isinstance(part, dict) else part for name, part in before.items()}
    for section, keys in changes.items():
        wanted[section] = (
            wanted.get(section, {}) | tomllib.loads(toml_lines({section: keys}))[section]
        )
    result = "\n".join(lines)
    try:
        good = tomllib.loads(result) == wanted
    except tomllib.TOMLDecodeError:
        good = False
    if not good:
        raise ValueError(f"{path}: cannot be changed line by line: paste fit.toml by hand")
    return result


def line_number(text: str, section: str, key: str) -> int | None:
    """The line, from 1, of a key in a section ("": at the top), or of the section, or None."""
    lines = text.split("\n")
    head = _head(lines, section) if section else -1
    if head is None:
        return None
    at = _find(lines, rf"\s*{re.escape(key)}\s*=", head + 1, _end(lines, head))
    if at is None and not section:  # a section that stands where none is known
        at = _head(lines, key)
    return None if at is None and head < 0 else (head if at is None else at) + 1


def _head(lines: Sequence[str], section: str) -> int | None:
    return _find(lines, rf"\s*\[\s*{re.escape(section)}\s*\]", 0, len(lines))


def _end(lines: Sequence[str], head: int) -> int:
    """The line after a section."""
    after = _find(lines, r"\s*\[", head + 1, len(lines))
    return len(lines) if after is None else after


def _list(numbers: Sequence[float]) -> str:
    return f"[{', '.join(f'{number:.4g}' for number in numbers)}]"


def _find(lines: Sequence[str], pattern: str, first: int, end: int) -> int | None:
    """The first line from `first` to `end` that begins with a pattern."""
    return next((i for i in range(first, end) if re.match(pattern, lines[i])), None)
