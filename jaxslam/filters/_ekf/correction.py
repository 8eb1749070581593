"""The correction of EKF-SLAM, Solà (26)-(30): by m measurements at once, or one after the other.

    ν = z ⊖ h(R, l)    S = H P Hᵀ + R(ẑ) = L Lᵀ    V = L⁻¹ H P    x ← x ⊞ Vᵀ L⁻¹ ν    P ← P - Vᵀ V

With the gain K = P Hᵀ S⁻¹ = Vᵀ L⁻¹ this is x ← x ⊞ K ν and P ← P - K S Kᵀ, symmetric as it stands.
`correct` does this for a whole scan, `correct_in_turn` for each measurement at the estimate that
those before it left. Both compute ν, S and the gate in `_innovate`, and use the sparsity of H,
which involves the robot and one landmark (`whitening`).

Letters: m measurements, Z numbers in one of them, L in a landmark, R in the robot (3, or 3 + E),
D = R + N·L of the state.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core import slots
from jaxslam.core._numbers import gate_quantile
from jaxslam.core.protocols import Chart, LinearizationPoint, Linearizer, Sensor
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.linear_system import basis_of_each, chart_jacobians
from jaxslam.filters._ekf.map_coordinates import at_slot, retract_map
from jaxslam.filters._ekf.whitening import factor_of, project, projected_cov, whiten, whiten_by
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import is_inside, log_density
from jaxslam.math._xla import CACHED, materialize, no_inline, where_any

CorrectionOrder = Literal["sequential", "joint"]

Covariance = Literal["plain", "joseph", "square_root"]
"""P ← P - Vᵀ V; Joseph's (I-KH) P (I-KH)ᵀ + K R Kᵀ; or the update of a root X of P = X Xᵀ"""


class KalmanFilter(Protocol):
    """The fields of `EkfSlam` that a correction uses."""

    @property
    def robot_chart(self) -> Chart: ...
    @property
    def linearize(self) -> Linearizer: ...
    @property
    def gate(self) -> Number | None: ...
    @property
    def iterations(self) -> int: ...
    @property
    def covariance(self) -> Covariance: ...


class Correction(NamedTuple):
    """The reported results of a correction by m measurements; finite for all of them.

    All but NIS and log-likelihood are against the prior.
    """

    z_hat: Float[Array, "m Z"]
    """the predicted measurement ẑ"""
    innovation: Float[Array, "m Z"]
    innovation_cov: Float[Array, "m Z Z"]
    """S_ii of each measurement alone"""
    nis: Float[Array, "m"]
    log_likelihood: Float[Array, "m"]
    inside: Bool[Array, "m"]
    """passed the gate"""
    positive: Bool[Array, "m"]
    """S is positive definite, alone and with the other measurements"""
    jacobian: Float[Array, "m Z R+L"]
    """H by coordinates"""
    basis: Float[Array, "m R+L R+L"] | None
    """the coordinates by the errors in the chart; None is the identity"""


def report_fused(
    prior: Correction,
    fuse: Bool[Array, "m"],
    whitened: Float[Array, "K"],
    log_det: Float[Array, "m"],
    regular: Bool[Array, "m"],
) -> Correction:
    """The `Correction` with NIS and log-likelihood of the fused measurements by their joint S.

    Args:
        prior: the correction of each measurement alone, whose nis is d² = νᵀ S_ii⁻¹ ν.
        fuse: mask of the measurements that are matched, inside the gate and positive alone.
        whitened, log_det, regular: L⁻¹ ν of S = L Lᵀ of the fused measurements; log |S_ii| of each
            given those before it; and whether its pivots of L are positive.
    """
    m, size_z = prior.innovation.shape
    nis = (whitened.reshape(m, size_z) ** 2).sum(axis=1)
    positive = prior.positive & regular
    density = log_density(nis, log_det, size_z)
    return prior._replace(
        nis=jnp.where(fuse, nis, prior.nis),
        log_likelihood=jnp.where(fuse & positive, density, 0.0),
        positive=positive,
    )


def correct(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements z (m, Z) of the landmarks in slot (m,) at once.

    Measurements that are not matched (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above it, each against
    the prior) or with a singular S have no effect. Where L = 0 (an absolute sensor) slot is not
    used.

    Each further iteration linearizes at the newest estimate x_i = x ⊞ ξ_i but starts again from the
    prior: ξ_{i+1} = K (z - h(x_i) + H ξ_i) (Bell & Cathey 1993).
    """
    gamma = gate_quantile(filter.gate, len(sensor.measurements))
    return _correct(filter, sensor, joint, z, slot, matched, gamma)


def _correct(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
    gamma: Number | None,
) -> tuple[Joint, Correction]:
    """The joint corrected at once. gamma: the largest d² that passes the gate, None without one."""
    innovation = _innovate(filter, sensor, joint, slot, z, matched, (joint, slot), gamma)
    cov = _correct_cov(joint.cov, innovation, filter.covariance)
    joint = retract_map(filter.robot_chart, joint, innovation.xi)
    return joint._replace(cov=cov), innovation.correction


class _Innovation(NamedTuple):
    """The whitened innovations of m measurements, for all forms of the covariance."""

    xi: Float[Array, "D"]
    """the correction ξ = Vᵀ L⁻¹ ν in the chart"""
    v: Float[Array, "m*Z D"]
    """V = L⁻¹ H P"""
    whitened: Float[Array, "m*Z"]
    """L⁻¹ ν"""
    factor: Float[Array, "m*Z m*Z"]
    """L, with rows of zeros for measurements that are not fused"""
    s: Float[Array, "m Z m Z"]
    """S, the identity where not fused"""
    hp: Float[Array, "m*Z D"]
    """H P"""
    hx: Float[Array, "m Z D"]
    """H X of a square-root filter, else H P"""
    noise: Float[Array, "m Z Z"]
    """R(ẑ), and the covariance that the linearizer adds to it"""
    fuse: Bool[Array, "m"]
    """matched, inside the gate, and with a positive definite S_ii"""
    correction: Correction


def _innovate(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    slot: Int[Array, "m"],
    z: Float[Array, "m Z"],
    matched: Bool[Array, "m"],
    memory: tuple[Joint, Int[Array, "m"]],
    gamma: Number | None,
) -> _Innovation:
    """The innovation of m measurements at once, from the rows of P that H meets: Solà (26)-(28).

        rows of P            H                       H P          S = H P Hᵀ + R
        robot (R, D)         by pose (m, Z, R)       (m·Z, D)     (m, Z, m, Z) = L Lᵀ
        landmark (m, L, D)   by landmark (m, Z, L)   V = L⁻¹ H P  ξ = Vᵀ L⁻¹ ν (D,)

    Gate, reported numbers and R(ẑ) are those of the first iteration: a later ẑ has moved towards z,
    so R there would depend on the noise of z (`predicted_noise` says why it must not).

    memory: the state with the linearizer's memory, and the landmarks' slots (m,) there. It is
    (joint, slot), unless joint is the local map of a group (`_correct_group`), whose slots differ.
    P may have further columns, of other errors.
    """
    square_root = filter.covariance == "square_root"
    landmark_rows = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)[1]
    # P (m, R+L, R+L) of the robot and the landmark of each measurement.
    local_cov = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)
    (m, size_z), n = z.shape, joint.robot_size
    diagonal = jnp.eye(m, dtype=z.dtype)[:, None, :, None]  # (m, 1, m, 1): times R, diagonal blocks
    xi: jax.Array | None = None
    for i in range(filter.iterations):
        # (26), with H of (25) by the pose and one landmark.
        h_nu, z_hat, added_noise, jacobian = _linearize(
            filter, sensor, joint, slot, local_cov, z, memory, xi
        )
        by_pose, by_landmark, nu = h_nu[:, :, :n], h_nu[:, :, n:-1], h_nu[:, :, -1]
        if i == 0:
            noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, z, matched)
            noise = noise + added_noise
        # (m·Z) D entries, each of which P - Vᵀ V needs D times.
        hp = hx = no_inline(project, h_nu, joint.cov[:n], landmark_rows)
        if square_root:
            # Of a root X only H X is at hand: H P = (H X) Xᵀ, O(D²) a row.
            hp = materialize((hx.reshape(m * size_z, -1) @ joint.cov.T).reshape(hx.shape))
        # (27): H P Hᵀ + R for all pairs of measurements.
        s = projected_cov(hp, by_pose, by_landmark, slot, joint.landmarks.shape[0])
        s = s + diagonal * noise[:, :, None]
        # (m, Z, Z): index arrays on both sides of a slice put their axis first.
        s_ii = s[jnp.arange(m), :, jnp.arange(m)]
        # Stored: each of the D columns of L⁻¹ H P needs it.
        inverse, definite = no_inline(jax.vmap(linalg.whitener), s_ii)
        if i == 0:
            # Gated against the prior, so that a later pass cannot change which are fused.
            distance = (whiten_by(inverse, nu[:, :, None]) ** 2).sum(axis=(1, 2))
            prior = Correction(
                z_hat=z_hat,
                innovation=nu,
                innovation_cov=s_ii,
                nis=distance,
                log_likelihood=jnp.zeros_like(distance),
                inside=is_inside(distance, gamma),
                positive=definite,
                jacobian=jnp.concatenate(jacobian, axis=2),
                basis=basis_of_each(filter.robot_chart, joint.robot, joint.landmarks[slot]),
            )
            fuse = matched & prior.inside & definite
        hp = hp.reshape(m * size_z, -1)
        factored = factor_of(s, inverse, definite, fuse)
        # (28), (29): K ν = Vᵀ L⁻¹ ν; K itself is never formed.
        v, whitened = whiten(factored, fuse, hp, nu)
        xi = linalg.gram(v, whitened[:, None])[:, 0]
        if i == 0:
            correction = report_fused(prior, fuse, whitened, factored.log_det, factored.regular)
    assert xi is not None
    return _Innovation(
        xi=xi,
        v=v,
        whitened=whitened,
        factor=factored.factor,
        s=factored.s,
        hp=hp,
        hx=hx,
        noise=noise,
        fuse=fuse,
        correction=correction,
    )


def _linearize(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    slot: Int[Array, "m"],
    local_cov: Float[Array, "m W W"],
    z: Float[Array, "m Z"],
    memory: tuple[Joint, Int[Array, "m"]],
    xi: Float[Array, "D"] | None,
) -> tuple[
    Float[Array, "m Z C"],
    Float[Array, "m Z"],
    Float[Array, "m Z Z"],
    tuple[Float[Array, "m Z R"], Float[Array, "m Z L"]],
]:
    """The linearization z ≈ ẑ + H (ξ - ξ_i) at x ⊞ ξ_i; xi = None: at the prior x.

    Returns H by the errors with ν = z - ẑ + H ξ_i beside it, so that the solution is ξ, relative to
    the prior; ẑ; the covariance that the linearizer adds to R; and H by the coordinates of pose and
    landmark.
    """
    state, slot_in_state = memory
    chart, prior_landmark = filter.robot_chart, joint.landmarks[slot]
    pose, landmark, errors = joint.robot, prior_landmark, None
    if xi is not None:
        (capacity, size_l), n = joint.landmarks.shape, joint.robot_size
        # ξ_i of the robot, and of the landmark of each measurement.
        errors = xi[:n], xi[n : n + capacity * size_l].reshape(capacity, size_l)[slot]
        over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
        poses, landmark = over_landmarks(joint.robot, prior_landmark, *errors)
        pose = poses[0]  # the same for all landmarks

    def observe(
        at: Int[Array, ""], landmark: Float[Array, "L"], cov: Float[Array, "K K"]
    ) -> PyTree:
        point = LinearizationPoint(state, chart, pose, cov, at, landmark)
        return filter.linearize.observe(at_slot(sensor, state, at), point)

    z_hat, by_pose, by_landmark, added_noise = jax.vmap(observe)(slot_in_state, landmark, local_cov)
    # z ⊖ ẑ, with angles wrapped: the sensor's own difference.
    nu = jax.vmap(sensor.residual)(z, z_hat)
    jacobian = by_pose, by_landmark
    # The monitor takes H by coordinates; P is of errors in the chart, so the gain needs H by these.
    if chart.basis is not None:
        by_pose, by_landmark = chart_jacobians(
            chart, joint.robot, prior_landmark, by_pose, by_landmark, errors
        )
    if errors is not None:
        # Back to the prior: z - h(x_i) + H ξ_i.
        nu = nu + jnp.einsum("mzi,i->mz", by_pose, errors[0])
        nu = nu + jnp.einsum("mzi,mi->mz", by_landmark, errors[1])
    # One array, and so one kernel and not three.
    h_nu = materialize(jnp.concatenate([by_pose, by_landmark, nu[:, :, None]], axis=2))
    return h_nu, z_hat, added_noise, jacobian


def _correct_cov(
    cov: Float[Array, "D D"], innovation: _Innovation, form: Covariance
) -> Float[Array, "D D"]:
    """The covariance P, or its root X, after the correction.

    "plain": P - Vᵀ V. "joseph": (I-KH) P (I-KH)ᵀ + K R Kᵀ. "square_root", of P = X Xᵀ and
    R = N Nᵀ: X - Vᵀ (L + N)⁻¹ H X (Andrews 1968, "A square root formulation of the Kalman
    covariance equations", AIAA Journal 6(6)).
    """
    v, factor, noise, fuse = innovation.v, innovation.factor, innovation.noise, innovation.fuse
    if form == "plain":
        # (30), as K S Kᵀ = Vᵀ V: symmetric as it stands.
        return cov - linalg.self_gram(v)
    m, size_z = noise.shape[:2]
    rows = m * size_z
    diagonal = jnp.eye(m, dtype=noise.dtype)[:, None, :, None]  # (m, 1, m, 1): diagonal blocks
    if form == "joseph":
        # O(m·Z·D²): (I - KH) P first, then its product with (I - KH)ᵀ. No D×D matrices are
        # multiplied.
        fused_noise = jnp.where(fuse[:, None, None, None], diagonal * noise[:, :, None], 0.0)
        # K = P Hᵀ S⁻¹ = Vᵀ L⁻¹, so Lᵀ Kᵀ = V: backward substitution, by the flipped system.
        gain = linalg.solve_lower(factor[::-1, ::-1].T, v[::-1])[::-1].T
        noise = fused_noise.reshape(rows, rows)
        one_sided = cov - gain @ innovation.hp  # (I - KH) P
        # (I - KH) P Hᵀ, with H P Hᵀ = S - R. Where not fused, S is the identity, but K is zero.
        one_sided_h = innovation.hp.T - gain @ (innovation.s.reshape(rows, rows) - noise)
        return linalg.symmetrize(one_sided - one_sided_h @ gain.T + gain @ noise @ gain.T)
    noise_root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
    unit = jnp.eye(size_z, dtype=noise.dtype)
    # (m, Z, m, Z); a unit pivot where not fused, so that L + N is regular. V is zero there.
    noise_root = diagonal * jnp.where(fuse[:, None, None], noise_root, unit)[:, :, None]
    factor_sum = factor + noise_root.reshape(rows, rows)  # L + N
    hx = innovation.hx.reshape(rows, -1)
    return cov - linalg.gram(v, materialize(linalg.solve_lower(factor_sum, hx)))


_LANES = 16
"""Entries of a vector register, 512 bits of float32. A pass over a P in the cache is bound by
arithmetic, and the rest of a row that fills no vector costs as much as a whole one."""

_GROUP_CACHED, _GROUP_UNCACHED = 3, 4
"""Measurements a pass over P, where P is cached and where it is not: the fastest by measurement.
More of them cost more loads of P_I, fewer cost more loads of P."""

_State = TypeVar("_State")

Measurements = tuple[Float[Array, "m Z"], Int[Array, "m"], Bool[Array, "m"]]
"""z, the slot of the landmark of each, and whether it is matched"""


def correct_in_turn(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements in turn, each linearized at the estimate before it.

    The same numbers as `correct` on each alone, with P read and written once a group of them:

        for each group (g measurements, W = R + g·L):
            P_I (W, D)  <-  rows of the robot and of the group's landmarks, of P (D, D)
            for each measurement: means and P_I corrected, P_I ← P_I - V_Iᵀ V; V (Z, D) is left
            P (D, D)    <-  P - Σ Vᵀ V over the group

    This is the postponed update of Guivant & Nebot 2001 ("Optimization of the simultaneous
    localization and map-building algorithm for real-time implementation", IEEE T-RA 17(3)), over
    one scan. A group without a matched measurement in any run of a batch costs nothing.

    A form of the covariance that needs all of P is corrected by `correct`, one measurement at a
    time.
    """
    gamma = gate_quantile(filter.gate, len(sensor.measurements))
    measurements = z, slot, matched
    unmatched = partial(no_correction, joint, chart=filter.robot_chart)
    if filter.covariance != "plain":

        def correct_one(joint: Joint, measurement: Measurements) -> tuple[Joint, Correction]:
            return _correct(filter, sensor, joint, *measurement, gamma)

        return in_groups(correct_one, joint, measurements, 1, unmatched)

    size = joint.cov.shape[1]
    cached = size <= CACHED
    group_size = max(1, min(_GROUP_CACHED if cached else _GROUP_UNCACHED, z.shape[0]))
    if cached:
        # Padded once for the whole scan; columns of zeros stay zero.
        joint = joint._replace(cov=jnp.pad(joint.cov, ((0, 0), (0, -size % _LANES))))
    # A partial, as a function here would be one more frame of the tracebacks in a user's model.
    correct_group = partial(_correct_group, filter, sensor, gamma=gamma)
    joint, corrections = in_groups(correct_group, joint, measurements, group_size, unmatched)
    return joint._replace(cov=joint.cov[:, :size]), corrections


def in_groups(
    work: Callable[[_State, Measurements], tuple[_State, Correction]],
    state: _State,
    measurements: Measurements,
    group_size: int,
    unmatched: Callable[[Measurements], Correction],
) -> tuple[_State, Correction]:
    """The state after work(state, g measurements) on each group of m, and the m corrections.

    unmatched: the `Correction` of a group without a match, in which the state does not change.
    """
    m = len(measurements[0])
    groups = -(-m // group_size)  # ⌈m/g⌉

    def pad(values: jax.Array) -> jax.Array:
        """The values in groups, (⌈m/g⌉, g, …), with zeros (not matched) at the end."""
        full = jnp.pad(values, [(0, groups * group_size - m), *[(0, 0)] * (values.ndim - 1)])
        return full.reshape(groups, group_size, *values.shape[1:])

    def step(state: _State, group: Measurements) -> tuple[_State, Correction]:
        skipped, matched = unmatched(group), group[2]
        return where_any(matched.any(), lambda s: work(s, group), lambda s: (s, skipped), state)

    state, corrections = jax.lax.scan(step, state, jax.tree.map(pad, measurements))

    def join(values: jax.Array) -> jax.Array:
        return values.reshape(groups * group_size, *values.shape[2:])[:m]

    return state, jax.tree.map(join, corrections)


def _correct_group(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    group: Measurements,
    gamma: Number | None,
) -> tuple[Joint, Correction]:
    """The joint corrected by g measurements in turn: local states by each, then P by all at once.

        local P (W, W) | M (W, W)     P_I after some measurements = M P_I of before, W = R + g·L
        V = L⁻¹ H P = L⁻¹ H M P_I     (g·Z, D), with L⁻¹ H M (g·Z, W), `whitened_hm`

    P may have columns of zeros beyond its own.
    """
    slot = group[1]
    size_l, size, n = joint.landmarks.shape[1], joint.cov.shape[0], joint.robot_size
    # Slot i owns rows R + i·L to R + (i+1)·L of P. Of a landmark that the group measures twice, the
    # local map has two copies; a correction moves both by the same numbers.
    of_landmarks = n + slot[:, None] * size_l + jnp.arange(size_l, dtype=slot.dtype)[None, :]
    index = jnp.concatenate([jnp.arange(n), of_landmarks.reshape(-1)])
    rows = joint.cov[index]  # P_I
    # M, the product of the corrections so far, begins as the identity.
    local = joint._replace(
        landmarks=joint.landmarks[slot],
        cov=jnp.concatenate([rows[:, index], jnp.eye(len(index), dtype=rows.dtype)], axis=1),
        alive=joint.alive[slot],
        tag=joint.tag[slot],
    )

    def correct_local(
        local: Joint, measurement: tuple[jax.Array, PyTree]
    ) -> tuple[Joint, tuple[jax.Array, jax.Array, Correction]]:
        """The local map corrected by one measurement; L⁻¹ H M (Z, W), L⁻¹ ν (Z,).

        P of the local map and the matrix M beside it are corrected as one:
        [P M] ← [P M] - Vᵀ [V, L⁻¹ H M].
        """
        # One measurement as m = 1; it is of landmark i of the local map, and of slot in the map.
        i, (z, slot, matched) = jax.tree.map(lambda leaf: leaf[None], measurement)
        width = local.cov.shape[0]
        memory = joint.with_robot(local.robot), slot
        innovation = _innovate(filter, sensor, local, i, z, matched, memory, gamma)
        # Of L⁻¹ H [P M], as M is in the further columns of P.
        v, whitened_hm = innovation.v[:, :width], innovation.v[:, width:]
        local = retract_map(filter.robot_chart, local, innovation.xi[:width])
        # V has the columns of [P M], so M is corrected by the same product as P.
        cov = local.cov - linalg.gram(v, innovation.v)
        correction = jax.tree.map(lambda leaf: leaf[0], innovation.correction)
        local = local._replace(cov=cov)
        return local, (whitened_hm, innovation.whitened, correction)

    # A gradient stores the input of each step, and recomputes the rest.
    # (prevent_cse is for use outside a scan, where XLA would merge that with the original.)
    local, (whitened_hm, whitened, corrections) = jax.lax.scan(
        jax.checkpoint(correct_local, prevent_cse=False),
        local,
        (jnp.arange(len(slot)), group),
    )
    # (g·Z, D) entries, each of which P - Vᵀ V needs D times.
    v = no_inline(linalg.matmul, whitened_hm.reshape(-1, len(index)), rows)
    landmarks = _move_map(joint, v[:, :size], whitened, filter.robot_chart)
    cov = joint.cov - linalg.gram(v[:, :size], v)
    return joint.with_robot(local.robot)._replace(landmarks=landmarks, cov=cov), corrections


def _move_map(
    joint: Joint, v: Float[Array, "K D"], whitened: Float[Array, "g Z"], chart: Chart
) -> Float[Array, "N L"]:
    """The landmarks after corrections V (g·Z, D), L⁻¹ ν, one after the other."""
    if chart.basis is None:  # retractions are additive
        xi = linalg.gram(v, whitened.reshape(-1, 1))[:, 0]
        return retract_map(chart, joint, xi).landmarks

    def move(joint: Joint, correction: tuple[jax.Array, jax.Array]) -> tuple[Joint, None]:
        v, whitened = correction
        return retract_map(chart, joint, linalg.gram(v, whitened[:, None])[:, 0]), None

    # (g, Z, D): a retraction that is not additive is done one measurement at a time.
    by_measurement = v.reshape(*whitened.shape, -1)
    return jax.lax.scan(move, joint, (by_measurement, whitened))[0].landmarks


def no_correction(joint: Joint, measurements: Measurements, chart: Chart) -> Correction:
    """The `Correction` of m measurements without a match, all zero; the map is unchanged."""
    z = measurements[0]
    (m, size), width = z.shape, joint.robot_size + joint.landmarks.shape[1]
    dtype = jnp.result_type(z, joint.pose, joint.cov)
    # As promoted in the corrected branch: both branches of a `cond` must have one dtype.
    numbers, flags = jnp.zeros(m, dtype), jnp.zeros(m, bool)
    return Correction(
        z_hat=jnp.zeros((m, size), dtype),
        innovation=jnp.zeros((m, size), dtype),
        innovation_cov=jnp.zeros((m, size, size), dtype),
        nis=numbers,
        log_likelihood=numbers,
        inside=flags,
        positive=flags,
        jacobian=jnp.zeros((m, size, width), dtype),
        basis=None if chart.basis is None else jnp.zeros((m, width, width), dtype),
    )
