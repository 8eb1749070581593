"""Files of a campaign that are damaged, or odd: what was kept, or a line of ValueError with the file."""

import io
import json
import zipfile

import hypothesis.strategies as st
import numpy as np
import pytest
from fuzzing import FLIPS, assert_one_line, flipped, fuzz, odd, watched
from hypothesis import given
from stored import SETTINGS, assert_same

import jaxslam
from jaxslam import store

ARRAYS = {"ekf/nees": np.arange(96.0).reshape(32, 3), "finite": np.ones(32, bool)}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A store with a block, and the block's path and bytes."""
    made = store.open(tmp_path_factory.mktemp("kept") / "blocks", SETTINGS)
    made.claim({"key": "fry 0:1"})
    path = made.save(0, ARRAYS, 32)
    return made, path, path.read_bytes()


def assert_told(error, path):
    """A line that names the file or the folder."""
    assert len(str(error).splitlines()) == 1
    assert str(path) in str(error)


def assert_block(made, path):
    """The block as it was saved, or a line that names the file."""
    try:
        block = watched(lambda _: made.load(path), path.parent)
    except ValueError as error:
        assert_one_line(error, path.parent)
    else:
        assert block[:2] == (0, 32)
        assert_same(block.arrays, ARRAYS)


@fuzz(100)
@given(flips=FLIPS)
def test_blocks_with_flipped_bits(flips, kept):
    made, path, whole = kept
    path.write_bytes(flipped(whole, flips))
    assert_block(made, path)


SHAPES = st.sampled_from(["(32,)", "(99999999999,)", "(2, -1)", "(4, 8)", "()", "(2**40,)", "[32]"])
HEADS = st.builds(
    lambda kind, order, shape: f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}",
    st.sampled_from(["'<f8'", "'|O'", "'<U4000000000'", "[('a', '<f8')]", "'x'", "'|V8'", "'<M8[s]'"]),
    st.sampled_from(["False", "True", "1"]),
    SHAPES,
)  # fmt: skip
ABOUT = odd('{"first": 0, "runs": 32, "settings": "0123", "sha256": "abcd"}')


def entry(head, data):
    """The bytes of an entry .npy with a header and data."""
    head = head.encode("utf-8", "surrogatepass") + b"\n"
    return b"\x93NUMPY\x01\x00" + (len(head) % 2**16).to_bytes(2, "little") + head + data


def as_array(text):
    """The bytes of an entry .npy that holds a text."""
    out = io.BytesIO()
    np.lib.format.write_array(out, np.frombuffer(text.encode("utf-8", "replace"), np.uint8))
    return out.getvalue()


ENTRIES = st.dictionaries(
    st.sampled_from(["x.npy", "ekf/nees.npy", "x", "../y.npy", "_block.npy"]),
    st.one_of(
        st.builds(entry, HEADS.flatmap(odd), st.sampled_from([b"", bytes(256), bytes(2**22)])),
        ABOUT.map(as_array),
        st.binary(max_size=40),
    ),
    max_size=4,
)


@fuzz(100)
@given(
    entries=ENTRIES, about=ABOUT, how=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
)
def test_blocks_of_odd_entries(entries, about, how, kept):
    made, path, _ = kept
    with zipfile.ZipFile(path, "w", how) as out:
        for name, content in ({"_block.npy": as_array(about)} | entries).items():
            out.writestr(name, content)
    assert_block(made, path)


@fuzz(200)
@given(data=st.data())
def test_odd_manifests(data, kept):
    made, path, whole = kept
    path.write_bytes(whole)
    usual = json.loads((path.parent / "manifest.json").read_text(encoding="utf-8"))
    text = data.draw(odd(json.dumps(usual)))
    where = path.parent.parent / "odd"
    where.mkdir(exist_ok=True)
    (where / "manifest.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        found = watched(lambda _: store.resume(where), where)
    except ValueError as error:
        assert_told(error, where / "manifest.json")
    else:
        assert (found.settings, found.campaign) == (json.loads(json.dumps(SETTINGS)), made.campaign)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a campaign of two runs, as the command writes it."""
    from command import run_command

    out = tmp_path_factory.mktemp("finished")
    options = ["--runs", "2", "--steps", "5", "--filters", "dead_reckoning", "--out", str(out)]
    assert run_command(["consistency", *options]) == 0
    return out


@fuzz(200)
@given(data=st.data())
def test_odd_results(data, finished):
    path = finished / "consistency.json"
    whole = finished / "whole"
    if not whole.exists():
        whole.write_bytes(path.read_bytes())
    path.write_text(data.draw(odd(whole.read_text(encoding="utf-8"))), encoding="utf-8")
    try:
        found = watched(jaxslam.load, finished)
    except ValueError as error:
        assert_told(error, finished)
    else:
        assert found.runs >= 1 and str(found) and repr(found)
