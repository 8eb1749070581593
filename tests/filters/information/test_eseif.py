"""The exactly sparse information filter: every step against dense NumPy; it never claims more."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_form import (
    COUNT,
    at,
    canonical,
    close,
    dense,
    dtypes,
    h_of,
    initialized,
    measured,
)
from worlds import narrow

from jaxslam import filters, motion, sensors
from jaxslam.filters.information.sparse.mean_recovery import recover_passive_means
from jaxslam.filters.information.sparse.relocation import determines_pose, marginalize_pose
from jaxslam.filters.information.sparse.sparse_state import linked_to_robot
from jaxslam.simulation.scenarios import cloister
from jaxslam.simulation.scenarios.view import between_ranges
from jaxslam.simulation.worlds import simulate
from jaxslam.types import Status

KEY = jax.random.key(0)
P0 = np.diag([0.01, 0.01, 0.005]) ** 2
STEPS, RUNS = 60, 12
ODOMETRY = np.diag([0.002, 0.004]) ** 2  # good, so that the robot's links last
NOISE = np.diag([0.1, np.deg2rad(2.0)]) ** 2
MODELS = motion.Increment(ODOMETRY), sensors.RangeBearing(NOISE), COUNT
AREA = {"active": 9, "links": COUNT - 1, "passive": 5}


@functools.cache
def logs():
    """Logs of RUNS draws, and as number 0 one without any noise; and the true poses."""
    scene = dataclasses.replace(
        cloister(STEPS),
        motion=MODELS[0],
        sensor=MODELS[1],
        visible=between_ranges(0.0, 2.2),
        places=8,
        pose_cov=P0,
    )
    silent = dataclasses.replace(
        scene,
        motion=motion.Increment(1e-30 * np.eye(2)),
        sensor=sensors.RangeBearing(1e-30 * np.eye(2)),
        pose_cov=1e-30 * np.eye(3),
    )
    keys = jax.random.split(jax.random.key(2), RUNS)
    first = simulate(silent, keys[0])
    rest = jax.jit(jax.vmap(functools.partial(simulate, scene)))(keys)
    first, rest = jax.device_get((first, rest))
    return jax.tree.map(lambda a, b: np.concatenate([a[None], b]), first, rest)


@functools.cache
def made(name, **options):
    """Predict and update, of one run after the other and of all of `logs` at once."""
    make = getattr(filters, name)
    f = make(*MODELS, **options)
    predict, update = jax.jit(f.predict), jax.jit(f.update)
    return f, lambda s, u, scan: update(predict(s, u, KEY), scan, KEY), predict, update


def start(f, dtype=float):
    return jax.jit(f.init)(np.asarray(cloister(2).pose, dtype), np.asarray(P0, dtype))


def rows(run=0, upto=STEPS):
    log = jax.tree.map(lambda leaf: leaf[run], logs()[1])
    for t in range(upto):
        yield log.control[t], jax.tree.map(lambda leaf: leaf[t], log.scan)


def least(matrix):
    """The least eigenvalue, as a share of the largest diagonal entry."""
    return np.linalg.eigvalsh(matrix)[0] / np.abs(np.diagonal(matrix)).max()


@functools.cache
def driven(name, **options):
    """States of the noise-free run, after each step, and infos."""
    f, step, *_ = made(name, **options)
    state, out = start(f), []
    for u, scan in rows():
        state, info = step(state, u, scan)
        out.append((state, info))
    return jax.device_get(out)


# --- one relocation ------------------------------------------------------------------------------


def test_relocation_of_one_information_matrix_is_its_marginal_and_conservative():
    """Sparsification claims more in some direction (test_seif.py). Relocation never does."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(13, 13))
    omega = root @ root.T + 0.1 * np.eye(13)
    gone = np.array([False, False, False, True, True])
    h = rng.normal(size=(6, 13))
    h[:, 9:] = 0  # measurements of the landmarks that stay
    residual = rng.normal(size=13)
    less, residual_less = jax.device_get(jax.jit(marginalize_pose)(omega, residual))
    assert not less[:3].any() and not residual_less[:3].any()
    # the marginal of the landmarks: covariance and mean
    close(np.linalg.inv(less[3:, 3:]), np.linalg.inv(omega)[3:, 3:])
    close(np.linalg.solve(less[3:, 3:], residual_less[3:]), np.linalg.solve(omega, residual)[3:])
    relocated, full = less + h.T @ h, omega + h.T @ h
    assert np.linalg.eigvalsh(full - relocated)[0] > -1e-9
    assert np.linalg.eigvalsh(np.linalg.inv(relocated) - np.linalg.inv(full))[0] > -1e-9
    np.testing.assert_array_equal(jax.jit(linked_to_robot)(relocated), ~gone)


def test_every_step_is_the_dense_formula():
    """Relocation, measurements of both kinds and births, by dense NumPy, on a noisy run."""
    f, step, predict, _ = made("eseif", **AREA)
    relax = jax.jit(functools.partial(recover_passive_means, count=5))
    state, relocations, late = start(f), 0, 0
    there = list(rows(run=1, upto=40))
    back = [(-u, scan) for (u, _), (_, scan) in zip(there[:20:-1], there[19:0:-1], strict=False)]
    for u, scan in there + back:
        before = jax.device_get(relax(predict(state, u, KEY)))
        state, info = jax.device_get(step(state, u, scan))
        omega, xi, mean = canonical(before)
        active = sorted(set(np.asarray(before.active)) - {COUNT})
        status = np.asarray(info.status)
        fused = np.flatnonzero(status == Status.FUSED)
        relocated = int(state.counts.relocated) > int(before.counts.relocated)
        if relocated:
            relocations += 1
            inner = np.linalg.inv(omega[:3, :3])
            marginal = omega - omega[:, :3] @ inner @ omega[:3]
            xi_marginal = xi - omega[:, :3] @ inner @ xi[:3]
            full, omega, xi = omega, marginal, xi_marginal
            omega[:3], omega[:, :3], xi[:3] = 0, 0, 0
        for known in (True, False):
            for i in fused:
                slot = int(scan.tag[i])
                if (slot in active) is not known:
                    continue
                late += not known
                omega, xi, h = measured(omega, xi, mean, scan, i, NOISE)
                if relocated:
                    full = full + h.T @ np.linalg.inv(NOISE) @ h
            # the active block moves to its mean, all others held where they are
            here = at(active) if known else at(sorted(set(np.asarray(state.active)) - {COUNT}))
            left = xi - omega @ mean
            if known:
                mean[here] += np.linalg.solve(omega[np.ix_(here, here)], left[here])
        if relocated:
            assert least(full - omega) > -1e-9
        mean = np.concatenate([state.pose, np.ravel(state.landmarks)])
        for i in np.flatnonzero(status == Status.BORN):
            omega, xi = initialized(omega, xi, mean, int(scan.tag[i]), NOISE)
        omega_after, xi_after, _ = canonical(state)
        close(omega_after, omega)
        close(xi_after, xi, 1e-6)
        ties = np.flatnonzero(np.abs(omega[:3, 3:]).max(axis=0).reshape(-1, 2).max(axis=1))
        assert len(ties) <= 9
    assert relocations >= 2 and late > 2
    assert int(state.counts.relocated) == relocations
    assert int(state.counts.dropped) == int(state.counts.refused) == 0
    assert int(state.counts.cut) > 0 and float(state.counts.cut_nats) > 0


# --- whole runs ----------------------------------------------------------------------------------


def test_relocation_is_conservative_over_a_run_and_sparsification_is_not():
    """Without noise in the data all filters linearize at the truth: covariances alone differ."""
    eif, exact, sparse = driven("eif_slam"), driven("eseif", **AREA), driven("seif", **AREA)
    claims_more = 0
    for t in range(9, STEPS, 10):
        tag = np.asarray(eif[t][0].tag)
        whole = np.linalg.inv(eif[t][0].omega)
        ours, theirs = (np.linalg.inv(dense(run[t][0])) for run in (exact, sparse))
        there = [s for s in np.flatnonzero(tag >= 0) if bool(exact[t][0].alive[tag[s]])]
        order, map_order = at(there), at(tag[there])
        # in units of what the full filter claims
        factor = np.linalg.cholesky(whole[np.ix_(order, order)])
        square = np.ix_(map_order, map_order)
        ours, theirs = (
            np.linalg.eigvalsh(np.linalg.solve(factor, np.linalg.solve(factor, cov[square]).T))
            for cov in (ours, theirs)
        )
        assert ours[0] > 1 - 1e-6
        claims_more += theirs[0] < 1 - 1e-4
    assert int(exact[-1][0].counts.relocated) >= 2
    assert claims_more > 0
    np.testing.assert_allclose(exact[-1][0].pose, eif[-1][0].pose, atol=1e-6)


def test_its_nees_is_that_of_an_honest_filter():
    """Of pose and landmarks together, by the whole Ω, at three times of four noisy runs."""
    f, step, *_ = made("eseif", **AREA)
    total = []
    for run in range(1, 5):
        truth = jax.tree.map(lambda leaf, run=run: np.asarray(leaf[run]), logs()[0])
        state = start(f)
        for t, (u, scan) in enumerate(rows(run)):
            state, _ = step(state, u, scan)
            if t % 20 == 19:
                off = np.ravel(truth.landmarks - np.asarray(state.landmarks))
                error = np.concatenate([truth.pose[t] - np.asarray(state.pose), off])
                error[2] = np.angle(np.exp(1j * error[2]))
                here = at(np.flatnonzero(state.alive))
                omega = np.asarray(dense(state))[np.ix_(here, here)]
                total.append(error[here] @ omega @ error[here] / len(here))
        assert int(state.counts.relocated) > 0
    # about 50 numbers each, of four independent runs: 4 standard deviations are 0.4
    assert 0.6 < np.mean(total) < 1.4


# --- when it must wait ---------------------------------------------------------------------------


def test_what_gives_a_pose():
    """Against the inverse of the information, by range and bearing from the origin."""

    def rows_of(*points):
        return np.concatenate(
            [np.linalg.solve(np.sqrt(NOISE), h_of(np.zeros(3), p, 0)[0][:, :3]) for p in points]
        )

    one, two = rows_of([1.0, 2.0]), rows_of([1.0, 2.0], [-2.0, 1.0])
    spread = np.sqrt(np.linalg.inv(two.T @ two)[2, 2])
    assert not determines_pose(jnp.asarray(one), 10.0)
    assert determines_pose(jnp.asarray(two), 1.01 * spread)
    assert not determines_pose(jnp.asarray(two), 0.99 * spread)
    assert not determines_pose(jnp.zeros((4, 3)), 10.0)
    ranges = rows_of([1.0, 2.0], [-2.0, 1.0], [0.5, 3.0])[::2]
    assert not determines_pose(jnp.asarray(ranges), 10.0)


def test_without_a_relocation_known_landmarks_wait_and_new_ones_with_them():
    """A full area, and a scan of strangers: nothing is cut, all are deferred, counted and later
    fused or born."""
    f, step, _, update = made("eseif", **AREA)
    state, scans = start(f), list(rows(run=1))
    for u, scan in scans:
        state, info = step(state, u, scan)
    known = np.flatnonzero(state.alive)
    away = np.setdiff1d(known, np.asarray(state.active))[:2]
    new = np.setdiff1d(np.arange(COUNT), known)[:2]
    # every active landmark is linked to the robot, so that none may leave
    places = np.flatnonzero(np.asarray(state.active) < COUNT)
    omega = np.array(state.omega)
    for p in places:
        omega[0, 3 + 2 * p] = omega[3 + 2 * p, 0] = omega[0, 3 + 2 * p] or 1e-6
    full = state._replace(omega=omega)
    assert len(places) == 9 and len(away) == 2 and len(new) == 2
    tag = np.array(scan.tag)
    tag[:4] = [*new, *away]
    z = np.array(scan.z)
    for i, slot in zip((2, 3), away, strict=True):
        z[i] = h_of(np.asarray(state.pose), np.asarray(state.landmarks[slot]), 0)[1]
    odd = scan._replace(tag=tag, z=z, valid=np.arange(len(tag)) < 4)
    after, info = update(full, odd, KEY)
    np.testing.assert_array_equal(info.status[:4], [Status.DEFERRED] * 4)
    assert np.all(np.asarray(info.slot) == -1)
    np.testing.assert_array_equal(after.active, full.active)
    assert int(after.counts.relocated) == int(state.counts.relocated)
    # or links are cut instead, and counted
    bold = filters.eseif(*MODELS, **AREA, wait=False)
    cut, info = jax.jit(bold.update)(full, odd, KEY)
    np.testing.assert_array_equal(info.status[:4], [Status.BORN] * 2 + [Status.FUSED] * 2)
    assert int(cut.counts.cut) == int(full.counts.cut) + 4
    assert int(cut.counts.relocated) == int(full.counts.relocated)
    # two open places: the known ones have them
    omega[:3, 3:7], omega[3:7, :3] = 0, 0
    after, info = update(full._replace(omega=omega), odd, KEY)
    np.testing.assert_array_equal(info.status[:4], [Status.DEFERRED] * 2 + [Status.FUSED] * 2)
    assert set(away) <= set(np.asarray(after.active).tolist())


# --- the house ------------------------------------------------------------------------------------


def test_float32_gradients_and_a_lost_area():
    f, step, *_ = made("eseif", **AREA)

    state = start(f, jnp.float32)
    for u, scan in rows(run=1):
        state, info = step(state, narrow(u), narrow(scan))
    assert dtypes(state) == {"float32", "int32", "bool"}
    assert int(state.counts.refused) == 0 and int(state.counts.relocated) > 0
    omega = np.array(state.omega)
    omega[0, 0] = -1.0
    lost = state._replace(omega=omega)
    after, info = step(lost, narrow(u), narrow(scan))
    assert int(after.counts.refused) == 1
    assert set(np.asarray(info.status)[np.asarray(scan.valid)]) == {int(Status.SINGULAR)}

    before, row = next(
        (a, row)
        for (a, _), (b, _), row in zip(
            driven("eseif", **AREA),
            driven("eseif", **AREA)[1:],
            list(rows())[1:],
            strict=False,
        )
        if int(b.counts.relocated) > int(a.counts.relocated)
    )

    def loss(sigma, before):
        sensor = sensors.RangeBearing(jnp.diag(jnp.stack([sigma, 0.03])) ** 2)
        other = filters.eseif(MODELS[0], sensor, COUNT, active=9, links=COUNT - 1, passive=1)
        u, scan = jax.tree.map(jnp.asarray, row)
        scan = scan._replace(z=scan.z + 0.01)
        after, _ = other.update(other.predict(before, u, KEY), scan, KEY)
        return after.pose[:2].sum() + after.omega[0, 0] * 1e-3, after.counts.relocated

    slope, relocated = jax.jit(jax.grad(loss, has_aux=True))(0.1, before)
    assert int(relocated) > int(before.counts.relocated)
    assert np.isfinite(slope) and abs(slope) > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"active": 0}, "eseif: active"),
        ({"links": 0}, "links"),
        ({"turn": 0.0}, "turn above 0"),
        ({"gate": -1.0}, "gate"),
    ],
)
def test_refusals(changes, message):
    with pytest.raises(ValueError, match=message):
        filters.eseif(*MODELS, **({"active": 10, "links": 10} | changes))
