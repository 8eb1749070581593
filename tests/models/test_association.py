"""Association: against exhaustive search and SciPy, at its limits, and inside a filter."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from cases import refused, swept
from worlds import narrow

from jaxslam import association
from jaxslam.core.protocols import Association, Pairs, Prediction
from jaxslam.core.types import Scan
from jaxslam.math._assignment import assign
from jaxslam.math.stats import chi2_quantile, sigma_gate

GATE = sigma_gate(3, 2)
METHODS = {
    "nearest": partial(association.Nearest, GATE),
    "maximum_likelihood": partial(association.MaximumLikelihood, GATE),
    "global_nearest": partial(association.GlobalNearest, GATE),
    "joint": association.JointCompatibility,
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


def posed(innovation, cross, noise, valid=None, alive=None):
    """A problem as a method sees it, in NumPy: (pairs, C, valid, alive)."""
    m, n = innovation.shape[:2]
    own = cross[np.arange(n), :, np.arange(n)]
    cov = own[None] + noise[:, None]
    distance = np.einsum("mni,mnij,mnj->mn", innovation, np.linalg.inv(cov), innovation)
    valid = np.ones(m, bool) if valid is None else valid
    alive = np.ones(n, bool) if alive is None else alive
    possible = valid[:, None] & alive[None, :]
    pairs = Pairs(innovation, cov, distance, np.linalg.slogdet(cov)[1], possible)
    return pairs, cross, valid, alive


def stacked(problems):
    return jax.tree.map(lambda *x: np.stack(x), *problems)


def plainly(method, pairs, cross, valid, alive):
    """Of one problem."""
    m, n, size_z = pairs.innovation.shape
    prediction = Prediction(jnp.full(n, -1), alive, lambda scan: pairs, lambda: cross)
    scan = Scan(jnp.zeros((m, size_z)), jnp.full(m, -1), valid)
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
    single = posed(innovation, cross, noise)[0].distance
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


@pytest.fixture(scope="module")
def thorough():
    """Joint compatibility of (many) 8 measurements and 12 landmarks, with all candidates."""
    method = association.JointCompatibility(0.95, budget=20_000, candidates=12)
    return jax.jit(jax.vmap(partial(plainly, method)))


def padded(array, *sizes):
    """With leading axes of these sizes, by repeating the last entry."""
    widths = [(0, size - had) for size, had in zip(sizes, array.shape, strict=False)]
    return np.pad(array, widths + [(0, 0)] * (array.ndim - len(sizes)), mode="edge")


@pytest.mark.parametrize(
    ("m", "n", "near", "count"), [(1, 3, 0.5, 100), (4, 6, 1.0, 200), (8, 12, 3.0, 100)]
)
def test_joint_compatibility_is_exhaustive_searchs_optimum(thorough, m, n, near, count):
    """Of fewer measurements and landmarks, too, where the others are not there."""
    rng = np.random.default_rng(n)
    problems = [problem(rng, m, n, near) for _ in range(count)]
    there = np.arange(8) < m, np.arange(12) < n
    whole = [
        posed(
            padded(innovation, 8, 12),
            padded(padded(cross, 12).swapaxes(0, 2), 12).swapaxes(0, 2),
            padded(noise, 8),
            *there,
        )
        for innovation, cross, noise in problems
    ]
    found = thorough(*stacked(whole))
    assert not np.asarray(found.exhausted).any()
    slots_found = np.asarray(found.slot)
    assert (slots_found[:, m:] == -1).all()
    rivals = 0
    for parts, slot in zip(problems, slots_found[:, :m], strict=True):
        pairs, _, slots = exhaustive(*parts, 0.95)
        assert (slot >= 0).sum() == pairs
        assert tuple(slot) == slots
        rivals += tuple(slot) != tuple(posed(*parts)[0].distance.argmin(axis=1))
    assert m == 1 or rivals > count / 10  # problems that the nearest neighbour gets wrong


def test_a_budget_that_does_not_suffice_is_said(thorough):
    parts = posed(*problem(np.random.default_rng(0), 8, 12, 1.5))

    @jax.jit
    def search(*parts):
        options = ({"budget": 1}, {"budget": 30}, {"budget": 20_000, "candidates": 1})
        return [
            plainly(association.JointCompatibility(0.95, **{"candidates": 12} | each), *parts)
            for each in options
        ]

    *found, few = search(*parts)
    found.append(jax.tree.map(lambda leaf: leaf[0], jax.device_get(thorough(*stacked([parts])))))
    assert [bool(one.exhausted) for one in found] == [True, True, False]
    most = [(np.asarray(one.slot) >= 0).sum() for one in found]
    assert most == sorted(most)
    assert few.exhausted


@pytest.fixture(scope="module")
def by_rule():
    """Association.slot of two measurements and two landmarks by each rule, in one program."""
    rules = {name: METHODS[name]() for name in METHODS if name != "joint"}
    rules["careful"] = association.Nearest(GATE, ambiguous="leave")
    rules["joint"] = association.JointCompatibility(0.98)
    return jax.jit(lambda *parts: {name: plainly(rule, *parts) for name, rule in rules.items()})


def test_the_joint_test_refuses_what_is_compatible_one_by_one(by_rule):
    """Two landmarks whose errors are the same: their innovations may not differ."""
    cross = np.ones((2, 1, 2, 1))
    noise = np.full((2, 1, 1), 0.01)
    innovation = np.array([[[2.0], [9.0]], [[9.0], [-2.0]]])
    found = by_rule(*posed(innovation, cross, noise))
    assert list(found["nearest"].slot) == [0, 1]
    assert (np.asarray(found["joint"].slot) >= 0).sum() == 1
    assert not found["joint"].is_new.any()


def test_the_sum_of_distances_decides_globally(by_rule):
    """Each landmark's nearest measurement is the first: only one of them can have it."""
    distance = np.array([[1.0, 1.2], [1.5, 4.0]])
    innovation, cross = np.sqrt(distance)[:, :, None], np.zeros((2, 1, 2, 1))
    found = by_rule(*posed(innovation, cross, np.ones((2, 1, 1))))
    assert list(found["global_nearest"].slot) == [1, 0]
    assert list(found["nearest"].slot) == [0, -1]
    assert not found["nearest"].is_new.any()
    assert list(found["careful"].slot) == [-1, -1]


def test_the_determinant_decides_for_likelihood(by_rule):
    """A landmark known badly is near in d², and unlikely."""
    cross = np.zeros((2, 1, 2, 1))
    cross[:, 0, :, 0] = np.diag([0.0, 99.0])
    innovation, noise = np.array([[[1.5], [3.0]]] * 2), np.ones((2, 1, 1))
    found = by_rule(*posed(innovation, cross, noise, valid=np.array([True, False])))
    near, likely = found["nearest"], found["maximum_likelihood"]
    assert (int(near.slot[0]), int(likely.slot[0])) == (1, 0)


# --- properties of all ----------------------------------------------------------------------------


COUNT = 20
"""Random problems of a batch; in two more no landmark is alive, or nothing was measured."""


@pytest.fixture(scope="module", params=swept(METHODS, "nearest", "joint"))
def batch(request):
    """A method, problems of it, and what it finds of them all at once."""
    method, rng = METHODS[request.param](), np.random.default_rng(5)
    valid, alive = rng.uniform(size=(COUNT + 2, 5)) < 0.8, rng.uniform(size=(COUNT + 2, 7)) < 0.7
    valid[COUNT:], alive[COUNT:] = [[True], [False]], [[False], [True]]
    parts = [posed(*problem(rng, 5, 7), v, a) for v, a in zip(valid, alive, strict=True)]
    found = jax.jit(jax.vmap(partial(plainly, method)))(*stacked(parts))
    return method, parts, jax.device_get(found)


def test_a_batch_is_its_problems_and_no_landmark_serves_twice(batch):
    """The batch in float64, its problems in float32."""
    method, parts, found = batch
    for slot, is_new, (_, _, there, living) in zip(found.slot, found.is_new, parts, strict=True):
        used = slot[slot >= 0]
        assert len(set(used)) == len(used)
        assert living[used].all()
        assert not (slot[~there] >= 0).any()
        assert not is_new[~there].any()
        assert not (is_new & (slot >= 0)).any()
    for i, each in enumerate(narrow(parts)):
        alone = associated(method, *each)
        np.testing.assert_array_equal(found.slot[i], alone.slot)
        np.testing.assert_array_equal(found.is_new[i], alone.is_new)


def test_everything_is_new_in_an_empty_map_and_nothing_in_an_empty_scan(batch):
    method, _, found = batch
    assert found.is_new[COUNT].all()
    assert (found.slot[COUNT] == -1).all()
    assert not found.is_new[COUNT + 1].any()
    innovation, cross, noise = problem(np.random.default_rng(0), 5, 7)
    nothing = posed(innovation[:0], cross, noise[:0])
    assert jax.eval_shape(partial(plainly, method), *nothing).slot.shape == (0,)


@pytest.mark.parametrize(
    "method", [association.Nearest, association.MaximumLikelihood, association.GlobalNearest]
)
def test_gates_of_nothing_and_of_everything(method):
    parts = posed(*problem(np.random.default_rng(1), 3, 5))
    gates = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 1.0])

    def of_gates(gate, new_gate, *parts):
        return plainly(method(gate, new_gate), *parts)

    over = jax.jit(jax.vmap(of_gates, (0, 0, *[None] * len(parts))))
    slot, is_new, _ = jax.device_get(over(*gates, *parts))
    assert (slot[0] == -1).all()
    np.testing.assert_array_equal(is_new, [[True] * 3, [False] * 3, [False] * 3])
    if method is association.GlobalNearest:
        best = scipy.optimize.linear_sum_assignment(parts[0].distance)[1]
        np.testing.assert_array_equal(slot[2], best)


def test_no_gate_is_a_traced_gate_of_1():
    parts = posed(*problem(np.random.default_rng(1), 3, 5))
    for method in (association.Nearest, association.MaximumLikelihood, association.GlobalNearest):
        without = plainly(method(None), *parts)
        within = jax.jit(lambda gate, method=method: plainly(method(gate), *parts))(1.0)
        np.testing.assert_array_equal(without.slot, within.slot)
        assert (np.asarray(without.slot) >= 0).any() and not without.is_new.any()


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_gate_is_a_probability_for_a_measurement_of_any_size(size):
    """Just inside and outside the quantile of Z numbers, S = I."""
    edge = np.sqrt(scipy.stats.chi2.ppf(0.9, size))
    for distance, inside in ((edge - 1e-6, True), (edge + 1e-6, False)):
        innovation = np.zeros((1, 1, size))
        innovation[..., 0] = distance
        noise = np.eye(size)[None]
        parts = posed(innovation, np.zeros((1, size, 1, size)), noise)
        for rule in (
            association.Nearest(0.9),
            association.Nearest(jnp.asarray(0.9)),
            association.JointCompatibility(0.9),
        ):
            found = jax.jit(plainly)(rule, *parts)
            assert (bool(found.slot[0] == 0), bool(found.is_new[0])) == (inside, not inside)


@refused(
    (
        lambda: association.Nearest(-1.0),
        "Nearest: gate: expected a probability above 0 and below 1",
    ),
    (lambda: association.Nearest(np.nan), "gate: expected a probability above 0 and below 1"),
    (
        lambda: association.Nearest(9.21),
        r"as 0.999, got 9.21 \(the χ² quantile 9.21 of 2 degrees of freedom is that of 0.99\)$",
    ),
    (lambda: association.MaximumLikelihood(1.0), r"got 1.0 \(None for no gate\)$"),
    (lambda: association.Nearest(0.99, 13.8), "below 1, .* 13.8 of .* that of 0.999"),
    (lambda: association.Nearest(None, 0.99), "new_gate: expected None without a gate"),
    (lambda: association.Nearest("9"), "Nearest: gate: expected a probability .*, got '9'$"),
    (
        lambda: plainly(association.Nearest, *posed(*problem(np.random.default_rng(1), 3, 5))),
        "got a Prediction: as associate, give a rule with its gate, not its class$",
    ),
    (
        lambda: association.MaximumLikelihood(0.99, 0.9),
        "new_gate: expected at least gate = 0.99, got 0.9",
    ),
    (
        lambda: association.GlobalNearest(0.99, 0.9),
        "new_gate: expected at least gate = 0.99, got 0.9",
    ),
    (lambda: association.Nearest(0.99, ambiguous="guess"), "guess"),
    (
        lambda: association.JointCompatibility(1.5),
        "JointCompatibility: probability: expected a probability",
    ),
    (
        lambda: association.JointCompatibility(0.99, 0.9),
        "new_gate: expected at least gate = 0.99, got 0.9",
    ),
    (lambda: association.JointCompatibility(budget=0), "budget"),
    (lambda: association.JointCompatibility(candidates=0), "candidates"),
)
def test_refusals(make):
    make()
