"""Numbers replaced in the text of a `dataset.toml`: comments and all else stay."""

import tomllib

import pytest

from jaxslam.datasets.table_settings import changed, toml_lines

CHANGES = {
    "motion": {"noise": [0.012345678, 1e-9]},
    "sensor": {"noise": [0.5, 2], "mount": [1, 0, 0]},
}
LINES = "noise = [0.01235, 1e-09]"


def test_the_fragment_is_toml_with_comments():
    text = toml_lines(CHANGES, {"motion.noise": "v [m/s], omega [rad/s]"})
    assert f"[motion]\n{LINES}  # v [m/s], omega [rad/s]\n" in text
    assert tomllib.loads(text)["sensor"] == {"noise": [0.5, 2], "mount": [1, 0, 0]}


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (
            "# mine\n[motion]\nmodel = 'unicycle'\nnoise = [1, 2]  # by hand [1]\n[filter]\ngate = 0.9\n",
            f"# mine\n[motion]\nmodel = 'unicycle'\n{LINES}  # by hand [1]\n[filter]\ngate = 0.9\n\n"
            "[sensor]\nnoise = [0.5, 2]\nmount = [1, 0, 0]\n",
        ),
        (
            "[ sensor ]\nmount=[0,0,0]\n[motion]\n",
            f"[ sensor ]\nnoise = [0.5, 2]\nmount=[1, 0, 0]\n[motion]\n{LINES}\n",
        ),
        ("name = 'a'", f"name = 'a'\n\n{toml_lines(CHANGES)}"),
        (None, toml_lines(CHANGES)),
    ],
)
def test_lines_are_replaced_or_inserted(tmp_path, before, after):
    path = tmp_path / "dataset.toml"
    if before is not None:
        path.write_text(before)
    assert changed(path, CHANGES) == after


@pytest.mark.parametrize("before", ["[motion]\nnoise = [\n1,\n2]\n", "motion = {noise = [1, 2]}\n"])
def test_what_cannot_be_changed_line_by_line_is_said(tmp_path, before):
    path = tmp_path / "dataset.toml"
    path.write_text(before)
    with pytest.raises(ValueError, match=r"dataset\.toml: cannot be changed line by line"):
        changed(path, CHANGES)
