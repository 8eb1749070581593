"""The bar of progress: on a terminal and in a notebook, by default; never in a pipe."""

import sys
from types import SimpleNamespace

import pytest
import worlds

from jaxslam.consistency.campaign import _progress, _work, monte_carlo


def test_a_bar_tells_how_fast_it_goes_and_how_long_that_takes(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    clock = iter([100.0, 130.0, 131.0, 132.0, 150.0])
    monkeypatch.setattr(_progress.time, "perf_counter", lambda: next(clock))
    with _progress.Progress("circle") as bar:
        for done in (64, 64, 128, 140):
            bar(done, 10_000)
    first, same, second, third = (
        line for line in capsys.readouterr().err.split("\x1b[K") if "/10,000" in line
    )
    assert first.endswith("64/10,000 runs, 30 s\r")
    assert same.endswith("64/10,000 runs, 31 s\r")  # no rate of nothing
    assert second.endswith("128/10,000 runs, 32 s, 32 a second, 5 min 8 s left\r")
    assert third.endswith("140/10,000 runs, 50 s, 3.8 a second, 43 min 15 s left\r")
    assert _progress._duration(59.6) == "1 min 0 s"
    assert _progress._duration(7322) == "2 h 2 min"


class Cell:
    """IPython in a notebook, and what is shown below the running cell."""

    def __init__(self, kernel=True):
        self.shown = []
        self.display = SimpleNamespace(display=self._display)
        shell = SimpleNamespace(kernel=None) if kernel else SimpleNamespace()
        self.get_ipython = lambda: shell

    def _display(self, data, *, raw, display_id):
        assert raw and display_id
        self.update(data, raw=raw)
        return self

    def update(self, data, *, raw):
        assert raw and list(data) == ["text/plain"]
        self.shown.append(data["text/plain"])


def test_in_a_notebook_one_line_is_replaced_and_gone_at_the_end(capsys, monkeypatch):
    cell = Cell()
    monkeypatch.setitem(sys.modules, "IPython", cell)
    with _progress.Progress("circle") as bar:
        assert bar.shown
        bar(64, 100)
    assert cell.shown[:2] == ["", "circle: compiling …"]
    assert "64/100 runs" in cell.shown[2]
    assert cell.shown[3:] == [""]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("ipython", [None, Cell(kernel=False)])
def test_in_a_pipe_nothing_is_written(capsys, monkeypatch, ipython):
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    with _progress.Progress("circle") as bar:
        assert not bar.shown
        bar(64, 100)
    assert capsys.readouterr() == ("", "")


class Begun(Exception):
    """A campaign got as far as its work."""


@pytest.mark.parametrize("terminal", [True, False])
def test_a_campaign_has_a_bar_by_default_where_it_can_be_seen(capsys, monkeypatch, terminal):
    bars = []

    def begun(self, plan, todo, report):
        bars.append(report)
        if report is not None:
            report(3, 10)
        raise Begun

    monkeypatch.setattr(_work.Work, "compute", begun)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    world, mine = worlds.ring(5), []

    def go(**options):
        with pytest.raises(Begun):
            monte_carlo(world, {"a": worlds.ekf(world)}, 10, worlds.key(), block=4, **options)
        return capsys.readouterr().err

    shown = go()
    assert ("ring, 1 filter: " in shown and "3/10 runs" in shown) == terminal
    assert (bars[-1] is not None) == terminal
    assert go(progress=False) == ""
    assert bars[-1] is None
    assert go(progress=lambda *done: mine.append(done)) == ""
    assert mine == [(3, 10)]


def test_what_is_no_progress_is_refused_by_name():
    world = worlds.ring(5)
    with pytest.raises(ValueError, match=r"progress: expected a function of \(runs done, runs\)"):
        monte_carlo(world, {"a": worlds.ekf(world)}, 10, worlds.key(), progress=True)
