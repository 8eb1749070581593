"""`jaxslam consistency --filters FILE.py:NAME --scenario FILE.py:NAME`: what a user's file may give."""

import dataclasses
import json

import pytest
from own_models import changed

import jaxslam
from jaxslam import Scenario, catalog, scenarios
from jaxslam import _cli as cli
from jaxslam.core.protocols import Filter

MINE = """
import dataclasses
import jax
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

@record
class Lost(Doubting):
    def update(self, state, scan, key):
        state, info = self.filter.update(state, scan, key)
        lost = jax.random.bernoulli(key, 0.1)
        return state._replace(pose=jax.numpy.where(lost, jax.numpy.nan, state.pose)), info

lost = Lost(ready.filter)
"""


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return path


def test_filters_of_a_file_stand_beside_those_of_the_catalog(mine, capsys):
    files = cli.user_objects.UserObjects()
    world = scenarios.circle(3)
    names = f"ekf, {mine}:blind,{mine}:ready,{mine}:alike,{mine}:named"
    filters = files.filters(names, world)
    assert list(filters) == ["ekf", "blind", "ready", "alike", "named"]  # as they were asked for
    assert all(isinstance(filters[name], Filter) for name in ("ekf", "blind", "ready"))
    assert isinstance(filters["alike"](None), Filter)
    assert capsys.readouterr().out == "loaded\n"  # once
    assert list(files.filters(f"{mine}:plain,{mine}:wide", world)) == ["plain", "wide"]
    assert list(files.filters("all", world)) == list(catalog.ALL)


def test_a_scenario_of_a_file_may_be_a_function_of_its_steps(mine):
    files = cli.user_objects.UserObjects()
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
            "mine.py:wrong: called with the scenario, it fails: mine.py:38: AttributeError: 'Scen",
        ),
        (["--filters", "mine.py:of_two"], "mine.py:of_two is called with one argument: missing a"),
        (["--filters", "mine.py:untraceable"], "mine.py:26: NameError: name 'undefined'"),
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
    files = cli.user_objects.UserObjects()
    world = scenarios.circle(3)
    compass = changed(world.sensor, measurements=("heading [rad]",))
    with pytest.raises(
        ValueError,
        match=r"ready: it takes measurements \(ahead \[m\], left \[m\]\), .* gives \(heading",
    ):
        files.filters(f"{mine}:ready", dataclasses.replace(world, sensor=compass))
    mine.write_text(
        MINE + "noisy = dataclasses.replace(world, motion=dataclasses.replace(world.motion,"
        " noise_cov=lambda pose, u: -jaxslam.scenarios.circle(1).motion.noise_cov(pose, u)))"
    )
    with pytest.raises(ValueError, match="noise_cov of"):
        cli.user_objects.UserObjects().scenario(f"{mine}:noisy", None)


def test_a_filter_that_is_lost_in_some_runs_is_told_everywhere(mine, tmp_path, capsys, undrawn):
    """Table, JSON, page, a campaign read back, and the exit status."""
    out = tmp_path / "out"
    asked = [
        "--scenario",
        f"{mine}:short",
        "--filters",
        f"{mine}:blind,{mine}:lost",
        "--runs",
        "16",
    ]
    shape = ["--block", "16", "--devices", "1", "--figures", "svg", "--out", str(out)]
    assert cli.main(["consistency", *asked, *shape]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    campaign = jaxslam.load(out)
    runs = campaign.filters["lost"].counts["runs"]
    assert 8 < runs < 16
    doubt = f"not finite (NaN or ∞) in {16 - runs} of 16 runs: averages of the {runs} finite runs"
    assert (
        campaign.filters["lost"].doubts[0] == doubt and campaign.verdicts["lost"] == "incomplete*"
    )
    assert not any("finite" in said for said in campaign.filters["blind"].doubts)
    page = (out / "report.html").read_text()
    assert f"lost*: {doubt}" in printed and f"lost*: {doubt}." in page
    assert "incomplete" in printed and "lost=incomplete*" in repr(campaign)
    assert f"averages of the {runs} finite runs</span>" in page
    found = json.loads((out / "consistency.json").read_text())["filters"]["lost"]
    assert (found["verdict"], found["doubts"][0]) == ("incomplete", doubt)


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
