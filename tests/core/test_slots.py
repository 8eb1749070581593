"""slots: the padding invariant under any sequence of operations, against a map that grows in NumPy."""

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import slots

CAPACITY = 4

find, allocate = jax.jit(slots.find), jax.jit(slots.allocate)
gather, scatter, remove = jax.jit(slots.gather), jax.jit(slots.scatter), jax.jit(slots.remove)


def as_of_a_large_map(*arguments, **options):
    """`scatter` as it is where P does not stay in the cache."""
    with mock.patch.object(slots, "CACHED", 0):
        return slots.scatter(*arguments, **options)


in_place = jax.jit(as_of_a_large_map, static_argnames="square_root")
both_ways = pytest.mark.parametrize("scatter", [scatter, in_place], ids=["one_pass", "in_place"])


def start(size=2, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3))
    return slots.empty(jnp.asarray(rng.normal(size=3)), jnp.asarray(root @ root.T), CAPACITY, size)


def births(rng, born, size=2):
    """Arguments of scatter for the slots born; garbage in the others, which must not be read."""
    root = rng.normal(size=(CAPACITY, size, size))
    own = root @ root.transpose(0, 2, 1)
    landmarks, by_pose = rng.normal(size=(CAPACITY, size)), rng.normal(size=(CAPACITY, size, 3))
    tag = rng.permutation(100)[:CAPACITY]
    spoil = ~np.asarray(born)
    landmarks[spoil], by_pose[spoil], own[spoil], tag[spoil] = np.nan, np.nan, np.nan, -99
    slot = np.where(born, np.arange(CAPACITY), 0)  # as allocate has it
    return slot, np.asarray(born), landmarks, by_pose, own, tag


def assert_padding(joint):
    size = joint.landmarks.shape[1]
    alive, cov = np.asarray(joint.alive), np.asarray(joint.cov)
    rows = np.repeat(~alive, size)
    dead = np.concatenate([np.zeros(3, bool), rows])
    assert not np.asarray(joint.landmarks)[~alive].any()
    np.testing.assert_array_equal(np.asarray(joint.tag)[~alive], -1)
    assert (np.asarray(joint.tag)[alive] >= 0).all()
    assert not cov[np.ix_(dead, ~dead)].any()
    assert not cov[np.ix_(~dead, dead)].any()
    np.testing.assert_array_equal(cov[np.ix_(dead, dead)], np.eye(dead.sum()))
    np.testing.assert_array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov)[0] > 0


class Dense:
    """The same map as plain as it gets: it grows and shrinks, in order of birth."""

    def __init__(self, joint):
        self.x, self.p, self.tags = np.array(joint.pose), np.array(joint.cov[:3, :3]), []
        self.size = joint.landmarks.shape[1]

    def add(self, landmark, by_pose, own, tag):
        n = len(self.x)
        big = np.zeros((n + self.size, n + self.size))
        big[:n, :n] = self.p
        big[n:, :n] = by_pose @ self.p[:3]
        big[:n, n:] = big[n:, :n].T
        big[n:, n:] = by_pose @ self.p[:3, :3] @ by_pose.T + own
        self.x, self.p = np.concatenate([self.x, landmark]), big
        self.tags.append(int(tag))

    def drop(self, tag):
        at = 3 + self.size * self.tags.index(tag)
        keep = np.delete(np.arange(len(self.x)), np.arange(at, at + self.size))
        self.x, self.p = self.x[keep], self.p[np.ix_(keep, keep)]
        self.tags.remove(tag)

    def assert_equals(self, joint):
        tags = [int(t) for t in joint.tag]
        slot = [tags.index(t) for t in self.tags]
        assert sorted(slot) == list(np.flatnonzero(joint.alive))
        rows = [0, 1, 2] + [3 + self.size * s + k for s in slot for k in range(self.size)]
        mean = np.concatenate([joint.pose, np.asarray(joint.landmarks)[slot].ravel()])
        np.testing.assert_allclose(mean, self.x, atol=1e-13)
        np.testing.assert_allclose(np.asarray(joint.cov)[np.ix_(rows, rows)], self.p, atol=1e-11)


def test_empty_map():
    joint = start()
    assert joint.cov.shape == (3 + 2 * CAPACITY,) * 2
    assert_padding(joint)
    Dense(joint).assert_equals(joint)
    unknown = slots.empty(jnp.zeros(3, np.float32), np.zeros((3, 3), np.float32), 2, 3)
    assert {a.dtype for a in (unknown.pose, unknown.landmarks, unknown.cov)} == {np.dtype("f4")}
    assert not unknown.cov[:3, :3].any()


@both_ways
@pytest.mark.parametrize("size", [1, 2, 3])
def test_scatter_is_dense_augmentation_of_several_landmarks_at_once(scatter, size):
    rng = np.random.default_rng(1)
    joint = start(size)
    dense = Dense(joint)
    for born in ([True, False, True, False], [False, True, False, False]):
        part = births(rng, born, size)
        joint = scatter(joint, *part)
        for i in np.flatnonzero(born):
            dense.add(*(table[i] for table in part[2:]))
        dense.assert_equals(joint)
        assert_padding(joint)
    # Two landmarks of one scan are correlated through the robot, and by that alone.
    cross = np.asarray(joint.cov)[3 : 3 + size, 3 + 2 * size : 3 + 3 * size]
    assert np.abs(cross).min() > 1e-6


@both_ways
def test_scatter_keeps_the_digits_of_a_covariance_far_below_the_unit_variance_of_padding(scatter):
    """Millimetres in float32: the 1 that stood in the slot must leave no rounding behind."""
    rng = np.random.default_rng(9)
    slot, born, landmarks, by_pose, own, tag = births(rng, [True, True, False, False])
    joint = start()
    joint = joint._replace(cov=joint.cov.at[:3, :3].multiply(1e-8))
    dense = Dense(joint)
    for i in (0, 1):
        dense.add(landmarks[i], by_pose[i], 1e-8 * own[i], tag[i])
    single = jax.tree.map(lambda a: np.asarray(a, "f4") if a.dtype == float else a, joint)
    part = [a.astype("f4") if a.dtype == float else a for a in (landmarks, by_pose, 1e-8 * own)]
    out = scatter(single, slot, born, *part, tag)
    np.testing.assert_allclose(out.cov[:7, :7], dense.p, rtol=1e-5, atol=1e-13)


@both_ways
def test_scatter_does_not_depend_on_the_order_of_the_places(scatter):
    part = births(np.random.default_rng(10), [True, False, True, True])
    shuffled = [table[[3, 0, 1, 2]] for table in part]
    for a, b in zip(scatter(start(), *part), scatter(start(), *shuffled), strict=True):
        np.testing.assert_array_equal(a, b)


@both_ways
def test_scatter_of_nothing_changes_nothing(scatter):
    rng = np.random.default_rng(2)
    joint = scatter(start(), *births(rng, [True, True, False, False]))
    same = scatter(joint, *births(rng, [False] * 4))
    for a, b in zip(joint, same, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("square_root", [False, True])
def test_both_ways_give_the_same_numbers_and_gradients_in_a_batch(square_root):
    """In runs with other births, one of them without any; dead places hold NaN."""
    rng = np.random.default_rng(11)
    old = scatter(start(), *births(rng, [False, True, False, False]))
    old = old._replace(cov=jnp.linalg.cholesky(old.cov)) if square_root else old
    each = [births(rng, born) for born in np.array([[1, 0, 1, 1], [0, 0, 0, 0], [0, 0, 0, 1]]) > 0]
    slot, born, landmarks, by_pose, own, tag = map(np.stack, zip(*each, strict=True))
    weights = rng.normal(size=(3, *old.cov.shape))

    used = np.concatenate([np.ones(3, bool), np.repeat(old.alive, 2)])

    def result(way, cov, by_pose, own):
        cov = jnp.where(used[:, None] & used, cov, old.cov)  # padding is a constant

        def one(slot, born, landmarks, by_pose, own, tag):
            joint = old._replace(cov=cov)
            return way(joint, slot, born, landmarks, by_pose, own, tag, square_root=square_root)

        return jax.vmap(one)(slot, born, landmarks, by_pose, own, tag)

    def loss(way, *variables):
        return jnp.sum(weights * result(way, *variables).cov)

    finite = np.nan_to_num(by_pose), np.where(np.isnan(own), np.eye(2), own)
    ways = slots.scatter, as_of_a_large_map
    a, b = (jax.jit(result, static_argnums=0)(way, old.cov, by_pose, own) for way in ways)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-15)
    np.testing.assert_array_equal(b.cov[1], old.cov)
    slope = jax.jit(jax.grad(loss, argnums=(1, 2, 3)), static_argnums=0)
    for x, y in zip(*(slope(way, old.cov, *finite) for way in ways), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


def test_a_birth_in_a_large_map_is_written_in_place(full_optimization):
    """Within a loop over scans: beside a donated P the program holds less than another one."""

    def drive(joint, landmarks):
        def step(joint, landmark):
            slot, granted = slots.allocate(joint.alive, jnp.array([True, False]))
            by_pose, own = jnp.ones((2, 2, 3)), jnp.stack([jnp.eye(2)] * 2)
            part = slot, granted, landmark, by_pose, own, jnp.arange(2)
            return slots.scatter(joint, *part), None

        return jax.lax.scan(step, joint, landmarks)[0]

    large = slots.empty(jnp.zeros(3), jnp.eye(3), 200, 2)
    assert len(large.cov) > slots.CACHED
    program = jax.jit(drive, donate_argnums=0).lower(large, jnp.zeros((5, 2, 2))).compile()
    assert program.memory_analysis().temp_size_in_bytes < large.cov.nbytes / 4


@both_ways
def test_any_sequence_of_births_and_removals_equals_the_growing_map(scatter):
    rng = np.random.default_rng(3)
    joint = start()
    dense = Dense(joint)
    sizes = set()
    for _ in range(40):
        alive = np.asarray(joint.alive)
        if rng.random() < 0.5:
            wish = rng.random(3) < 0.7
            slot, granted = allocate(joint.alive, wish)
            born = np.zeros(CAPACITY, bool)
            born[np.asarray(slot)[np.asarray(granted)]] = True
            part = births(rng, born)
            part[5][born] += 1000 * (1 + rng.integers(1000))  # tags do not recur
            joint = scatter(joint, *part)
            for i in np.flatnonzero(born):
                dense.add(*(table[i] for table in part[2:]))
        else:
            dead = rng.random(CAPACITY) < 0.5  # dead slots among them
            tags = np.asarray(joint.tag)[dead & alive]
            joint = remove(joint, dead)
            for tag in tags:
                dense.drop(int(tag))
        assert_padding(joint)
        dense.assert_equals(joint)
        sizes.add(len(dense.tags))
    assert sizes == set(range(CAPACITY + 1))  # the walk met the empty map and the full one


def test_removal_leaves_the_marginal_of_the_rest_untouched_and_frees_the_slot():
    rng = np.random.default_rng(4)
    joint = scatter(start(), *births(rng, [True, True, True, False]))
    left = remove(joint, np.array([False, True, False, False]))
    keep = np.r_[0:5, 7:9]
    np.testing.assert_array_equal(left.cov[np.ix_(keep, keep)], joint.cov[np.ix_(keep, keep)])
    np.testing.assert_array_equal(left.landmarks[:3:2], joint.landmarks[:3:2])
    np.testing.assert_array_equal(left.tag[:3:2], joint.tag[:3:2])
    slot, granted = allocate(left.alive, np.array([True]))
    assert granted.all()
    assert int(slot[0]) == 1


def test_removing_a_dead_slot_is_the_identity():
    joint = scatter(start(), *births(np.random.default_rng(5), [True, False, True, False]))
    for dead in ([False] * 4, [False, True, False, True]):
        for a, b in zip(joint, remove(joint, np.array(dead)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_concerned_slots_are_those_that_a_place_names():
    slot, on = np.array([2, 0, -1, 2, 4]), np.array([True, False, False, True, True])
    found = jax.jit(slots.slot_mask, static_argnums=2)(slot, on, 6)
    np.testing.assert_array_equal(found, [False, False, True, False, True, False])
    assert not slots.slot_mask(slot[:0], on[:0], 6).any()


def test_allocate_grants_the_lowest_free_slots_in_order_until_the_map_is_full():
    rng = np.random.default_rng(6)
    for _ in range(200):
        alive, wanted = rng.random(CAPACITY) < 0.5, rng.random(5) < 0.6
        free, expected = list(np.flatnonzero(~alive)), []
        for wish in wanted:
            expected.append(free.pop(0) if wish and free else None)
        slot, granted = allocate(alive, wanted)
        np.testing.assert_array_equal(granted, [e is not None for e in expected])
        np.testing.assert_array_equal(slot, [0 if e is None else e for e in expected])


def test_find_answers_for_living_slots_alone():
    tag = np.array([7, -1, 9, 7], np.int32)
    alive = np.array([False, False, True, True])
    slot, found = find(tag, alive, np.array([7, 9, -1, 5]))
    np.testing.assert_array_equal(found, [True, True, False, False])
    np.testing.assert_array_equal(slot, [3, 2, 0, 0])


def test_gather_returns_a_landmark_and_its_rows():
    joint = scatter(start(), *births(np.random.default_rng(7), [True, False, True, False]))
    landmark, rows = gather(joint, 2)
    np.testing.assert_array_equal(landmark, joint.landmarks[2])
    np.testing.assert_array_equal(rows, joint.cov[7:9])


def test_a_mask_of_another_kind_or_shape_is_refused():
    joint = scatter(start(), *births(np.random.default_rng(5), [True, False, True, False]))
    with pytest.raises(ValueError, match="bool"):
        remove(joint, np.array([1, 0, 0, 0]))
    with pytest.raises(ValueError, match="shape"):
        remove(joint, np.array([True, False]))
