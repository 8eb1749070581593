"""A block comes back bit for bit, or its file is named as bad; nothing half-written counts."""

import contextlib
import errno
import itertools
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from stored import SETTINGS, assert_same, files, fill, spans

from jaxslam import store

ARRAYS = {
    "ekf/nees": np.random.default_rng(0).normal(size=(4, 3)),
    "file": np.float32([[1.5, np.nan], [-0.0, np.inf]]),  # an argument's name in np.savez
    "finite": np.array([True, False]),
    "counts": np.asfortranarray(np.arange(6, dtype=np.int64).reshape(2, 3)),
    "nothing": np.zeros((0, 5), np.float32),
    "single": np.array(7, np.int32),
    "verdict σ": np.array(["fine", "pessimistic"]),
}


def test_arrays_come_back_bit_for_bit(made):
    path = made.save(32, ARRAYS, 32)
    assert path.name == "block-00000032-00000064.npz"
    with zipfile.ZipFile(path) as entries:  # the time of writing is not in it
        assert {entry.date_time for entry in entries.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    once = path.read_bytes()
    assert made.save(32, ARRAYS, 32).read_bytes() == once
    made.save(0, {}, np.int64(32))
    again = store.resume(made.folder, SETTINGS)
    empty, full = again.blocks()
    assert empty == (0, 32, {})
    assert full[:2] == (32, 32)
    assert_same(full.arrays, ARRAYS)
    with np.load(path, allow_pickle=False) as npz:  # anyone can read it
        np.testing.assert_array_equal(npz["ekf/nees"], ARRAYS["ekf/nees"])
    assert again.set_aside == []


def test_what_would_not_come_back_is_refused(made):
    for arrays in (
        {"x": np.array([None])},
        {"x": np.zeros(2, [("a", float)])},
        *({name: np.zeros(2)} for name in ("", "_block", "a.npy", "a\0b", "a\\b")),
    ):
        with pytest.raises(ValueError, match="block"):
            made.save(0, arrays, 1)
    for first, runs in ((-1, 1), (0, 0)):
        with pytest.raises(ValueError, match="expected runs >= 1"):
            made.save(first, {}, runs)
    assert files(made) == ["manifest.json"]


@pytest.mark.parametrize("call", ["replace", "fsync"])
@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_a_failed_save_leaves_the_earlier_blocks_alone(made, monkeypatch, call, kind):
    fill(made, 0)
    before = files(made)
    content = made.folder.joinpath(before[0]).read_bytes()

    def fail(*_):
        (hidden,) = set(files(made)) - set(before)
        assert hidden.startswith(".")
        assert str(os.getpid()) in hidden  # another process has another
        raise kind(errno.ENOSPC, "No space left on device") if kind is OSError else kind

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(kind) as caught:
        fill(made, 0, runs=31)
    if kind is OSError:
        assert caught.value.errno == errno.ENOSPC
        assert "block-00000000-00000031.npz" in str(caught.value)
        assert "No space left" in str(caught.value) and "bytes" in str(caught.value)
    with pytest.raises(kind):
        made.save(0, {"x": np.ones(9)}, 32)  # over one that is there
    assert files(made) == before
    assert made.folder.joinpath(before[0]).read_bytes() == content


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_names_the_file_and_the_size(made, monkeypatch):
    monkeypatch.setattr(Path, "open", lambda _, mode, plain=open: plain("/dev/full", mode))
    with pytest.raises(
        OSError, match=r"cannot write 80\d,\d{3} bytes, No space .*block-00000000"
    ) as e:
        made.save(0, {"x": np.zeros(100_000)}, 1)
    assert e.value.errno == errno.ENOSPC


def test_a_block_cut_short_anywhere_is_set_aside(made):
    (path,) = fill(made, 0)
    whole = path.read_bytes()
    for size in [0, 1, 4, *range(10, len(whole), 37), len(whole) - 1]:
        path.write_bytes(whole[:size])
        with pytest.raises(
            ValueError, match=r"block-00000000-00000032\.npz: truncated or not an npz"
        ):
            made.load(path)
    assert spans(made) == []
    (path,) = fill(made, 0)
    path.write_bytes(whole[:300])
    assert spans(made) == []
    bad = path.name + ".bad"
    assert files(made) == [bad, f"{bad}1", "manifest.json"]
    assert made.folder.joinpath(f"{bad}1").read_bytes() == whole[:300]
    assert [bad in line and "truncated" in line for line in made.set_aside] == [True, True]


def test_no_flipped_bit_changes_a_number(made):
    """A bit that carries no content, as of a date, may flip; each one of the data must be missed."""
    x = np.arange(20) / 3
    path = made.save(0, {"x": x}, 20)
    whole = path.read_bytes()
    data = range(whole.index(x.tobytes()), whole.index(x.tobytes()) + x.nbytes)
    for place, bit in itertools.product(range(len(whole)), (0, 6)):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << bit
        path.write_bytes(flipped)
        with contextlib.suppress(ValueError):
            block = made.load(path)
            assert place not in data
            assert block[:2] == (0, 20)
            assert_same(block.arrays, {"x": x})


def test_a_damaged_header_cannot_ask_for_memory(made):
    (path,) = fill(made, 0)
    old, new = b"(32,), }" + b" " * 12, b"(99999999999999,), }"
    assert len(old) == len(new) and path.read_bytes().count(old) == 1
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(ValueError, match=r"entry x\.npy is damaged"):
        made.load(path)


def test_the_checksum_sees_what_the_zip_does_not(made):
    (path,) = fill(made, 0)
    with np.load(path) as npz:
        entries = dict(npz)
    x = entries.pop("x")
    np.savez(path, x=x, **entries)
    assert_same(made.load(path).arrays, {"x": x})
    forms = [np.nextafter(x, 9), x.astype(np.float32), x.reshape(2, 16), x.view(np.int64)]
    for changed in ({}, {"y": x}, {"x": x, "y": x}, *({"x": form} for form in forms)):
        np.savez(path, **entries, **changed)
        with pytest.raises(ValueError, match="checksum"):
            made.load(path)
    for about in (b"{}", b"[]", b"{"):
        np.savez(path, x=x, _block=np.frombuffer(about, np.uint8))
        with pytest.raises(ValueError, match="not a block"):
            made.load(path)
    np.savez(path, x=x)
    with pytest.raises(ValueError, match="not a block"):
        made.load(path)


def test_pickle_is_never_loaded(made):
    class Trap:
        def __reduce__(self):
            return pytest.fail, ("unpickled",)

    path = made.folder / "block-00000000-00000032.npz"
    np.savez(path, x=np.array([Trap()], object))
    with pytest.raises(ValueError, match="allow_pickle"):
        made.load(path)
