"""Compiled programs on the disk: found again, bounded, and no trouble of theirs is anybody's."""

import os
import sys
import zlib
from pathlib import Path

import jax
import pytest

from jaxslam import _cli as cli

OURS = {
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
}


def test_the_suite_writes_nothing_into_the_users_folder():
    """Not in processes that tests start either; see conftest."""
    assert os.environ.get("JAX_COMPILATION_CACHE_DIR")


@pytest.fixture(autouse=True)
def as_it_was(monkeypatch, tmp_path):
    """The test run may have a cache of its own; here JAX has been told of none."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "of the user"))
    with cli.cache.jax_settings(jax_compilation_cache_dir=None):
        before = {name: getattr(jax.config, name) for name in OURS}
        yield
        assert {name: getattr(jax.config, name) for name in OURS} == before


def one_program(number=1.0):
    """How many of the programs needed for it were taken from the cache."""

    def add(x):
        return x + number

    with cli.common.CompileClock() as clock:
        jax.jit(add).lower(1.0).compile()
    assert clock.programs == 1
    assert 0.0 < clock.compiling <= clock.seconds
    return clock.cached


def entries(folder):
    return sorted(folder.rglob("*-cache"))


def test_programs_are_found_again(tmp_path):
    for cached in (0, 1):
        with cli.cache.program_cache(tmp_path / "a" / "b"):
            assert one_program() == cached
    assert len(entries(tmp_path / "a" / "b")) == 1
    with cli.cache.program_cache(tmp_path / "other"):
        assert one_program() == 0
    assert len(entries(tmp_path)) == 2


def test_by_default_they_are_kept_in_the_users_folder_or_where_jax_was_told(tmp_path):
    with cli.cache.program_cache(None):
        one_program()
    assert len(entries(tmp_path / "of the user" / "jaxslam")) == 1
    with cli.cache.jax_settings(
        jax_compilation_cache_dir=str(tmp_path / "told"),
        jax_persistent_cache_min_compile_time_secs=0.0,
    ):
        with cli.cache.program_cache(None):
            one_program()
        assert len(entries(tmp_path / "told")) == 1
        with cli.cache.program_cache(None, off=True):
            assert one_program() == 0
            assert one_program(2.0) == 0
        assert len(entries(tmp_path / "told")) == 1
        with cli.cache.program_cache(tmp_path / "asked"):
            one_program()
        assert len(entries(tmp_path / "asked")) == 1
    assert len(entries(tmp_path)) == 3


def test_the_users_folder_follows_the_platform(monkeypatch):
    home = Path.home()
    for system, variables, expected in (
        ("linux", {}, home / ".cache" / "jaxslam"),
        ("linux", {"XDG_CACHE_HOME": "/x"}, Path("/x/jaxslam")),
        ("linux", {"XDG_CACHE_HOME": "relative"}, home / ".cache" / "jaxslam"),
        ("darwin", {}, home / "Library" / "Caches" / "jaxslam"),
        ("win32", {}, home / "AppData" / "Local" / "jaxslam"),
        ("win32", {"LOCALAPPDATA": "/l"}, Path("/l/jaxslam")),
    ):
        with monkeypatch.context() as patch:
            for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
                patch.delenv(name, raising=False)
            for name, value in variables.items():
                patch.setenv(name, value)
            patch.setattr(sys, "platform", system)
            assert cli.cache.user_folder() == expected


def warned(capsys):
    """The lines on the standard error, each a warning."""
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("jaxslam: warning: ") for line in lines)
    return lines


def test_a_folder_that_cannot_be_is_said_and_done_without(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").write_text("")
    cache_folder = tmp_path / "file" / "cache"
    with cli.cache.program_cache(cache_folder):
        one_program()
    (line,) = warned(capsys)
    assert f"cannot be kept in {cache_folder} (" in line
    assert "continuing without" in line

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(cli.cache, "user_folder", homeless)
    with cli.cache.program_cache(None):
        one_program()
    assert "the user's cache folder (Could not determine home" in warned(capsys)[0]


@pytest.mark.parametrize("spoil", ["truncated", "empty", "noise", "of another version"])
def test_a_damaged_program_is_said_and_compiled_anew(tmp_path, capsys, spoil):
    def both():
        with cli.cache.program_cache(tmp_path):
            return one_program() + one_program(2.0)

    assert both() == 0
    for path in entries(tmp_path):
        content = path.read_bytes()
        path.write_bytes(
            {
                "truncated": content[: len(content) // 2],
                "empty": b"",
                "noise": bytes(range(256)),
                "of another version": zlib.compress(b"\0\0\0\1" + b"another version's " * 9),
            }[spoil]
        )
    assert both() == 0
    (line,) = warned(capsys)  # of two programs
    assert f"a compiled program in {tmp_path}" in line
    assert "is damaged (" in line
    assert both() == 2
    assert warned(capsys) == []


def test_a_folder_that_jax_was_told_of_is_not_ours_to_mend(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with (
        cli.cache.jax_settings(jax_compilation_cache_dir=str(tmp_path / "file" / "below")),
        cli.cache.program_cache(None),
    ):
        assert one_program() + one_program(2.0) == 0
    (line,) = warned(capsys)
    assert f"a compiled program in {tmp_path / 'file' / 'below'}" in line


def test_a_full_disk_is_said_once_and_leaves_no_half_of_a_program(tmp_path, capsys, monkeypatch):
    def full(path, content):
        with open(path, "wb") as file:
            file.write(content[:50])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with cli.cache.program_cache(tmp_path):
        assert one_program() + one_program(2.0) == 0
    (line,) = warned(capsys)
    assert "cannot be written (" in line
    assert "No space left on device" in line
    assert entries(tmp_path) == []


def test_other_warnings_are_left_alone(tmp_path):
    import warnings

    with pytest.warns(UserWarning, match="something else"), cli.cache.program_cache(tmp_path):
        warnings.warn("something else", stacklevel=1)


def test_what_was_not_used_for_longest_goes_first(tmp_path):
    folder = tmp_path / "kind"
    folder.mkdir()
    for used, name in enumerate("dbca"):
        path = folder / f"{name}-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (1000 + used, 900))
    (folder / "mine.txt").write_bytes(bytes(1000))
    cli.cache.prune(tmp_path, 400)
    assert len(entries(tmp_path)) == 4
    cli.cache.prune(tmp_path, 250)
    assert [path.name for path in entries(tmp_path)] == ["a-cache", "c-cache"]
    with cli.cache.program_cache(tmp_path, bound=0):
        one_program()
    assert entries(tmp_path) == []
    assert (folder / "mine.txt").exists()


def test_programs_of_another_version_or_processor_are_of_another_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cli.cache, "version", lambda name: "0.0.1")
    with cli.cache.program_cache(tmp_path):
        one_program()
    monkeypatch.undo()
    with cli.cache.program_cache(tmp_path):
        assert one_program() == 0
    assert len({path.parent for path in entries(tmp_path)}) == 2


@pytest.mark.parametrize(
    ("options", "kept", "lines"),
    [
        (["--cache", "{}/asked"], 1, 0),
        (["--no-cache"], 0, 0),
        ([], 1, 0),
        (["--cache", "{}/file/below"], 0, 1),
    ],
)
@pytest.mark.parametrize("command", [["verify"], ["run", "--dataset", "bonn", "path"]])
def test_commands_keep_programs_unless_told_not_to(
    tmp_path, capsys, monkeypatch, command, options, kept, lines
):
    def work(*_):
        one_program()
        return 0

    (tmp_path / "file").write_text("")
    monkeypatch.setattr(cli.verify, "verify_models", work)
    monkeypatch.setattr(cli.run, "run_dataset", work)
    assert cli.main([*command, *(option.format(tmp_path) for option in options)]) == 0
    said = capsys.readouterr()
    assert len(entries(tmp_path)) == kept
    assert len(said.err.splitlines()) == lines
    assert "s of them to compile or load 1 program: 1 compiled, 0 loaded from the cache" in said.out
