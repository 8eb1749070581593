"""The command's programs on the disk: found without a trace, whole or not at all."""

from pathlib import Path

import numpy as np
import worlds

import jaxslam
from jaxslam import filters, programs
from jaxslam.cli.runtime import cache, library
from jaxslam.cli.runtime.compile_clock import CompileClock
from jaxslam.monte_carlo import monte_carlo

ASKED = {"scenario": "ring", "filters": "ekf", "seed": 0, "runs": 4, "bound": False}


class Shelf:
    """A library in memory that counts."""

    def __init__(self):
        self.content, self.found = {}, 0

    def get(self, name):
        self.found += name in self.content
        return self.content.get(name)

    def put(self, name, content):
        self.content[name] = content


def test_a_campaign_runs_from_what_another_has_compiled():
    """The same numbers, and no filter is traced."""
    there, shelf = worlds.ring(13), Shelf()
    traced = []

    def campaign(candidate, kept):
        found = monte_carlo(
            there,
            {"reckoning": candidate},
            4,
            worlds.key(),
            block=4,
            library=kept,
            dtype=np.float64,
        )
        return found.filters["reckoning"]

    def watched(truth):
        traced.append(1)
        return filters.DeadReckoning(there.motion, there.sensor)

    with cache.jax_settings(jax_compilation_cache_dir=None):
        first = campaign(watched, shelf)
    names = set(shelf.content)
    assert {name.partition(",")[0] for name in names} == {
        "draw",
        "drive reckoning",
        "statistics",
        "jacobians",
    }
    traced.clear()
    programs.clear()  # as in another process
    with CompileClock() as clock:
        second = campaign(watched, shelf)
    assert (traced, shelf.found) == ([], len(names))
    assert len(names) <= clock.cached <= clock.programs  # a command counts them as loaded
    for name, values in first.per_run.items():
        np.testing.assert_array_equal(values, second.per_run[name])


def test_a_program_is_kept_whole_or_not_at_all(tmp_path, capsys):
    kept = library.ProgramFolder(tmp_path, library.identity(ASKED, "cpu"))
    assert kept.get("drive ekf") is None
    kept.put("drive ekf", b"a program")
    assert kept.get("drive ekf") == b"a program"
    assert kept.get("drive fej") is None
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert kept.get("drive ekf") is None
    assert "damaged" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_said_and_costs_nothing_else(tmp_path, capsys):
    nowhere = tmp_path / "a file"
    nowhere.write_text("")
    library.ProgramFolder(nowhere, {}).put("drive ekf", b"a program")
    assert "cannot be kept" in capsys.readouterr().err


def test_a_program_is_of_its_scenario_precision_source_and_processor(tmp_path, monkeypatch):
    library.ProgramFolder(tmp_path, library.identity(ASKED, "cpu")).put("drive ekf", b"a program")
    for change, found in (
        ({"seed": 1}, True),
        ({"runs": 5}, True),
        ({"filters": "ekf,fej"}, True),
        ({"scenario": "circle"}, False),
        ({"dtype": "float32"}, False),
    ):
        other = library.ProgramFolder(tmp_path, library.identity(ASKED | change, "cpu"))
        assert (other.get("drive ekf") is not None) == found
    monkeypatch.setattr(cache, "processor_kind", lambda: "another processor")
    other = library.ProgramFolder(tmp_path, library.identity(ASKED, "cpu"))
    assert other.get("drive ekf") is None
    assert library.identity(ASKED, "cpu") != library.identity(ASKED, "gpu")
    assert Path(jaxslam.__file__).parent == library.PACKAGE  # all of the source, not one folder


def test_without_a_cache_there_is_no_library():
    with cache.jax_settings(jax_compilation_cache_dir=None), library.program_folder({}) as kept:
        assert kept is None
