"""Corrections one after the other of a map and its last motion, composed with each other at the end
of the scan (`Chart.motion_apart`)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import linalg
from jaxslam.angles import wrap
from jaxslam.filters.composition import lever_of_motion, out_of
from jaxslam.filters.propagation import Transition, in_charts, moved_cov
from jaxslam.filters.watching import informed
from jaxslam.filters.weighing import Correction, view_of, weigh
from jaxslam.linearize.first_order import turned
from jaxslam.protocols import Chart
from jaxslam.slots import Joint, Last
from jaxslam.staging import apart

Retract = Callable[[Chart, Joint, jax.Array], tuple[jax.Array, jax.Array]]


class Parted(NamedTuple):
    """The map as if its last motion were known, and that motion's error δ beside it.

    The errors of the map are e = T x + g δ, with x those of `rest`. To a map in the frame of the
    robot the motion is affine, so x and δ are corrected by adding to them, whatever the order.
    """

    rest: Joint
    """pose and landmarks without the step; cov (D + 3, ·), of x and then δ"""
    frame: jax.Array
    """() heading of the frame the motion began from"""
    step: jax.Array
    """(3,) by which the motion has been corrected"""


class Composition(NamedTuple):
    """The map with the corrected motion."""

    pose: jax.Array
    """(3,)"""
    moved: Transition
    """T"""
    lever: jax.Array
    """(D, 3) g"""

    def times(self, rows: jax.Array) -> jax.Array:
        """[T g] times rows (D + 3, k)."""
        return self.moved.times(rows[:-3]) + linalg.matmul(self.lever, rows[-3:])


def part(joint: Joint, chart: Chart) -> Parted:
    """x = e - g δ: cov(x) = P - g C - (g C)ᵀ + g Q gᵀ, C = cov(δ, e), Q = cov(δ)."""
    last, lever = joint.last, lever_of_motion(joint, chart).T
    shared = linalg.matmul(last.own, lever)
    half = last.cov - 0.5 * shared
    change = linalg.gram(jnp.concatenate([lever, half]), jnp.concatenate([half, lever]))
    cross = last.cov - shared
    top = jnp.concatenate([linalg.symmetrize(joint.cov - change), cross.T], axis=1)
    bottom = jnp.concatenate([cross, last.own], axis=1)
    rest = joint._replace(cov=jnp.concatenate([top, bottom]), last=())
    return Parted(rest, last.frame, jnp.zeros_like(joint.pose))


def compose(parted: Parted, chart: Chart) -> Composition:
    """The motion with its step, put behind the rest."""
    assert chart.basis is not None
    rest, frame = parted.rest, parted.frame
    change = out_of(frame) @ parted.step
    pose = rest.pose + change
    pose = jnp.concatenate([pose[:2], wrap(pose[2:])])
    over_map = jax.vmap(chart.basis, in_axes=(None, 0))
    before, after = over_map(rest.pose, rest.landmarks), over_map(pose, rest.landmarks)
    by_pose = turned(jnp.eye(3, dtype=pose.dtype), change[:2])
    last = Last(frame, rest.cov[-3:], rest.cov[-3:, -3:])
    lever = lever_of_motion(rest._replace(pose=pose, last=last), chart)
    return Composition(pose, in_charts(by_pose, before, after, rest.alive), lever)


def whole(parted: Parted, chart: Chart) -> Joint:
    """The map again: P = T cov(x) Tᵀ + g C Tᵀ + (g C Tᵀ)ᵀ + g Q gᵀ, C = cov(δ, x)."""
    found, rest = compose(parted, chart), parted.rest
    size = rest.cov.shape[0] - 3
    own, lever = rest.cov[size:, size:], found.lever.T
    cross = found.moved.times(rest.cov[size:, :size].T).T
    shared = linalg.matmul(own, lever)
    half = cross + 0.5 * shared
    change = linalg.gram(jnp.concatenate([lever, half]), jnp.concatenate([half, lever]))
    cov = moved_cov(rest.cov[:size, :size], found.moved, None) + change
    watch = rest.watch
    if watch:
        watch = watch._replace(directions=found.moved.times(watch.directions))
    last = Last(parted.frame, cross + shared, own)
    return rest._replace(pose=found.pose, cov=linalg.symmetrize(cov), watch=watch, last=last)


def correct_group(
    parted: Parted,
    places: tuple[jax.Array, jax.Array, jax.Array],
    *,
    chart: Chart,
    retracted: Retract,
    **options: Any,
) -> tuple[Parted, Correction]:
    """Correct by g measurements one after the other: z (g, Z), slot (g,), known (g,).

    As a group of `correction.correct_in_turn`: means and the rows of x_I and δ that the group sees
    are corrected by each, all of P once.
    """
    rest, slot = parted.rest, places[1]
    size_l, count = rest.landmarks.shape[1], rest.cov.shape[0]
    of_landmarks = 3 + slot[:, None] * size_l + jnp.arange(size_l)[None, :]
    at = jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1), count - 3 + jnp.arange(3)])
    rows, seen = rest.cov[at], len(at) - 3
    watch: Any = rest.watch
    if watch:
        watch = watch._replace(directions=watch.directions[at[:-3]])
    # The local rows of P, and beside them the matrix that takes those of before to those of now.
    local = rest._replace(
        landmarks=rest.landmarks[slot],
        cov=jnp.concatenate([rows[:, at], jnp.eye(len(at), dtype=rows.dtype)], axis=1),
        alive=rest.alive[slot],
        tag=rest.tag[slot],
        watch=watch,
    )

    def one(now: Parted, place: Any) -> tuple[Parted, Any]:
        i, (z, slot, known) = jax.tree.map(lambda leaf: leaf[None], place)
        local, found = now.rest, compose(now, chart)
        against = found.times(local.cov)
        among = found.times(against[:, : seen + 3].T)
        watch = local.watch
        if watch:
            watch = watch._replace(directions=found.moved.times(watch.directions))
        here = local._replace(
            pose=found.pose, cov=jnp.concatenate([among.T, against], axis=1), watch=watch
        )
        memory = rest._replace(pose=found.pose), slot
        said = weigh(here, i, view_of(here, i), z, known, memory, chart=chart, **options)
        v = said.v[:, seen:]
        xi = linalg.gram(v[:, : seen + 3], said.whitened[:, None])[:, 0]
        pose, landmarks = retracted(chart, local, xi[:seen])
        watch = local.watch
        if watch:
            fused = said.fuse & said.correction.positive
            told = informed(here, chart, *said.seen, i, said.own_noise, fused)
            watch = told._replace(directions=watch.directions)
        cov = local.cov - linalg.gram(v[:, : seen + 3], v)
        moved = local._replace(pose=pose, landmarks=landmarks, cov=cov, watch=watch)
        frame = now.frame + (pose[2] - local.pose[2])
        done = jax.tree.map(lambda leaf: leaf[0], said.correction)
        after = Parted(moved, frame, now.step + xi[seen:])
        return after, (v[:, seen + 3 :], said.whitened, done)

    each = jnp.arange(len(slot)), places
    after, (reach, whitened, done) = jax.lax.scan(
        one, parted._replace(rest=local), each, unroll=True
    )
    v = apart(linalg.matmul, reach.reshape(-1, len(at)), rows)
    xi = linalg.gram(v[:, : count - 3], whitened.reshape(-1, 1))[:, 0]
    pose, landmarks = retracted(chart, rest, xi)
    some = places[2].any()  # a move by zero would round
    watch = rest.watch
    if watch:
        watch = after.rest.watch._replace(directions=watch.directions)
    rest = rest._replace(
        pose=jnp.where(some, pose, rest.pose),
        landmarks=jnp.where(some, landmarks, rest.landmarks),
        cov=rest.cov - linalg.gram(v[:, :count], v),
        watch=watch,
    )
    frame = parted.frame + jnp.where(some, pose[2] - parted.rest.pose[2], 0.0)
    return Parted(rest, frame, after.step), done
