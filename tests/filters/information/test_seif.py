"""The sparse information filter: every step against the dense formulas, and what it gives up."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from worlds import draw, narrow, unmatched

from jaxslam import catalog, filters, run, scenarios, sensors
from jaxslam.charts import Euclidean
from jaxslam.core.protocols import Filter
from jaxslam.core.record import record
from jaxslam.core.types import Scan, Status
from jaxslam.filters._information import active_set, eif_slam, marginals, sparse_state
from jaxslam.simulation.scenarios import BetweenRanges, cloister

COUNT = 36
"""landmarks of the cloister"""

dense = jax.jit(lambda state: marginals.local_information(state, jnp.arange(state.alive.shape[0])))


def canonical(state):
    """Ω, ξ and μ of all."""
    omega, state = np.array(dense(state)), jax.device_get(state)
    mean = np.concatenate([state.pose, np.ravel(state.landmarks)])
    residual = np.concatenate([state.pose_residual, np.ravel(state.landmark_residual)])
    return omega, omega @ mean + residual, mean


def at(slots, robot=True):
    """Rows of robot and landmarks in Ω."""
    rows = ([0, 1, 2] if robot else []) + [3 + 2 * s + k for s in slots for k in (0, 1)]
    return np.array(rows, int)


def picks(slots, robot=False):
    """F, (D, n): the columns of the unit matrix of robot and landmarks."""
    return np.eye(3 + 2 * COUNT)[:, at(slots, robot)]


def h_of(pose, point, slot):
    """(2, D) of range and bearing, and what is expected."""
    dx, dy = point - pose[:2]
    q = dx * dx + dy * dy
    r = np.sqrt(q)
    h = np.zeros((2, 3 + 2 * COUNT))
    h[:, at([slot])] = [
        [-dx / r, -dy / r, 0, dx / r, dy / r],
        [dy / q, -dx / q, -1, -dy / q, dx / q],
    ]
    return h, np.array([r, np.arctan2(dy, dx) - pose[2]])


def measured(omega, xi, mean, scan, i, noise):
    """Ω and ξ after measurement i of a scan, the models at a mean; and its H."""
    slot = int(scan.tag[i])
    h, expected = h_of(mean[:3], mean[at([slot], robot=False)], slot)
    nu = np.asarray(scan.z[i]) - expected
    nu[1] = np.angle(np.exp(1j * nu[1]))
    gain = h.T @ np.linalg.inv(noise)
    return omega + gain @ h, xi + gain @ (nu + h @ mean), h


def initialized(omega, xi, mean, slot, noise):
    """Ω and ξ after a landmark is new at the mean: H and its noise say the same as g and its own."""
    h, _ = h_of(mean[:3], mean[at([slot], robot=False)], slot)
    more = h.T @ np.linalg.inv(noise) @ h
    padding = picks([slot])
    return omega + more - padding @ padding.T, xi + more @ mean


def close(a, b, tolerance=1e-8):
    """The same to a share of the largest entry."""
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


def dtypes(tree):
    return {str(leaf.dtype) for leaf in jax.tree.leaves(tree)}


KEY = jax.random.key(0)
P0 = np.diag([0.1, 0.1, 0.05]) ** 2


@functools.cache
def world(steps=40):
    """Few landmarks in sight at a time, in the cloister; its log."""
    scene = dataclasses.replace(
        cloister(steps), visible=BetweenRanges(0.0, 2.2), places=8, pose_cov=P0
    )
    return scene, draw(scene)[1]


@functools.cache
def compiled_seif(active=10, links=COUNT - 1, passive=5):
    scene, _ = world()
    f = filters.Seif(scene.motion, scene.sensor, COUNT, active=active, links=links, passive=passive)
    return f, jax.jit(f.predict), jax.jit(f.update)


def start(f, dtype=float):
    return jax.jit(f.init)(np.asarray(world()[0].pose, dtype), np.asarray(P0, dtype))


FEW = {"links": 8, "passive": COUNT}
"""links too few for all, and all means recovered in turn"""


@functools.cache
def driven(upto=40, **options):
    f, predict, update = compiled_seif(**options)
    state = start(f)
    for u, scan in rows(upto):
        state, _ = update(predict(state, u, KEY), scan, KEY)
    return state


def rows(upto=40):
    log = world()[1]
    for t in range(upto):
        yield log.control[t], jax.tree.map(lambda leaf: leaf[t], log.scan)


def projected(omega, f):
    return omega @ f @ np.linalg.inv(f.T @ omega @ f) @ f.T @ omega


def sparsified(omega, plus, zero):
    """The formula of the errata, by projections."""
    f0 = picks([*plus, *zero], robot=True)
    conditioned = f0 @ f0.T @ omega @ f0 @ f0.T
    robot = picks([], robot=True)
    return (
        omega
        - projected(conditioned, picks(zero))
        + projected(conditioned, picks(zero, robot=True))
        - projected(omega, robot)
    )


def test_every_step_is_the_dense_formula():
    """Motion, sparsification, measurement and birth, in Ω and ξ, by dense NumPy."""
    f, predict, update = compiled_seif()
    relax = jax.jit(functools.partial(marginals.recover_passive_means, count=5))
    noise = np.diag([0.1, np.deg2rad(1.0)]) ** 2
    state, cut, born = start(f), 0, 0
    for u, scan in rows():
        state = jax.device_get(state)
        omega, xi, mean = canonical(state)
        c, sine, d = np.cos(mean[2]), np.sin(mean[2]), float(u[0])
        moved = predict(state, u, KEY)
        g = np.eye(3 + 2 * COUNT)
        g[:2, 2] = [-d * sine, d * c]
        by_noise = np.array([[c, 0.0], [sine, 0.0], [0.0, 1.0]])
        q = by_noise @ np.diag([0.01, 0.02]) ** 2 @ by_noise.T
        phi = np.linalg.inv(g).T @ omega @ np.linalg.inv(g)
        cov = np.linalg.inv(phi)
        cov[:3, :3] += q
        after = np.linalg.inv(cov)
        error = np.linalg.solve(omega, xi) - mean  # the mean, as an error
        omega_bar, xi_bar, mean_bar = canonical(moved)
        error = g @ error + mean_bar
        close(omega_bar, after, 1e-9)
        close(xi_bar, after @ error, 1e-8)
        # mean recovery moves μ and leaves Ω and ξ
        state = relax(moved)
        omega, xi, mean = canonical(state)
        close(omega, omega_bar, 1e-12)
        close(xi, xi_bar, 1e-12)
        # the scan
        after_scan, info = jax.device_get(update(moved, scan, KEY))
        old, new = (set(np.asarray(s.active)) - {COUNT} for s in (state, after_scan))
        gone = sorted(old - new)
        if gone:
            cut += 1
            less = sparsified(omega, sorted(old & new), gone)
            assert np.linalg.eigvalsh(less)[0] > 0
            assert np.abs(less[:3][:, [3 + 2 * s for s in gone]]).max() < 1e-6 * np.abs(less).max()
            xi = xi + (less - omega) @ mean
            omega = less
        for i in np.flatnonzero(np.asarray(info.status) == Status.FUSED):
            omega, xi, _ = measured(omega, xi, mean, scan, i, noise)
        mean = np.concatenate([after_scan.pose, np.ravel(after_scan.landmarks)])
        for i in np.flatnonzero(np.asarray(info.status) == Status.BORN):
            born += 1
            omega, xi = initialized(omega, xi, mean, int(scan.tag[i]), noise)
        state = after_scan
        omega_after, xi_after, _ = canonical(state)
        close(omega_after, omega, 1e-8)
        close(xi_after, xi, 1e-7)
        assert int(state.counts.dropped) == 0
    assert cut >= 2
    assert born > 10
    assert int(state.counts.cut) >= cut
    assert float(state.counts.cut_nats) > 0


@pytest.mark.sweep
def test_mean_recovery_converges_to_the_whole_mean():
    state = driven(**FEW)
    residual = np.concatenate([state.pose_residual, np.ravel(state.landmark_residual)])
    step = np.linalg.solve(filters.whole_information(state).toarray(), residual)
    pose, landmarks = state.pose + step[:3], state.landmarks + step[3:].reshape(-1, 2)
    f, _, update = compiled_seif(**FEW)
    _, scan = next(rows(1))
    nothing = scan._replace(valid=np.zeros_like(scan.valid))
    for _ in range(1500):
        state, _ = update(state, nothing, KEY)
    np.testing.assert_allclose(state.pose, pose, atol=1e-4)
    alive = np.asarray(state.alive)
    recovered = np.asarray(state.landmarks)
    np.testing.assert_allclose(recovered[alive], np.asarray(landmarks)[alive], atol=1e-4)


def test_whole_map_and_markov_blankets():
    state = driven()
    omega = filters.whole_information(state).toarray()
    np.testing.assert_allclose(omega, dense(state), atol=1e-12 * np.abs(omega).max())
    cov = np.linalg.inv(omega)
    marginal_covs = np.asarray(jax.jit(marginals.blanket_marginals)(state)[1])
    cov_of, chosen = jax.jit(marginals.blanket_cov), set(np.asarray(state.active))
    neighbours = np.asarray(state.neighbours)
    for slot in np.flatnonzero(state.alive):
        at = [0, 1, 2, 3 + 2 * slot, 4 + 2 * slot]
        local = np.asarray(cov_of(state, slot))
        # given more, it is less: never above the marginal covariance
        assert np.linalg.eigvalsh(cov[np.ix_(at, at)] - local)[0] > -1e-9
        np.testing.assert_allclose(marginal_covs[slot], local[3:, 3:], atol=1e-12)
        # and it is the inverse of the block of the blanket
        row = neighbours[slot]
        members = sorted({int(slot), *row[row < COUNT], *chosen} - {COUNT})
        f = picks(members, robot=True)
        inner = np.linalg.inv(f.T @ omega @ f)
        k = 3 + 2 * members.index(slot)
        at = [0, 1, 2, k, k + 1]
        np.testing.assert_allclose(local, inner[np.ix_(at, at)], atol=1e-9)


def test_sparsification_is_overconfident():
    """A counter-example: Ω - Ω̃ is not positive semi-definite."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(9, 9))
    omega = root @ root.T + 0.1 * np.eye(9)
    gone = np.array([False, False, True])
    sparsify = jax.jit(sparse_state.sparsify)
    after, nats = sparsify(omega, gone)
    after = np.asarray(after)
    assert np.linalg.eigvalsh(after)[0] > 0
    assert np.abs(after[:3, 7:]).max() == 0
    size = np.linalg.eigvalsh(omega - after)
    assert size[0] < -1e-3  # claims more in some direction
    assert size[-1] > 1e-3  # and less in another
    # What it keeps: the moments of (x, m+) and of (m0, m+), hence all its own marginals.
    a, b = np.linalg.inv(omega), np.linalg.inv(after)
    np.testing.assert_allclose(a[:7, :7], b[:7, :7], atol=1e-10)
    np.testing.assert_allclose(a[3:, 3:], b[3:, 3:], atol=1e-10)
    # The nats are the divergence of the two.
    divergence = 0.5 * (np.trace(after @ a) - 9 - np.linalg.slogdet(after @ a)[1])
    np.testing.assert_allclose(nats, divergence, rtol=1e-9)
    same, none = sparsify(omega, np.zeros(3, bool))
    np.testing.assert_array_equal(same, omega)
    assert float(none) == 0


def test_sparsification_of_some_is_overconfident_about_the_rest():
    """With passive landmarks held at their means, covariances of the whole map shrink."""
    rng, smaller = np.random.default_rng(0), 0
    for _ in range(20):
        root = rng.normal(size=(3 + 2 * COUNT, 3 + 2 * COUNT))
        omega = root @ root.T + np.eye(len(root))
        f = picks([*range(8, COUNT)])
        omega[:3] = np.where((f.sum(axis=1) > 0)[None, :], 0.0, omega[:3])
        omega[:, :3] = omega[:3].T
        omega += np.eye(len(omega)) * max(0.0, 0.1 - np.linalg.eigvalsh(omega)[0])
        before, after = np.linalg.inv(omega), np.linalg.inv(sparsified(omega, range(6), [6, 7]))
        smaller += np.linalg.eigvalsh(after - before)[0] < -1e-9
    assert smaller == 20


def test_the_least_psd_completion_of_a_link():
    rng = np.random.default_rng(0)
    links = [*rng.normal(size=(20, 2, 2)), np.zeros((2, 2)), np.outer([1.0, 2.0], [3.0, 1.0])]
    completion = jax.jit(sparse_state.psd_completion)
    for link in links:
        u, v = (np.asarray(part) for part in completion(link))
        np.testing.assert_allclose(u @ u, link @ link.T, atol=1e-12)
        np.testing.assert_allclose(v @ v, link.T @ link, atol=1e-12)
        assert np.linalg.eigvalsh(np.block([[u, link], [link.T, v]]))[0] > -1e-12
    slope = jax.jit(jax.grad(lambda b: sparse_state.psd_completion(b)[0].sum()))(np.zeros((2, 2)))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("conservative", [False, True])
def test_a_full_list_drops_its_weakest_link(conservative):
    """Three links enter a list of two: the weakest goes, on both sides, and Ω̃ ⪰ Ω, or ⪯."""
    state = jax.jit(lambda: sparse_state.empty_map(jnp.zeros(3), jnp.eye(3), 5, 1, 2))()
    state = state._replace(diagonal=100.0 * np.asarray(state.diagonal))
    enter = jax.jit(functools.partial(active_set.enter_link, conservative=conservative))
    link = np.array([[-2.0, 0.5], [0.1, -1.0]])
    yes = np.array(True)
    at = [np.array(k) for k in range(5)]
    state = enter(state, at[0], at[1], 2 * link, yes)
    state = enter(state, at[2], at[0], link, yes)
    assert int(state.counts.dropped) == 0
    before = np.array(dense(state))
    np.testing.assert_array_equal(before[3:5, 7:9], np.asarray(link).T)
    state = enter(state, at[0], at[3], 3 * link, yes)
    after = np.asarray(dense(state))
    assert sorted(np.asarray(state.neighbours[0])) == [1, 3]
    assert np.all(np.asarray(state.neighbours[2]) == 5)
    before[3:5, 9:11], before[9:11, 3:5] = 3 * link, 3 * link.T
    change = np.linalg.eigvalsh(after - before)
    assert (change[-1] < 1e-12) if conservative else (change[0] > -1e-12)
    assert np.abs(change).max() > 1
    # a link weaker than all that the list holds is not entered
    state = enter(state, at[0], at[4], 0.1 * link, yes)
    assert sorted(np.asarray(state.neighbours[0])) == [1, 3]
    assert np.all(np.asarray(state.neighbours[4]) == 5)
    assert int(state.counts.dropped) == 2
    assert int(state.counts.anchored) == (0 if conservative else 2)
    norm = np.linalg.norm(np.asarray(link))
    np.testing.assert_allclose(state.counts.dropped_links, 1.1 * norm)
    # where the conservative way would take too much, it is not taken
    weak = state._replace(diagonal=np.tile(0.5 * np.eye(2), (5, 1, 1)))
    weak = enter(weak, at[0], at[4], 0.5 * link, yes)
    assert int(weak.counts.anchored) == (1 if conservative else 3)


@pytest.mark.sweep
def test_few_links_stay_definite_and_are_counted():
    state = driven(**FEW)
    assert int(state.counts.dropped) > 0
    assert int(state.counts.refused) == 0
    omega = filters.whole_information(state).toarray()
    np.testing.assert_array_equal(omega, omega.T)
    assert np.linalg.eigvalsh(omega)[0] > 0


def test_statuses_of_strange_scans():
    f, predict, update = compiled_seif()
    state = driven(upto=10)
    _, scan = list(rows(11))[-1]
    tag = np.array(scan.tag)
    valid = np.flatnonzero(np.asarray(scan.valid))
    tag[valid[:2]] = [-1, COUNT + 3]
    after, info = update(state, scan._replace(tag=jnp.asarray(tag)), KEY)
    assert int(info.status[valid[0]]) == Status.UNMATCHED
    assert int(info.status[valid[1]]) == Status.OVERFLOW
    tag[valid[0]] = tag[valid[2]]
    after, info = update(state, scan._replace(tag=jnp.asarray(tag)), KEY)
    assert int(info.status[valid[2]]) == Status.REPEATED
    assert int(after.counts.refused) == 0


def test_lost_definiteness_is_refused_and_counted():
    f, predict, update = compiled_seif()
    state = driven(upto=10)
    _, scan = list(rows(11))[-1]
    bad = state._replace(omega=state.omega.at[0, 0].set(-1.0))
    after, info = update(bad, scan, KEY)
    assert int(after.counts.refused) == 1
    np.testing.assert_array_equal(after.pose, bad.pose)
    status = np.asarray(info.status)[np.asarray(scan.valid)]
    assert np.all(status == Status.SINGULAR)


@pytest.mark.sweep
def test_float32_keeps_its_type_and_its_definiteness():
    scene, log = world()
    f, predict, update = compiled_seif()

    state, wide = start(f, jnp.float32), start(f)
    for u, scan in rows():
        state, _ = update(predict(state, narrow(u), KEY), narrow(scan), KEY)
        wide, _ = update(predict(wide, u, KEY), scan, KEY)
    assert dtypes(state) == {"float32", "int32", "bool"}
    assert int(state.counts.refused) == 0
    np.testing.assert_allclose(state.pose, wide.pose, atol=1e-2)


@pytest.mark.sweep
def test_gradients_and_batches():
    """Of one step, which is that of one run alone."""
    row = list(rows(12))[-1]

    def loss(sigma, state):
        sensor = sensors.RangeBearing(jnp.diag(jnp.stack([sigma, np.deg2rad(1.0)])) ** 2)
        options = {"active": 10, "links": COUNT - 1, "passive": 5}
        f = filters.Seif(world()[0].motion, sensor, COUNT, **options)
        return f.update(f.predict(state, row[0], KEY), row[1], KEY)[0].pose.sum()

    both = jax.jit(jax.vmap(jax.value_and_grad(loss), (0, None)))
    several, slope = both(np.array([0.1, 0.2]), driven(upto=11))
    assert np.isfinite(slope).all() and (np.abs(slope) > 0).all()
    np.testing.assert_allclose(several[0], driven(upto=12).pose.sum(), rtol=1e-8)


@refused(
    ({"active": 0}, "active"),
    ({"links": 0}, "links"),
    ({"passive": 0}, "passive"),
    ({"sweeps": 0}, "sweeps"),
    ({"capacity": 0}, "capacity"),
    ({"floor": -1.0}, "floor"),
    ({"sensor": sensors.RangeBearingSignature(0.01 * np.eye(3))}, r"landmarks \(x, y\)"),
)
def test_refusals(changes):
    scene, _ = world()
    options = {"motion": scene.motion, "sensor": scene.sensor, "capacity": COUNT}
    filters.Seif(**(options | {"active": 10, "links": 10} | changes))


def test_an_area_smaller_than_a_scan_is_refused():
    scene, log = world()
    f = filters.Seif(scene.motion, scene.sensor, COUNT, active=7, links=10)
    with pytest.raises(
        ValueError,
        match="Seif: active: expected a number >= 8, the measurement slots of a scan, got",
    ):
        run(f, log, scene.pose, P0, KEY)


# --- SEIF of the catalog is sparse wherever there is a map to speak of ----------------------------


@pytest.mark.parametrize(("scenario", "active"), [("cloister", 18), ("circle", 10)])
def test_fewer_landmarks_are_active_than_the_map_has(scenario, active):
    world = scenarios.SCENARIOS[scenario](20)
    count = len(world.landmarks)
    filter = catalog.ALL["seif"](world)
    pose, cov = jnp.zeros(3), jnp.eye(3)
    state = jax.eval_shape(filter.init, pose, cov)
    assert state.active.shape == (active,) and active < count
    places = world.places or count
    scan = Scan(jnp.zeros((places, 2)), jnp.arange(places), jnp.ones(places, bool))
    _, info = jax.eval_shape(filter.update, state, scan, jax.random.key(0))
    assert info.status.shape == (places,) and info.innovation_cov.shape == (places, 2, 2)


@record
class Toy(Filter):
    """A filter that adds up what it measures, three measurements at once."""

    controls = ("a", "b", "c")
    measurements = ("x [m]", "y [m]")
    chart = Euclidean()

    def init(self, pose, pose_cov):
        return pose[0]

    def predict(self, state, u, key):
        return state

    def update(self, state, scan, key):
        assert scan.tag.shape == (3,)
        info = unmatched(scan)._replace(slot=scan.tag, log_likelihood=scan.z.sum())
        return state + jnp.where(scan.valid, scan.z[:, 0], 0.0).sum(), info

    def estimate(self, state):
        return state


def test_a_scan_in_pieces_loses_and_moves_nothing():
    seen = eif_slam.InPieces(Toy(), 3)
    tag = jnp.asarray([7, 3, 9, 1, 4, 8, 0])
    scan = Scan(jnp.stack([tag, -tag], axis=1) * 1.0 + 1.0, tag, tag != 9)
    state, info = jax.jit(seen.update)(jnp.zeros(()), scan, jax.random.key(0))
    np.testing.assert_array_equal(info.slot, tag)
    np.testing.assert_array_equal(info.status != 0, tag != 9)
    assert state == np.asarray(tag)[np.asarray(tag) != 9].sum() + 6
    assert info.log_likelihood == 14 and info.nis.shape == (7,) and info.exhausted.shape == ()
