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
from jaxslam.staging import settle

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
    change = linalg.gram_both(*settle((lever, half)))
    cross = last.cov - shared
    top = jnp.concatenate([joint.cov - change, cross.T], axis=1)
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
    cov = moved_cov(rest.cov[:size, :size], found.moved, None, (lever, half))
    watch = rest.watch
    if watch:
        watch = watch._replace(directions=found.moved.times(watch.directions))
    last = Last(parted.frame, cross + shared, own)
    return rest._replace(pose=found.pose, cov=cov, watch=watch, last=last)


def correct_one(
    parted: Parted,
    place: tuple[jax.Array, jax.Array, jax.Array],
    *,
    chart: Chart,
    retracted: Retract,
    **options: Any,
) -> tuple[Parted, Correction]:
    """Correct x and δ by one measurement: z (1, Z), slot (1,), known (1,).

    It sees e of the robot and its landmark, E = [T g] of their rows of (x, δ). With P that of
    (x, δ) and V = L⁻¹ H E P: ξ = Vᵀ L⁻¹ ν and P ← P - Vᵀ V.
    """
    rest, (z, slot, known) = parted.rest, place
    size_l, size = rest.landmarks.shape[1], rest.cov.shape[0] - 3
    own = 3 + slot[0] * size_l + jnp.arange(size_l)
    at = jnp.concatenate([jnp.arange(3), own, size + jnp.arange(3)])
    watch: Any = rest.watch
    if watch:
        watch = watch._replace(directions=watch.directions[at[:-3]])
    local = rest._replace(
        landmarks=rest.landmarks[slot],
        cov=rest.cov[at],
        alive=rest.alive[slot],
        tag=rest.tag[slot],
        watch=watch,
    )
    found = compose(parted._replace(rest=local), chart)
    against = found.times(local.cov)
    among = found.times(against[:, at].T).T
    if watch:
        watch = watch._replace(directions=found.moved.times(watch.directions))
    cov = jnp.concatenate([among, against], axis=1)
    here = local._replace(pose=found.pose, cov=cov, watch=watch)
    first = jnp.zeros_like(slot)
    memory = rest._replace(pose=found.pose), slot
    said = weigh(here, first, view_of(here, first), z, known, memory, chart=chart, **options)
    v = said.v[:, len(among) :]
    xi = linalg.gram(v, said.whitened[:, None])[:, 0]
    pose, landmarks = retracted(chart, rest, xi[:size])
    pose = jnp.where(known[0], pose, rest.pose)  # a move by zero would round
    if watch:
        fused = said.fuse & said.correction.positive
        watch = informed(here, chart, *said.seen, first, said.own_noise, fused)
        watch = watch._replace(directions=rest.watch.directions)
    rest = rest._replace(
        pose=pose,
        landmarks=jnp.where(known[0], landmarks, rest.landmarks),
        cov=rest.cov - linalg.gram(v, v),
        watch=watch,
    )
    frame = parted.frame + (pose[2] - parted.rest.pose[2])
    return Parted(rest, frame, parted.step + xi[size:]), said.correction
