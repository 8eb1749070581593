"""Optional libraries: whatever they raise is one line that says what is wrong and how to mend it."""

import re
import sys
import tomllib
from pathlib import Path

import broken
import pytest

from jaxslam.core._optional import LIBRARIES, Unusable, loading

BAGS = r"pip install 'jaxslam\[ros\]'"


@pytest.mark.parametrize(
    ("source", "version", "told"),
    [
        (None, None, f"rosbags is not installed: {BAGS}"),
        ("", "0.11.5", f"rosbags 0.11.5 is too old, expected 0.11.6 or later: {BAGS}"),
        ("", "0.9.16.post1", "rosbags 0.9.16.post1 is too old"),
        (
            "raise RuntimeError('no\\n library')",
            "0.12",
            r"rosbags 0.12 is .* \(RuntimeError: no\): ",
        ),
        (
            "raise OSError()",
            "1.0",
            r"cannot be used \(OSError\): pip install --force-reinstall ros",
        ),
        ("import nowhere_to_be_found", "1", r"\(ModuleNotFoundError: No module named 'nowhere"),
        ("", "0.11.6", r"\(ImportError: cannot import name 'highlevel'"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, monkeypatch, source, version, told):
    if source is None:
        monkeypatch.setitem(sys.modules, "rosbags", None)
    else:
        broken.library(monkeypatch, tmp_path, "rosbags", {"": source}, version)
    for kind in (ImportError, ValueError):
        with (
            pytest.raises(kind, match=f"^rosbag: .*{told}") as caught,
            loading("rosbag", "rosbags"),
        ):
            from rosbags import highlevel  # noqa: F401
        assert "\n" not in str(caught.value) and type(caught.value) is Unusable


@pytest.mark.parametrize("version", ["0.11.6", "0.11.10", "0.12rc1", "1", "1.0.0", "unknown"])
def test_another_version_is_tried(tmp_path, monkeypatch, version):
    broken.library(monkeypatch, tmp_path, "rosbags", {"": "ways = 1"}, version)
    with loading("rosbag", "rosbags"):
        from rosbags import ways
    assert ways == 1


def test_the_lowest_versions_are_those_of_the_package():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for name, library in LIBRARIES.items():
        if library.lowest:
            extra = re.findall(r"\[(.*)\]", library.install) or ["dask", "mpi"]
            assert all(f"{name}>={library.lowest}" in extras[each] for each in extra)
