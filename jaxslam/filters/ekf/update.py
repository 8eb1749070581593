"""The correction of a Kalman-type SLAM filter on a `Joint`, by a scan at once or place by place.

With `predict`, they exploit that a motion touches the robot alone, and a measurement
the robot and one landmark: no dense D×D product is formed. They take the models as records, so one
set of equations serves every sensor, chart and linearizer. `filters.ekf_slam` binds them.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxslam.filters.ekf import robocentric_update
from jaxslam.filters.ekf.innovation import Correction, Weighed, view_of, weigh
from jaxslam.filters.ekf.observability import along, informed, split
from jaxslam.filters.ekf.robocentric_motion import lever_of_motion, moved_anew
from jaxslam.math import linalg
from jaxslam.math.xla import apart, settle, where_any
from jaxslam.protocols import Chart, Linearizer, Sensor
from jaxslam.slots import Joint

# Up to this many rows P stays in the cache next to a core: the pass over it is bound by arithmetic,
# vectors of this many entries at a time, and what is left of a row costs as much again.
_CACHED, _LANES = 128, 16

# Measurements that one pass over P corrects by, where it is cached and where it is not. More cost
# more loads of P_I, fewer more of P.
_GROUP, _GROUP_BEYOND = 3, 4


def correct(
    joint: Joint,
    z: jax.Array,
    slot: jax.Array,
    known: jax.Array,
    *,
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
    gate: float | None = None,
    iterations: int = 1,
    joseph: bool = False,
    square_root: bool = False,
) -> tuple[Joint, Correction]:
    """Correct by m measurements at once, z (m, Z) of the landmarks in slot (m,): Solà (26)-(30).

    With S = H P Hᵀ + R = L Lᵀ and V = L⁻¹ H P: x ← x ⊞ Vᵀ L⁻¹ ν and P ← P - Vᵀ V, symmetric as it
    stands. H is Z×(3+L) a measurement; where L = 0 (an absolute sensor) slot means nothing. Places
    not known (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above it, each against the prior) or with a
    singular S do nothing.

    Each further iteration linearizes at the newest estimate x_i = x ⊞ ξ_i but starts again from the
    prior: ξ_{i+1} = K (z - h(x_i) + H ξ_i) (Bell & Cathey 1993). joseph: P ← (I-KH)P(I-KH)ᵀ + KRKᵀ.

    square_root: of P = X Xᵀ, X ← X - Vᵀ (L + N)⁻¹ H X, R = N Nᵀ (Andrews 1968, "A square root
    formulation of the Kalman covariance equations", AIAA Journal 6(6)).
    """
    found = weigh(
        joint,
        slot,
        view_of(joint, slot, square_root),
        z,
        known,
        (joint, slot),
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        gate=gate,
        iterations=iterations,
        square_root=square_root,
    )
    m, size_z = z.shape
    v, factor, noise = found.v, found.factor, found.noise
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    each = found.fuse[:, None, None, None]
    if joseph:
        fused_noise = jnp.where(each, same * noise[:, :, None], 0.0)
        cov = _joseph(joint.cov, found.hp, found.s, fused_noise, factor, v)
    elif square_root:
        root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
        unit = jnp.eye(size_z, dtype=z.dtype)
        root = same * jnp.where(found.fuse[:, None, None], root, unit)[:, :, None]
        root = factor + root.reshape(m * size_z, m * size_z)
        hx = found.hx.reshape(m * size_z, -1)
        cov = joint.cov - linalg.gram(v, settle(linalg.solve_lower(root, hx)))
    else:
        cov = joint.cov - linalg.square(v)
    xi, last = found.xi, joint.last
    if last:
        seen_last = along(*found.slopes, *split(last.cov.T, joint.landmarks.shape[0]), slot)
        seen_last = linalg.solve_lower(factor, seen_last.reshape(m * size_z, 3))
        step = linalg.gram(seen_last, found.whitened[:, None])[:, 0]
        lever = lever_of_motion(joint, chart)
        xi = xi - lever @ step
        last = last._replace(
            cov=last.cov - linalg.gram(seen_last, v),
            own=last.own - linalg.gram(seen_last, seen_last),
        )
    moved = _moved(joint, found, xi, slot, chart)._replace(cov=cov, last=last)
    if last:
        moved = moved_anew(moved, moved.pose[2] - joint.pose[2], step, lever, chart)
    return moved, found.correction


def correct_in_turn(
    joint: Joint,
    z: jax.Array,
    slot: jax.Array,
    known: jax.Array,
    *,
    chart: Chart,
    joseph: bool = False,
    square_root: bool = False,
    **options: Any,
) -> tuple[Joint, Correction]:
    """Correct by m measurements one after the other, each linearized at what those before left.

    The same numbers as `correct` on each alone, with P read and written once a group of them: what
    a group sees of P are the rows P_I of the robot and of its landmarks. Each measurement corrects
    means and these rows, P_I ← P_I - V_Iᵀ V, and leaves V; at the end P ← P - Σ Vᵀ V over the
    group. This is the postponed update of Guivant & Nebot 2001 ("Optimization of the simultaneous
    localization and map-building algorithm for real-time implementation", IEEE T-RA 17(3)), over
    one scan. A group without a known measurement in any run of a batch costs nothing.

    In a chart that keeps the last motion apart, map and motion are corrected side by side, and
    composed once (`filters.parted`). Options are those of `correct`, which is used as it is, one
    measurement at a time, for forms of the update that need all of P.
    """
    whole = joseph or square_root
    m, size_l = z.shape[0], joint.landmarks.shape[1]
    size = joint.cov.shape[1]
    cached = size <= _CACHED
    group = 1 if whole else max(1, min(_GROUP if cached else _GROUP_BEYOND, m))
    groups = -(-m // group)

    def padded(part: jax.Array) -> jax.Array:
        wide = jnp.pad(part, [(0, groups * group - m), *[(0, 0)] * (part.ndim - 1)])
        return wide.reshape(groups, group, *part.shape[1:])

    def one_of_all(joint: Joint, part: Any) -> tuple[Joint, Correction]:
        return correct(joint, *part, chart=chart, joseph=joseph, square_root=square_root, **options)

    def in_group(joint: Joint, part: Any) -> tuple[Joint, Correction]:
        slot = part[1]
        of_landmarks = 3 + slot[:, None] * size_l + jnp.arange(size_l)[None, :]
        at = jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1)])
        rows = joint.cov[at]
        watch: Any = joint.watch
        if watch:
            watch = watch._replace(directions=watch.directions[at])
        # The local map, and beside its P the matrix that takes P_I of before to P_I of now.
        local = joint._replace(
            landmarks=joint.landmarks[slot],
            cov=jnp.concatenate([rows[:, at], jnp.eye(len(at), dtype=rows.dtype)], axis=1),
            alive=joint.alive[slot],
            tag=joint.tag[slot],
            watch=watch,
        )

        def one(local: Joint, place: Any) -> tuple[Joint, Any]:
            i, part = place
            i, (z, slot, known) = jax.tree.map(lambda leaf: leaf[None], (i, part))
            memory = joint._replace(pose=local.pose), slot
            found = weigh(local, i, view_of(local, i), z, known, memory, chart=chart, **options)
            v, reach = found.v[:, : len(at)], found.v[:, len(at) :]
            moved = _moved(local, found, found.xi[: len(at)], i, chart)
            moved = moved._replace(cov=local.cov - linalg.gram(v, found.v))
            done = jax.tree.map(lambda leaf: leaf[0], found.correction)
            return moved, (reach, found.whitened, done)

        # A gradient keeps what each begins with, and computes the rest of these few rows again.
        local, (reach, whitened, done) = jax.lax.scan(
            jax.checkpoint(one, prevent_cse=False),
            local,
            (jnp.arange(group), part),
        )
        v = apart(linalg.matmul, reach.reshape(-1, len(at)), rows)
        landmarks = _moved_map(joint, v[:, :size], whitened, chart)
        if watch:
            watch = local.watch._replace(directions=joint.watch.directions)
        cov = joint.cov - linalg.gram(v[:, :size], v)
        return joint._replace(pose=local.pose, landmarks=landmarks, cov=cov, watch=watch), done

    def in_groups(work: Any, state: Any) -> tuple[Any, Correction]:
        def of_group(state: Any, part: Any) -> tuple[Any, Correction]:
            nothing = _nothing(joint, part[0])
            some = part[2].any()
            after: tuple[Any, Correction] = where_any(
                some, lambda s: work(s, part), lambda s: (s, nothing), state
            )
            return after

        state, done = jax.lax.scan(of_group, state, jax.tree.map(padded, (z, slot, known)))
        shape = (groups * group,)
        return state, jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[2:])[:m], done)

    if whole:
        return in_groups(one_of_all, joint)
    if chart.motion_apart and joint.last:
        work = partial(
            robocentric_update.correct_group, chart=chart, retracted=retracted, **options
        )

        def with_motion(joint: Joint) -> tuple[Joint, Correction]:
            columns = size + 3 + (-(size + 3) % _LANES if cached else 0)
            rest, done = in_groups(work, robocentric_update.part(joint, chart, columns))
            # A run without a measurement must keep its map to the bit.
            after = robocentric_update.whole(rest, chart)
            kept: Joint = jax.tree.map(lambda a, b: jnp.where(known.any(), a, b), after, joint)
            return kept, done

        nothing = _nothing(joint, z)
        return where_any(known.any(), with_motion, lambda joint: (joint, nothing), joint)
    if cached:
        joint = joint._replace(cov=jnp.pad(joint.cov, ((0, 0), (0, -size % _LANES))))
    joint, done = in_groups(in_group, joint)
    return joint._replace(cov=joint.cov[:, :size]), done


def _nothing(joint: Joint, z: jax.Array) -> Correction:
    """The `Correction` of m measurements z (m, Z) that nothing is done with, all zero."""
    m, size = z.shape
    dtype = jnp.result_type(z, joint.pose, joint.cov)
    each, flags = jnp.zeros(m, dtype), jnp.zeros(m, bool)
    return Correction(
        innovation=jnp.zeros((m, size), dtype),
        innovation_cov=jnp.zeros((m, size, size), dtype),
        nis=each,
        log_likelihood=each,
        inside=flags,
        positive=flags,
    )


def _moved(joint: Joint, found: Weighed, xi: jax.Array, slot: jax.Array, chart: Chart) -> Joint:
    """The means moved by ξ (D,), and what the measurements tell a watch; P as it was."""
    pose, landmarks = retracted(chart, joint, xi)
    watch = joint.watch
    if watch:
        fused = found.fuse & found.correction.positive
        watch = informed(joint, chart, *found.seen, slot, found.own_noise, fused)
    return joint._replace(pose=pose, landmarks=landmarks, watch=watch)


def _moved_map(joint: Joint, v: jax.Array, whitened: jax.Array, chart: Chart) -> jax.Array:
    """The landmarks (N, L) after corrections V (g·Z, D), L⁻¹ ν (g, Z), one after the other."""
    if chart.basis is None:  # moves add up
        xi = linalg.gram(v, whitened.reshape(-1, 1))[:, 0]
        return retracted(chart, joint, xi)[1]

    def move(joint: Joint, one: tuple[jax.Array, jax.Array]) -> tuple[Joint, None]:
        xi = linalg.gram(one[0], one[1][:, None])[:, 0]
        pose, landmarks = retracted(chart, joint, xi)
        return joint._replace(pose=pose, landmarks=landmarks), None

    each = v.reshape(*whitened.shape, -1)
    return jax.lax.scan(move, joint, (each, whitened))[0].landmarks


def retracted(chart: Chart, joint: Joint, xi: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pose (3,) and landmarks (N, L) moved by errors ξ (D,)."""
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(joint.landmarks.shape)
    )
    return poses[0], jnp.where(joint.alive[:, None], landmarks, 0.0)


def _joseph(
    cov: jax.Array, hp: jax.Array, s: jax.Array, noise: jax.Array, factor: jax.Array, v: jax.Array
) -> jax.Array:
    """(I - KH) P (I - KH)ᵀ + K R Kᵀ from H P, in O(D²): the left factor first, then the right."""
    rows = hp.shape[0]
    gain = linalg.solve_lower(factor[::-1, ::-1].T, v[::-1])[::-1].T
    noise = noise.reshape(rows, rows)
    left = cov - gain @ hp
    left_h = hp.T - gain @ (s.reshape(rows, rows) - noise)
    return linalg.symmetrize(left - left_h @ gain.T + gain @ noise @ gain.T)
