"""What a film shows, and how it becomes frames.

A layer is a function of the axes: it draws what stays, makes what changes (`animated=True`), and
returns a function that sets it to frame k. Another kind of film is another layer:

    def growing(maps):  # (F, H, W)
        def layer(axes):
            image = axes.imshow(maps[0], animated=True)
            return lambda k: image.set_data(maps[k])
        return layer

    film = render(Scene(len(maps), Panel([growing(maps)], xlim, ylim)))

What stays is drawn once; of each frame only what changes.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from jaxslam.core.numbers import check_count
from jaxslam.results.film import Film
from jaxslam.results.film.timing import pace
from jaxslam.results.plot.style import (
    COLORS,
    FAINT,
    INK,
    PAGE,
    RULE,
    SHADE,
    TEXT,
    TITLE,
    panels_of,
    titled,
)

Draw: TypeAlias = Callable[[int], object]
"""Sets what a layer has made to frame k."""

Layer: TypeAlias = Callable[[Axes], Draw]
"""Draws on the axes what is the same in all frames, and returns what draws frame k."""

DPI = 110
"""dots an inch: a film as wide as a page has 788 pixels"""

_SHADES = (1.0, 0.85, 0.65, 0.45, 0.25, 0.1)
"""shares of a colour on white, as at the edge of a line"""

_OTHERS = 48
"""number of colours of a film beside those of the style and their shades, and"""

_NEAR = 12
"""how much they differ from those, of 255"""

_HEAD = 0.42
"""height of title and text [in]"""


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
    """in the upper right corner; below it is the legend"""
    said: Callable[[int], str] = lambda k: f"frame {k + 1}"
    """the text above frame k"""
    title: str = ""
    note: str = ""
    """see `Film`"""


def render(
    scene: Scene,
    *,
    fps: float | None = None,
    width: float = PAGE,
    dpi: float = DPI,
    progress: Callable[[int, int], object] | None = None,
) -> Film:
    """The frames of a scene, as PNG files of 127 colours, the same for all frames.

    Args:
        fps: frames a second; default so many that the film lasts 10 s, at most 25.
        width: of the figure [in], with letters of 8 pt.
        dpi: dots an inch.
        progress: called with the frames done and their number.
    Raises:
        ValueError: on a scene without frames, an fps or a size that is not above 0.
    """
    check_count("render: frames", scene.frames)
    fps = pace(scene.frames) if fps is None else fps
    for name, value in (("fps", fps), ("width", width), ("dpi", dpi)):
        if not 0 < value < np.inf:
            raise ValueError(f"render: expected {name} above 0, got {value}")
    stage = _Stage(scene, width, dpi)
    samples = {0, scene.frames // 2, scene.frames - 1}
    palette = _palette([stage.picture(k) for k in sorted(samples)])
    frames, said = [], []
    for k in range(scene.frames):
        frames.append(_png(stage.picture(k), palette))
        said.append(scene.said(k))
        if progress is not None:
            progress(k + 1, scene.frames)
    return Film(tuple(frames), float(fps), tuple(said), scene.title, scene.note)


class _Stage:
    """The figure of a scene, drawn but for what changes."""

    def __init__(self, scene: Scene, width: float, dpi: float) -> None:
        self._scene = scene
        height, widths = 0.645 * width, (2.15, 1.0)
        if scene.beside is None:  # a column for the legend, and as low as the panel is
            widths = (4.0, 1.0)
            share = np.ptp(scene.main.ylim) / np.ptp(scene.main.xlim)
            height = float(np.clip(0.75 * width * share + 0.4, 0.3 * width, 0.75 * width))
        # Both sides even, as MP4 wants them.
        across, tall = (2 * round(dpi * part / 2) for part in (width, height + _HEAD))
        size = across / dpi, tall / dpi
        figure, (main, beside) = panels_of(*size, 1, 2, share=(False, False), widths=widths)
        figure.set_dpi(dpi)
        engine = figure.get_layout_engine()
        assert isinstance(engine, ConstrainedLayoutEngine)
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - _HEAD / size[1]))
        canvas = FigureCanvasAgg(figure)
        self._draws = _furnish(main, scene.main)
        beside.set_anchor("N")
        if scene.beside is None:
            beside.set_axis_off()
        else:
            self._draws += _furnish(beside, scene.beside)
        _legend(main, beside)
        left, line = 0.06 / size[0], 0.19 / size[1]
        figure.text(left, 1 - 0.04 / size[1], scene.title, size=TITLE, va="top", color=INK)
        self._text = figure.text(left, 1 - 0.05 / size[1] - line, "", size=TEXT, va="top")
        self._text.set_animated(True)
        self._moving = [*_animated(main), *_animated(beside)]
        for artist in self._moving:
            artist.set_in_layout(False)
        figure.draw_without_rendering()  # the layout of axes of equal aspect takes two passes
        canvas.draw()
        figure.set_layout_engine("none")
        self._figure, self._canvas = figure, canvas
        self._still = canvas.copy_from_bbox(figure.bbox)

    def picture(self, k: int) -> np.ndarray:
        """Frame k as an array (height, width, 3) of bytes."""
        for draw in self._draws:
            draw(k)
        self._text.set_text(self._scene.said(k))
        self._canvas.restore_region(self._still)
        for artist in (*self._moving, self._text):
            self._figure.draw_artist(artist)
        return np.array(self._canvas.buffer_rgba())[:, :, :3]


def _furnish(axes: Axes, panel: Panel) -> list[Draw]:
    """Set up the axes of a panel; returns the functions that draw a frame on them."""
    axes.set(xlim=panel.xlim, ylim=panel.ylim, xlabel=panel.xlabel, ylabel=panel.ylabel)
    axes.set(aspect="equal", autoscale_on=False)
    if panel.title:
        titled(axes, panel.title)
    return [layer(axes) for layer in panel.layers]


def _animated(axes: Axes) -> Iterator[Artist]:
    """What changes on the axes, from the lowest to the highest."""
    found = [artist for artist in axes.get_children() if artist.get_animated()]
    yield from sorted(found, key=lambda artist: artist.get_zorder())


def _legend(main: Axes, beside: Axes) -> None:
    """The legend of both panels, each label once, below the one beside."""
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


def _palette(pictures: Sequence[np.ndarray]) -> Image.Image:
    """An image that has the colours of the style, and others of some pictures."""
    style = np.array([to_rgb(color) for color in (*COLORS, INK, FAINT, SHADE, RULE)])
    shades = np.concatenate([255 * (share * style + 1 - share) for share in _SHADES])
    # Pillow looks colours up in cells of 4: a near one would take the place of white.
    shades = np.concatenate([shades[shades.min(axis=1) < 255 - _NEAR], [[255.0] * 3]])
    sample = Image.fromarray(np.concatenate([picture[::2, ::2] for picture in pictures]))
    found = sample.quantize(_OTHERS, Image.Quantize.MEDIANCUT).getpalette() or []
    others = np.reshape(found, (-1, 3)).astype(float)
    away = np.abs(others[:, None] - shades).max(axis=2).min(axis=1) > _NEAR
    colors = np.rint(np.concatenate([shades, others[away]])).astype(int)
    palette = Image.new("P", (1, 1))
    palette.putpalette(list(np.unique(colors, axis=0).flat))
    return palette


def _png(picture: np.ndarray, palette: Image.Image) -> bytes:
    """The PNG file of a picture in the colours of a palette."""
    image = Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()
