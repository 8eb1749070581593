"""Sequential corrections of a map and its last motion, which are composed at the end of the scan
(`Chart.motion_apart`)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.filters.ekf.coordinates.linear_system import Transition
from jaxslam.filters.ekf.coordinates.map_coordinates import retracted
from jaxslam.filters.ekf.coordinates.robocentric_motion import lever_by, lever_of_motion, out_of
from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.filters.ekf.steps.innovation import Correction, innovate, view_of
from jaxslam.filters.ekf.steps.predict import in_charts, moved_cov
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.math.xla import materialize, no_inline
from jaxslam.protocols import Chart
from jaxslam.slots import Joint, Last


class MapAndMotion(NamedTuple):
    """The map given its last motion, and that motion's error δ as a separate variable.

    The errors of the map are e = T x + g δ, with x those of `rest`. In the frame of the robot the
    motion is affine in the map, so x and δ are corrected by addition, in any order.
    """

    rest: Joint
    """pose and landmarks without the step; cov (D + 3, ·), of x and then δ, and columns of zeros"""
    frame: Float[Array, ""]
    """heading of the frame the motion began from"""
    step: Float[Array, "3"]
    """the correction of the motion"""


class Composition(NamedTuple):
    """The map with the corrected motion."""

    pose: Float[Array, "3"]
    moved: Transition
    """T"""
    lever: Float[Array, "D 3"]
    """g"""

    def times(self, rows: Float[Array, "E k"]) -> Float[Array, "D k"]:
        """The product of [T g] with rows, E = D + 3."""
        return self.moved.times(rows[:-3]) + linalg.matmul(self.lever, rows[-3:])


def separate_motion(joint: Joint, chart: Chart, columns: int) -> MapAndMotion:
    """The state x = e - g δ without the last motion: cov(x) = P - g C - (g C)ᵀ + g Q gᵀ.

    C = cov(δ, e) and Q = cov(δ).

    columns: of the P of (x, δ), D + 3 or more; what is beyond is zero.
    """
    last, lever = joint.last, lever_of_motion(joint, chart).T
    shared = linalg.matmul(last.own, lever)
    half = last.cov - 0.5 * shared
    change = linalg.gram_both(*materialize((lever, half)))
    cross = last.cov - shared
    beyond = [(0, 0), (0, columns - len(change) - 3)]
    top = jnp.concatenate([joint.cov - change, jnp.pad(cross.T, beyond)], axis=1)
    bottom = jnp.concatenate([cross, jnp.pad(last.own, beyond)], axis=1)
    rest = joint._replace(cov=jnp.concatenate([top, bottom]), last=None)
    return MapAndMotion(rest, last.frame, jnp.zeros_like(joint.pose))


def composition_of(state: MapAndMotion, chart: Chart) -> Composition:
    """The composition of the map with the corrected last motion."""
    assert chart.basis is not None
    rest, frame = state.rest, state.frame
    change = linalg.matmul(out_of(frame), state.step[:, None])[:, 0]
    pose = rest.pose + change
    pose = materialize(jnp.concatenate([pose[:2], wrap(pose[2:])]))
    over_map = jax.vmap(chart.basis, in_axes=(None, 0))
    before, after = over_map(rest.pose, rest.landmarks), over_map(pose, rest.landmarks)
    by_pose = with_lever_arm(jnp.eye(3, dtype=pose.dtype), change[:2])
    moved = in_charts(by_pose, before, after, rest.alive)
    return Composition(pose, moved, lever_by(moved, frame))


def compose_map(state: MapAndMotion, chart: Chart) -> tuple[Joint, Transition]:
    """The composed map, P = T cov(x) Tᵀ + g C Tᵀ + (g C Tᵀ)ᵀ + g Q gᵀ with C = cov(δ, x); and T."""
    found, rest = composition_of(state, chart), state.rest
    size = rest.cov.shape[0] - 3
    own, lever = rest.cov[size:, size : size + 3], found.lever.T
    cross = found.moved.times(rest.cov[size:, :size].T).T
    shared = linalg.matmul(own, lever)
    half = cross + 0.5 * shared
    cov = moved_cov(rest.cov[:size, :size], found.moved, None, (lever, half))
    last = Last(state.frame, cross + shared, own)
    return rest._replace(pose=found.pose, cov=cov, last=last), found.moved


def correct_map_and_motion(
    state: MapAndMotion,
    part: tuple[Float[Array, "g Z"], Int[Array, "g"], Bool[Array, "g"]],
    settings: EkfSettings,
) -> tuple[MapAndMotion, Correction]:
    """x and δ corrected by g measurements in turn: z (g, Z), slot (g,), known (g,).

    As in `correct_in_turn`: each measurement corrects the rows P_I of the robot, the group's
    landmarks and δ, and the whole P is read and written once.
    """
    rest, (_, slot, known) = state.rest, part
    size_l, size = rest.landmarks.shape[1], rest.cov.shape[0] - 3
    of_landmarks = 3 + slot[:, None] * size_l + jnp.arange(size_l)[None, :]
    at = jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1), size + jnp.arange(3)])
    rows = rest.cov[at]
    # The local map, with the matrix from the initial P_I to the current P_I appended to its P.
    local = rest._replace(
        landmarks=rest.landmarks[slot],
        cov=jnp.concatenate([rows[:, at], jnp.eye(len(at), dtype=rows.dtype)], axis=1),
        alive=rest.alive[slot],
        tag=rest.tag[slot],
    )

    def one(
        state: MapAndMotion, measurement: tuple[jax.Array, PyTree]
    ) -> tuple[MapAndMotion, tuple[jax.Array, jax.Array, Correction]]:
        return _correct_one(state, measurement, rest, settings)

    # A gradient stores the input of each step, and recomputes the rest.
    after, (reach, whitened, done) = jax.lax.scan(
        jax.checkpoint(one, prevent_cse=False),
        state._replace(rest=local),
        (jnp.arange(len(slot)), part),
    )
    v = no_inline(linalg.matmul, reach.reshape(-1, len(at)), rows)
    xi = linalg.gram(v, whitened.reshape(-1, 1))[:, 0]
    landmarks = retracted(settings.chart, rest, xi[:size])[1]
    rest = rest._replace(
        pose=after.rest.pose,
        landmarks=jnp.where(known.any(), landmarks, rest.landmarks),  # adding zero would round
        cov=rest.cov - linalg.gram(v[:, : size + 3], v),
    )
    return after._replace(rest=rest), done


def _correct_one(
    state: MapAndMotion,
    measurement: tuple[jax.Array, PyTree],
    whole: Joint,
    settings: EkfSettings,
) -> tuple[MapAndMotion, tuple[jax.Array, jax.Array, Correction]]:
    """A local x and δ corrected by a measurement of its landmark i (), of slot () in the map.

    It measures e of the robot and its landmark, E = [T g] of their rows of (x, δ). With P that of
    (x, δ) and V = L⁻¹ H E P: ξ = Vᵀ L⁻¹ ν and P ← P - Vᵀ V. Returns V in the columns appended to P
    (Z, ·), and L⁻¹ ν (Z,).
    """
    i, (z, slot, known) = jax.tree.map(lambda leaf: leaf[None], measurement)
    rest, chart = state.rest, settings.chart
    size_l, size = rest.landmarks.shape[1], rest.cov.shape[0] - 3
    at = jnp.concatenate(
        [jnp.arange(3), 3 + i[0] * size_l + jnp.arange(size_l), size + jnp.arange(3)]
    )
    local = rest._replace(
        landmarks=rest.landmarks[i],
        cov=rest.cov[at],
        alive=rest.alive[i],
        tag=rest.tag[i],
    )
    found = composition_of(state._replace(rest=local), chart)
    against = found.times(local.cov)
    among = found.times(against[:, at].T).T
    cov = jnp.concatenate([among, against], axis=1)
    here = local._replace(pose=found.pose, cov=cov)
    first = jnp.zeros_like(i)
    memory = whole._replace(pose=found.pose), slot
    said = innovate(here, first, view_of(here, first), z, known, memory, settings)
    v = said.v[:, len(among) : len(among) + size + 3]
    reach = said.v[:, len(among) + size + 3 :]
    xi = linalg.gram(v, said.whitened[:, None])[:, 0]
    pose, landmarks = retracted(chart, rest, xi[:size])
    pose = jnp.where(known[0], pose, rest.pose)  # a move by zero would round
    rest = rest._replace(
        pose=pose,
        landmarks=jnp.where(known[0], landmarks, rest.landmarks),
        cov=rest.cov - linalg.gram(v, said.v[:, len(among) :]),
    )
    frame = state.frame + (pose[2] - state.rest.pose[2])
    done = jax.tree.map(lambda leaf: leaf[0], _of_errors(said.correction, found.moved))
    return MapAndMotion(rest, frame, state.step + xi[size:]), (reach, said.whitened, done)


def _of_errors(done: Correction, moved: Transition) -> Correction:
    """The correction by one measurement of T x, with the coordinates by errors x."""
    assert done.basis is not None
    transition = moved.times(jnp.eye(done.basis.shape[2], dtype=done.basis.dtype))
    return done._replace(basis=done.basis @ transition)
