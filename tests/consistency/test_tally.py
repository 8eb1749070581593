"""Sums that do not depend on how runs are divided, and the pieces they are divided into."""

from fractions import Fraction

import numpy as np
import pytest

from jaxslam.consistency import Score
from jaxslam.consistency._tally import Sum, Tally, condense, plus, sum_rows
from jaxslam.consistency.campaign._pieces import missing_pieces


def test_a_total_is_exact_where_a_plain_sum_is_not():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(77, 5)) * 10.0 ** rng.integers(-12, 12, size=(77, 5))
    high, low = sum_rows(rows)
    exact = [sum(map(Fraction, rows[:, i].tolist())) for i in range(5)]
    assert any(
        Fraction(plain) != e for plain, e in zip(rows.sum(axis=0).tolist(), exact, strict=True)
    )
    for i in range(5):
        assert abs(Fraction(high[i]) + Fraction(low[i]) - exact[i]) < 1e-18 * abs(exact[i])
        assert high[i] == float(exact[i])


@pytest.mark.parametrize("rows", [np.zeros((0, 3)), np.ones((1, 3))])
def test_a_total_of_none_or_one(rows):
    np.testing.assert_array_equal(sum_rows(rows).high, rows.sum(axis=0))


def test_cancellation_leaves_the_small_term():
    part = Sum(np.array([1e16]), np.array([0.0]))
    for value in (1.0, -1e16):
        part = plus(part, Sum(np.array([value]), np.array([0.0])))
    np.testing.assert_array_equal(part.high + part.low, [1.0])


def scores(runs, rng):
    def measure():
        return rng.normal(size=runs), rng.integers(0, 5, runs)

    return Score(
        finite=rng.random(runs) > 0.1,
        measures={"nees_pose": measure(), "square_position": measure()},
        snapshots=(
            rng.normal(size=(runs, 2, 3)),
            rng.normal(size=(runs, 2, 3, 3)),
            rng.random((runs, 2)) > 0.5,
        ),
        sums={"nees_pose": rng.normal(size=(runs, 4)) * 1e3, "missed": rng.integers(0, 5, runs)},
    )


def tallied(each, cuts, order):
    runs = len(each.finite)
    edges = [0, *cuts, runs]
    tally = Tally()
    for i in order:
        first, end = edges[i], edges[i + 1]
        part = Score(*(_cut(field, first, end) for field in each))
        tally.add(first, end - first, condense(part, first, 1.0))
    return tally


def _cut(field, first, end):
    if isinstance(field, dict):
        return {name: _cut(value, first, end) for name, value in field.items()}
    if isinstance(field, tuple):
        return tuple(_cut(value, first, end) for value in field)
    return field[first:end]


@pytest.mark.parametrize(("cuts", "order"), [([], [0]), ([7], [1, 0]), ([1, 2, 30], [3, 0, 2, 1])])
def test_blocks_of_any_size_in_any_order_give_the_same_bits(cuts, order):
    each = scores(41, np.random.default_rng(1))
    one, other = tallied(each, [], [0]), tallied(each, cuts, order)
    assert other.pieces() == sorted(other.pieces())
    np.testing.assert_array_equal(other.numbers(), np.arange(41))
    for name, value in one.sums.items():
        assert value.tobytes() == other.sums[name].tobytes()
        np.testing.assert_allclose(value, each.sums[name][each.finite].sum(axis=0), rtol=1e-12)
    for name, value in one.measures().items():
        np.testing.assert_array_equal(value, other.measures()[name])
        whole, weight = each.measures[name]
        there = each.finite & (weight > 0)
        np.testing.assert_array_equal(np.isnan(value), ~there)
        np.testing.assert_allclose(value[there], whole[there] / weight[there])
    far = np.linalg.norm(each.snapshots[0][:, -1, :2], axis=1) > 1
    np.testing.assert_array_equal(other.flags("inaccurate"), far & each.finite)
    assert 0 < (far & each.finite).sum() < far.sum()
    claimed = np.maximum(np.trace(each.snapshots[1][:, -1, :2, :2], axis1=1, axis2=2), 0)
    beyond = np.linalg.norm(each.snapshots[0][:, -1, :2], axis=1) > 5 * np.sqrt(claimed)
    np.testing.assert_array_equal(other.flags("divergent"), far & beyond & each.finite)
    for a, b, leaf in zip(one.snapshots(), other.snapshots(), each.snapshots, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, leaf[each.finite])


def test_blocks_that_follow_each_other_are_joined():
    """In any order: nothing is lost, and a campaign of many blocks keeps a few arrays."""
    rng = np.random.default_rng(3)
    for spread in (0, 3, 1000):
        tally, most = Tally(), 0
        for number in np.argsort(np.arange(600) + rng.uniform(0, spread, 600)).tolist():
            run = 2 * number + np.arange(2)
            tally.add(2 * number, 2, {"finite": run % 7 > 0, "x": run / 3, "limit": np.array(5.0)})
            most = max(most, len(tally.pieces()))
        assert most < (20 if spread < 1000 else 300)
        assert tally.pieces()[0][0] == 0 and sum(runs for _, runs in tally.pieces()) == 1200
        back = Tally()
        back.merge(tally)
        for found in (tally, back):
            np.testing.assert_array_equal(found.numbers(), np.arange(1200))
            np.testing.assert_array_equal(found.flags("finite"), np.arange(1200) % 7 > 0)
            np.testing.assert_array_equal(found.flags("x"), np.arange(1200) / 3)
            assert found.first("limit") == 5


def test_merged_tallies_are_one():
    each = scores(20, np.random.default_rng(2))
    whole, parts = tallied(each, [12], [0, 1]), tallied(each, [12], [1])
    parts.merge(tallied(each, [12], [0]))
    np.testing.assert_array_equal(parts.flags("divergent"), whole.flags("divergent"))
    for name, value in whole.sums.items():
        assert value.tobytes() == parts.sums[name].tobytes()


def test_missing_is_every_run_not_done():
    rng = np.random.default_rng(1)
    for _ in range(500):
        runs, block = int(rng.integers(0, 60)), int(rng.integers(1, 20))
        done = [tuple(map(int, rng.integers(0, [70, 25]))) for _ in range(rng.integers(0, 6))]
        todo = missing_pieces(iter(done), runs, block)
        assert all(0 < size <= block for _, size in todo)
        listed = [run for first, size in todo for run in range(first, first + size)]
        finished = {run for first, size in done for run in range(first, first + size)}
        assert listed == [run for run in range(runs) if run not in finished]
    assert missing_pieces([(32, 32)], 128, 32) == [(0, 32), (64, 32), (96, 32)]
    assert missing_pieces([(8, 8)], 40, 16) == [(0, 8), (16, 16), (32, 8)]
    with pytest.raises(ValueError, match="block: expected an integer >= 1, got 0"):
        missing_pieces([], 3, 0)
