"""A film: a figure, and the one function that sets its artists to frame k.

figure, (axes, _) = stage((-20.0, 20.0), (-20.0, 20.0))
(dots,) = axes.plot([], [], ".")

def update(k):
    dots.set_data(*walks[k].T)
    return f"step {k + 1}"

film = Film(figure, update, len(walks))
"""

import base64
import html
import io
import json
import shutil
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxslam.core._optional import Unusable, first_line
from jaxslam.core.validation import InvalidField, at_least, positive, refusals_of, require
from jaxslam.results.plot._style import INK, PAGE, TEXT, TITLE, own_settings, panels_of

_DPI = 110
"""Dots an inch: a film as wide as a page has 788 pixels."""

_HEAD = 0.42
"""Height of title and text [in]."""

_SECONDS, _FASTEST, _SLOWEST = 10.0, 25.0, 2.0
"""A film lasts 10 s, unless it would have more than 25 or fewer than 2 frames a second."""

_LEVELS = (17 * np.rint(np.arange(256) / 17)).astype(np.uint8)
"""The 16 levels of a colour in frames: hardly visible, and PNG files are half as large."""

_PLAYER = Template("""<div class="$name" style="display: inline-block; text-align: center">
<img alt="$title" style="max-width: 100%"><br>
<input type="range" min="0" max="$last" value="0" style="width: 70%"><br>
<button title="First frame">&laquo;</button> <button title="Previous frame">&lsaquo;</button>
<button title="Play">&#9654;&#65038;</button> <button title="Pause">&#8214;</button>
<button title="Next frame">&rsaquo;</button> <button title="Last frame">&raquo;</button>
<button title="Slower">&minus;</button> <button title="Faster">+</button>
</div>
<script>
(() => {
  const frames = $frames, last = $last;
  const film = [...document.querySelectorAll(".$name")].pop();
  const image = film.querySelector("img"), slider = film.querySelector("input");
  let timer = 0, delay = $delay;
  const show = (k) => {
    slider.value = Math.min(Math.max(k, 0), last);
    image.src = "data:image/png;base64," + frames[slider.value];
  };
  const stop = () => { clearInterval(timer); timer = 0; };
  const play = () => {
    stop();
    if (+slider.value === last) show(0);
    timer = setInterval(() => +slider.value < last ? show(+slider.value + 1) : stop(), delay);
  };
  const paced = (factor) => { delay *= factor; if (timer) play(); };
  const jump = (k) => { stop(); show(k); };
  const actions = {
    "First frame": () => jump(0), "Last frame": () => jump(last), "Play": play, "Pause": stop,
    "Previous frame": () => jump(+slider.value - 1), "Next frame": () => jump(+slider.value + 1),
    "Slower": () => paced(1.4), "Faster": () => paced(1 / 1.4),
  };
  for (const button of film.querySelectorAll("button")) button.onclick = actions[button.title];
  slider.oninput = () => jump(+slider.value);
  show(0);
})();
</script>
""")


@own_settings()
def stage(
    xlim: tuple[float, float],
    ylim: tuple[float, float],
    *,
    beside: float | None = None,
    width: float = PAGE,
) -> tuple[Figure, list[Axes]]:
    """The empty figure of a film: a map [m], and a panel beside it with the legend below.

    The panels have equal aspect, and limits that are fixed over the film.

    Args:
        beside: half of the side of the panel beside the map [m]; by default the legend is there.
        width: of the figure [in], with letters of 8 pt.
    """
    with refusals_of("stage"):
        require("width", width, positive)
    height, widths = 0.645 * width, (2.15, 1.0)
    if beside is None:  # a column for the legend, and as low as the panel is
        widths = (4.0, 1.0)
        share = np.ptp(ylim) / np.ptp(xlim)
        height = float(np.clip(0.75 * width * share + 0.4, 0.3 * width, 0.75 * width))
    # Both sides even, as MP4 wants them.
    width, height = (2 * round(_DPI * part / 2) / _DPI for part in (width, height + _HEAD))
    figure, panels = panels_of(width, height, 1, 2, share=(False, False), widths=widths)
    figure.set_dpi(_DPI)
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, 0.0, 1.0, 1.0 - _HEAD / height))
    half = 1.0 if beside is None else beside
    limits = (xlim, ylim), ((-half, half), (-half, half))
    for axes, (x, y) in zip(panels, limits, strict=True):
        axes.set(xlim=x, ylim=y, xlabel="x [m]", ylabel="y [m]")
        axes.set(aspect="equal", autoscale_on=False)
    panels[1].set_anchor("N")
    if beside is None:
        panels[1].set_axis_off()
    return figure, panels


class Film:
    """The film of a figure. A notebook shows its player.

        film = jaxslam.plot.animate(trace, log, truth)
        film.save("slam.gif")

    Args:
        figure: from `stage`, with artists on its panels.
        update: sets the artists to frame k; returns the text above it, or None.
        frames: the number of frames.
        title: above the text.
        note: the steps of a longer run that are shown, in words; "" for all.
        fps: frames per second; by default the film lasts 10 s, with at most 25 a second.
    Raises:
        ValueError: without frames, or on an fps that is not above 0.
    """

    @own_settings()
    def __init__(
        self,
        figure: Figure,
        update: Callable[[int], str | None],
        frames: int,
        *,
        title: str = "",
        note: str = "",
        fps: float | None = None,
    ) -> None:
        with refusals_of("Film"):
            require("frames", frames, at_least(1))
            fps = np.clip(frames / _SECONDS, _SLOWEST, _FASTEST) if fps is None else fps
            require("fps", fps, positive)
        self.figure, self.update, self.frames, self.fps = figure, update, frames, float(fps)
        self.title, self.note = title, note
        # The legend of both panels, each label once, below the smaller panel.
        main, beside = figure.axes
        handles: dict[str, Artist] = {}
        for axes in (main, beside):
            for handle in axes.get_legend_handles_labels()[0]:
                handles.setdefault(str(handle.get_label()), handle)
        corner = (0.0, -0.26) if beside.axison else (0.0, 1.0)
        options: dict[str, Any] = {"frameon": False, "fontsize": TEXT, "borderaxespad": 0.0}
        options |= {"handlelength": 2.2, "labelspacing": 0.35, "borderpad": 0.0}
        handles_labels = list(handles.values()), list(handles)
        legend = beside.legend(*handles_labels, loc="upper left", bbox_to_anchor=corner, **options)
        legend.set_in_layout(False)
        width, height = figure.get_size_inches()
        figure.text(0.06 / width, 1 - 0.05 / height, title, size=TITLE, va="top", color=INK)
        line: dict[str, Any] = {"size": TEXT, "va": "top", "animated": True}
        self._text = figure.text(0.06 / width, 1 - 0.24 / height, "", **line)
        # Axes, legend and title are drawn once, the artists anew in each frame.
        self._moving: list[Artist] = []
        for axes in figure.axes:
            self._moving += [*axes.images, *axes.patches, *axes.collections, *axes.lines]
        self._moving.sort(key=Artist.get_zorder)
        for artist in self._moving:
            artist.set_animated(True)
            artist.set_in_layout(False)
        self._canvas = FigureCanvasAgg(figure)
        figure.draw_without_rendering()  # the layout of axes of equal aspect takes two passes
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def caption(self, k: int) -> str:
        """The text above frame k, to which it sets the artists."""
        return self.update(k) or f"frame {k + 1}"

    def picture(self, k: int) -> np.ndarray:
        """Frame k as an array (height, width, 3) of bytes."""
        self._text.set_text(self.caption(k))
        self._canvas.restore_region(self._still)
        for artist in (*self._moving, self._text):
            self.figure.draw_artist(artist)
        return _LEVELS[np.asarray(self._canvas.buffer_rgba())[:, :, :3]]

    def save(
        self,
        filename: str | Path,
        *,
        fps: float | None = None,
        progress_callback: Callable[[int, int], object] = lambda k, of: None,
    ) -> None:
        """Write GIF (by Pillow), HTML (a player), or MP4 (by ffmpeg), by the ending of the name.

        Args:
            filename: name of the file.
            fps: frames per second, by default those of the film.
            progress_callback: called with the number of each frame, and that of all.
        Raises:
            ValueError: on another ending, or .mp4 where ffmpeg is missing or fails.
        """
        kind, path = Path(filename).suffix, Path(filename)
        fps = self.fps if fps is None else fps
        with refusals_of("Film.save"):
            require("fps", fps, positive)
            if kind not in (".gif", ".html", ".mp4"):
                text = f"expected a name in .gif, .html, .mp4, got {filename}"
                raise InvalidField("filename", text)
        problem = mp4_problem() if kind == ".mp4" else None
        if problem is None:
            pictures = []
            for k in range(self.frames):
                pictures.append(self.picture(k))
                progress_callback(k, self.frames)
            if kind == ".html":
                path.write_text(self._player(pictures, fps), encoding="utf-8")
            elif kind == ".gif":
                first, *others = map(Image.fromarray, pictures)
                delay = round(1000 / fps)
                first.save(path, save_all=True, append_images=others, duration=delay, loop=0)
            else:
                problem = _write_mp4(pictures, fps, path)
        if problem:
            raise Unusable(f"Film.save: {filename} cannot be written ({problem}): save a .gif")

    def to_jshtml(self) -> str:
        """The player in HTML, which loads nothing."""
        return self._player(map(self.picture, range(self.frames)), self.fps)

    def _player(self, pictures: Iterable[np.ndarray], fps: float) -> str:
        frames = []
        for picture in pictures:
            file = io.BytesIO()
            Image.fromarray(picture).save(file, format="png", optimize=True)
            frames.append(base64.b64encode(file.getvalue()).decode())
        parts = {"frames": json.dumps(frames), "last": len(frames) - 1, "delay": 1000 / fps}
        name = f"film-{zlib.crc32(str(parts).encode()):08x}"
        return _PLAYER.substitute(parts, name=name, title=html.escape(self.title))

    def _repr_html_(self) -> str:
        return self.to_jshtml()


def mp4_problem() -> str | None:
    """The reason why no MP4 can be written: ffmpeg is missing, does not start, or has no H.264.

    None if ffmpeg can write two black frames.
    """
    if shutil.which("ffmpeg") is None:
        return "ffmpeg is not installed"
    with tempfile.TemporaryDirectory() as folder:
        black = [np.zeros((64, 64, 3), np.uint8)] * 2
        return _write_mp4(black, 2.0, Path(folder) / "trial.mp4")


def _write_mp4(pictures: Sequence[np.ndarray], fps: float, path: Path) -> str | None:
    """Write a video by ffmpeg; the last line of what it says if it fails."""
    height, width, _ = pictures[0].shape
    source = ["-f", "rawvideo", "-s", f"{width}x{height}", "-pix_fmt", "rgb24", "-framerate"]
    source += [f"{fps:g}", "-i", "pipe:"]
    program = shutil.which("ffmpeg") or "ffmpeg"  # one that does not start is not passed over
    command = [program, "-y", "-loglevel", "error", *source]
    command += ["-vcodec", "h264", "-pix_fmt", "yuv420p", str(path)]
    try:
        subprocess.run(
            command, input=b"".join(map(bytes, pictures)), capture_output=True, check=True
        )
    except (subprocess.CalledProcessError, OSError) as error:
        said = (getattr(error, "stderr", None) or b"").decode(errors="replace").strip()
        return f"ffmpeg: {said.splitlines()[-1].strip() if said else first_line(error)}"
    return None


_ROBOT = np.array([[1.0, 0.0], [-0.6, 0.55], [-0.6, -0.55]])


def robot_at(pose: np.ndarray, size: float) -> np.ndarray:
    """The corners (3, 2) of a robot's triangle, `size` long from its position to its tip."""
    x, y, heading = pose
    cosine, sine = np.cos(heading), np.sin(heading)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    corners: np.ndarray = np.array([x, y]) + size * _ROBOT @ turn
    return corners


def joined(lines: Float[np.ndarray, "E C 2"]) -> Float[np.ndarray, "D 2"]:
    """Lines (E, C, 2) joined into one with NaN between them, so that they are drawn at once."""
    gap = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gap], axis=1).reshape(-1, 2)
