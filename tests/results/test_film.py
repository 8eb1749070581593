"""Films as files: which steps, GIF, MP4, and the player, which loads nothing."""

import re
import shutil
import subprocess

import broken
import matplotlib
import numpy as np
import pytest
from PIL import Image

from jaxslam import plot
from jaxslam.results.plot import _film, _run_film, _style

COLORS = [(204, 0, 0), (0, 204, 0), (0, 0, 204)]


def painted(count=3, fps=4):
    """A film whose panel is red, green and blue."""
    figure, (axes, _) = plot.stage((0, 1), (0, 1), width=2.0)
    picture = axes.imshow(np.zeros((2, 2, 3), np.uint8), extent=(0, 1, 0, 1))

    def update(k):
        picture.set_data(np.full((2, 2, 3), COLORS[k % 3], np.uint8))

    return plot.Film(figure, update, count, fps=fps)


@pytest.fixture
def three():
    return painted()


def test_a_film_does_not_depend_on_the_users_settings(three):
    usual = three.to_jshtml()
    with matplotlib.rc_context(
        {"font.size": 30.0, "axes.grid": True, "image.interpolation": "none"}
    ):
        other = painted().to_jshtml()
    assert usual.count("iVBOR") == 3 and other == usual


# --- steps --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "most"), [(1, 1), (3, 3), (3, 10)])
def test_every_step_of_a_short_run_is_a_frame(steps, most):
    np.testing.assert_array_equal(_run_film.frame_steps(steps, most), np.arange(steps))


def test_a_long_run_is_shown_evenly_from_the_first_step_to_the_last():
    at = _run_film.frame_steps(6969, 250)
    assert len(at) == 250 and at[0] == 0 and at[-1] == 6968
    assert set(np.diff(at)) == {27, 28}
    assert list(_run_film.frame_steps(5, 1)) == [4]
    assert len(_run_film.frame_steps(6969)) == _run_film.MOST


def test_frames_are_even_in_time_where_times_are_given():
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 4.0, 7.9, 8.0])
    at = _run_film.frame_steps(8, 5, time)  # at 0, 2, 4, 6, 8 s
    np.testing.assert_array_equal(at, [0, 4, 5, 5, 7])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "animate: steps: expected an integer >= 1, got 0"),
        ((3, 0), "animate: frames: expected an integer >= 1, got 0"),
        ((3, 2, np.zeros(2)), "animate: time: expected 3 finite ones"),
        ((3, 2, np.array([0.0, 2.0, 1.0])), "ones that do not go back"),
        ((3, 9, np.array([0.0, np.nan, 1.0])), "animate: time: expected 3 finite ones"),
    ],
)
def test_steps_that_cannot_be_chosen_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        _run_film.frame_steps(*arguments)


@pytest.mark.parametrize(("frames", "fps"), [(1, 2), (30, 3), (100, 10), (250, 25), (1000, 25)])
def test_a_film_lasts_ten_seconds_if_it_can(frames, fps):
    assert painted(frames, fps=None).fps == fps


# --- files --------------------------------------------------------------------------------------


def test_a_gif_has_every_frame_with_its_delay(three, tmp_path):
    three.save(tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as read:
        assert read.n_frames == 3 and read.info["loop"] == 0
        for k, color in enumerate(COLORS):
            read.seek(k)
            assert read.convert("RGB").getpixel((70, 80)) == color
            assert read.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
            assert read.info["duration"] == 250


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_an_mp4_holds_the_frames(three, tmp_path):
    path, shot = tmp_path / "a.mp4", tmp_path / "frame-%d.png"
    three.save(path)
    assert path.read_bytes()[4:8] == b"ftyp"
    subprocess.run(["ffmpeg", "-loglevel", "error", "-i", path, shot], check=True)
    for k, color in ((1, COLORS[0]), (3, COLORS[2])):
        seen = Image.open(tmp_path / f"frame-{k}.png").convert("RGB").getpixel((70, 80))
        np.testing.assert_allclose(seen, color, atol=12)
    assert len(list(tmp_path.glob("frame-*"))) == 3


def test_a_file_that_cannot_be_written_is_refused(three, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    for name, message in (
        *((name, r"expected a name in .gif, .html, .mp4, got") for name in ("a.avi", "a", "a.GIF")),
        ("a.mp4", r"a.mp4 cannot be written \(ffmpeg is not installed\): save a .gif"),
    ):
        with pytest.raises(ValueError, match=f"Film.save: .*{message}"):
            three.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


ENCODERLESS = "#!/bin/sh\necho 'Unknown encoder h264' >&2\nexit 1\n"


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (ENCODERLESS, "Unknown encoder h264"),
        ("#!/bin/sh\nexec 0<&-\nexit 127\n", "127"),
    ],
)
def test_an_ffmpeg_that_fails_is_one_line(three, tmp_path, monkeypatch, script, message):
    broken.program(monkeypatch, tmp_path, "ffmpeg", script)
    assert _film.mp4_problem().startswith("ffmpeg: ")
    with pytest.raises(ValueError, match=r"(?s)^Film.save: .*: save a .gif$") as caught:
        three.save(tmp_path / "a.mp4")
    assert "\n" not in str(caught.value) and message in str(caught.value)


def test_an_ffmpeg_that_does_not_start_or_is_not_there_is_named(tmp_path, monkeypatch):
    broken.program(monkeypatch, tmp_path, "ffmpeg", "#!/no/such/shell\n")
    monkeypatch.setenv("PATH", str(tmp_path))  # else one that is installed is taken
    assert "Error: [Errno" in _film.mp4_problem()
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert _film.mp4_problem() == "ffmpeg is not installed"


def test_without_a_font_nothing_is_drawn(tmp_path, monkeypatch):
    (tmp_path / "damaged.ttf").write_bytes(b"no font")
    monkeypatch.setattr(_style, "findfont", lambda _: str(tmp_path / "damaged.ttf"))
    with pytest.raises(
        ValueError, match=r"^figures: matplotlib .* cannot be used \(.*: pip"
    ) as caught:
        plot.panels_of(2, 2, 1)
    assert "\n" not in str(caught.value)


# --- the player ---------------------------------------------------------------------------------


def test_the_player_holds_every_frame_and_loads_nothing(three, tmp_path):
    html = three._repr_html_()
    assert html.count("iVBOR") == 3 and "data:image/png;base64," in html
    assert "http" not in html and "href" not in html
    three.save(tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text() == html


ACTIONS = """
<script>
setTimeout(() => {
  const slider = document.querySelector("input[type=range]"), seen = [slider.value];
  const click = (what) => {
    document.querySelector(`[title="${what}"]`).click();
    seen.push(slider.value);
  };
  for (const what of ["Next frame", "Last frame", "Previous frame", "First frame"]) click(what);
  click("Play");
  setTimeout(() => {
    seen.push(slider.value, document.querySelector("img").naturalWidth);
    document.title = seen.join(" ");
  }, 2000);
}, 500);
</script>"""


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
def test_a_browser_steps_and_plays(three, tmp_path):
    (tmp_path / "film.html").write_text(three.to_jshtml() + ACTIONS)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--virtual-time-budget=5000", f"--user-data-dir={tmp_path / 'profile'}"]
    command += ["--dump-dom", f"file://{tmp_path}/film.html"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (title,) = re.findall("<title>(.*?)</title>", done.stdout)
    assert title.split() == ["0", "1", "2", "1", "0", "0", "2", "220"]
