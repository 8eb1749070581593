"""Messages of a ROS bag by the library `rosbags`: only here is it imported."""

import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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

    def __init__(self, path: Path, reader: Any, types: Any) -> None:
        self.path = path
        self._reader = reader
        self._types = types
        self.topics = tuple(
            Topic(name, (of.msgtype or "several types").replace("/msg/", "/"), of.msgcount)
            for name, of in sorted(reader.topics.items())
        )
        """by name"""
        some = any(topic.count for topic in self.topics)
        self.start = reader.start_time * 1e-9 if some else math.nan
        """of the recording [s]"""
        self.end = reader.end_time * 1e-9 if some else math.nan

    def messages(self, names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, time of the recording [ns], message) of the named topics, in that order of time.

        Raises ValueError, with the file, if one cannot be read, or lacks a field that ROS gives it.
        """
        connections = [each for each in self._reader.connections if each.topic in names]
        if not connections:
            return
        for each in connections:
            if field := self._lacking(each.msgtype):
                raise self.error(f"{each.topic}: expected the messages of ROS, without {field}")
        found = self._reader.messages(connections)
        count = 0
        while True:
            try:
                connection, recorded, data = next(found)
                message = self._reader.deserialize(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as problem:  # of SQLite, zstd, struct, … where a bag is damaged
                raise _unreadable(
                    self.path, problem, f" after {count:,} messages of {', '.join(sorted(names))}"
                ) from problem
            count += 1
            yield connection.topic, recorded, message

    def first(self, name: str) -> Any:
        """The first message of a topic; raises ValueError, with the file, if it has none."""
        found = next(self.messages([name]), None)
        if found is None:
            raise self.error(f"{name}: expected messages, as the index of the bag says, got none")
        return found[2]

    def _lacking(self, name: str) -> str | None:
        """A type of ROS that the bag does not define, or a field that it defines otherwise."""
        if name not in self._types.fielddefs:  # no type of ROS 2, as tf/tfMessage
            return None
        if name not in self._reader.typestore.fielddefs:
            return name.replace("/msg/", "/")
        own = dict(self._reader.typestore.fielddefs[name][1])
        for field, kind in self._types.fielddefs[name][1]:
            if own.get(field) != kind:
                return f"{name}/{field}".replace("/msg/", "/")
            while isinstance(kind[1][0], tuple):  # of an array
                kind = kind[1][0]
            if isinstance(kind[1], str) and (found := self._lacking(kind[1])):
                return found
        return None

    def error(self, reason: str) -> ValueError:
        """A ValueError about the bag, for the caller to raise."""
        return ValueError(f"{self.path}: {_one_line(reason)}")


@contextmanager
def opened(path: str | Path) -> Iterator[Bag]:
    """The bag in a file (ROS 1 `.bag`, ROS 2 `.mcap` or `.db3`) or in a folder of ROS 2.

    Raises ValueError if `rosbags` cannot be used, and, with the file, if the bag cannot be read.
    """
    with loading("rosbag", "rosbags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        # Bags of ROS 2 before Iron have no definitions; those of these types are equal in all.
        types = get_typestore(Stores.ROS2_HUMBLE)
    path = Path(path)
    try:
        reader = AnyReader([path], default_typestore=types)
        reader.open()
    except Exception as problem:  # of SQLite, zstd, struct, … where a bag is damaged
        raise _unreadable(path, problem) from problem
    try:
        yield Bag(path, reader, types)
    finally:
        reader.close()


def is_bag(path: str | Path) -> bool:
    """Whether a path is that of a bag: a folder, or a file .bag, .mcap or .db3."""
    return Path(path).is_dir() or Path(path).suffix in (".bag", ".mcap", ".db3")


def _unreadable(path: Path, problem: Exception, where: str = "") -> ValueError:
    """The error on a bag that is damaged or none."""
    if isinstance(problem, FileNotFoundError):
        what = "metadata.yaml" if path.is_dir() else "file"
        return ValueError(f"{path}: cannot be read: no such {what}")
    reason = _one_line(str(problem)) or type(problem).__name__
    return ValueError(f"{path}: cannot be read as a ROS bag{where}: {reason}")


def _one_line(text: str) -> str:
    """A text that may quote a bag, without breaks of lines."""
    return " ".join(text.split())
