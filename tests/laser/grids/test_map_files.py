"""ROS maps in and out: shades to log-odds by hand, exact round trips, and errors with file and line."""

import math

import broken
import numpy as np
import pytest
import recordings

from jaxslam import datasets

YAML = """# a map
image: map.pgm
resolution: 0.05   # metres
origin: [-1.5, 2.0, 0.25]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
# The top row first: 0 black, 254 nearly white, 205 grey; 100 is p = 0.608.
SHADES = [[0, 254, 205], [100, 255, 10]]


def made(folder, yaml=YAML, image=None):
    if image is None:
        image = b"P5\n# by hand\n3 2\n255\n" + bytes(SHADES[0] + SHADES[1])
    (folder / "map.pgm").write_bytes(image)
    path = folder / "map.yaml"
    path.write_text(yaml, encoding="utf-8")
    return path


def same(a, b):
    for one, two in zip(a, b, strict=True):
        np.testing.assert_array_equal(one, two)


CERTAIN = math.log(509)
"""The log-odds of occupied cells: half a shade of 255 is left."""


def logit(p):
    return math.log(p / (1 - p))


def test_a_trinary_map_by_hand(tmp_path):
    grid = datasets.read_map(made(tmp_path))
    o = CERTAIN
    np.testing.assert_array_equal(grid.log_odds, [[0, -o, o], [o, -o, 0]])  # the last row first
    np.testing.assert_array_equal(grid.origin, [-1.5, 2.0, 0.25])
    assert grid.resolution == 0.05
    np.testing.assert_array_equal(grid.observed, [[False, True, True], [True, True, False]])
    assert logit(1 - 0.5 / 255) == pytest.approx(CERTAIN)


def test_scale_and_negate_by_hand(tmp_path):
    yaml = YAML.replace("negate: 0", "mode: scale\nnegate: true")
    grid = datasets.read_map(made(tmp_path, yaml))
    p = (100 / 255 - 0.196) / (0.65 - 0.196)
    o = CERTAIN
    np.testing.assert_allclose(grid.log_odds, [[logit(p), o, -o], [-o, o, o]], atol=1e-12)


def test_text_images_wide_shades_and_lists_in_lines(tmp_path):
    expected = datasets.read_map(made(tmp_path))
    text = b"P2 # text\n3 2\n255\n0 254 205\n# half way\n100 255 10\n"
    same(datasets.read_map(made(tmp_path, image=text)), expected)
    wide = b"P5 3 2 65535\n" + np.array(SHADES, ">u2").__mul__(257).astype(">u2").tobytes()
    same(datasets.read_map(made(tmp_path, image=wide)), expected)
    lines = YAML.replace("[-1.5, 2.0, 0.25]", "\n- -1.5\n- 2.0\n- 0.25").replace(
        "map.pgm", '"map.pgm"'
    )
    same(datasets.read_map(made(tmp_path, lines)), expected)


@pytest.mark.parametrize(
    "origin",
    [
        "[-1.5, 2.0,\n         0.25]",
        "[\n  -1.5,\n  2.0,\n  0.25,\n]",
        "\n  - -1.5\n  - 2\n  - 0.25",
    ],
)
def test_what_other_programs_write_is_read_and_their_keys_are_named(tmp_path, origin):
    """YAML as map_saver, slam_toolbox, nav2 and Cartographer write it, with keys of their own."""
    expected = datasets.read_map(made(tmp_path))
    text = YAML.replace("[-1.5, 2.0, 0.25]", origin)
    text = f"%YAML 1.1\n---\nmap_type: occupancy\n{text}info: {{frame: map, layers: [a, b]}}\n"
    with pytest.warns(UserWarning, match="is not read") as told:
        same(datasets.read_map(made(tmp_path, text)), expected)
    keys = [str(one.message).partition("map.yaml")[2] for one in told]
    assert keys[0] == ":3: key 'map_type' is not read"
    assert [key.partition(": ")[2] for key in keys[1:]] == ["key 'info' is not read"]


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "I;16", "BMP"])
def test_images_of_other_formats(tmp_path, mode):
    """Written by Pillow, which Matplotlib brings along: grey, colours, 16 bits."""
    image = broken.optional("PIL.Image")
    shades = np.array(SHADES, np.uint8)
    name = "map.bmp" if mode == "BMP" else "map.png"
    if mode == "I;16":
        drawn = image.fromarray(shades.astype(np.uint16) * 257)
    else:
        drawn = image.fromarray(shades).convert("L" if mode == "BMP" else mode)
    drawn.save(tmp_path / name)
    expected = datasets.read_map(made(tmp_path))
    same(datasets.read_map(made(tmp_path, YAML.replace("map.pgm", name))), expected)
    if mode == "RGBA":
        drawn.putalpha(100)
        drawn.save(tmp_path / name)
        with pytest.raises(ValueError, match=r"map\.png: expected an image that is opaque"):
            datasets.read_map(made(tmp_path, YAML.replace("map.pgm", name)))


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_round_trips_are_exact(tmp_path, mode):
    first = datasets.read_map(made(tmp_path))
    out = tmp_path / "out"
    paths = datasets.write_map(out / "again.yaml", first, mode=mode)
    assert [path.name for path in paths] == ["again.yaml", "again.pgm"]
    same(datasets.read_map(out / "again.yaml"), first)


@pytest.mark.parametrize("top", [254, 255])
def test_every_level_of_a_scaled_map_survives(tmp_path, top):
    image = f"P5 {top + 1} 1 {top}\n".encode() + bytes(range(top + 1))
    yaml = YAML.replace("0.65", "1").replace("0.196", "0").replace("negate", "mode: scale\nnegate")
    grid = datasets.read_map(made(tmp_path, yaml, image))
    assert np.sum(~grid.observed) == (top == 254)
    assert len(np.unique(grid.log_odds)) == top + 1
    _, pgm = datasets.write_map(tmp_path / "b.yaml", grid, mode="scale")
    assert pgm.read_bytes() == f"P5\n{top + 1} 1\n{top}\n".encode() + bytes(range(top + 1))
    same(datasets.read_map(tmp_path / "b.yaml"), grid)


def test_the_map_of_turtlebot(tmp_path):
    path = recordings.folder("maps") / "turtlebot3_world.yaml"
    grid = datasets.read_map(path)
    counts = [int(np.sum(c)) for c in (grid.log_odds > 0, grid.log_odds < 0, grid.log_odds == 0)]
    assert counts == [870, 7903, 138683]
    np.testing.assert_array_equal(grid.origin, [-10.0, -10.0, 0.0])
    datasets.write_map(tmp_path / "map.yaml", grid)
    same(datasets.read_map(tmp_path / "map.yaml"), grid)


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("map.pgm", "none.pgm", 2, "no image"),
        ("map.pgm", 300 * "9", 2, "no image"),
        ("0.05", "0", 3, "expected a resolution above 0"),
        ("0.05", "-0.05", 3, "expected a resolution above 0"),
        ("0.05", "fine", 3, "resolution is not a finite number: 'fine'"),
        ("0.05", "nan", 3, "resolution is not a finite number"),
        ("-1.5, 2.0, 0.25", "-1.5, 2.0", 4, "expected origin: [x, y, yaw], got [-1.5, 2.0]"),
        ("2.0, 0.25]", "2.0, 0.25", 4, "expected YAML, but "),
        ("-1.5, 2.0, 0.25", "-1.5, 2.0, inf", 4, "yaw is not a finite number"),
        ("-1.5, 2.0, 0.25", "-1.5, 2.0, 0\n 25", 4, "got [-1.5, 2.0, 0 25]: yaw is not a finite"),
        ("negate: 0", "negate: 2", 5, "expected negate to be 0 or 1"),
        ("negate: 0", "mode: raw\nnegate: 0", 5, "expected mode to be trinary or scale"),
        ("0.65", "0.1", 6, "expected 0 <= free_thresh < occupied_thresh <= 1"),
        ("negate: 0", "negate 0", 5, "expected YAML, but could not find expected ':'"),
        ("image: map.pgm", "image: [map.pgm]", 2, "expected one value of image"),
        (YAML, "- 1", 1, "expected `key: value`"),
        ("negate: 0", "resolution: 0.05", 5, "resolution occurs twice"),
        ("negate: 0\n", "", 6, "negate is missing"),
    ],
)
def test_a_bad_yaml_is_refused_with_its_line(tmp_path, old, new, line, reason):
    path = made(tmp_path, YAML.replace(old, new))
    recordings.assert_error(path, line, reason, lambda: datasets.read_map(path))


def test_a_byte_order_mark_is_no_key_and_other_ends_of_lines_are_read(tmp_path):
    assert datasets.read_map(made(tmp_path, "\r\r" + YAML)).resolution == 0.05
    assert datasets.read_map(made(tmp_path, "\ufeff" + YAML)).resolution == 0.05


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (b"\x89PNG\r\n\x1a\n123", "expected a PNG image: "),
        (b"P6 3 2 255\n", "expected an image in PGM (P5 or P2), PNG or BMP"),
        (b"", "expected an image in PGM"),
        (b"P5 3 2 255\n123", "the image ends after 3 of 6 bytes"),
        (b"P2 3 2 255\n1 2 3", "the image ends after 3 of 6 numbers"),
        (b"P2 3 2 255\n1 2 3 4 5 x", "expected a whole number, got 'x'"),
        (b"P5 3 -2 255\n123456", "expected a whole number, got '-2'"),
        (b"P5 0 2 255\n", "expected an image of at least 1 × 1"),
        (b"P2 3 2 9\n1 2 3 4 5 10", "a shade of 10 is above the largest, 9"),
    ],
)
def test_a_bad_image_is_refused(tmp_path, image, reason):
    path = made(tmp_path, image=image)
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is looked at below
        datasets.read_map(path)
    assert str(caught.value).startswith(f"{tmp_path / 'map.pgm'}: ")
    assert reason in str(caught.value)


@pytest.mark.parametrize("name", ["a #1", "b: c", "d's", "#", "two words"])
def test_a_name_that_yaml_would_misread_is_quoted(tmp_path, name):
    grid = datasets.read_map(made(tmp_path))
    path, _ = datasets.write_map(tmp_path / f"{name}.yaml", grid)
    same(datasets.read_map(path), grid)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises((ValueError, OSError), match=r"none\.yaml"):
        datasets.read_map(tmp_path / "none.yaml")


def test_what_cannot_be_written_is_refused_and_nothing_is_left(tmp_path):
    grid = datasets.read_map(made(tmp_path))
    for path, wrong, mode, reason in [
        ("a.yaml", grid._replace(log_odds=np.full((2, 2), np.nan)), "trinary", "unknown is 0"),
        (
            "a.yaml",
            grid._replace(log_odds=np.zeros((0, 2))),
            "trinary",
            "log_odds: expected at least one cell",
        ),
        (
            "a.yaml",
            grid._replace(origin=np.zeros(2)),
            "trinary",
            r"origin: expected finite numbers of shape \(3,\)",
        ),
        (
            "a.yaml",
            grid._replace(resolution=0.0),
            "trinary",
            "resolution: expected a number above 0",
        ),
        ("a.yaml", "grid", "trinary", "expected a Grid"),
        ("a.yaml", grid, "raw", "mode: expected"),
        ("a.pgm", grid, "trinary", "path: expected NAME.yaml"),
    ]:
        with pytest.raises(ValueError, match=f"write_map: .*{reason}"):
            datasets.write_map(tmp_path / "new" / path, wrong, mode=mode)
    assert not (tmp_path / "new").exists()
    (tmp_path / "b.pgm").mkdir()
    with pytest.raises(IsADirectoryError, match=r"b\.pgm cannot be written: it is a folder"):
        datasets.write_map(tmp_path / "b.yaml", grid)
    assert not (tmp_path / "b.yaml").exists()
