"""A scene of panels of layers, and its film, an animation of Matplotlib.

A layer is a function of the axes: it draws the fixed artists, makes the moving ones, and returns a
function that sets those to frame k. Another kind of film is another layer:

    def growing(maps):  # (F, H, W)
        def layer(axes):
            image = axes.imshow(maps[0])
            return lambda k: image.set_data(maps[k])
        return layer

    film = Film(Scene(len(maps), Panel([growing(maps)], xlim, ylim)))
"""

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.animation import FFMpegWriter, FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Polygon

from jaxslam.core._optional import Unusable, first_line
from jaxslam.core.validation import InvalidField, at_least, positive, refusals_of, require
from jaxslam.results.plot._landmarks import ellipses
from jaxslam.results.plot._style import INK, PAGE, TEXT, TITLE, own_settings, panels_of, titled

Draw: TypeAlias = Callable[[int], object]
"""Sets the moving artists of a layer to frame k."""

Layer: TypeAlias = Callable[[Axes], Draw]
"""Draws the fixed artists on the axes, and returns the function that draws frame k."""

_DPI = 110
"""Dots an inch: a film as wide as a page has 788 pixels."""

_HEAD = 0.42
"""Height of title and text [in]."""

_SECONDS, _FASTEST, _SLOWEST = 10.0, 25.0, 2.0
"""A film lasts 10 s, unless it would have more than 25 or fewer than 2 frames a second."""

_EMBEDDED = 100.0
"""Largest size of the player [MB], beyond which Matplotlib leaves out frames."""

_LEVELS = (17 * np.rint(np.arange(256) / 17)).astype(np.uint8)
"""The 16 levels of a colour in frames: hardly visible, and PNG files are half as large."""

_ICON_FONT = """<link rel="stylesheet"
href="https://maxcdn.bootstrapcdn.com/font-awesome/4.4.0/css/font-awesome.min.css">"""

_ICONS = """<style>
.fa { font-style: normal; } .fa-flip-horizontal { display: inline-block; transform: scaleX(-1); }
.fa-minus::before { content: "\\2212"; } .fa-plus::before { content: "+"; }
.fa-play::before { content: "\\25B6\\FE0E"; } .fa-pause::before { content: "\\2016"; }
.fa-step-backward::before { content: "\\2039"; } .fa-step-forward::before { content: "\\203A"; }
.fa-fast-backward::before { content: "\\AB"; } .fa-fast-forward::before { content: "\\BB"; }
</style>"""
"""The icons of the player's buttons as characters, so that it loads nothing from the network."""


@dataclass(frozen=True, eq=False)
class Panel:
    """Layers on axes of equal aspect, whose limits are fixed over the film."""

    layers: Sequence[Layer]
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    xlabel: str = "x [m]"
    ylabel: str = "y [m]"
    title: str = ""


@dataclass(frozen=True, eq=False)
class Scene:
    """A film before it is drawn: a map, a smaller panel beside it, and a line of text."""

    frames: int
    main: Panel
    beside: Panel | None = None
    """a panel in the upper right corner, above the legend"""
    caption: Callable[[int], str] = lambda k: f"frame {k + 1}"
    """the text above frame k"""
    title: str = ""
    note: str = ""
    """the steps of a longer run that are shown, in words; "" for all"""


class Film(FuncAnimation):
    """The film of a scene, an animation of Matplotlib. A notebook shows its player.

        film = jaxslam.plot.animate(trace, log, truth)
        film.save("slam.gif")

    Args:
        fps: frames per second; by default the film lasts 10 s, with at most 25 a second.
        width: of the figure [in], with letters of 8 pt.
    Raises:
        ValueError: on a scene without frames, an fps or a width that is not above 0.
    """

    @own_settings()
    def __init__(self, scene: Scene, *, fps: float | None = None, width: float = PAGE) -> None:
        with refusals_of("Film"):
            require("frames", scene.frames, at_least(1))
            fps = np.clip(scene.frames / _SECONDS, _SLOWEST, _FASTEST) if fps is None else fps
            require("fps", fps, positive)
            require("width", width, positive)
        self.scene = scene
        stage = _Stage(scene, width)
        figure = Figure(figsize=stage.size, dpi=_DPI)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        image = axes.imshow(stage.picture(0), aspect="auto", interpolation="nearest")

        def draw(k: int) -> list[Artist]:
            image.set_data(stage.picture(k))
            return [image]

        options: dict[str, Any] = {"repeat": False, "cache_frame_data": False}
        super().__init__(figure, draw, scene.frames, interval=1000 / fps, **options)

    def __del__(self) -> None:
        """No warning about a film that was never drawn, unlike Matplotlib."""

    @own_settings()
    def save(
        self, filename: str | Path, writer: Any = None, *arguments: Any, **options: Any
    ) -> None:
        """Write GIF (by Pillow), HTML (a player), or MP4 (by ffmpeg), by the ending of the name.

        Args:
            filename: name of the file.
            writer: another writer of Matplotlib, for any ending.
            arguments, options: of Matplotlib's `Animation.save`.
        Raises:
            ValueError: on another ending, or .mp4 where ffmpeg is missing or fails.
        """
        kind = Path(filename).suffix
        if writer is None and kind == ".html":
            Path(filename).write_text(self.to_jshtml(), encoding="utf-8")
            return
        if not writer:
            if kind not in (".gif", ".mp4"):
                raise InvalidField(
                    "filename",
                    f"expected a name in .gif, .html, .mp4, got {filename}",
                    owner="Film.save",
                )
            if kind == ".mp4" and (problem := mp4_problem()):
                raise Unusable(f"Film.save: {filename} cannot be written ({problem}): save a .gif")
            writer = "pillow" if kind == ".gif" else "ffmpeg"
        try:
            super().save(filename, writer, *arguments, **options)
        except (subprocess.CalledProcessError, BrokenPipeError) as error:
            raise Unusable(
                f"Film.save: {filename} cannot be written ({_reason(error)}): save a .gif"
            ) from error

    @own_settings()
    def to_jshtml(self, *arguments: Any, **options: Any) -> str:
        """The player in HTML, which loads nothing; arguments as for Matplotlib's method."""
        with matplotlib.rc_context({"animation.embed_limit": _EMBEDDED}):
            return super().to_jshtml(*arguments, **options).replace(_ICON_FONT, _ICONS)

    def _repr_html_(self) -> str:
        return self.to_jshtml()


def mp4_problem() -> str | None:
    """The reason why no MP4 can be written: ffmpeg is missing, does not start, or has no H.264.

    None if ffmpeg can write two black frames.
    """
    if not FFMpegWriter.isAvailable():
        return "ffmpeg is not installed"
    source = ["-f", "rawvideo", "-s", "64x64", "-pix_fmt", "rgba", "-framerate", "2", "-i", "pipe:"]
    codec = ["-vcodec", matplotlib.rcParams["animation.codec"], "-pix_fmt", "yuv420p"]
    try:
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(
                [FFMpegWriter.bin_path(), "-loglevel", "error", *source, *codec, "trial.mp4"],
                input=bytes(2 * 64 * 64 * 4),
                capture_output=True,
                check=True,
                cwd=folder,
            )
    except (subprocess.CalledProcessError, OSError) as error:
        return f"ffmpeg: {_reason(error)}"
    return None


def _reason(error: BaseException) -> str:
    """The reason of a failed program: the last line of its standard error, or the error."""
    output = getattr(error, "stderr", None) or ""
    text = output.decode(errors="replace") if isinstance(output, bytes) else output
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "") or (
        first_line(error)
    )


class _Stage:
    """The figure of a scene; artists that no layer changes are drawn once, for speed."""

    def __init__(self, scene: Scene, width: float) -> None:
        height, widths = 0.645 * width, (2.15, 1.0)
        if scene.beside is None:  # a column for the legend, and as low as the panel is
            widths = (4.0, 1.0)
            share = np.ptp(scene.main.ylim) / np.ptp(scene.main.xlim)
            height = float(np.clip(0.75 * width * share + 0.4, 0.3 * width, 0.75 * width))
        # Both sides even, as MP4 wants them.
        across, tall = (2 * round(_DPI * part / 2) for part in (width, height + _HEAD))
        self.size = across / _DPI, tall / _DPI
        figure, (main, beside) = panels_of(*self.size, 1, 2, share=(False, False), widths=widths)
        figure.set_dpi(_DPI)
        self._canvas, self._caption = FigureCanvasAgg(figure), scene.caption
        engine = figure.get_layout_engine()
        assert isinstance(engine, ConstrainedLayoutEngine)
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - _HEAD / self.size[1]))
        self._draws, self._moving = _furnish(main, scene.main)
        beside.set_anchor("N")
        if scene.beside is None:
            beside.set_axis_off()
        else:
            draws, moving = _furnish(beside, scene.beside)
            self._draws, self._moving = self._draws + draws, self._moving + moving
        _legend(main, beside)
        left, line = 0.06 / self.size[0], 0.19 / self.size[1]
        top = 1 - 0.05 / self.size[1]
        figure.text(left, top, scene.title, size=TITLE, va="top", color=INK)
        self._text = figure.text(left, top - line, "", size=TEXT, va="top", animated=True)
        figure.draw_without_rendering()  # the layout of axes of equal aspect takes two passes
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def picture(self, k: int) -> np.ndarray:
        """Frame k as an array (height, width, 3) of bytes."""
        for draw in self._draws:
            draw(k)
        self._text.set_text(self._caption(k))
        self._canvas.restore_region(self._still)
        for artist in (*self._moving, self._text):
            self._canvas.figure.draw_artist(artist)
        return _LEVELS[np.asarray(self._canvas.buffer_rgba())[:, :, :3]]


def _furnish(axes: Axes, panel: Panel) -> tuple[list[Draw], list[Artist]]:
    """Set up the axes of a panel; returns its functions of the frame, and its moving artists."""
    axes.set(xlim=panel.xlim, ylim=panel.ylim, xlabel=panel.xlabel, ylabel=panel.ylabel)
    axes.set(aspect="equal", autoscale_on=False)
    if panel.title:
        titled(axes, panel.title)
    before = set(axes.get_children())
    draws = [layer(axes) for layer in panel.layers]
    moving = [artist for artist in axes.get_children() if artist not in before]
    for artist in moving:
        artist.set_animated(True)
        artist.set_in_layout(False)
    return draws, sorted(moving, key=lambda artist: artist.get_zorder())


def _legend(main: Axes, beside: Axes) -> None:
    """The legend of both panels, each label once, below the smaller panel."""
    handles: dict[object, Artist] = {}
    for axes in (main, beside):
        for handle in axes.get_legend_handles_labels()[0]:
            handles.setdefault(handle.get_label(), handle)
    legend = beside.legend(
        list(handles.values()),
        [str(label) for label in handles],
        loc="upper left",
        bbox_to_anchor=(0.0, -0.26) if beside.axison else (0.0, 1.0),
        borderaxespad=0.0,
        frameon=False,
        fontsize=TEXT,
        handlelength=2.2,
        labelspacing=0.35,
        borderpad=0.0,
    )
    legend.set_in_layout(False)


_TRIANGLE = np.array([[1.0, 0.0], [-0.6, 0.55], [-0.6, -0.55]])


def still(points: Float[np.ndarray, "N 2"], **look: Any) -> Layer:
    """The layer of points that are the same in all frames."""

    def layer(axes: Axes) -> Draw:
        axes.plot(*np.asarray(points).T, **look)
        return lambda k: None

    return layer


def line_of(points: Callable[[int], Float[np.ndarray, "N 2"]], **look: Any) -> Layer:
    """The layer of a line through points(k) in frame k, interrupted at NaN."""

    def layer(axes: Axes) -> Draw:
        (line,) = axes.plot([], [], **look)
        return lambda k: line.set_data(*points(k).T)

    return layer


def track(path: Float[np.ndarray, "T C"], until: Int[np.ndarray, "F"], **look: Any) -> Layer:
    """The layer of a path that grows: in frame k its points up to until[k]."""
    return line_of(lambda k: path[: until[k] + 1, :2], **look)


def marks(points: Float[np.ndarray, "F N 2"], shown: Bool[np.ndarray, "F N"], **look: Any) -> Layer:
    """The layer of points that differ from frame to frame."""
    return line_of(lambda k: points[k][shown[k]], ls="none", **look)


def triangle(poses: Float[np.ndarray, "F 3"], size: float, **look: Any) -> Layer:
    """The layer of a robot: a triangle, `size` long from its position to its tip."""

    def layer(axes: Axes) -> Draw:
        patch = Polygon(size * _TRIANGLE, closed=True, **look)
        axes.add_patch(patch)

        def draw(k: int) -> None:
            x, y, heading = poses[k]
            cosine, sine = np.cos(heading), np.sin(heading)
            turn = np.array([[cosine, sine], [-sine, cosine]])
            patch.set_visible(bool(np.isfinite(poses[k]).all()))
            patch.set_xy(np.array([x, y]) + size * _TRIANGLE @ turn)

        return draw

    return layer


def rings(
    means: Float[np.ndarray, "F N 2"],
    covs: Float[np.ndarray, "F N 2 2"],
    shown: Bool[np.ndarray, "F N"],
    **look: Any,
) -> Layer:
    """The layer of 3 σ ellipses in each frame; indefinite covariances are left out."""
    return line_of(
        lambda k: _join(ellipses(means[k][shown[k]], covs[k][shown[k]], points=48)), **look
    )


def lines_between(ends: Sequence[Float[np.ndarray, "E 2 2"]], **look: Any) -> Layer:
    """The layer of lines between pairs of points that differ from frame to frame."""
    return line_of(lambda k: _join(ends[k]), **look)


def weighted_segments(
    ends: Sequence[Float[np.ndarray, "E 2 2"]],
    weights: Sequence[Float[np.ndarray, "E"]],
    *,
    color: str,
    width: float,
    **look: Any,
) -> Layer:
    """The layer of lines with weights from 0 to 1: light ones are thin and pale.

    width: of a line of weight 1 [pt].
    """

    def layer(axes: Axes) -> Draw:
        lines = LineCollection([], color=color, linewidth=width, **look)
        axes.add_collection(lines, autolim=False)

        def draw(k: int) -> None:
            heavy = np.sqrt(weights[k])
            lines.set_segments(list(ends[k]))
            lines.set_linewidth(list(width * (0.15 + 0.85 * heavy)))
            lines.set_color([to_rgba(color, 0.2 + 0.6 * value) for value in heavy])

        return draw

    return layer


def cloud(
    points: Float[np.ndarray, "F P 2"], weight: Float[np.ndarray, "F P"], **look: Any
) -> Layer:
    """The layer of particles of positive weight, with areas in proportion to their weights."""
    areas = 4.0 * weight * weight.shape[1]

    def layer(axes: Axes) -> Draw:
        dots = axes.scatter([], [], **look)

        def draw(k: int) -> None:
            shown = weight[k] > 0
            dots.set_offsets(points[k][shown])
            dots.set_sizes(np.clip(areas[k][shown], 0.5, 60.0))

        return draw

    return layer


def _join(lines: Float[np.ndarray, "E C 2"]) -> Float[np.ndarray, "D 2"]:
    """Lines joined into one with NaN between them, so that they are drawn at once."""
    gap = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gap], axis=1).reshape(-1, 2)
