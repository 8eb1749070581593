"""The correction of a Kalman-type SLAM filter, by measurements at once or one after the other.

As in `predict`, the sparsity of the models is used (a motion involves the robot alone, a
measurement the robot and one landmark): no dense D×D product is formed. The models are records of
the settings, so one set of equations serves every sensor, chart and linearizer.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core.protocols import Chart
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.ekf_settings import Covariance, EkfSettings
from jaxslam.filters._ekf.innovation import Correction, Innovation, innovate, view_of
from jaxslam.filters._ekf.map_coordinates import retracted
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import CACHED, materialize, no_inline, where_any


def correct(
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    known: Bool[Array, "m"],
    settings: EkfSettings,
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements z (m, Z) of landmarks in slot (m,): Solà (26)-(30).

    With S = H P Hᵀ + R(ẑ) = L Lᵀ and V = L⁻¹ H P: x ← x ⊞ Vᵀ L⁻¹ ν and P ← P - Vᵀ V, symmetric as
    it stands. H is Z×(3+L) a measurement; where L = 0 (an absolute sensor) slot is not used.
    Measurements not known (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above it, each against the prior)
    or with a singular S have no effect.

    Each further iteration linearizes at the newest estimate x_i = x ⊞ ξ_i but starts again from the
    prior: ξ_{i+1} = K (z - h(x_i) + H ξ_i) (Bell & Cathey 1993).

    Other forms of the covariance: "joseph", P ← (I-KH)P(I-KH)ᵀ + KRKᵀ; "square_root", of P = X Xᵀ,
    X ← X - Vᵀ (L + N)⁻¹ H X, R = N Nᵀ (Andrews 1968, "A square root formulation of the Kalman
    covariance equations", AIAA Journal 6(6)).
    """
    view = view_of(joint, slot, settings.square_root)
    found = innovate(joint, slot, view, z, known, (joint, slot), settings)
    cov = _corrected_cov(joint.cov, found, settings.covariance)
    return _retract_means(joint, found.xi, settings.chart)._replace(cov=cov), found.correction


def _corrected_cov(
    cov: Float[Array, "D D"], found: Innovation, form: Covariance
) -> Float[Array, "D D"]:
    """The covariance P, or its root X, after the correction."""
    v, factor, noise = found.v, found.factor, found.noise
    m, size_z = noise.shape[:2]
    if form == "plain":
        return cov - linalg.self_gram(v)
    same = jnp.eye(m, dtype=noise.dtype)[:, None, :, None]
    if form == "joseph":
        each = found.fuse[:, None, None, None]
        fused_noise = jnp.where(each, same * noise[:, :, None], 0.0)
        return _joseph(cov, found.hp, found.s, fused_noise, factor, v)
    root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
    unit = jnp.eye(size_z, dtype=noise.dtype)
    root = same * jnp.where(found.fuse[:, None, None], root, unit)[:, :, None]
    root = factor + root.reshape(m * size_z, m * size_z)
    hx = found.hx.reshape(m * size_z, -1)
    return cov - linalg.gram(v, materialize(linalg.solve_lower(root, hx)))


def _retract_means(joint: Joint, xi: Float[Array, "D"], chart: Chart) -> Joint:
    """The means retracted by ξ; P is not changed."""
    pose, landmarks = retracted(chart, joint, xi)
    return joint._replace(pose=pose, landmarks=landmarks)


def _joseph(
    cov: Float[Array, "D D"],
    hp: Float[Array, "K D"],
    s: Float[Array, "m Z m Z"],
    noise: Float[Array, "m Z m Z"],
    factor: Float[Array, "K K"],
    v: Float[Array, "K D"],
) -> Float[Array, "D D"]:
    """Joseph's form (I - KH) P (I - KH)ᵀ + K R Kᵀ from H P, in O(D²): left factor, then right."""
    rows = hp.shape[0]
    gain = linalg.solve_lower(factor[::-1, ::-1].T, v[::-1])[::-1].T
    noise = noise.reshape(rows, rows)
    left = cov - gain @ hp
    left_h = hp.T - gain @ (s.reshape(rows, rows) - noise)
    return linalg.symmetrize(left - left_h @ gain.T + gain @ noise @ gain.T)


# A pass over a P in the cache is bound by arithmetic, on vectors of this many entries, and the rest
# of a row costs as much as a whole vector.
_LANES = 16

# Measurements a pass over P, where P is cached and where it is not. More of them cost more loads of
# P_I, fewer cost more loads of P.
_GROUP, _GROUP_BEYOND = 3, 4

_State = TypeVar("_State")

Measurements = tuple[Float[Array, "m Z"], Int[Array, "m"], Bool[Array, "m"]]
"""z, the slot of the landmark of each, and whether it is known"""


def correct_in_turn(
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    known: Bool[Array, "m"],
    settings: EkfSettings,
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements in turn, each linearized at the estimate before it.

    The same numbers as `correct` on each alone, with P read and written once a group of them:

        for each group (g measurements, W = 3 + g·L):
            P_I (W, D)  <-  rows of the robot and of the group's landmarks, of P (D, D)
            for each measurement: means and P_I corrected, P_I ← P_I - V_Iᵀ V; V (Z, D) is left
            P (D, D)    <-  P - Σ Vᵀ V over the group

    This is the postponed update of Guivant & Nebot 2001 ("Optimization of the simultaneous
    localization and map-building algorithm for real-time implementation", IEEE T-RA 17(3)), over
    one scan. A group without a known measurement in any run of a batch costs nothing.

    A form of the covariance that needs all of P is corrected by `correct`, one measurement at a
    time.
    """
    measurements = z, slot, known
    size = joint.cov.shape[1]
    if settings.covariance != "plain":
        return _one_by_one(joint, measurements, settings)
    cached = size <= CACHED
    group = max(1, min(_GROUP if cached else _GROUP_BEYOND, z.shape[0]))
    if cached:
        joint = joint._replace(cov=jnp.pad(joint.cov, ((0, 0), (0, -size % _LANES))))
    joint, corrections = _in_groups(
        lambda joint, part: _correct_group(joint, part, settings),
        joint,
        measurements,
        group,
        partial(_nothing, joint, chart=settings.chart),
    )
    return joint._replace(cov=joint.cov[:, :size]), corrections


def _one_by_one(
    joint: Joint, measurements: Measurements, settings: EkfSettings
) -> tuple[Joint, Correction]:
    """`correct_in_turn` by `correct` of one measurement at a time."""

    def work(joint: Joint, one: Measurements) -> tuple[Joint, Correction]:
        return correct(joint, *one, settings)

    nothing = partial(_nothing, joint, chart=settings.chart)
    return _in_groups(work, joint, measurements, 1, nothing)


def _in_groups(
    work: Callable[[_State, Measurements], tuple[_State, Correction]],
    state: _State,
    measurements: Measurements,
    group: int,
    nothing: Callable[[Measurements], Correction],
) -> tuple[_State, Correction]:
    """The state after work(state, g measurements) on each group of m, padded: (⌈m/g⌉, g, …).

    nothing: of unused measurements, the `Correction`.
    """
    m = len(measurements[0])
    groups = -(-m // group)

    def padded(part: jax.Array) -> jax.Array:
        wide = jnp.pad(part, [(0, groups * group - m), *[(0, 0)] * (part.ndim - 1)])
        return wide.reshape(groups, group, *part.shape[1:])

    def of_group(state: _State, part: Measurements) -> tuple[_State, Correction]:
        unused = nothing(part)
        return where_any(part[2].any(), lambda s: work(s, part), lambda s: (s, unused), state)

    state, corrections = jax.lax.scan(of_group, state, jax.tree.map(padded, measurements))
    shape = (groups * group,)
    return state, jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[2:])[:m], corrections)


def _correct_group(
    joint: Joint, part: Measurements, settings: EkfSettings
) -> tuple[Joint, Correction]:
    """The joint corrected by g measurements in turn: local states by each, then P by all at once.

        local P (W, W) | M (W, W)    P_I of now = M P_I of before, W = 3 + g·L
        V (g·Z, D) = reach (g·Z, W) P_I of before

    P may have columns of zeros beyond its own.
    """
    slot, chart = part[1], settings.chart
    size_l, size = joint.landmarks.shape[1], joint.cov.shape[0]
    of_landmarks = 3 + slot[:, None] * size_l + jnp.arange(size_l, dtype=slot.dtype)[None, :]
    at = jnp.concatenate([jnp.arange(3), of_landmarks.reshape(-1)])
    rows = joint.cov[at]
    local = joint._replace(
        landmarks=joint.landmarks[slot],
        cov=jnp.concatenate([rows[:, at], jnp.eye(len(at), dtype=rows.dtype)], axis=1),
        alive=joint.alive[slot],
        tag=joint.tag[slot],
    )

    def one(local: Joint, measurement: tuple[jax.Array, PyTree]) -> tuple[Joint, PyTree]:
        return _correct_local(local, measurement, joint, settings)

    # A gradient stores the input of each step, and recomputes the rest.
    local, (reach, whitened, corrections) = jax.lax.scan(
        jax.checkpoint(one, prevent_cse=False),
        local,
        (jnp.arange(len(slot)), part),
    )
    v = no_inline(linalg.matmul, reach.reshape(-1, len(at)), rows)
    landmarks = _moved_map(joint, v[:, :size], whitened, chart)
    cov = joint.cov - linalg.gram(v[:, :size], v)
    return joint._replace(pose=local.pose, landmarks=landmarks, cov=cov), corrections


def _correct_local(
    local: Joint, measurement: tuple[jax.Array, PyTree], whole: Joint, settings: EkfSettings
) -> tuple[Joint, tuple[jax.Array, jax.Array, Correction]]:
    """A local map corrected by a measurement of its landmark i (), of slot () in the whole map.

    P of the local map and the matrix M beside it are corrected as one:
    [P M] ← [P M] - Vᵀ [V reach].
    Returns reach (Z, W), and L⁻¹ ν (Z,).
    """
    i, (z, slot, known) = jax.tree.map(lambda leaf: leaf[None], measurement)
    width = local.cov.shape[0]
    memory = whole._replace(pose=local.pose), slot
    found = innovate(local, i, view_of(local, i), z, known, memory, settings)
    v, reach = found.v[:, :width], found.v[:, width:]
    moved = _retract_means(local, found.xi[:width], settings.chart)
    moved = moved._replace(cov=local.cov - linalg.gram(v, found.v))
    correction = jax.tree.map(lambda leaf: leaf[0], found.correction)
    return moved, (reach, found.whitened, correction)


def _nothing(joint: Joint, unused: Measurements, chart: Chart) -> Correction:
    """The `Correction` of m unused measurements, all zero; the map is unchanged."""
    z = unused[0]
    (m, size), width = z.shape, 3 + joint.landmarks.shape[1]
    dtype = jnp.result_type(z, joint.pose, joint.cov)
    each, flags = jnp.zeros(m, dtype), jnp.zeros(m, bool)
    return Correction(
        z_hat=jnp.zeros((m, size), dtype),
        innovation=jnp.zeros((m, size), dtype),
        innovation_cov=jnp.zeros((m, size, size), dtype),
        nis=each,
        log_likelihood=each,
        inside=flags,
        positive=flags,
        jacobian=jnp.zeros((m, size, width), dtype),
        basis=None if chart.basis is None else jnp.zeros((m, width, width), dtype),
    )


def _moved_map(
    joint: Joint, v: Float[Array, "K D"], whitened: Float[Array, "g Z"], chart: Chart
) -> Float[Array, "N L"]:
    """The landmarks after corrections V (g·Z, D), L⁻¹ ν, one after the other."""
    if chart.basis is None:  # retractions are additive
        xi = linalg.gram(v, whitened.reshape(-1, 1))[:, 0]
        return retracted(chart, joint, xi)[1]

    def move(joint: Joint, one: tuple[jax.Array, jax.Array]) -> tuple[Joint, None]:
        return _retract_means(joint, linalg.gram(one[0], one[1][:, None])[:, 0], chart), None

    each = v.reshape(*whitened.shape, -1)
    return jax.lax.scan(move, joint, (each, whitened))[0].landmarks
