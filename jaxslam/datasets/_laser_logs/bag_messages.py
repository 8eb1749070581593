"""Messages of a ROS bag by the library `rosbags`: only here is it imported."""

import math
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from jaxslam.core._optional import loading

TRANSFORMS = ("tf2_msgs/TFMessage", "tf/tfMessage")


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    """as `sensor_msgs/LaserScan`; `several types` if its publishers differ"""
    count: int
    """number of messages"""


class Bag:
    """An open bag: its topics, and the messages of some of them."""

    def __init__(self, path: Path, reader: Any, types: Any, notes: list[str]) -> None:
        self.path = path
        self.notes = notes
        """on parts of the recording that are in other files"""
        self._reader = reader
        self._types = types
        self.topics = tuple(
            Topic(name, (of.msgtype or "several types").replace("/msg/", "/"), of.msgcount)
            for name, of in sorted(reader.topics.items())
        )
        """by name"""
        has_messages = any(topic.count for topic in self.topics)
        self.start = reader.start_time * 1e-9 if has_messages else math.nan
        """start of the recording [s]"""
        self.end = reader.end_time * 1e-9 if has_messages else math.nan

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, time of the recording [ns], message) of the named topics, in that order of time.

        Raises ValueError, with the file, if a message cannot be read, or lacks a field of ROS.
        """
        connections = [
            connection for connection in self._reader.connections if connection.topic in names
        ]
        if not connections:
            return
        for connection in connections:
            if field := self._missing_field(connection.msgtype):
                raise self.error(
                    f"{connection.topic}: expected the messages of ROS, without {field}"
                )
        raw_messages = self._reader.messages(connections)
        count = 0
        while True:
            try:
                connection, recorded, data = next(raw_messages)
                message = self._reader.deserialize(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as problem:  # of SQLite, zstd, struct, … where a bag is damaged
                raise _bag_error(
                    self.path, problem, f" after {count:,} messages of {', '.join(sorted(names))}"
                ) from problem
            count += 1
            yield connection.topic, recorded, message

    def first(self, name: str) -> Any:
        """The first message of a topic; raises ValueError, with the file, if it has none."""
        first = next(self.messages([name]), None)
        if first is None:
            raise self.error(f"{name}: expected messages, as the index of the bag says, got none")
        return first[2]

    def _missing_field(self, name: str) -> str | None:
        """A type of ROS that the bag does not define, or a field that it defines otherwise."""
        if name not in self._types.fielddefs:  # no type of ROS 2, as tf/tfMessage
            return None
        if name not in self._reader.typestore.fielddefs:
            return name.replace("/msg/", "/")
        bag_fields = dict(self._reader.typestore.fielddefs[name][1])
        for field, kind in self._types.fielddefs[name][1]:
            if bag_fields.get(field) != kind:
                return f"{name}/{field}".replace("/msg/", "/")
            while isinstance(kind[1][0], tuple):  # of an array
                kind = kind[1][0]
            if isinstance(kind[1], str) and (field := self._missing_field(kind[1])):
                return field
        return None

    def error(self, reason: str) -> ValueError:
        """A ValueError about the bag, for the caller to raise."""
        return ValueError(f"{self.path}: {_one_line(reason)}")


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """The bag in a file (ROS 1 `.bag`, ROS 2 `.mcap` or `.db3`), in a folder of ROS 2, or in the
    parts of a recording that are alone in a folder.

    Raises ValueError if `rosbags` cannot be used, and, with the file, if the bag cannot be read.
    """
    with loading("rosbag", "rosbags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        # Bags of ROS 2 before Iron have no definitions; those of these types are equal in all.
        types = get_typestore(Stores.ROS2_HUMBLE)
    path = Path(path)
    files, notes = _parts(path)
    try:
        reader = AnyReader(files, default_typestore=types)
        reader.open()
    except Exception as problem:  # of SQLite, zstd, struct, … where a bag is damaged
        raise _bag_error(path, problem) from problem
    try:
        # Each part of a recording begins about when the part before it ends.
        order = sorted(range(len(files)), key=lambda k: reader.readers[k].start_time)
        for before, after in pairwise(order):
            pause = (reader.readers[after].start_time - reader.readers[before].end_time) * 1e-9
            if not -_OVERLAP <= pause <= _PAUSE:
                raise ValueError(
                    f"{path}: expected parts of one recording, and {files[after].name} begins "
                    f"{abs(pause):,.1f} s {'after' if pause > 0 else 'before'} "
                    f"{files[before].name} ends; name one of them"
                )
        yield Bag(path, reader, types, notes)
    finally:
        reader.close()


_SPLIT = re.compile(r"(.*?)(?:[_-]?\d{4}(?:-\d\d){5})?_(\d+)")
"""Name of a part, NAME_0; `rosbag record --split` puts the time of its start before the number."""
_SUFFIXES = ".bag", ".mcap", ".db3"
_PAUSE, _OVERLAP = 60.0, 5.0
"""Time between two parts of a recording, and overlap of them, at most [s]."""


def _parts(path: Path) -> tuple[list[Path], list[str]]:
    """The files to read as one recording, and notes on parts that are not among them.

    They are the path itself, or the bags in a folder without `metadata.yaml`: one, or parts of the
    same name. Raises ValueError, with the folder, on bags of several names.
    """
    if not path.exists() or (path / "metadata.yaml").exists():
        return [path], []
    folder, kinds = (path, _SUFFIXES) if path.is_dir() else (path.parent, (path.suffix,))
    names: dict[tuple[str, str], dict[int, Path]] = {}
    files = sorted(file for file in folder.iterdir() if file.suffix in kinds and file.is_file())
    for file in files:
        if split := _SPLIT.fullmatch(file.stem):
            names.setdefault((split[1], file.suffix), {})[int(split[2])] = file
    if path.is_file():
        others = [
            file.name
            for parts in names.values()
            if path in parts.values()
            for file in parts.values()
            if file != path
        ]
        note = (
            f"{path.name} is read alone; beside it may be other parts of the recording, which the "
            f"folder reads as one: {', '.join(others[:9])}" + ", …" * (len(others) > 9)
        )
        return [path], [note] * bool(others)
    if len(files) <= 1:
        return files or [path], []
    parts = next(iter(names.values()), {})
    if len(names) != 1 or len(parts) < len(files):
        raise ValueError(
            f"{path}: expected one bag, or the parts NAME_0.bag, NAME_1.bag, … of a recording, got "
            f"{', '.join(file.name for file in files)}; name one of them"
        )
    notes = [f"one recording of {len(parts)} files, {', '.join(file.name for file in files[:9])}"]
    if missing := sorted(set(range(max(parts))) - set(parts)):
        notes.append(f"parts that are missing in the folder: {', '.join(map(str, missing))}")
    return [parts[number] for number in sorted(parts)], notes


def is_bag(path: str | Path) -> bool:
    """Whether a path is that of a bag: a folder, or a file .bag, .mcap or .db3."""
    return Path(path).is_dir() or Path(path).suffix in _SUFFIXES


def _bag_error(path: Path, problem: Exception, where: str = "") -> ValueError:
    """The error on a bag that is damaged, or on a file that is no bag."""
    if isinstance(problem, FileNotFoundError):
        missing = "metadata.yaml" if path.is_dir() else "file"
        return ValueError(f"{path}: cannot be read: no such {missing}")
    reason = _one_line(str(problem)) or type(problem).__name__
    return ValueError(f"{path}: cannot be read as a ROS bag{where}: {reason}")


def _one_line(text: str) -> str:
    """A text that may quote a bag, without breaks of lines."""
    return " ".join(text.split())
