"""The record of a film: its frames, and what can be done with them."""

import warnings
from dataclasses import dataclass
from pathlib import Path

from jaxslam.results.files import write_files
from jaxslam.results.film.encoding import NoEncoder, gif, mp4, size_of
from jaxslam.results.film.player import player, player_page

KINDS = ("mp4", "gif", "html")
"""endings of the files that a film can be written to"""


@dataclass(frozen=True, eq=False)
class Film:
    """A film: frames of one size, as PNG files. A notebook shows the player.

    film = jaxslam.plot.animate(trace, log, truth)
    film.save("slam.mp4")
    """

    frames: tuple[bytes, ...]
    fps: float
    """frames a second"""
    said: tuple[str, ...]
    """what is written above each frame, for readers who cannot see it"""
    title: str = ""
    note: str = ""
    """which steps of a longer run are shown; "" where all are"""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        return size_of(self.frames[0])

    @property
    def seconds(self) -> float:
        """How long the film lasts [s]."""
        return len(self.frames) / self.fps

    def player(self) -> str:
        """The fragment of HTML that plays the film; see `film.player`."""
        return player(self.frames, said=self.said, fps=self.fps, title=self.title)

    def encoded(self, kind: str) -> bytes:
        """The film as a file of a kind: mp4, gif, or html (a page that holds the player alone).

        Raises `NoEncoder` where ffmpeg, which mp4 takes, is not installed or fails.
        """
        if kind == "html":
            return player_page(self.player(), self.title).encode()
        return mp4(self.frames, self.fps) if kind == "mp4" else gif(self.frames, self.fps)

    def moving(self) -> tuple[str, bytes, str]:
        """A film to show without a browser: "mp4" and the file, or else "gif" and why not MP4."""
        try:
            return "mp4", self.encoded("mp4"), ""
        except NoEncoder as problem:
            return "gif", self.encoded("gif"), f"{problem}: GIF instead of MP4"

    def save(self, path: str | Path) -> Path:
        """Write the film as MP4, GIF or HTML, by the name's ending; returns the path written.

        Without ffmpeg a GIF is written in place of MP4, with a warning of one line. The file is
        complete or not there. Raises ValueError on another ending.
        """
        target = Path(path)
        kind = target.suffix[1:]
        if kind not in KINDS:
            raise ValueError(f"Film.save: expected a name in .{', .'.join(KINDS)}, got {path!s}")
        if kind == "mp4":
            kind, content, why = self.moving()
            target = target.with_suffix(f".{kind}")
            if why:
                warnings.warn(f"Film.save: {why}, {target}", stacklevel=2)
        else:
            content = self.encoded(kind)
        write_files(target.parent, {target.name: lambda path: path.write_bytes(content)})
        return target

    def _repr_html_(self) -> str:
        return self.player()
