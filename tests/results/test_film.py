"""Films as files: which steps, GIF, MP4, the player in a browser, and files written whole or not at all."""

import base64
import hashlib
import io
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from jaxslam.results import film
from jaxslam.results.film import Film, encoding, frame_steps, player
from jaxslam.results.film.timing import pace

COLORS = [(200, 0, 0), (0, 200, 0), (0, 0, 200)]
SAID = ("first </script>", "second", "third")


def png(color, size=(16, 8)):
    out = io.BytesIO()
    Image.new("RGB", size, color).quantize(4).save(out, "PNG")
    return out.getvalue()


@pytest.fixture
def three():
    return Film(tuple(map(png, COLORS)), 25.0, SAID, "a <b>")


# --- steps --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "most"), [(1, 1), (3, 3), (3, 10)])
def test_every_step_of_a_short_run_is_a_frame(steps, most):
    np.testing.assert_array_equal(frame_steps(steps, most), np.arange(steps))


def test_a_long_run_is_shown_evenly_from_the_first_step_to_the_last():
    at = frame_steps(6969)
    assert len(at) == film.MOST and at[0] == 0 and at[-1] == 6968
    assert set(np.diff(at)) == {27, 28}
    assert list(frame_steps(5, 1)) == [4]


def test_frames_are_even_in_time_where_times_are_given():
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 4.0, 7.9, 8.0])
    at = frame_steps(8, 5, time)  # at 0, 2, 4, 6, 8 s
    np.testing.assert_array_equal(at, [0, 4, 5, 5, 7])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "animate: expected at least one step, got 0"),
        ((3, 0), "animate: frames: expected an integer >= 1, got 0"),
        ((3, 2, np.zeros(2)), "animate: expected 3 finite times"),
        ((3, 2, np.array([0.0, 2.0, 1.0])), "times that do not go back"),
        ((3, 9, np.array([0.0, np.nan, 1.0])), "animate: expected 3 finite times"),
    ],
)
def test_steps_that_cannot_be_chosen_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        frame_steps(*arguments)


def test_a_film_lasts_ten_seconds_if_it_can():
    assert [pace(n) for n in (1, 30, 250, 1000)] == [2.0, 3.0, 25.0, 25.0]


# --- files --------------------------------------------------------------------------------------


def test_a_gif_has_every_frame_with_its_delay(three):
    read = Image.open(io.BytesIO(three.encoded("gif")))
    assert read.n_frames == 3 and read.size == three.size == (16, 8) and read.info["loop"] == 0
    for k, color in enumerate(COLORS):
        read.seek(k)
        assert read.convert("RGB").getpixel((3, 3)) == color
        assert read.info["duration"] == (40 if k < 2 else 2000)


def test_without_ffmpeg_a_gif_is_written_and_said_in_a_line(three, tmp_path, monkeypatch):
    monkeypatch.setattr(encoding, "ffmpeg", lambda: None)
    with pytest.warns(UserWarning, match="ffmpeg is not installed: GIF instead of MP4") as said:
        path = three.save(tmp_path / "a.mp4")
    assert "\n" not in str(said[0].message)
    assert path == tmp_path / "a.gif" and path.read_bytes().startswith(b"GIF89a")
    assert [each.name for each in tmp_path.iterdir()] == ["a.gif"]


def test_what_ffmpeg_says_is_passed_on(three, tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.exit('no encoder\\nUnknown encoder')\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(encoding, "ffmpeg", lambda: str(program))
    kind, content, why = three.moving()
    assert kind == "gif" and content.startswith(b"GIF")
    assert why == "ffmpeg failed (Unknown encoder): GIF instead of MP4"


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_an_mp4_holds_the_frames(three, tmp_path):
    frames = [png(color, (64, 32)) for color in COLORS for _ in range(5)]
    path = Film(tuple(frames), 5.0, ("",) * 15).save(tmp_path / "a.mp4")
    assert path.read_bytes()[4:8] == b"ftyp"
    shot = tmp_path / "frame-%d.png"
    subprocess.run(["ffmpeg", "-loglevel", "error", "-i", path, shot], check=True)
    for k, color in ((1, COLORS[0]), (15, COLORS[2])):
        seen = Image.open(tmp_path / f"frame-{k}.png").convert("RGB").getpixel((30, 15))
        np.testing.assert_allclose(seen, color, atol=12)
    assert len(list(tmp_path.glob("frame-*"))) == 15


@pytest.mark.parametrize("name", ["a.avi", "a", "a.MP4"])
def test_another_ending_is_refused(three, tmp_path, name):
    with pytest.raises(ValueError, match=r"Film.save: expected a name in .mp4, .gif, .html"):
        three.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


# --- the player ---------------------------------------------------------------------------------


def held(html):
    """The data of a player."""
    return json.loads(re.search('application/json">(.*?)</script>', html)[1])


def composed(html):
    """The frames of a player as arrays: each over what they have in common."""
    under = re.search(r'alt=""\s+src="data:image/png;base64,([^"]*)"', html)[1]
    data = held(html)
    ground, *own = (
        Image.open(io.BytesIO(base64.b64decode(each))).convert("RGBA")
        for each in (under, *data["frames"])
    )
    return [np.asarray(Image.alpha_composite(ground, each).convert("RGB")) for each in own]


@pytest.mark.parametrize("one_palette", [True, False])
def test_what_frames_have_in_common_is_kept_once(one_palette):
    rng = np.random.default_rng(0)
    pictures = np.repeat(rng.integers(0, 5, (1, 40, 60)), 6, axis=0).astype(np.uint8)
    pictures[np.arange(6), 3 + 5 * np.arange(6)] = 4 - pictures[np.arange(6), 3 + 5 * np.arange(6)]
    palette = rng.integers(0, 255, 15).tolist()
    frames = []
    for k, picture in enumerate(pictures):
        image = Image.frombytes("P", (60, 40), picture.tobytes())
        image.putpalette(palette if one_palette else [*palette[:-1], k])
        out = io.BytesIO()
        image.save(out, "PNG")
        frames.append(out.getvalue())
    html = player(frames)
    given = [np.asarray(Image.open(io.BytesIO(frame)).convert("RGB")) for frame in frames]
    np.testing.assert_array_equal(composed(html), given)
    data = held(html)
    sizes = [3 * len(each) / 4 for each in data["frames"]]
    assert (max(sizes) < 0.6 * min(map(len, frames))) == one_palette


def test_a_player_holds_every_frame_and_loads_nothing(three):
    html = three.player()
    assert html == player(three.frames, said=SAID, fps=25.0, title="a <b>")
    assert [tuple(frame[3, 3]) for frame in composed(html)] == COLORS
    assert html.count("</script>") == 2  # that in a text is no end
    assert "Film: a &lt;b&gt;" in html and 'width="16" height="8"' in html
    page = three.encoded("html").decode()
    assert not re.search(r"(src|href)=.?(?!.?data:)\w", page)
    digest = base64.b64encode(hashlib.sha256(film.SCRIPT.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page and f"<script>{film.SCRIPT}</script>" in page
    with pytest.raises(ValueError, match="player: expected frames and a text for each or none"):
        player(three.frames, said=("one",))
    with pytest.raises(ValueError, match="got 0 frames"):
        player([])


ACTIONS = """
<script>
const film = document.querySelector(".jaxslam-film"), seen = [];
const at = () => film.querySelector(".frame").alt.split(" ")[0] + film.querySelector("input").value;
const press = (key) => film.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
const click = (what) => film.querySelector(`[data-do=${what}]`).click();
seen.push(at());
for (const key of ["Home", "ArrowRight", "ArrowLeft", "ArrowLeft", "End", "ArrowRight", "x"]) {
  press(key);
  seen.push(at());
}
for (const what of ["first", "next", "last", "back"]) { click(what); seen.push(at()); }
film.querySelector("input").value = 0;
film.querySelector("input").dispatchEvent(new Event("input"));
seen.push(at(), film.querySelector("output").value.replaceAll(" ", ""));
press("End");
click("play");
seen.push(at(), film.querySelector("[data-do=play]").getAttribute("aria-pressed"));
setTimeout(() => {
  seen.push(at(), film.querySelector("[data-do=play]").getAttribute("aria-pressed"));
  seen.push(getComputedStyle(film.querySelector(".bar")).display);
  seen.push(film.querySelector(".frame").naturalWidth);
  document.title = seen.join(" ");
}, 1000);
</script>
</body>"""


def browsed(page, folder):
    """The page as a browser has it after 5 s of its own time."""
    (folder / "film.html").write_text(page)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--virtual-time-budget=5000", f"--user-data-dir={folder / 'profile'}", "--dump-dom"]
    command += [f"file://{folder}/film.html"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
def test_a_browser_steps_and_plays_by_button_slider_and_key(three, tmp_path):
    page = three.encoded("html").decode().replace("</body>", ACTIONS)
    # The policy, for the test's own script.
    page = re.sub(r"script-src 'sha256-[^']*'", "script-src 'unsafe-inline'", page)
    (title,) = re.findall("<title>(.*?)</title>", browsed(page, tmp_path))
    assert title.split() == [
        *["third2", "first0", "second1", "first0", "first0", "third2", "third2", "third2"],
        *["first0", "second1", "third2", "second1", "first0", "1/3"],
        *["first0", "true", "third2", "false", "flex", "16"],
    ]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
def test_the_policy_of_the_page_lets_the_player_run(three, tmp_path):
    page = browsed(three.encoded("html").decode(), tmp_path)
    assert 'data-ready="yes"' in page and 'aria-valuetext="third"' in page
