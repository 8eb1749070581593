"""`jaxslam consistency --filters FILE.py:NAME --scenario FILE.py:NAME`: what a user's file may give."""

import dataclasses
import json

import pytest
from own_models import changed

from jaxslam import _catalog as catalog
from jaxslam import _cli as cli
from jaxslam import scenarios
from jaxslam._cli.user_objects import UserObjects
from jaxslam.core.protocols import Filter
from jaxslam.simulation._worlds import Scenario

MINE = """
import dataclasses
import jaxslam
from jaxslam.core.record import record

print("loaded")
factor = 2.0
world = jaxslam.scenarios.circle(4)
number = 3.0

def short(steps=3):
    return dataclasses.replace(jaxslam.scenarios.circle(steps), name="short")

@record
class Doubting(jaxslam.filters.Wrapper):
    name = "dead_reckoning"

    def predict(self, state, u, key):
        state = self.filter.predict(state, u, key)
        return state._replace(cov=factor * state.cov)

@record
class Untraceable(Doubting):
    def update(self, state, scan, key):
        return undefined(state)

@record
class Named(Doubting):
    name = "my filter"

def blind(scenario):
    # Takes no measurement, and doubts its motion.
    return Doubting(jaxslam.filters.DeadReckoning(scenario.motion, scenario.sensor))

ready = blind(world)
alike = lambda scenario: lambda truth: blind(scenario)
wrong = lambda scenario: scenario.nothing
plain = lambda scenario: jaxslam.filters.EkfSlam(scenario.motion, scenario.sensor, 4)
wide = lambda scenario: jaxslam.filters.EkfSlam(scenario.motion, scenario.sensor, 8)
of_two = lambda scenario, capacity: ready
untraceable = lambda scenario: Untraceable(ready)
named = Named(ready.filter)
"""


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return path


def test_filters_of_a_file_stand_beside_those_of_the_catalog(mine, capsys):
    files = UserObjects()
    world = scenarios.circle(3)
    asked = f"ekf, {mine}:blind,{mine}:ready,{mine}:alike,{mine}:named"
    found = files.filters(asked, world)
    assert list(found) == ["ekf", "blind", "ready", "alike", "my filter"]
    assert all(isinstance(found[name], Filter) for name in ("ekf", "blind", "ready"))
    assert isinstance(found["alike"](None), Filter)
    assert capsys.readouterr().out == "loaded\n"  # once
    assert list(files.filters(f"{mine}:plain,{mine}:wide", world)) == ["plain", "wide"]
    assert list(files.filters("all", world)) == list(catalog.ALL)


def test_a_scenario_of_a_file_may_be_a_function_of_its_steps(mine):
    files = UserObjects()
    assert files.scenario(f"{mine}:short", None).steps == 3
    assert files.scenario(f"{mine}:short", 7).steps == 7
    assert isinstance(files.scenario(f"{mine}:world", None), Scenario)
    assert files.scenario("circle", 5).steps == 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--filters", "mine.py"],
            "--filters: expected FILE.py:NAME, got mine.py; it defines: world, short, blind",
        ),
        (["--filters", "other.py:blind"], "other.py: no such file"),
        (["--filters", "mine.txt:blind"], "expected a Python file"),
        (
            ["--filters", "mine.py:nobody"],
            "--filters: mine.py has no 'nobody'; it defines: world",
        ),
        (
            ["--filters", "mine.py:number"],
            "mine.py:number: expected a Filter, or a function of the",
        ),
        (
            ["--filters", "mine.py:wrong"],
            "mine.py:wrong: called with the scenario, it fails: mine.py:37: AttributeError: 'Scen",
        ),
        (["--filters", "mine.py:of_two"], "mine.py:of_two is called with one argument: missing a"),
        (["--filters", "mine.py:untraceable"], "mine.py:25: NameError: name 'undefined'"),
        (["--filters", "mine.py:blind,mine.py:blind"], "expected each name once, got blind twice"),
        (
            ["--scenario", "mine.py:number"],
            "mine.py:number: expected a Scenario, or a function that",
        ),
        (
            ["--scenario", "mine.py:world", "--steps", "3"],
            "mine.py:world is a Scenario, which has 4",
        ),
        (
            ["--scenario", "mine.py:world", "--filters", "magic"],
            "; or FILE.py:NAME, one of your own",
        ),
        (["--figures", "gif"], "--figures: expected formats of png, pdf, svg, got 'gif'"),
        (["--figures", ""], "--figures: expected formats of png, pdf, svg, got ''"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line_and_nothing_written(
    mine, refused, monkeypatch, options, message
):
    monkeypatch.chdir(mine.parent)
    said = refused(["consistency", "--out", "out", *options], message)
    assert said.count("\n") == 1
    assert not (mine.parent / "out").exists()


def test_a_filter_of_another_size_and_a_world_without_covariance_are_refused(mine):
    files = UserObjects()
    world = scenarios.circle(3)
    compass = changed(world.sensor, measurements=("heading [rad]",))
    with pytest.raises(
        ValueError,
        match=r"ready takes measurements \(ahead \[m\], left \[m\]\), .* gives \(heading",
    ):
        files.filters(f"{mine}:ready", dataclasses.replace(world, sensor=compass))
    mine.write_text(
        MINE + "noisy = dataclasses.replace(world, motion=dataclasses.replace(world.motion,"
        " noise_cov=lambda pose, u: -jaxslam.scenarios.circle(1).motion.noise_cov(pose, u)))"
    )
    with pytest.raises(ValueError, match="noise_cov of"):
        UserObjects().scenario(f"{mine}:noisy", None)


@pytest.mark.sweep
def test_a_campaign_of_a_file_is_resumed_while_the_file_computes_the_same(
    mine, tmp_path, capsys, refused, undrawn
):
    out = tmp_path / "out"
    asked = ["--scenario", f"{mine}:short", "--filters", f"{mine}:blind"]
    asked += ["--runs", "2", "--block", "2", "--devices", "1", "--figures", "svg"]
    assert cli.main(["consistency", *asked, "--out", str(out)]) == 0
    assert {path.suffix for path in out.glob("[a-z]*.*")} == {".html", ".json", ".csv", ".svg"}
    found = json.loads((out / "consistency.json").read_text())
    assert found["scenario"] == "short"
    assert list(found["filters"]) == ["blind"]

    again = ["consistency", "--resume", str(out), "--devices", "1"]
    mine.write_text("# the same filter\n" + MINE)
    assert cli.main([*again, "--figures", "svg"]) == 0
    assert "finished: nothing was run and nothing written" in capsys.readouterr().out
    # Of a finished campaign.
    assert cli.main([*again, "--figures", "pdf,png"]) == 0
    assert {path.suffix for path in out.glob("map.*")} == {".svg", ".pdf", ".png"}
    mine.write_text(MINE.replace("factor = 2.0", "factor = 3.0"))
    message = refused(
        [*again, "--runs", "4"],
        f"{out / 'blocks'} holds another campaign: filter blind: has other numbers "
        "or other code than in the stored runs; choose another folder, or replace",
    )
    assert "--overwrite" in message
