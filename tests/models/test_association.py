"""Association: against exhaustive search and SciPy, at its limits, and inside a filter."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxslam import association
from jaxslam.math.assignment import assign
from jaxslam.math.stats import chi2_quantile
from jaxslam.protocols import Association, Pairs, Prediction
from jaxslam.types import Scan

METHODS = {
    "nearest": partial(association.nearest, 9.0),
    "maximum_likelihood": partial(association.maximum_likelihood, 9.0),
    "global_nearest": partial(association.global_nearest, 9.0),
    "joint": association.joint,
}


def problem(rng, m, n, near=1.0, size_z=2):
    """A scan's innovations by a random joint covariance of N expected measurements: (ν, C, R).

    Landmarks stand close together, so that several are compatible with a measurement; some
    measurements are of none.
    """
    root = rng.normal(size=(n * size_z, n * size_z + 2)) * 0.3
    cross = (root @ root.T / n).reshape(n, size_z, n, size_z)
    noise = np.broadcast_to(0.2**2 * np.eye(size_z), (m, size_z, size_z))
    expected = rng.uniform(-near, near, size=(n, size_z))
    error = np.linalg.cholesky(cross.reshape(n * size_z, -1)) @ rng.normal(size=n * size_z)
    seen = rng.permutation(n)[: min(m, n)]
    seen = np.concatenate([seen, rng.integers(0, n, m - len(seen))])
    z = (expected + error.reshape(n, size_z))[seen] + 0.2 * rng.normal(size=(m, size_z))
    stray = rng.uniform(size=m) < 0.2
    z = np.where(stray[:, None], rng.uniform(-2 * near, 2 * near, size=z.shape), z)
    return z[:, None] - expected[None], cross, noise


def pairs_of(innovation, cross, noise, xp=np):
    n = cross.shape[0]
    own = cross[xp.arange(n), :, xp.arange(n)]
    cov = own[None] + noise[:, None]
    distance = xp.einsum("mni,mnij,mnj->mn", innovation, xp.linalg.inv(cov), innovation)
    log_det = xp.linalg.slogdet(cov)[1]
    return Pairs(innovation, cov, distance, log_det, xp.ones(distance.shape, bool))


def plainly(method, innovation, cross, noise, valid=None, alive=None):
    """Of one problem."""
    m, n = innovation.shape[:2]
    valid = jnp.ones(m, bool) if valid is None else valid
    alive = jnp.ones(n, bool) if alive is None else alive
    pairs = pairs_of(innovation, cross, noise, jnp)
    pairs = pairs._replace(possible=valid[:, None] & alive[None, :])
    prediction = Prediction(jnp.full(n, -1), alive, lambda scan: pairs, lambda: cross)
    scan = Scan(jnp.zeros((m, innovation.shape[2])), jnp.full(m, -1), valid)
    return Association(*method(prediction, scan))


associated = jax.jit(plainly, static_argnums=0)


# --- optima ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("m", "n"), [(1, 1), (3, 3), (4, 12), (8, 20)])
def test_assignments_are_scipys(m, n):
    rng = np.random.default_rng(m)
    costs = rng.normal(size=(2500, m, n))
    costs[::5] = np.round(costs[::5])  # ties
    columns = np.asarray(jax.jit(jax.vmap(assign))(costs))
    for cost, column in zip(costs, columns, strict=True):
        rows, best = scipy.optimize.linear_sum_assignment(cost)
        assert len(set(column)) == m
        np.testing.assert_allclose(cost[np.arange(m), column].sum(), cost[rows, best].sum())


def test_assign_refuses_more_rows_than_columns():
    with pytest.raises(ValueError, match="at least as many columns"):
        assign(jnp.zeros((3, 2)))


def exhaustive(innovation, cross, noise, probability):
    """All hypotheses of singly compatible pairs: the most pairs, then the least D²."""
    m, n, size_z = innovation.shape
    single = pairs_of(innovation, cross, noise).distance
    options = [[-1, *np.flatnonzero(row <= chi2_quantile(probability, size_z))] for row in single]
    best = (-1, np.inf, None)
    for slots in itertools.product(*options):
        used = [s for s in slots if s >= 0]
        if len(set(used)) < len(used) or len(used) < best[0]:
            continue
        distance = 0.0
        if used:
            which = [i for i, s in enumerate(slots) if s >= 0]
            cov = cross[np.ix_(used, range(size_z), used, range(size_z))].copy()
            for k, i in enumerate(which):
                cov[k, :, k] += noise[i]
            nu = innovation[which, used].ravel()
            distance = nu @ np.linalg.solve(cov.reshape(len(nu), -1), nu)
            if distance > chi2_quantile(probability, len(nu)):
                continue
        if len(used) > best[0] or distance < best[1]:
            best = (len(used), distance, slots)
    return best


@pytest.mark.parametrize(
    ("m", "n", "near", "count"), [(1, 3, 0.5, 100), (4, 6, 1.0, 200), (8, 12, 3.0, 100)]
)
def test_joint_compatibility_is_exhaustive_searchs_optimum(m, n, near, count):
    rng = np.random.default_rng(n)
    problems = [problem(rng, m, n, near) for _ in range(count)]
    stacked = [np.stack(parts) for parts in zip(*problems, strict=True)]
    method = association.joint(0.95, budget=20_000, candidates=n)
    found = jax.jit(jax.vmap(partial(associated, method)))(*stacked)
    assert not np.asarray(found.exhausted).any()
    rivals = 0
    for parts, slot in zip(problems, np.asarray(found.slot), strict=True):
        pairs, _, slots = exhaustive(*parts, 0.95)
        assert (slot >= 0).sum() == pairs
        assert tuple(slot) == slots
        rivals += tuple(slot) != tuple(pairs_of(*parts).distance.argmin(axis=1))
    assert m == 1 or rivals > count / 10  # problems that the nearest neighbour gets wrong


def test_a_budget_that_does_not_suffice_is_said():
    rng = np.random.default_rng(0)
    innovation, cross, noise = problem(rng, 8, 12, 1.5)

    @jax.jit
    def search(*parts):
        budgets = [association.joint(0.95, budget=b, candidates=12) for b in (1, 30, 20_000)]
        few = association.joint(0.95, budget=20_000, candidates=1)
        return [plainly(method, *parts) for method in (*budgets, few)]

    *found, few = search(innovation, cross, noise)
    assert [bool(one.exhausted) for one in found] == [True, True, False]
    most = [(np.asarray(one.slot) >= 0).sum() for one in found]
    assert most == sorted(most)
    assert few.exhausted


def test_the_joint_test_refuses_what_is_compatible_one_by_one():
    """Two landmarks whose errors are the same: their innovations may not differ."""
    cross = np.ones((2, 1, 2, 1))
    noise = np.full((2, 1, 1), 0.01)
    innovation = np.array([[[2.0], [9.0]], [[9.0], [-2.0]]])
    alone = associated(association.nearest(6.0), innovation, cross, noise)
    together = associated(association.joint(0.98), innovation, cross, noise)
    assert list(alone.slot) == [0, 1]
    assert (np.asarray(together.slot) >= 0).sum() == 1
    assert not together.is_new.any()


def test_the_sum_of_distances_decides_globally():
    """Each landmark's nearest measurement is the first: only one of them can have it."""
    distance = np.array([[1.0, 1.2], [1.5, 4.0]])
    innovation, cross = np.sqrt(distance)[:, :, None], np.zeros((2, 1, 2, 1))
    noise = np.ones((2, 1, 1))
    together = associated(association.global_nearest(9.0), innovation, cross, noise)
    alone = associated(association.nearest(9.0), innovation, cross, noise)
    assert list(together.slot) == [1, 0]
    assert list(alone.slot) == [0, -1]
    assert not alone.is_new.any()
    careful = association.nearest(9.0, ambiguous="leave")
    assert list(associated(careful, innovation, cross, noise).slot) == [-1, -1]


def test_the_determinant_decides_for_likelihood():
    """A landmark known badly is near in d², and unlikely."""
    cross = np.zeros((2, 1, 2, 1))
    cross[:, 0, :, 0] = np.diag([0.0, 99.0])
    innovation, noise = np.array([[[1.5], [3.0]]]), np.ones((1, 1, 1))
    near = associated(association.nearest(9.0), innovation, cross, noise)
    likely = associated(association.maximum_likelihood(9.0), innovation, cross, noise)
    assert (int(near.slot[0]), int(likely.slot[0])) == (1, 0)


# --- properties of all ----------------------------------------------------------------------------


@pytest.fixture(scope="module", params=METHODS)
def method(request):
    return METHODS[request.param]()


def test_a_batch_is_its_problems_and_no_landmark_serves_twice(method):
    rng = np.random.default_rng(5)
    problems = [problem(rng, 5, 7, 1.0) for _ in range(20)]
    parts = [np.stack(p) for p in zip(*problems, strict=True)]
    valid, alive = rng.uniform(size=(20, 5)) < 0.8, rng.uniform(size=(20, 7)) < 0.7
    many = jax.jit(jax.vmap(partial(plainly, method)))
    batch = jax.device_get(many(*parts, valid, alive))
    single = many(*(p.astype("f4") for p in parts), valid, alive)
    for slot, is_new, there, living in zip(batch.slot, batch.is_new, valid, alive, strict=True):
        used = slot[slot >= 0]
        assert len(set(used)) == len(used)
        assert living[used].all()
        assert not (slot[~there] >= 0).any()
        assert not is_new[~there].any()
        assert not (is_new & (slot >= 0)).any()
    for found, count in ((batch, 3), (single, 20)):
        for i in range(count):
            alone = associated(method, *(p[i] for p in parts), valid[i], alive[i])
            np.testing.assert_array_equal(found.slot[i], alone.slot)
            np.testing.assert_array_equal(found.is_new[i], alone.is_new)


def test_everything_is_new_in_an_empty_map_and_nothing_in_an_empty_scan(method):
    parts = problem(np.random.default_rng(0), 5, 7)
    found = associated(method, *parts, np.ones(5, bool), np.zeros(7, bool))
    assert found.is_new.all()
    assert (np.asarray(found.slot) == -1).all()
    found = associated(method, *parts, np.zeros(5, bool), np.ones(7, bool))
    assert not found.is_new.any()
    innovation, cross, noise = parts
    empty = jax.eval_shape(partial(plainly, method), innovation[:0], cross, noise[:0])
    assert empty.slot.shape == (0,)


@pytest.mark.parametrize("name", ["nearest", "maximum_likelihood", "global_nearest"])
def test_gates_of_nothing_and_of_everything(name):
    factory = getattr(association, name)
    parts = problem(np.random.default_rng(1), 3, 5)
    gates = np.array([0.0, 0.0, np.inf]), np.array([0.0, np.inf, np.inf])

    def of_gates(gate, new_gate, *parts):
        return plainly(factory(gate, new_gate), *parts)

    over = jax.jit(jax.vmap(of_gates, (0, 0, None, None, None)))
    slot, is_new, _ = jax.device_get(over(*gates, *parts))
    assert (slot[0] == -1).all()
    np.testing.assert_array_equal(is_new, [[True] * 3, [False] * 3, [False] * 3])
    if name == "global_nearest":
        best = scipy.optimize.linear_sum_assignment(pairs_of(*parts).distance)[1]
        np.testing.assert_array_equal(slot[2], best)


def test_joint_probabilities_of_nothing_and_of_everything():
    parts = problem(np.random.default_rng(1), 3, 5)
    assert associated(association.joint(0.0), *parts).is_new.all()
    everything = associated(association.joint(1.0, budget=10_000), *parts)
    assert (np.asarray(everything.slot) >= 0).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: association.nearest(-1.0), "at least 0"),
        (lambda: association.nearest(np.nan), "at least 0"),
        (lambda: association.nearest("9"), "nearest: expected a number as gate, got str$"),
        (
            lambda: plainly(association.nearest, *problem(np.random.default_rng(1), 3, 5)),
            r"expected a number .*: as associate, give nearest\(gate\), not nearest$",
        ),
        (lambda: association.maximum_likelihood(9.0, 4.0), "new_gate >= gate"),
        (lambda: association.global_nearest(9.0, 4.0), "new_gate >= gate"),
        (lambda: association.nearest(9.0, ambiguous="guess"), "guess"),
        (lambda: association.joint(1.5), "probability"),
        (lambda: association.joint(budget=0), "budget"),
        (lambda: association.joint(candidates=0), "candidates"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_joint_refuses_a_gate_for_new_ones_below_its_own():
    parts = problem(np.random.default_rng(1), 3, 5)
    with pytest.raises(ValueError, match="new_gate >= gate"):
        associated(association.joint(0.99, new_gate=1.0), *parts)
