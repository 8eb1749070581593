"""A file of settings by a schema: one loop reads its keys, checks them and notes the defaults."""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core._numbers import is_number
from jaxslam.core._units import TURN
from jaxslam.core.validation import Check, InvalidFile
from jaxslam.math._definite import is_asymmetric, is_indefinite

REQUIRED: Any = object()
"""The default of a key that has none."""

_LARGEST_DEVIATION = 1.0
"""[rad] standard deviation of an angle above which it says nearly nothing, and may be of degrees"""


def anything(value: Any, names: Sequence[str]) -> Any:
    """The kind of a value that its check alone restricts."""
    return value


class Key(NamedTuple):
    """A key of a section of the settings."""

    name: str
    kind: Callable[[Any, Sequence[str]], Any] = anything
    """(value in the file, `names`) -> value; raises ValueError with the reason"""
    names: tuple[str, ...] | None = ()
    """of its numbers, with units; None: of the model, `names` of the context"""
    default: Any = None
    """or a function of the context, to which the values of the keys before it belong"""
    check: Check | None = None
    note: bool | str = False
    """whether its default is noted, or the note after the key"""
    of: Callable[[Any], bool] | None = None
    """whether a model has the key; None: each has"""


# --- kinds and checks ---------------------------------------------------------------------------


def numbers(value: Any, names: Sequence[str]) -> list[float]:
    """The kind of a finite number for each name; a single one may stand without a list."""
    if len(names) == 1 and is_number(value):
        value = [value]
    if not isinstance(value, list) or len(value) != len(names) or not all(map(is_number, value)):
        expected = f"{len(names)} number{'s' * (len(names) > 1)} ({', '.join(names)})"
        raise ValueError(f"expected {expected}, got {value!r}")
    return [float(entry) for entry in value]


def number(value: Any, names: Sequence[str]) -> float:
    """The kind of one finite number."""
    return numbers(value, names)[0]


def rows(value: Any, names: Sequence[str]) -> np.ndarray:
    """The kind of a matrix, with a row and a column for each name."""
    if not isinstance(value, list) or len(value) != len(names):
        raise ValueError(f"expected {len(names)} rows of numbers ({', '.join(names)})")
    return np.array([numbers(row, names) for row in value])


def some_names(value: Any, names: Sequence[str]) -> list[str]:
    """The kind of a list of at least one of the names."""
    if not isinstance(value, list) or not value or not all(name in names for name in value):
        raise ValueError(f"expected some of {', '.join(names) or 'none'}, got {value!r}")
    return value


def not_negative(value: float | list[float]) -> None:
    """The check of a number, or of a list of numbers, >= 0."""
    if np.min(value) < 0:
        expected = "numbers" if isinstance(value, list) else "a number"
        raise ValueError(f"expected {expected} >= 0, got {value}")


def covariance(value: np.ndarray) -> None:
    """The check of a covariance, which may be written with six digits."""
    if is_asymmetric(value, 1e-6) or is_indefinite(value, 1e-6):
        raise ValueError("expected a covariance")


# --- notes --------------------------------------------------------------------------------------


def as_toml(value: Any) -> Any:
    """A default as in TOML: text in quotes, lists in place of tuples, six digits."""
    if isinstance(value, tuple | list):
        return [as_toml(part) for part in value]
    if isinstance(value, str):
        return f'"{value}"'
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _degree_notes(place: str, values: Sequence[float], names: Sequence[str]) -> Iterator[str]:
    """Notes on angles that seem to be in degrees. place: the section and the key."""
    for name, value in zip(names, values, strict=True):
        shown, hint = f"{place}: {name} = {value:g} is", "degrees? write radians"
        if "[rad]" in name and abs(value) > TURN:
            yield f"{shown} beyond 2π: {hint}"
        elif "[rad]" in name and value > _LARGEST_DEVIATION and place.endswith(" noise"):
            yield f"{shown} a standard deviation of {np.rad2deg(value):.3g}°: {hint}"


# --- the file -----------------------------------------------------------------------------------


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    """The text and the content of a file of settings; empty without a file."""
    try:
        content = path.read_text(encoding="utf-8")
        return content, tomllib.loads(content)
    except FileNotFoundError:
        return "", {}
    except tomllib.TOMLDecodeError as problem:
        # Before Python 3.14 only the text has the line: "… (at line 3, column 7)".
        reason, line = str(problem), content.count("\n") + 1
        if place := re.search(r" \(at line (\d+), column \d+\)$", reason):
            reason, line = reason[: place.start()], int(place[1])
        raise InvalidFile(path, f"expected TOML: {reason}", line) from problem
    except RecursionError as problem:
        raise InvalidFile(path, "expected TOML, got brackets in brackets") from problem
    except (OSError, ValueError) as problem:  # not text, or a whole number of over 4,300 digits
        raise InvalidFile(path, f"cannot be read: {problem}") from problem


def _line_number(content: str, section: str, key: str) -> int | None:
    """The line, from 1, of a key in a section ("": at the top), or of the section, or None."""
    current, heading_line = "", None
    for line, row in enumerate(content.split("\n"), 1):
        if heading := re.match(r"\s*\[\s*(\w+)\s*\]", row):
            current = heading[1]
            if heading_line is None and current == (section or key):
                heading_line = line
        elif current == section and re.match(rf"\s*{re.escape(key)}\s*=", row):
            return line
    return heading_line


class SettingsFile:
    """The settings in a file, by a schema: the keys of each section, "" for those at the top.

    A second file beside it, if there is one, replaces values of it. `assumed` lists that, and the
    defaults taken so far. Raises InvalidFile on a file that is not TOML, and on an unknown section.
    """

    def __init__(
        self, path: Path, schema: Mapping[str, tuple[Key, ...]], beside: str | None = None
    ) -> None:
        self.path = path
        self.keys = dict(schema)
        self.content: dict[str, Any] = {}
        self.assumed: list[str] = [] if path.exists() else [f"no {path.name}"]
        self._texts: dict[Path, str] = {}
        self._file_of: dict[tuple[str, str], Path] = {}
        """the file of a key, where it is not `path`"""
        at_top = [*(key.name for key in schema[""]), *filter(None, schema)]
        for file in (path, path.with_name(beside)) if beside else (path,):
            self._texts[file], content = _read(file)
            for name, value in sorted(content.items()):
                self._file_of["", name] = file
                if name not in at_top:
                    raise self.error("", name, f"expected one of {', '.join(at_top)}")
                if name not in schema:
                    self.content[name] = value
                    continue
                if not isinstance(value, dict):
                    raise self.error("", name, f"expected a section [{name}]")
                self.content[name] = self.content.get(name, {}) | value
                self._file_of |= dict.fromkeys(((name, key) for key in value), file)
                if file != path:
                    self.assumed.append(f"[{name}] {', '.join(value)} of {beside}")

    def error(self, section: str, key: str, reason: str) -> InvalidFile:
        """An InvalidFile about a key, for the caller to raise."""
        path = self._file_of.get((section, key), self.path)
        line = _line_number(self._texts[path], section, key)
        return InvalidFile(path, reason, line, f"[{section}] {key}" if section else key)

    def stated(self, section: str) -> dict[str, Any]:
        """The values in the file of a section, unchecked."""
        values: dict[str, Any] = self.content.get(section, {})
        return values

    def refuse_unknown(self, section: str, of: str = "") -> None:
        """Raise InvalidFile on a key that a section does not have. of: where its keys are from."""
        names = [key.name for key in self.keys[section]]
        for name in self.stated(section):
            if name not in names:
                raise self.error(section, name, f"expected one of {', '.join(names)}{of}")

    def read(self, section: str, *chosen: str, **context: Any) -> dict[str, Any]:
        """The values of some keys of a section, in the order of the schema, checked.

        A key that is missing has its default, which is noted.

        context: of the log and the models, what the schema needs for names and defaults.
        """
        stated = self.stated(section) if section else self.content
        values: dict[str, Any] = {}
        for key in self.keys[section]:
            if key.name not in chosen:
                continue
            names = context["names"] if key.names is None else key.names
            place = f"[{section}] {key.name}"
            try:
                if key.name in stated or key.default is REQUIRED:
                    value = key.kind(stated.get(key.name), names)
                    if key.check is not None:
                        key.check(value)
                    if key.kind is numbers:
                        self.assumed += _degree_notes(place, value, names)
                else:
                    is_rule = callable(key.default)
                    value = key.default(context | values) if is_rule else key.default
                    shown = ": none" if value is None else f" = {as_toml(value)}"
                    shown += f" ({', '.join(names)})" * (key.names is None)
                    if key.note:
                        self.assumed.append(place + (key.note if key.note is not True else shown))
            except ValueError as problem:
                raise self.error(section, key.name, str(problem)) from problem
            values[key.name] = value
        return values
