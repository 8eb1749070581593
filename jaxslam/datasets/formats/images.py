"""Grey images in files: PGM, P5 (binary) and P2 (text), read here; PNG and BMP by Matplotlib."""

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxslam.datasets.formats.lines import read_bytes

_BY_MATPLOTLIB = {b"\x89PNG": "png", b"BM": "bmp"}


def read_shades(path: Path) -> NDArray[np.float64]:
    """The shades of an image (rows, columns), 0 black to 1 white; the first row is at the top.

    A colour counts as the mean of its three channels, as in `map_server`.

    Raises ValueError, `path: reason`, on a file of another format, one that is damaged, and an
    image that is transparent somewhere.
    """
    path, data = read_bytes(path)
    for begin, form in _BY_MATPLOTLIB.items():
        if data.startswith(begin):
            return _by_matplotlib(path, data, form)
    kind = data[:2]
    if kind not in (b"P5", b"P2") or not data[2:3].isspace():
        raise ValueError(f"{path}: expected an image in PGM (P5 or P2), PNG or BMP")
    header, at = _fields(path, data, 2, 3)
    width, height, top = header
    if width < 1 or height < 1 or not 1 <= top <= 65535:
        raise ValueError(
            f"{path}: expected an image of at least 1 × 1 with a largest shade of 1 to 65535, "
            f"got {width} × {height} with {top}"
        )
    count = width * height
    if kind == b"P2":
        found = np.array(_fields(path, data, at, count)[0])
    else:
        shades = np.dtype(np.uint8 if top < 256 else ">u2")
        body = data[at + 1 :]
        size = count * shades.itemsize
        if len(body) < size:
            raise ValueError(f"{path}: the image ends after {len(body)} of {size} bytes")
        found = np.frombuffer(body[:size], shades)
    if found.max() > top:
        raise ValueError(f"{path}: a shade of {found.max()} is above the largest, {top}")
    return np.asarray(found.reshape(height, width) / top, np.float64)


def _by_matplotlib(path: Path, data: bytes, form: str) -> NDArray[np.float64]:
    import matplotlib.image  # late, since most commands read no image

    try:
        image = np.asarray(matplotlib.image.imread(io.BytesIO(data), format=form))
    except (OSError, SyntaxError, ValueError) as problem:
        raise ValueError(f"{path}: expected a {form.upper()} image: {problem}") from problem
    if np.issubdtype(image.dtype, np.integer):
        image = image / np.iinfo(image.dtype).max
    image = image.astype(np.float64).reshape(*image.shape[:2], -1)
    colours = image.shape[2] - (image.shape[2] in (2, 4))
    if np.any(image[..., colours:] < 1):
        raise ValueError(f"{path}: expected an image that is opaque everywhere")
    return np.asarray(image[..., :colours].mean(axis=2))


def _fields(path: Path, data: bytes, at: int, count: int) -> tuple[list[int], int]:
    """The `count` whole numbers of a text from a place on, without comments, and where they end."""
    if count > 3:  # a body of text: quicker, and it has no end to find
        lines = [line.partition(b"#")[0] for line in data[at:].split(b"\n")]
        words = b" ".join(lines).split()[:count]
    else:
        words = []
        while len(words) < count and at < len(data):
            if data[at : at + 1].isspace():
                at += 1
            elif data[at : at + 1] == b"#":
                at = (data.find(b"\n", at) + 1) or len(data)
            else:
                end = at
                while end < len(data) and not data[end : end + 1].isspace():
                    end += 1
                words.append(data[at:end])
                at = end
    if len(words) < count:
        raise ValueError(f"{path}: the image ends after {len(words)} of {count} numbers")
    for word in words:
        if not word.isdigit():
            raise ValueError(f"{path}: expected a whole number, got {word.decode('latin-1')!r}")
    return [int(word) for word in words], at


def pgm_bytes(image: NDArray[np.int64], top: int) -> bytes:
    """A binary PGM file (P5) of shades (rows, columns), 0 to top <= 255, the first row on top."""
    height, width = image.shape
    return f"P5\n{width} {height}\n{top}\n".encode() + image.astype(np.uint8).tobytes()
