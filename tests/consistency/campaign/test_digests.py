"""A campaign is known by its data and code: whatever changes a result changes its identity."""

import dataclasses
import json
import os
import runpy
import subprocess
import sys

import jax
import numpy as np
import pytest
import worlds

from jaxslam import filters, sensors, store
from jaxslam.consistency import _digests as digests
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.core.record import record


def world(steps=12, sigma=0.05, **changes):
    sensor = sensors.RangeBearing(np.diag([sigma, 0.02]) ** 2, mount=(0.1, -0.05, 0.3))
    return dataclasses.replace(worlds.ring(steps), sensor=sensor, **changes)


def blind(scenario):
    return filters.DeadReckoning(scenario.motion, scenario.sensor)


def campaign(scenario=None, name="blind", make=blind, key=0):
    scenario = scenario or world()
    return {"scenario": scenario, "filters": {name: make(scenario)}, "key": jax.random.key(key)}


@record
class Drifting(filters.Wrapper):
    name = "dead_reckoning"

    def predict(self, state, u, key):
        return self.filter.predict(state, 1.0001 * u, key)


def drifting(scenario):
    """The same filter by another line of code."""
    return Drifting(blind(scenario))


ELSEWHERE = np.asarray(worlds.ring(12).landmarks) + [1e-15, 0.0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    kept = store.open(tmp_path_factory.mktemp("claimed"))
    kept.claim(digests.identity(**campaign(), platform="cpu"))
    return kept.folder


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"key": 1}, {"key"}),
        ({"scenario": world(sigma=0.06)}, {"sensor", "filter blind"}),
        ({"scenario": world(steps=13)}, {"steps", "controls"}),
        ({"scenario": world(landmarks=ELSEWHERE)}, {"landmarks"}),
        ({"scenario": world(name="circus")}, {"scenario"}),
        (
            {"scenario": world(visible=lambda pose, landmark: landmark[0] > pose[0])},
            {"world's visible"},
        ),
        ({"name": "deaf"}, {"filters", "filter blind", "filter deaf"}),
        ({"make": drifting}, {"filter blind"}),
        ({"make": worlds.ekf}, {"filter blind"}),
    ],
)
def test_a_changed_campaign_is_refused_by_what_changed(folder, changed, named):
    changed = campaign(**changed)
    with pytest.raises(ValueError, match="holds another campaign: ") as caught:
        monte_carlo(runs=2, keep=store.resume(folder), **changed)
    differences = str(caught.value).split("another campaign: ")[1].split("; ")
    assert differences.pop().startswith("choose another folder")
    assert {difference.split(": ")[0] for difference in differences} == named
    for each in differences:
        assert each.endswith((" here", " has other numbers or other code than in the stored runs"))


def test_another_precision_platform_version_or_bound_is_another_campaign(folder, monkeypatch):
    stored = store.resume(folder).campaign
    parts = campaign()

    def changed(platform="cpu", **options):
        identity = digests.identity(**parts, platform=platform, **options)
        assert identity.keys() == stored.keys()
        return {name for name in identity if identity[name] != stored[name]}

    assert changed() == set()
    assert changed(platform="gpu") == {"platform"}
    assert changed(bound=True) == {"bound"}
    with jax.enable_x64(False):
        assert "dtype" in changed()
    monkeypatch.setattr(digests, "version", lambda name: {"jax": "0.1"}.get(name, stored[name]))
    assert changed() == {"jax"}


def test_fewer_runs_than_are_kept_are_refused(tmp_path):
    kept = store.open(tmp_path)
    kept.claim(digests.identity(**campaign(), platform="cpu"))
    kept.save(0, {"0/x": np.zeros(2)}, 2)
    kept.save(2, {"0/x": np.zeros(2)}, 2)
    with pytest.raises(
        ValueError, match=r"runs: expected at least 4, as many as keep holds, got 3"
    ):
        monte_carlo(runs=3, keep=store.resume(tmp_path), **campaign())


def test_a_gate_that_a_filter_closes_over_is_seen():
    scenario = world()
    ekfs = [
        digests.identity(
            scenario, {"it": worlds.ekf(scenario, gate=gate)}, jax.random.key(0), platform="cpu"
        )["filter it"]
        for gate in (0.99, 0.99, 0.99 + 1e-12)
    ]
    assert ekfs[0] == ekfs[1] != ekfs[2]


ALONE = """
import json, jax, test_digests as t
jax.config.update("jax_enable_x64", True)
found = t.digests.identity(**t.campaign(make=t.worlds.ekf), platform="cpu")
print(json.dumps(found))
"""


def test_the_same_campaign_in_another_process_has_the_same_identity():
    done = subprocess.run(
        [sys.executable, "-c", ALONE],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "7"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout) == digests.identity(**campaign(make=worlds.ekf), platform="cpu")


def made_by(scale, table):
    return lambda x: helped(x) * scale + table


def helped(x):
    return x + 1.0


def test_a_digest_of_a_function_is_of_its_code_and_of_what_it_refers_to(monkeypatch):
    table = np.arange(3.0)
    digest = digests.digest(made_by(2.0, table))
    assert digest == digests.digest(made_by(2.0, table.copy()))
    others = [
        digests.digest(made_by(np.nextafter(2.0, 3.0), table)),
        digests.digest(made_by(2.0, np.nextafter(table, 9))),
        digests.digest(lambda x: x),
    ]
    monkeypatch.setitem(globals(), "helped", lambda x: x + 2.0)
    assert len({digest, *others, digests.digest(made_by(2.0, table))}) == 5
    assert digests.digest(np.sin) != digests.digest(np.cos)


SCALED = """
import numpy as np
FACTOR = {factor}
def scaled(x):
    {comment}
    def inner(y):
        return FACTOR * y  {aside}
    return inner(x){end}
first, second = (lambda x: x + 1), (lambda x: {last})
"""
SAME = {"factor": 2.0, "comment": '"""Of the author."""', "aside": "", "end": "", "last": "x + 2"}


def digests_of_file(path, **text):
    path.write_text(SCALED.format(**SAME | text))
    module = runpy.run_path(str(path))
    return [digests.digest(module[name]) for name in ("scaled", "first", "second")]


def test_a_digest_of_a_function_is_of_its_source_without_comments_and_layout(tmp_path):
    scaled, first, second = digests_of_file(tmp_path / "a.py")
    assert len({scaled, first, second}) == 3
    other = digests_of_file(tmp_path / "b.py", comment="# no docstring", aside="# scaled")
    assert other == [scaled, first, second]
    # The same file, written again.
    assert other == digests_of_file(tmp_path / "b.py", comment="# of the author\n    # and more")
    changes = [{"factor": 3.0}, {"end": " + 1"}, {"last": "x + 3"}]
    changed = [digests_of_file(tmp_path / f"{i}.py", **text) for i, text in enumerate(changes)]
    assert [[a != b for a, b in zip(row, other, strict=True)] for row in changed] == [
        [True, False, False],
        [True, False, False],
        [False, False, True],
    ]


def test_a_file_that_was_edited_since_it_was_loaded_says_nothing_of_the_code(tmp_path):
    path = tmp_path / "a.py"
    path.write_text(SCALED.format(**SAME))
    scaled = runpy.run_path(str(path))["scaled"]
    loaded = digests.digest(scaled)
    path.write_text(SCALED.format(**SAME | {"end": " + 1"}))
    edited = digests.digest(runpy.run_path(str(path))["scaled"])
    assert len({digests.digest(scaled), loaded, edited}) == 3


def test_a_digest_of_code_without_a_file_is_of_what_it_does():
    def digest(text):
        module = {}
        exec(text, module)
        return digests.digest(module["f"])

    assert digest("f = lambda x: x + 1") == digest("f  =  lambda x:  x + 1")
    assert digest("f = lambda x: x + 1") != digest("f = lambda x: x + 2")


def test_a_digest_of_a_class_is_of_its_constants_methods_and_of_sets_in_its_code():
    def class_of(scale, among, by=1.0):
        @record
        class Scaled(filters.Wrapper):
            factor = scale

            @staticmethod
            def contains(tag):
                return tag in among

            def predict(self, state, u, key):
                return self.filter.predict(state, self.factor * by * u, key)

        return Scaled

    first, second = frozenset({1, 2}), frozenset({2, 3})
    assert digests.digest(class_of(1.0, first)) == digests.digest(class_of(1.0, frozenset({2, 1})))
    others = (1.0, first), (2.0, first), (1.0, second), (1.0, first, 2.0)
    assert len({digests.digest(class_of(*arguments)) for arguments in others}) == 4
