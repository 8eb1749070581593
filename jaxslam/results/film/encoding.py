"""Frames as bytes of a GIF file and, by ffmpeg, as an MP4 file."""

import io
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

REST = 2.0
"""time for which a GIF shows its last frame before it starts again [s]"""


class NoEncoder(Exception):
    """ffmpeg is not installed, or cannot write MP4; the message says which, in a line."""


def ffmpeg() -> str | None:
    """The path of the program ffmpeg, or None."""
    return shutil.which("ffmpeg")


def size_of(frame: bytes) -> tuple[int, int]:
    """Width and height of a PNG file [pixels], from its header."""
    return int.from_bytes(frame[16:20], "big"), int.from_bytes(frame[20:24], "big")


def gif(frames: Sequence[bytes], fps: float) -> bytes:
    """The frames, PNG files of one size, as a GIF file that repeats.

    Its delays are multiples of 10 ms.
    """
    first, *rest = (Image.open(io.BytesIO(frame)) for frame in frames)
    delay = 10 * round(100 / fps)
    delays = [*[delay] * len(rest), round(1000 * REST)]
    out = io.BytesIO()
    first.save(out, "GIF", save_all=True, append_images=rest, duration=delays, loop=0)
    return out.getvalue()


def mp4(frames: Sequence[bytes], fps: float) -> bytes:
    """The frames, PNG files of one size with even sides, as an MP4 file (H.264).

    Raises NoEncoder where ffmpeg is not installed or fails.
    """
    program = ffmpeg()
    if program is None:
        raise NoEncoder("ffmpeg is not installed")
    given = ["-f", "image2pipe", "-c:v", "png", "-framerate", f"{fps:g}", "-i", "pipe:0"]
    # yuv420p is what browsers and presentations play; the index at the front lets them start early.
    wanted = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "film.mp4"  # not a pipe: the index is written last
        command = [program, "-loglevel", "error", *given, *wanted, str(made)]
        done = subprocess.run(command, input=b"".join(frames), capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
            raise NoEncoder(f"ffmpeg failed ({said[-1]})")
        return made.read_bytes()
