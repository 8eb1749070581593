"""A store holds the blocks of one campaign, each run once, whatever ends the processes that save."""

import itertools
import json
import multiprocessing
import os
import shutil
import signal

import pytest
from stored import SETTINGS, files, fill, spans

from jaxslam import store


def test_a_renamed_or_foreign_block_is_set_aside(made, tmp_path):
    first, _ = fill(made, 0, 32)
    first.rename(made.folder / "block-00000064-00000096.npz")
    other = store.open(tmp_path / "other", SETTINGS | {"seed": 4})
    shutil.copy(fill(other, 0)[0], made.folder)
    shutil.copy(fill(made, 96)[0], made.folder / "block-96.npz")
    assert spans(made) == [(32, 32), (96, 32)]
    assert len(made.set_aside) == 3
    nameless, foreign, renamed = made.set_aside
    assert "block-96.npz: names no runs, holds 96 to 128" in nameless
    assert (
        "block-00000000-00000032.npz: belongs to another campaign, or to other settings" in foreign
    )
    assert "block-00000064-00000096.npz: names runs 64 to 96, holds 0 to 32" in renamed
    assert sum(name.endswith(".bad") for name in files(made)) == 3
    assert spans(made) == [(32, 32), (96, 32)] and len(made.set_aside) == 3


def test_no_run_counts_twice(made):
    fill(made, 0, 32, 64)
    fill(made, 0, runs=8)
    fill(made, 40, runs=60)
    (bad,) = fill(made, 16, runs=1)
    bad.write_bytes(b"")
    assert spans(made) == [(0, 32), (32, 32), (64, 32)]
    assert [line.split("block-")[1][:17] for line in made.set_aside] == [
        "00000000-00000008", "00000016-00000017", "00000040-00000100"
    ]  # fmt: skip
    # One that is bad itself bars nothing.
    fill(made, 96, runs=64)[0].write_bytes(b"")
    fill(made, 100, runs=8)
    assert spans(made)[3:] == [(100, 8)]


def test_blocks_are_read_one_at_a_time(made, monkeypatch):
    fill(made, *range(0, 320, 32))
    read = []
    monkeypatch.setattr(
        store.Store,
        "load",
        lambda self, path, load=store.Store.load: read.append(path) or load(self, path),
    )
    for number, _ in enumerate(made.blocks(), 1):
        assert len(read) == number


def test_a_manifest_is_whole_or_refused(made, tmp_path):
    manifest = made.folder / "manifest.json"
    text = manifest.read_text(encoding="utf-8")
    for content, message in (
        ('{\n"format": 1,\n"settings": {]}', "manifest.json, line 3: "),
        ("[]", "manifest.json: not the manifest"),
        ("\udcff", "manifest.json: not JSON"),
        (text.replace('"format": 4', '"format": 2'), "manifest.json: expected format 4, got 2"),
        (
            text.replace('"seed": 3', '"seed": 4'),
            "manifest.json: it was changed since .*: put the original back",
        ),
        (
            text.replace('"campaign": {}', '"campaign": []'),
            "manifest.json: it was changed since .*: put the original back",
        ),
    ):
        manifest.write_text(content, encoding="utf-8", errors="surrogateescape")
        with pytest.raises(ValueError, match=message):
            store.resume(made.folder)
    manifest.write_text(text, encoding="utf-8")
    assert store.resume(made.folder).settings == made.settings == json.loads(text)["settings"]
    with pytest.raises(ValueError, match=r"there is no .*nowhere.manifest\.json"):
        store.resume(tmp_path / "nowhere")
    for unfit in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="JSON"):
            store.open(tmp_path / "nowhere", {"bound": unfit})
    assert not (tmp_path / "nowhere").exists()


def test_a_campaign_claims_its_folder_and_no_other_gets_it(made):
    mine = {"key": "fry 0:1", "filter σ": "abc"}
    fill(made, 0)  # of nobody knows what
    made.claim(mine)
    made.claim(dict(reversed(mine.items())))
    fill(made, 32)
    again = store.resume(made.folder, SETTINGS)
    assert again.campaign == mine
    assert spans(again) == [(32, 32)]
    assert "another campaign" in again.set_aside[0]
    with pytest.raises(ValueError, match="holds another campaign: ") as caught:
        again.claim({"key": "fry 0:2", "steps": "5"})
    assert str(caught.value).split("another campaign: ")[1].split("; ") == [
        "key: fry 0:1 there, fry 0:2 here",
        "filter σ: abc there, absent here",
        "steps: absent there, 5 here",
        "choose another folder, or replace its runs (in the command, --overwrite)",
    ]
    assert store.resume(made.folder).campaign == mine
    # Of two that were opened before either claimed it, the second to claim finds the first.
    first, second = (store.open(made.folder / "new", SETTINGS) for _ in range(2))
    first.claim(mine)
    with pytest.raises(ValueError, match="key: fry 0:1 there"):
        second.claim(mine | {"key": "fry 0:2"})


def test_the_number_of_runs_may_grow_but_not_shrink(tmp_path):
    made = store.open(tmp_path, runs=64)
    made.claim({"key": "0"})
    fill(made, 32)
    wished = store.open(tmp_path, runs=100)
    assert (wished.runs, store.resume(tmp_path).runs) == (100, 64)
    with pytest.raises(ValueError, match="another campaign"):
        wished.claim({"key": "1"})
    assert store.resume(tmp_path).runs == 64  # what is refused extends nothing
    wished.claim({"key": "0"})
    store.resume(tmp_path).claim({"key": "0"})
    with pytest.raises(ValueError, match="to have 100 runs: expected at least as many, got 99"):
        store.open(tmp_path, runs=99)
    assert store.resume(tmp_path).runs == store.open(tmp_path).runs == 100
    assert spans(store.resume(tmp_path)) == [(32, 32)]


def test_a_folder_may_be_a_string_and_nothing_else_is_taken_for_one(tmp_path):
    made = store.open(str(tmp_path / "a"), SETTINGS)
    made.claim({})
    assert store.resume(str(tmp_path / "a"), SETTINGS).folder == made.folder == tmp_path / "a"
    for function in (store.open, store.resume):
        with pytest.raises(ValueError, match="expected a folder, as a path or a string, got 3"):
            function(3)


def test_every_difference_of_settings_is_named(made):
    for here, expected in (
        ({"seed": 4}, ["seed: 3 there, 4 here"]),
        ({"seed": "3"}, ['seed: 3 there, "3" here']),
        ({"seed": 3.0}, ["seed: 3 there, 3.0 here"]),
        ({"versions": {"jax": "0.10.2"}}, ["versions.jax: 0.10.1 there, 0.10.2 here"]),
        (
            {"versions": {"numpy": "2"}, "dtype": None},
            ["versions.jax: 0.10.1 there, absent here", "versions.numpy: absent there, 2 here", "dtype: absent there, null here"],
        ),
        ({"filters": ["ekf"]}, ['filters: ["ekf", "σ"] there, ["ekf"] here']),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="another campaign") as caught:
            store.resume(made.folder, SETTINGS | here)
        assert str(caught.value).split("another campaign: ")[1].split("; ") == expected
    with pytest.raises(ValueError, match="seed: 3 there, absent here"):
        store.resume(made.folder, {key: value for key, value in SETTINGS.items() if key != "seed"})


def _save_some(folder, offset):
    made = store.resume(folder, SETTINGS)
    for first in range(offset, 640, 64):
        fill(made, first)


def _save_until_killed(folder, call):
    made = store.resume(folder, SETTINGS)

    def kill(at, *_):
        if call == "fsync":  # in the middle of the write
            os.ftruncate(at, os.fstat(at).st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)

    for first in itertools.count(0, 32):
        if first == 96:
            setattr(os, call, kill)
        fill(made, first)


def finish(target, *arguments):
    """Exit codes of processes of their own, one for each tuple of arguments, all at once."""
    spawn = multiprocessing.get_context("spawn")
    workers = [spawn.Process(target=target, args=each) for each in arguments]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    return [worker.exitcode for worker in workers]


def test_two_processes_save_into_one_folder(made):
    assert finish(_save_some, (made.folder, 0), (made.folder, 32)) == [0, 0]
    assert spans(made) == [(first, 32) for first in range(0, 640, 32)]
    assert made.set_aside == []
    assert len(files(made)) == 21


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_killed_process_leaves_whole_blocks_only(made, call):
    assert finish(_save_until_killed, (made.folder, call)) == [-signal.SIGKILL]
    assert sum(name.endswith(".tmp") for name in files(made)) == 1, "killed in the middle"
    resumed = store.resume(made.folder, SETTINGS)
    assert spans(resumed) == [(0, 32), (32, 32), (64, 32)]
    fill(resumed, 96)
    assert spans(resumed)[3:] == [(96, 32)]
    assert resumed.set_aside == []
