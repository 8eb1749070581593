"""Matchers and covariances of a match as records: their leaves, copies, programs and derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused
from scanned_rooms import pairs

from jaxslam import matching
from jaxslam.core.record import record
from jaxslam.laser.matching import IcpSettings, covariance

SIGMA, START_COV = 0.03, np.diag([0.05, 0.05, 0.03]) ** 2
SETTINGS = IcpSettings(reach=0.4, lone=0.5, span=2, gap=0.8, fewest=5, least_condition=None)
RECORDS = {
    "points": (matching.PointToPoint(), [0.5, 0.1, 0.5, 1e-6, 0.5, 0.01]),
    "lines": (matching.PointToLine(SETTINGS), [0.4, 0.1, 0.8, 0.5, 1e-6, 0.5]),
    "field": (matching.FieldMatcher(reach=0.3), [0.3, 0.1, 1e-6, 0.5, 0.01]),
    "correlative": (matching.Correlative(apart=0.2), [0.95, 0.2]),
    "one peak": (matching.Correlative(ambiguous=None), [0.3]),
    "hessian": (covariance.Hessian(), []),
    "implicit": (covariance.Implicit(SIGMA), [SIGMA]),
    "along normals": (covariance.AlongNormals(SIGMA, gap=0.8), [SIGMA, 0.8]),
    "lattice": (covariance.Lattice(SIGMA, window=0.2), [SIGMA, 0.2, 0.3]),
    "unscented": (covariance.Unscented(SIGMA, START_COV), [SIGMA, START_COV]),
    "sampling": (covariance.Sampling(SIGMA, START_COV, 4), [SIGMA, START_COV]),
}
REFERENCE, SCAN, _, START = (jax.tree.map(lambda part: part[0], of) for of in pairs(1))


@pytest.mark.parametrize("name", RECORDS)
def test_numbers_are_leaves_and_copies_are_alike(name):
    worlds.assert_record(*RECORDS[name])


def test_what_fixes_a_size_is_structure():
    search = matching.Correlative()
    for other in ({"window": 0.4}, {"turn": 0.02}, {"cell": 0.1}, {"sigma": 0.1}, {"block": 8}):
        changed = dataclasses.replace(search, **other)
        assert jax.tree.structure(changed) != jax.tree.structure(search)
    assert matching.FieldMatcher.name == "field" and search.name == "correlative"
    assert matching.PointToLine.name == "point_to_line"


TRACED = []


@record
class Counted(matching.PointToLine):
    """PL-ICP that counts how often it is traced."""

    def prepare(self, reference):
        TRACED.append(1)
        return super().prepare(reference)


def test_other_numbers_cost_no_trace_and_no_program():
    def both(reach, sigma):
        matcher = Counted(dataclasses.replace(SETTINGS, reach=reach))
        found = matching.match(matcher, REFERENCE, SCAN, START)
        given = matcher, REFERENCE, SCAN, found, START, jax.random.key(0)
        return jax.device_get((found, covariance.covariance(covariance.Implicit(sigma), *given)))

    _, first = both(0.4, SIGMA)
    with worlds.nothing_compiled(TRACED):
        near, second = both(0.3, 2 * SIGMA)
        none, _ = both(1e-6, SIGMA)
    assert none.status == matching.MatchStatus.TOO_FEW != near.status
    np.testing.assert_allclose(second, 4 * first, rtol=1e-3)


def test_a_derivative_of_a_record_is_one():
    """The covariance is σ² times what the scans say: its derivative by σ is twice it over σ."""
    matcher = matching.PointToLine(SETTINGS)
    found = matching.match(matcher, REFERENCE, SCAN, START)
    scans = covariance.MatchedScans(REFERENCE, SCAN, found, START, None)

    @jax.jit
    def trace(way, matcher):
        return jnp.trace(way.of(matcher, scans))

    way = covariance.Implicit(SIGMA)
    value, slope = jax.value_and_grad(trace)(way, matcher)
    assert type(slope) is covariance.Implicit
    np.testing.assert_allclose(slope.sigma, 2 * value / SIGMA, rtol=1e-3)

    def cost(matcher):
        return matcher.cost(matcher.prepare(REFERENCE), SCAN, START, found)

    # The cost is a + lone² b, of pairs with a line and without.
    slope = jax.grad(cost)(matcher)
    without = cost(matching.PointToLine(dataclasses.replace(SETTINGS, lone=1e-9)))
    assert type(slope) is matching.PointToLine
    np.testing.assert_allclose(slope.settings.lone, 2 * (cost(matcher) - without) / 0.5)
    assert slope.settings.lone > 0


@pytest.mark.parametrize("name", ["points", "lines", "field", "correlative"])
def test_numbers_in_float64_leave_a_match_in_float32(name):
    matcher = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), RECORDS[name][0])
    reference, scan = worlds.narrow((REFERENCE, SCAN))
    if matcher.of_grid:
        reference = matching.raster(reference, 0.1, 4.0)

    def both(reference, scan, start):
        prepared = matcher.prepare(reference)
        found = matcher.match(prepared, scan, start)
        return found, matcher.cost(prepared, scan, start, found)

    shapes = jax.eval_shape(both, reference, scan, START.astype(np.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {np.dtype("i4"), np.dtype("f4")}


@record
class Lost(matching.Matcher):
    """A matcher that does not match."""

    def prepare(self, reference):
        return reference


@record
class Silent(covariance.MatchCovariance):
    """A covariance that says nothing."""


@refused(
    (lambda: matching.PointToLine(0.5), "PointToLine: settings: expected IcpSettings, got 0.5"),
    (lambda: IcpSettings(trim=0), r"IcpSettings: trim: expected a number .*, got 0"),
    (lambda: IcpSettings(fewest=-1), "IcpSettings: fewest: expected an integer >= 0, got -1"),
    (lambda: IcpSettings(lone=0.0), "IcpSettings: lone: expected a number above 0, got 0.0"),
    (lambda: IcpSettings(least_condition=0), "IcpSettings: least_condition: expected a number above 0"),
    (lambda: matching.FieldMatcher(iterations=0), "FieldMatcher: iterations: expected an integ"),
    (lambda: matching.Correlative(ambiguous=1.0), "Correlative: ambiguous: expected a number above 0 and below 1"),
    (lambda: matching.Correlative(window=-1), "Correlative: window: expected a finite number >= 0"),
    (lambda: matching.Correlative(apart=0), "Correlative: apart: expected a number above 0, got 0"),
    (lambda: covariance.AlongNormals(SIGMA, span=0), "AlongNormals: span: expected an integer"),
    (lambda: covariance.Lattice(SIGMA, window=0), "Lattice: window: expected a number above 0, got 0"),
    (lambda: Lost(), "Lost: match: expected a method"),
    (lambda: Silent(), "Silent: of_usable: expected a method"),
    told="^",
)  # fmt: skip
def test_bad_numbers_are_one_line_that_names_the_class(make):
    make()
