"""The correction of EKF-SLAM, Solà (26)-(30): by m measurements at once, or one after the other.

    ν = z ⊖ h(R, l)    S = H P Hᵀ + R(ẑ) = L Lᵀ    V = L⁻¹ H P    x ← x ⊞ Vᵀ L⁻¹ ν    P ← P - Vᵀ V

The guide's z̄ and Z are ν and S. With its gain K = P Hᵀ S⁻¹ = Vᵀ L⁻¹ this is x ← x ⊞ K ν and
P ← P - K S Kᵀ, symmetric as it stands. `correct` does this for a whole scan, `correct_in_turn` for
each measurement at the estimate that those before it left. Both compute ν, S and the gate in
`_innovate`, and use the sparsity of H, which involves the robot and one landmark (`whitening`).

Letters in shapes: m measurements; Z numbers of a measurement, L of a landmark, R of the robot (3,
or 3 + E); D = R + N·L of the state; B = R + L of the robot and one landmark; mZ = m·Z of a scan;
W = R + g·L of the robot and the g landmarks of a group.
"""

from functools import partial
from typing import Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.protocols import Chart, LinearizationPoint, Linearizer, Sensor
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.linear_system import basis_of_each, chart_jacobians
from jaxslam.filters._ekf.map_coordinates import at_slot, retract_map
from jaxslam.filters._ekf.whitening import (
    Projection,
    Whitened,
    project_cov,
    whiten,
    whiten_by,
)
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import is_inside, log_density
from jaxslam.math._xla import CACHED, materialize, no_inline, scan_in_groups

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
    jacobian: Float[Array, "m Z B"]
    """H by coordinates"""
    basis: Float[Array, "m B B"] | None
    """the coordinates by the errors in the chart; None is the identity"""


def report_fused(
    prior: Correction,
    fuse: Bool[Array, "m"],
    whitened: Float[Array, "mZ"],
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
    gamma: Number | None,
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements z (m, Z) of the landmarks in slot (m,) at once.

    Measurements that are not matched (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above γ, each against
    the prior; γ = None: no gate) or with a singular S have no effect. Where L = 0 (an absolute
    sensor) slot is not used.
    """
    innovation = _innovate(filter, sensor, joint, z, slot, matched, gamma, (joint, slot))
    cov = _correct_cov(joint.cov, innovation, filter.covariance)
    joint = retract_map(filter.robot_chart, joint, innovation.whitened.xi)
    return joint._replace(cov=cov), innovation.correction


class _Innovation(NamedTuple):
    """The innovations of m measurements, for all forms of the covariance."""

    projection: Projection
    """H P and S, in the last iteration"""
    whitened: Whitened
    """V = L⁻¹ H P, L⁻¹ ν and the correction ξ = Vᵀ L⁻¹ ν, in the last iteration"""
    noise: Float[Array, "m Z Z"]
    """R(ẑ), and the covariance that the linearizer adds to it"""
    fuse: Bool[Array, "m"]
    """matched, inside the gate, and with a positive definite S_ii"""
    correction: Correction


def _innovate(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
    gamma: Number | None,
    full_map: tuple[Joint, Int[Array, "m"]],
) -> _Innovation:
    """The innovation of m measurements at once, from the rows of P that H meets: Solà (25)-(29).

        rows of P            H                       H P          S = H P Hᵀ + R
        robot (R, D)         by pose (m, Z, R)       (mZ, D)      (m, Z, m, Z) = L Lᵀ
        landmark (m, L, D)   by landmark (m, Z, L)   V = L⁻¹ H P  ξ = Vᵀ L⁻¹ ν (D,)

    The first iteration, at the prior, is the EKF; it decides the gate, the reported numbers and
    R(ẑ), since a later ẑ has moved towards z, so that R there would depend on the noise of z
    (`predicted_noise` says why it must not). A further one linearizes at the newest estimate
    x_i = x ⊞ ξ_i but starts again from the prior (Bell & Cathey 1993):
    ξ_{i+1} = K (z - h(x_i) + H ξ_i).

    full_map: the map that the linearizer looks its memory up in, and the slots (m,) there. It is
    (joint, slot), unless joint is the local map of a group (`_correct_group`), whose slots differ.
    P may have further columns, of other errors.
    """
    square_root = filter.covariance == "square_root"
    landmark_rows = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)[1]
    # P (m, B, B) of the robot and the landmark of each measurement.
    local_cov = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)
    project = partial(project_cov, joint, landmark_rows, slot, square_root=square_root)
    linearize = partial(_linearize, filter, sensor, joint, slot, local_cov, full_map)

    # (25), (26): ν = z ⊖ ẑ, with angles wrapped: the sensor's own difference.
    z_hat, h, by_coordinates, added_noise = linearize(None)
    nu = jax.vmap(sensor.residual)(z, z_hat)
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, z, matched) + added_noise
    # (27): S, whose diagonal blocks S_ii decide the gate.
    projection = project(h, nu, noise)
    distance = (whiten_by(projection.inverse, projection.nu[:, :, None]) ** 2).sum(axis=(1, 2))
    prior = Correction(
        z_hat=z_hat,
        innovation=projection.nu,
        innovation_cov=projection.s_ii,
        nis=distance,
        log_likelihood=jnp.zeros_like(distance),
        inside=is_inside(distance, gamma),
        positive=projection.definite,
        jacobian=jnp.concatenate(by_coordinates, axis=2),
        basis=basis_of_each(filter.robot_chart, joint.robot, joint.landmarks[slot]),
    )
    fuse = matched & prior.inside & prior.positive
    # (28), (29): K ν = Vᵀ L⁻¹ ν; K itself is never formed.
    whitened = whiten(projection, fuse)
    correction = report_fused(prior, fuse, whitened.nu, whitened.log_det, whitened.regular)

    (capacity, size_l), n = joint.landmarks.shape, joint.robot_size
    for _ in range(filter.iterations - 1):
        xi = whitened.xi
        # ξ_i of the robot, and of the landmark of each measurement.
        errors = xi[:n], xi[n : n + capacity * size_l].reshape(capacity, size_l)[slot]
        z_hat, h, _, _ = linearize(errors)
        # Back to the prior: z ⊖ h(x_i) + H ξ_i.
        nu = jax.vmap(sensor.residual)(z, z_hat)
        nu = nu + jnp.einsum("mzi,i->mz", h[0], errors[0])
        nu = nu + jnp.einsum("mzi,mi->mz", h[1], errors[1])
        projection = project(h, nu, noise)
        whitened = whiten(projection, fuse)
    return _Innovation(projection, whitened, noise, fuse, correction)


_Jacobians = tuple[Float[Array, "m Z R"], Float[Array, "m Z L"]]
"""H by the robot, and by the landmark of each measurement"""


def _linearize(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    slot: Int[Array, "m"],
    local_cov: Float[Array, "m B B"],
    full_map: tuple[Joint, Int[Array, "m"]],
    errors: tuple[Float[Array, "R"], Float[Array, "m L"]] | None,
) -> tuple[Float[Array, "m Z"], _Jacobians, _Jacobians, Float[Array, "m Z Z"]]:
    """The linearization z ≈ ẑ + H (ξ - ξ_i) at x ⊞ ξ_i: Solà (25).

    errors: ξ_i of the robot and of each landmark; None: at the prior x. Returns ẑ, H by the errors,
    H by the coordinates, and the covariance that the linearizer adds to R.
    """
    chart, prior_landmark = filter.robot_chart, joint.landmarks[slot]
    robot, landmark = joint.robot, prior_landmark
    if errors is not None:
        over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
        robots, landmark = over_landmarks(robot, prior_landmark, *errors)
        robot = robots[0]  # the same for all landmarks
    state, slot_in_state = full_map

    def observe(
        at: Int[Array, ""], landmark: Float[Array, "L"], cov: Float[Array, "B B"]
    ) -> tuple[Array, Array, Array, Array]:
        point = LinearizationPoint(state, chart, robot, cov, at, landmark)
        return filter.linearize.observe(at_slot(sensor, state, at), point)

    z_hat, by_pose, by_landmark, added_noise = jax.vmap(observe)(slot_in_state, landmark, local_cov)
    by_coordinates = by_pose, by_landmark
    # The monitor takes H by coordinates; P is of errors in the chart, so the gain needs H by these.
    if chart.basis is None:
        return z_hat, by_coordinates, by_coordinates, added_noise
    h = chart_jacobians(chart, joint.robot, prior_landmark, by_pose, by_landmark, errors)
    return z_hat, h, by_coordinates, added_noise


def _correct_cov(
    cov: Float[Array, "D D"], innovation: _Innovation, form: Covariance
) -> Float[Array, "D D"]:
    """The covariance P, or its root X, after the correction.

    "plain": P - Vᵀ V. "joseph": (I-KH) P (I-KH)ᵀ + K R Kᵀ. "square_root", of P = X Xᵀ and
    R = N Nᵀ: X - Vᵀ (L + N)⁻¹ H X (Andrews 1968, "A square root formulation of the Kalman
    covariance equations", AIAA Journal 6(6)).
    """
    projection, whitened, noise, fuse, _ = innovation
    v, factor = whitened.v, whitened.factor
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
        one_sided = cov - gain @ projection.hp  # (I - KH) P
        # (I - KH) P Hᵀ, with H P Hᵀ = S - R. Where not fused, S is the identity, but K is zero.
        one_sided_h = projection.hp.T - gain @ (whitened.s.reshape(rows, rows) - noise)
        return linalg.symmetrize(one_sided - one_sided_h @ gain.T + gain @ noise @ gain.T)
    noise_root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
    unit = jnp.eye(size_z, dtype=noise.dtype)
    # (m, Z, m, Z); a unit pivot where not fused, so that L + N is regular. V is zero there.
    noise_root = diagonal * jnp.where(fuse[:, None, None], noise_root, unit)[:, :, None]
    factor_sum = factor + noise_root.reshape(rows, rows)  # L + N
    return cov - linalg.gram(v, materialize(linalg.solve_lower(factor_sum, projection.hx)))


_LANES = 16
"""Entries of a vector register, 512 bits of float32. A pass over a P in the cache is bound by
arithmetic, and the rest of a row that fills no vector costs as much as a whole one."""

_GROUP_CACHED, _GROUP_UNCACHED = 3, 4
"""Measurements a pass over P, where P is cached and where it is not: the fastest by measurement.
More of them cost more loads of P_I, fewer cost more loads of P."""


def correct_in_turn(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    matched: Bool[Array, "m"],
    gamma: Number | None,
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
    size, correct_group, group_size = joint.cov.shape[1], correct, 1
    if filter.covariance == "plain":
        cached = size <= CACHED
        group_size = max(1, min(_GROUP_CACHED if cached else _GROUP_UNCACHED, len(slot)))
        correct_group = _correct_group
        if cached:
            # Padded once for the whole scan; columns of zeros stay zero.
            joint = joint._replace(cov=jnp.pad(joint.cov, ((0, 0), (0, -size % _LANES))))
    skip = partial(
        no_correction,
        (group_size, z.shape[1]),
        joint.robot_size + joint.landmarks.shape[1],
        # As promoted in the corrected branch: both branches of a `cond` must have one dtype.
        jnp.result_type(z, joint.pose, joint.cov),
        has_basis=filter.robot_chart.basis is not None,
    )
    # A partial, as a function here would be one more frame of the tracebacks in a user's model.
    work = partial(correct_group, filter, sensor, gamma=gamma)
    joint, corrections = scan_in_groups(work, skip, joint, (z, slot, matched), group_size)
    return joint._replace(cov=joint.cov[:, :size]), corrections


def _correct_group(
    filter: KalmanFilter,
    sensor: Sensor,
    joint: Joint,
    z: Float[Array, "g Z"],
    slot: Int[Array, "g"],
    matched: Bool[Array, "g"],
    gamma: Number | None,
) -> tuple[Joint, Correction]:
    """The joint corrected by g measurements in turn: local maps by each, then P by all at once.

        local P (W, W) | M (W, W)     P_I after some measurements = M P_I of before, W = R + g·L
        V = L⁻¹ H P = L⁻¹ H M P_I     (g·Z, D), with L⁻¹ H M (g·Z, W), `whitened_hm`

    P may have columns of zeros beyond its own.
    """
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
        local: Joint, measurement: tuple[Array, Array, Array, Array]
    ) -> tuple[Joint, tuple[Array, Array, Correction]]:
        """The local map corrected by one measurement; L⁻¹ H M (Z, W), L⁻¹ ν (Z,).

        P of the local map and the matrix M beside it are corrected as one:
        [P M] ← [P M] - Vᵀ [V, L⁻¹ H M].
        """
        # One measurement as m = 1; its landmark is number i of the local map, and in slot of P.
        i, z, slot, matched = (leaf[None] for leaf in measurement)
        full_map = joint.with_robot(local.robot), slot
        innovation = _innovate(filter, sensor, local, z, i, matched, gamma, full_map)
        whitened, width = innovation.whitened, local.cov.shape[0]
        # V has the columns of [P M], so M is corrected by the same product as P.
        v, whitened_hm = whitened.v[:, :width], whitened.v[:, width:]
        local = retract_map(filter.robot_chart, local, whitened.xi[:width])
        local = local._replace(cov=local.cov - linalg.gram(v, whitened.v))
        correction = jax.tree.map(lambda leaf: leaf[0], innovation.correction)
        return local, (whitened_hm, whitened.nu, correction)

    # A gradient stores the input of each step, and recomputes the rest.
    # (prevent_cse is for use outside a scan, where XLA would merge that with the original.)
    local, (whitened_hm, whitened_nu, corrections) = jax.lax.scan(
        jax.checkpoint(correct_local, prevent_cse=False),
        local,
        (jnp.arange(len(slot)), z, slot, matched),
    )
    # (g·Z, D) entries, each of which P - Vᵀ V needs D times.
    v = no_inline(linalg.matmul, whitened_hm.reshape(-1, len(index)), rows)
    landmarks = _move_map(filter.robot_chart, joint, v[:, :size], whitened_nu)
    cov = joint.cov - linalg.gram(v[:, :size], v)
    return joint.with_robot(local.robot)._replace(landmarks=landmarks, cov=cov), corrections


def _move_map(
    chart: Chart, joint: Joint, v: Float[Array, "gZ D"], whitened_nu: Float[Array, "g Z"]
) -> Float[Array, "N L"]:
    """The landmarks after g corrections in turn, x ← x ⊞ Vᵀ L⁻¹ ν, with rows V (g·Z, D)."""
    if chart.basis is None:  # retractions are additive
        xi = linalg.gram(v, whitened_nu.reshape(-1, 1))[:, 0]
        return retract_map(chart, joint, xi).landmarks

    def move(joint: Joint, correction: tuple[Array, Array]) -> tuple[Joint, None]:
        v, whitened_nu = correction
        return retract_map(chart, joint, linalg.gram(v, whitened_nu[:, None])[:, 0]), None

    # (g, Z, D): a retraction that is not additive is done one measurement at a time.
    by_measurement = v.reshape(*whitened_nu.shape, -1)
    return jax.lax.scan(move, joint, (by_measurement, whitened_nu))[0].landmarks


def no_correction(
    shape: tuple[int, int], size_b: int, dtype: DTypeLike, *, has_basis: bool
) -> Correction:
    """The `Correction` of (m, Z) measurements without a match, all zero; the map is unchanged.

    size_b: B, the columns of H. has_basis: the chart has a basis, which is then zeros, too.
    """
    m, _ = shape
    numbers, flags = jnp.zeros(m, dtype), jnp.zeros(m, bool)
    return Correction(
        z_hat=jnp.zeros(shape, dtype),
        innovation=jnp.zeros(shape, dtype),
        innovation_cov=jnp.zeros((*shape, shape[1]), dtype),
        nis=numbers,
        log_likelihood=numbers,
        inside=flags,
        positive=flags,
        jacobian=jnp.zeros((*shape, size_b), dtype),
        basis=jnp.zeros((m, size_b, size_b), dtype) if has_basis else None,
    )
