"""Reader and writer of occupancy grids in the format of ROS: a YAML file and an image.

Grey images are PGM, P5 (binary) and P2 (text), read here; PNG and BMP are read by Matplotlib.
"""

import io
import math
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

from jaxslam.core.validation import InvalidField, InvalidFile, one_of, refusals_of, require
from jaxslam.datasets._lines import DIGITS, TextFile, read_bytes
from jaxslam.laser.grids._grid import Grid, grid_map
from jaxslam.results._files import Files, write_files

_PGM = re.compile(rb"(P[25])" + 3 * rb"(?:\s|#[^\n]*\n)+([^\s#]+)" + rb"\s")
"""The head of a PGM file: kind, width, height and largest shade, with comments between."""

_BY_MATPLOTLIB = {b"\x89PNG": "png", b"BM": "bmp"}


def _read_shades(path: Path) -> NDArray[np.float64]:
    """The shades of an image (rows, columns), 0 black to 1 white; the first row is at the top.

    A colour counts as the mean of its three channels, as in `map_server`.

    Raises ValueError, `path: reason`, on a file that is damaged or of another format, and on an
    image with transparent pixels.
    """
    path, data = read_bytes(path)
    for begin, form in _BY_MATPLOTLIB.items():
        if data.startswith(begin):
            return _by_matplotlib(path, data, form)
    head = _PGM.match(data)
    if head is None:
        raise ValueError(f"{path}: expected an image in PGM (P5 or P2), PNG or BMP")
    width, height, top = _integers(path, head.groups()[1:])
    if width < 1 or height < 1 or not 1 <= top <= 65535:
        raise ValueError(
            f"{path}: expected an image of at least 1 × 1 with a largest shade of 1 to 65535, "
            f"got {width} × {height} with {top}"
        )
    count, body = width * height, data[head.end() :]
    if head[1] == b"P2":
        words = re.sub(rb"#[^\n]*", b"", body).split()[:count]
        if len(words) < count:
            raise ValueError(f"{path}: the image ends after {len(words)} of {count} numbers")
        levels = np.array(_integers(path, words))
    else:
        kind = np.dtype(np.uint8 if top < 256 else ">u2")  # two bytes, the high one first
        size = count * kind.itemsize
        if len(body) < size:
            raise ValueError(f"{path}: the image ends after {len(body)} of {size} bytes")
        levels = np.frombuffer(body[:size], kind)
    if levels.max() > top:
        raise ValueError(f"{path}: a shade of {levels.max()} is above the largest, {top}")
    return np.asarray(levels.reshape(height, width) / top, np.float64)


def _integers(path: Path, words: Sequence[bytes]) -> list[int]:
    """The whole numbers of words; ValueError on any other word."""
    for word in words:
        if not word.isdigit() or len(word) > DIGITS:
            shown = word[: DIGITS + 1].decode("latin-1")
            raise ValueError(f"{path}: expected a whole number, got {shown!r}")
    return [int(word) for word in words]


def _by_matplotlib(path: Path, data: bytes, form: str) -> NDArray[np.float64]:
    """The shades of a PNG or BMP image, as of `_read_shades`."""
    # Slow to load, and most commands read no image; `plot` loads it whatever the user's backend is.
    import jaxslam.results.plot  # noqa: F401

    # isort: split
    import matplotlib.image

    try:
        image = np.asarray(matplotlib.image.imread(io.BytesIO(data), format=form))
    except (OSError, SyntaxError, ValueError) as problem:
        raise ValueError(f"{path}: expected a {form.upper()} image: {problem}") from problem
    if np.issubdtype(image.dtype, np.integer):
        image = image / np.iinfo(image.dtype).max
    image = image.astype(np.float64).reshape(*image.shape[:2], -1)
    # Grey, grey and opacity, three colours, or three colours and opacity.
    colours = image.shape[2] - (image.shape[2] in (2, 4))
    if np.any(image[..., colours:] < 1):
        raise ValueError(f"{path}: expected an image that is opaque everywhere")
    return np.asarray(image[..., :colours].mean(axis=2))


CERTAIN = math.log(509.0)
"""Log-odds of an occupied cell: p = 1 - ε with ε half a level of grey, 0.5/255."""

_REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_MODES = ("trinary", "scale")
_Value = TypeVar("_Value")
_UNKNOWN = 205
"""The shade of unknown cells: p = 50/255 is between the usual thresholds."""


def read_map(path: str | Path) -> Grid:
    """The occupancy grid in a map file of ROS, `NAME.yaml` with its image; arrays are NumPy's.

    | key | meaning |
    |---|---|
    | `image` | a PGM (P5 or P2), PNG or BMP file, relative to the folder of the YAML file |
    | `resolution` | side of a cell [m] |
    | `origin` | [x, y, yaw], pose of the lower left corner of the lower left cell [m, m, rad] |
    | `negate` | 0: dark is occupied, p = 1 - shade; 1: p = shade; shade in [0, 1] |
    | `occupied_thresh`, `free_thresh` | above, below which p a cell is occupied, free |
    | `mode` | `trinary` (default): all else is unknown; `scale`: all else is in between |

    Another key, as `map_type`, is named in a warning. Shades have 8 or 16 bits; a colour counts as
    the mean of its channels.

    An occupied cell gets log-odds of ln 509 (p = 1 - 0.5/255, half a level of grey), a free one the
    negative of it, an unknown one 0. In mode `scale` a cell between the thresholds has the
    probability (p - free_thresh)/(occupied_thresh - free_thresh), bounded in the same way.

    Source: the map format of the ROS package `map_server`, wiki.ros.org/map_server.

    Raises:
        ValueError: `path:line: reason` for what is not YAML, a key that is missing or occurs twice,
            a resolution that is not above 0, an invalid origin, thresholds out of order, a
            mode `raw`, and an image that is missing, transparent, of another format, or damaged.
    """
    head = _Header(path)
    resolution = head.number("resolution")
    if not resolution > 0:
        raise head.error("resolution", f"expected a resolution above 0, got {resolution:g}")
    origin = head.numbers("origin", ("x", "y", "yaw"))
    occupied, free = head.number("occupied_thresh"), head.number("free_thresh")
    if not 0 <= free < occupied <= 1:
        raise head.error(
            "occupied_thresh",
            f"expected 0 <= free_thresh < occupied_thresh <= 1, got {free:g} and {occupied:g}",
        )
    negate = head.choice("negate", {"0": False, "1": True, "false": False, "true": True})
    mode = head.choice("mode", dict(zip(_MODES, _MODES, strict=True)), "trinary")
    image = head.file.path.parent / head.text("image")
    if not os.path.isfile(image):  # Path.is_file raises on a name that is too long
        raise head.error("image", f"no image {image}")
    shade = _read_shades(image)
    p = shade if negate else 1.0 - shade
    between = np.full(p.shape, 0.5) if mode == "trinary" else (p - free) / (occupied - free)
    p = np.where(p > occupied, 1.0, np.where(p < free, 0.0, between))
    return Grid(_log_odds(p)[::-1].copy(), np.array(origin), np.array(resolution))


def write_map(path: str | Path, grid: Grid, *, mode: str = "trinary") -> list[Path]:
    """Write a grid as a ROS map, `NAME.yaml` and `NAME.pgm`; returns their paths.

    Mode `trinary` has black, white and grey 205 for log-odds above, below and equal to 0: what was
    read from a trinary map is read again as the same numbers. Mode `scale` has the probability in
    255 levels, or in 254, of which one is ½, where that alone gives the same grid again or where
    cells are unknown; its thresholds are 1 and 0. Either both files are written or none.

    Raises ValueError on a grid that is none, another mode, and a path that does not end in .yaml.
    """
    path = Path(path)
    if path.suffix != ".yaml" or path.stem == "":
        raise InvalidField("path", f"expected NAME.yaml, got {path}", owner="write_map")
    return write_files(path.parent, map_files(path.stem, grid, mode))


def map_files(stem: str, grid: Grid, mode: str = "trinary") -> Files:
    """The map file STEM.yaml and its image STEM.pgm, for `write_files`."""
    with refusals_of("write_map"):
        require("grid", grid, grid_map)
        require("mode", mode, one_of(*_MODES))
    log_odds = np.asarray(grid.log_odds, np.float64)[::-1]
    if mode == "trinary":
        occupied, free = 0.65, 0.196  # as `map_saver` of ROS writes them
        image = np.where(log_odds > 0, 0, np.where(log_odds < 0, 254, _UNKNOWN))
        levels = 255
    else:
        occupied, free = 1.0, 0.0
        image, levels = _levels(log_odds)
    numbers = ", ".join(repr(float(value)) for value in np.asarray(grid.origin))
    name = f"{stem}.pgm"
    # YAML needs quotes unless a text has letters, digits and a few signs alone.
    if not (name[0].isalnum() and all(sign.isalnum() or sign in " ._-/" for sign in name)):
        name = "'" + name.replace("'", "''") + "'"
    text = (
        f"image: {name}\nmode: {mode}\nresolution: {float(grid.resolution)!r}\n"
        f"origin: [{numbers}]\nnegate: 0\noccupied_thresh: {occupied}\nfree_thresh: {free}\n"
    )
    height, width = image.shape  # the first row is on top
    pgm = f"P5\n{width} {height}\n{levels}\n".encode() + image.astype(np.uint8).tobytes()
    return {f"{stem}.yaml": text, f"{stem}.pgm": pgm}


def _log_odds(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """The log-odds log p/(1-p), within ±CERTAIN; exactly 0 at ½."""
    within = np.clip(p, 0.5 / 255, 1.0 - 0.5 / 255)
    # The two logarithms of a library need not cancel exactly at ½.
    log_odds = np.where(p == 0.5, 0.0, np.log(within) - np.log1p(-within))
    return np.where(within > p, -CERTAIN, np.where(within < p, CERTAIN, log_odds))


def _levels(log_odds: NDArray[np.float64]) -> tuple[NDArray[np.int64], int]:
    """The image of a grid in shades, and the largest shade: 255, or 254, which has one of ½."""
    p = 1.0 / (1.0 + np.exp(-log_odds))
    p = np.where(log_odds >= CERTAIN, 1.0, np.where(log_odds <= -CERTAIN, 0.0, p))
    images = {top: np.rint((1.0 - p) * top).astype(np.int64) for top in (255, 254)}
    for top, image in images.items():
        if np.array_equal(_log_odds(1.0 - image / top), log_odds):
            return image, top
    top = 254 if np.any(log_odds == 0) else 255
    return images[top], top


class _Header:
    """The keys of a map file and their values; a key that `load` does not read gives a warning.

    PyYAML parses the file to nodes, which keep the text and the line of each value.
    """

    def __init__(self, path: str | Path) -> None:
        self.file = TextFile(path)
        text = "\n".join(self.file.lines)
        try:
            root = yaml.compose(text, yaml.SafeLoader)
        except yaml.MarkedYAMLError as problem:
            mark = problem.context_mark or problem.problem_mark  # where it begins
            reason = str(problem.problem).removeprefix("but ")
            raise self.file.error(mark.line + 1, f"expected YAML, but {reason}") from problem
        except yaml.reader.ReaderError as problem:
            line = text.count("\n", 0, problem.position) + 1
            raise self.file.error(line, f"expected YAML, but {problem.reason}") from problem
        except RecursionError as problem:
            raise self.file.error(1, "expected `key: value`, got brackets in brackets") from problem
        if not isinstance(root, yaml.MappingNode):
            raise self.file.error(1, "expected `key: value`")
        self.nodes: dict[str, yaml.Node] = {}
        for name, value in root.value:
            line = name.start_mark.line + 1
            if not isinstance(name, yaml.ScalarNode):
                raise self.file.error(line, "expected `key: value`")
            if name.value in self.nodes:
                raise self.file.error(line, f"{name.value} occurs twice")
            if name.value in (*_REQUIRED, "mode"):
                self.nodes[name.value] = value
            else:
                unknown = f"{self.file.path}:{line}: key {name.value!r} is not read"
                warnings.warn(unknown, stacklevel=4)
        for key in _REQUIRED:
            if key not in self.nodes:
                raise self.file.end_error(f"{key} is missing")

    def error(self, key: str, reason: str) -> InvalidFile:
        """An InvalidFile about the line of a value, for the caller to raise."""
        line = self.nodes[key].start_mark.line + 1
        return self.file.error(line, " ".join(reason.split()))  # a value may go over lines

    def text(self, key: str) -> str:
        """The value of a key as written in the file, without quotes."""
        value = self.nodes[key].value
        if not isinstance(value, str) or not value:
            raise self.error(key, f"expected one value of {key}")
        return value

    def number(self, key: str) -> float:
        """The value of a key as a finite number."""
        line = self.nodes[key].start_mark.line + 1
        return self.file.numbers(line, [self.text(key)], [key])[0]

    def numbers(self, key: str, names: tuple[str, ...]) -> list[float]:
        """The value of a key as a list of finite numbers, one per name."""
        node = self.nodes[key]
        items = node.value if isinstance(node, yaml.SequenceNode) else [node]
        fields = [item.value if isinstance(item, yaml.ScalarNode) else "" for item in items]
        line = node.start_mark.line + 1
        try:
            return self.file.numbers(line, fields, names)
        except InvalidFile as problem:
            expected = f"expected {key}: [{', '.join(names)}], got [{', '.join(fields)}]"
            raise self.error(key, f"{expected}: {problem.reason}") from problem

    def choice(self, key: str, choices: dict[str, _Value], default: str | None = None) -> _Value:
        """The meaning of the value of a key."""
        if key not in self.nodes and default is not None:
            return choices[default]
        value = self.text(key).lower()
        if value not in choices:
            raise self.error(key, f"expected {key} to be {' or '.join(choices)}, got {value}")
        return choices[value]
