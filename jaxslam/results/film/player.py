"""A player of frames in HTML: one element without dependencies, alone on a page or within one."""

import base64
import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from html import escape

import numpy as np
from PIL import Image

from jaxslam.results.files import html_page
from jaxslam.results.film.encoding import size_of

_ICONS = {
    "first": "M2 3h2v10H2zM9 3v10L4 8zM14 3v10L9 8z",
    "back": "M10 3v10L4 8zM11 3h2v10h-2z",
    "play": "M4 2v12l10-6z",
    "next": "M6 3v10l6-5zM3 3h2v10H3z",
    "last": "M12 3h2v10h-2zM7 3v10l5-5zM2 3v10l5-5z",
}

_BUTTONS = {
    "first": "First frame (Home)",
    "back": "One frame back (left arrow)",
    "play": "Play or pause (space)",
    "next": "One frame on (right arrow)",
    "last": "Last frame (End)",
}

SCRIPT = """
for (const film of document.querySelectorAll(".jaxslam-film:not([data-ready])")) {
  film.dataset.ready = "yes";
  const data = JSON.parse(film.querySelector("script[type='application/json']").textContent);
  const find = (what) => film.querySelector(what);
  const image = find(".frame"), slider = find("input"), number = find("output");
  const speed = find("select");
  const button = find("[data-do=play]"), last = data.frames.length - 1;
  let at = last, timer = 0, began = 0, from = 0;
  const show = (k) => {
    at = Math.max(0, Math.min(last, k));
    const said = data.said[at] || `frame ${at + 1}`;
    image.src = "data:image/png;base64," + data.frames[at];
    image.alt = said;
    slider.value = at;
    slider.setAttribute("aria-valuetext", said);
    number.value = `${at + 1} / ${last + 1}`;
  };
  const stop = () => {
    clearInterval(timer);
    timer = 0;
    button.setAttribute("aria-pressed", "false");
  };
  const tick = () => {
    show(from + Math.floor((performance.now() - began) * data.fps * speed.value / 1000));
    if (at === last) stop();
  };
  const play = () => {
    clearInterval(timer);
    from = at === last ? 0 : at;
    began = performance.now();
    show(from);
    timer = setInterval(tick, 1000 / data.fps / Math.max(1, speed.value));
    button.setAttribute("aria-pressed", "true");
  };
  const go = (k) => { stop(); show(k); };
  const moves = {
    first: () => go(0), back: () => go(at - 1), next: () => go(at + 1), last: () => go(last),
    play: () => timer ? stop() : play(),
  };
  const keys = {
    Home: moves.first, ArrowLeft: moves.back, ArrowRight: moves.next, End: moves.last,
    " ": moves.play, PageUp: () => go(at - 10), PageDown: () => go(at + 10),
  };
  for (const each of film.querySelectorAll("button")) each.onclick = moves[each.dataset.do];
  slider.oninput = () => go(Number(slider.value));
  speed.onchange = () => { if (timer) play(); };
  film.onkeydown = (event) => {
    const own = event.target === speed || (event.key === " " && event.target.matches("button"));
    if (own || !keys[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
  };
  find(".bar").hidden = false;
  show(last);
}
"""
"""What every player on a page runs; run again, it starts those that were added since."""

SCRIPT_SOURCE = f"'sha256-{base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()}'"
"""What allows `SCRIPT` in the `script-src` of a content security policy."""

_CSS = """
.jaxslam-film { display: inline-block; max-width: 100%; color: var(--ink, #1c2330);
  font: 14px/1.4 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
.jaxslam-film .screen { position: relative; margin: 1px; overflow: hidden; background: #fff;
  border-radius: .5rem; box-shadow: 0 0 0 1px var(--line, #dfe3ea); }
.jaxslam-film img { display: block; width: auto; max-width: 100%; height: auto; margin: 0;
  padding: 0; border: 0; border-radius: 0; background: none; }
.jaxslam-film .frame { position: absolute; inset: 0; width: 100%; height: 100%; }
.jaxslam-film .bar { display: flex; flex-wrap: wrap; align-items: center; gap: .3rem .5rem;
  margin-top: .4rem; }
.jaxslam-film .bar[hidden] { display: none; }
.jaxslam-film button { width: 2.2rem; height: 2.2rem; padding: 0; color: inherit;
  background: var(--card, transparent); border: 1px solid var(--line, #b9c0cc);
  border-radius: .4rem; cursor: pointer; }
.jaxslam-film svg { display: block; width: 1rem; height: 1rem; margin: auto; fill: currentColor; }
.jaxslam-film [aria-pressed=true] path { d: path("M4 3h3v10H4zM9 3h3v10H9z"); }
.jaxslam-film input { flex: 1 1 10rem; min-width: 6rem; margin: 0;
  accent-color: var(--accent, #0072b2); }
.jaxslam-film output { min-width: 5.2rem; text-align: right; font-variant-numeric: tabular-nums; }
.jaxslam-film select { font: inherit; color: inherit; background: var(--card, transparent);
  border: 1px solid var(--line, #b9c0cc); border-radius: .4rem; height: 2.2rem; }
.jaxslam-film option { color: #1c2330; background: #fff; }
.jaxslam-film :focus-visible, .jaxslam-film:focus-visible { outline-offset: 2px;
  outline: 2px solid var(--accent, #0072b2); }
@media print { .jaxslam-film .bar { display: none; } }
"""

_SPEEDS = {0.25: "¼ ×", 0.5: "½ ×", 1: "1 ×", 2: "2 ×", 4: "4 ×"}


def player(
    frames: Sequence[bytes], *, said: Sequence[str] = (), fps: float = 25.0, title: str = ""
) -> str:
    """The fragment of HTML that plays frames: play, step, slider, speed, keyboard.

    It loads nothing, and takes the colours --ink, --line, --card and --accent of the page, where it
    has them. Without scripts and in print it is the last frame. Several may be on a page. A content
    security policy has to allow `img-src data:`, inline styles, and `SCRIPT_SOURCE`.

    Args:
        frames: PNG files of one size.
        said: the text of each frame, for readers who cannot see it; default none.
        fps: frames a second.
        title: what the film shows.
    Raises:
        ValueError: without frames, or with texts that are not as many.
    """
    if not frames or len(said) not in (0, len(frames)):
        raise ValueError(
            f"player: expected frames and a text for each or none, got {len(frames)} frames and "
            f"{len(said)} texts"
        )
    width, height = size_of(frames[-1])
    ground, *images = (base64.b64encode(each).decode("ascii") for each in _divided(frames))
    data = json.dumps({"fps": fps, "frames": images, "said": list(said)}, ensure_ascii=False)
    data = data.replace("<", "\\u003c")  # no end of the element within it
    buttons = "".join(
        f'<button type="button" data-do="{name}" title="{what}" aria-label="{what}">'
        f'<svg viewBox="0 0 16 16" aria-hidden="true"><path d="{_ICONS[name]}"/></svg></button>'
        for name, what in _BUTTONS.items()
    )
    speeds = "".join(
        f'<option value="{value}"{" selected" * (value == 1)}>{text}</option>'
        for value, text in _SPEEDS.items()
    )
    last, named = len(frames) - 1, escape(f"Film: {title}")
    return f"""<div class="jaxslam-film" role="group" tabindex="0" aria-label="{named}">
<style>{_CSS}</style>
<div class="screen"><img width="{width}" height="{height}" alt=""
src="data:image/png;base64,{ground}"><img class="frame" alt="{escape(said[-1] if said else title)}"
src="data:image/png;base64,{images[-1]}"></div>
<div class="bar" hidden>{buttons}<input type="range" min="0" max="{last}" value="{last}"
aria-label="Frame"><output aria-hidden="true"></output>
<select aria-label="Speed">{speeds}</select></div>
<script type="application/json">{data}</script>
<script>{SCRIPT}</script>
</div>
"""


def _divided(frames: Sequence[bytes]) -> Iterator[bytes]:
    """What most frames have in common, then what each has of its own, as PNG files.

    Frames of one palette become transparent where they are as the first picture, which halves them;
    others stay as they are, and cover it.
    """
    images = [Image.open(io.BytesIO(frame)) for frame in frames]
    palettes = {tuple(image.getpalette() or ()) for image in images}
    if {image.mode for image in images} != {"P"} or len(palettes) > 1 or 768 in map(len, palettes):
        yield from (frames[-1], *frames)
        return
    palette = [*palettes.pop(), 255, 255, 255]
    clear = len(palette) // 3 - 1  # the index of what is transparent
    samples = np.stack([np.asarray(image) for image in images[:: max(1, len(images) // 15)]])
    ground = np.sort(samples, axis=0)[len(samples) // 2]
    yield _file(ground, palette)
    for image in images:
        own = np.asarray(image)
        yield _file(np.where(own == ground, clear, own), palette, transparency=clear)


def _file(indices: np.ndarray, palette: Sequence[int], **more: int) -> bytes:
    """The PNG file of a picture of colours by their index in a palette."""
    tall, wide = indices.shape
    image = Image.frombytes("P", (wide, tall), indices.astype(np.uint8).tobytes())
    image.putpalette(palette)
    out = io.BytesIO()
    image.save(out, "PNG", **more)
    return out.getvalue()


_PAGE_CSS = """
:root { color-scheme: light dark; --ink: #1c2330; --line: #b9c0cc; --accent: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ef; --line: #4a5467;
  --accent: #7cc0f0; } body { background: #14181f; } }
body { margin: 1rem; text-align: center; }
.jaxslam-film { text-align: left; }
"""


def player_page(fragment: str, title: str = "") -> str:
    """A page of HTML with a player alone; the browser may load nothing."""
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {SCRIPT_SOURCE}"
    )
    return html_page(title or "film", policy, _PAGE_CSS, fragment)
