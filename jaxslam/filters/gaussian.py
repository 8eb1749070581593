"""The atoms of every Kalman-type SLAM filter on a `Joint`: propagate, correct, augment.

Each exploits that a motion touches the robot alone, and a measurement the robot and one landmark:
no dense D×D product is formed. They take the models as records, so one set of equations serves
every sensor, chart and linearizer. `filters.ekf_slam` binds them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import linalg, slots
from jaxslam.protocols import Basis, Chart, Linearizer, Motion, Sensor
from jaxslam.slots import Joint

# Up to this many rows the covariance update is written as outer products, which XLA fuses into one
# pass over P; beyond, as one matrix product.
_OUTER_PRODUCTS = 16


class Correction(NamedTuple):
    """What `correct` did with its m measurements; the numbers are finite for all of them."""

    innovation: jax.Array
    """(m, Z) against the prior"""
    innovation_cov: jax.Array
    """(m, Z, Z)"""
    nis: jax.Array
    """(m,)"""
    log_likelihood: jax.Array
    """(m,)"""
    inside: jax.Array
    """(m,) bool: passed the gate"""
    positive: jax.Array
    """(m,) bool: its innovation covariance is positive definite"""


def propagate(
    joint: Joint, u: jax.Array, *, motion: Motion, chart: Chart, linearize: Linearizer
) -> Joint:
    """Robot motion, O(N) in a chart whose landmarks stand still: Solà (14)-(17).

    pose ← f(pose, u, 0), P_RR ← F P_RR Fᵀ + W Q Wᵀ, P_RM ← F P_RM. In another chart the error of
    the landmarks moves too, with A = E(x')⁻¹ F E(x), E the chart's basis; O(N²), block by block.
    """
    by_pose, by_noise, lin = linearize.motion(joint.lin, motion, joint.pose, u)
    pose = motion.step(joint.pose, u, jnp.zeros(by_noise.shape[1], joint.pose.dtype))
    noise = motion.noise_cov(joint.pose, u)
    if chart.basis is None:
        robot = _matmul(by_pose, joint.cov[:3])
        own = _matmul(robot[:, :3], by_pose.T) + _matmul(_matmul(by_noise, noise), by_noise.T)
        robot = jnp.concatenate([linalg.symmetrize(own), robot[:, 3:]], axis=1)
        cov = joint.cov.at[:3].set(robot).at[:, :3].set(robot.T)
    else:
        over_map = jax.vmap(chart.basis, in_axes=(None, 0))
        before, after = over_map(joint.pose, joint.landmarks), over_map(pose, joint.landmarks)
        cov = _propagate_in_chart(joint, by_pose, by_noise, noise, before, after)
    return joint._replace(pose=pose, cov=cov, lin=lin)


def _propagate_in_chart(
    joint: Joint,
    by_pose: jax.Array,
    by_noise: jax.Array,
    noise: jax.Array,
    before: Basis,
    after: Basis,
) -> jax.Array:
    capacity, size = joint.landmarks.shape
    undo = linalg.inverse(after.pose[0])
    pose_pose = undo @ by_pose @ before.pose[0]
    pose_noise = undo @ by_noise
    own = jax.vmap(linalg.inverse)(after.landmark)
    alive = joint.alive[:, None, None]
    land_pose = jnp.where(alive, own @ (before.cross - after.cross @ pose_pose), 0.0)
    land_land = jnp.where(alive, own @ before.landmark, jnp.eye(size, dtype=own.dtype))
    land_noise = jnp.where(alive, -own @ after.cross @ pose_noise, 0.0)

    def rows(matrix: jax.Array) -> jax.Array:
        blocks = matrix[3:].reshape(capacity, size, -1)
        moved = jnp.einsum("nij,jd->nid", land_pose, matrix[:3])
        moved = moved + linalg.total(
            land_land[:, :, k, None] * blocks[:, k, None, :] for k in range(size)
        )
        return jnp.concatenate([pose_pose @ matrix[:3], moved.reshape(capacity * size, -1)])

    gain = jnp.concatenate([pose_noise, land_noise.reshape(capacity * size, -1)])
    return linalg.symmetrize(rows(rows(joint.cov).T) + gain @ noise @ gain.T)


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
) -> tuple[Joint, Correction]:
    """Correct by m measurements at once, z (m, Z) of the landmarks in slot (m,): Solà (26)-(30).

    With S = H P Hᵀ + R = L Lᵀ and V = L⁻¹ H P: x ← x ⊞ Vᵀ L⁻¹ ν and P ← P - Vᵀ V, symmetric as it
    stands. H is Z×(3+L) a measurement; where L = 0 (an absolute sensor) slot means nothing. Places
    not known (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above it, each against the prior) or with a
    singular S do nothing.

    Each further iteration linearizes at the newest estimate x_i = x ⊞ ξ_i but starts again from the
    prior: ξ_{i+1} = K (z - h(x_i) + H ξ_i) (Bell & Cathey 1993). joseph: P ← (I-KH)P(I-KH)ᵀ + KRKᵀ.
    """
    m, size_z = z.shape
    capacity, size_l = joint.landmarks.shape
    prior_l, prior_rows = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)
    noise = jax.vmap(sensor.noise_cov)(z)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))

    pose, landmark = joint.pose, prior_l
    xi = jnp.zeros(joint.cov.shape[0], z.dtype)
    for iteration in range(iterations):
        by_pose, by_landmark = jax.vmap(linearize.observe, in_axes=(None, None, 0, 0, None, 0))(
            joint.lin, sensor, slot, joint.tag[slot], pose, landmark
        )
        predicted = jax.vmap(sensor.observe, in_axes=(None, 0))(pose, landmark)
        nu = jax.vmap(sensor.residual)(z, predicted)
        xi_l = xi[3:].reshape(capacity, size_l)[slot]
        if chart.basis is not None:
            by_pose, by_landmark = _in_chart(
                chart, joint.pose, prior_l, xi[:3], xi_l, by_pose, by_landmark, iteration == 0
            )
        if iteration > 0:
            nu = nu + jnp.einsum("mzi,i->mz", by_pose, xi[:3])
            nu = nu + jnp.einsum("mzi,mi->mz", by_landmark, xi_l)
        by_pose, by_landmark, nu = linalg.settle((by_pose, by_landmark, nu))
        hp = linalg.total(by_pose[:, :, k, None] * joint.cov[None, None, k] for k in range(3))
        if size_l > 0:
            hp = hp + linalg.total(
                by_landmark[:, :, k, None] * prior_rows[:, None, k] for k in range(size_l)
            )
        hp = linalg.settle(hp)
        s = _innovation_cov(hp, by_pose, by_landmark, slot, capacity) + same * noise[:, :, None]
        if iteration == 0:
            marginal = s[jnp.arange(m), :, jnp.arange(m)]
            distance, positive = jax.vmap(_squared_distance)(nu, marginal)
            inside = jnp.ones(m, bool) if gate is None else ~positive | (distance <= gate)
            fuse = known & inside & positive
            innovation = nu
        hp = jnp.where(fuse[:, None, None], hp, 0.0).reshape(m * size_z, -1)
        both = fuse[:, None, None, None] & fuse[None, None, :, None]
        s = jnp.where(both, s, same * jnp.eye(size_z, dtype=z.dtype)[None, :, None])
        s = linalg.settle(s)
        factor = linalg.settle(linalg.cholesky(s.reshape(m * size_z, m * size_z))[0])
        # Measurements that are regular one by one can still be singular together.
        regular = (jnp.diagonal(factor).reshape(m, size_z) > 0).all(axis=1)
        keep = jnp.repeat(regular, size_z)
        nu = jnp.where(fuse[:, None], nu, 0.0).reshape(-1)
        v = jnp.where(keep[:, None], linalg.solve_lower(factor, hp), 0.0)
        v, whitened = linalg.settle((v, jnp.where(keep, linalg.solve_lower(factor, nu), 0.0)))
        xi = _gram(v, whitened[:, None])[:, 0]
        if iteration == 0:
            positive = positive & regular
            pivots = jnp.diagonal(factor).reshape(m, size_z)
            nis = (whitened.reshape(m, size_z) ** 2).sum(axis=1)
        if iteration + 1 < iterations:
            xi_l = xi[3:].reshape(capacity, size_l)[slot]
            poses, landmark = over_landmarks(joint.pose, prior_l, xi[:3], xi_l)
            pose = poses[0]

    if joseph:
        fused_noise = jnp.where(fuse[:, None, None, None], same * noise[:, :, None], 0.0)
        cov = _joseph(joint.cov, hp, s, fused_noise, factor, v)
    else:
        cov = joint.cov - _gram(v, v)
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(capacity, size_l)
    )
    log_det = 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum(axis=1)
    log_likelihood = -0.5 * (nis + log_det + size_z * jnp.log(2 * jnp.pi))
    return joint._replace(pose=poses[0], landmarks=landmarks, cov=cov), Correction(
        innovation=innovation,
        innovation_cov=marginal,
        nis=jnp.where(fuse, nis, distance),
        log_likelihood=jnp.where(fuse & positive, log_likelihood, 0.0),
        inside=inside,
        positive=positive,
    )


def augment(
    joint: Joint,
    z: jax.Array,
    tag: jax.Array,
    slot: jax.Array,
    granted: jax.Array,
    *,
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
) -> Joint:
    """Start landmarks from measurements z (m, Z) in free slots (m,), where granted (m,).

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx: Solà (32)-(38),
    with the prior's term of (44); several in one scan are correlated through the robot.
    """
    mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)

    def one(z_i: jax.Array, tag_i: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        landmark = sensor.invert(joint.pose, z_i, mean)
        by_pose, by_z, by_s = linearize.invert(joint.lin, sensor, tag_i, joint.pose, z_i, mean)
        own = by_z @ sensor.noise_cov(z_i) @ by_z.T + by_s @ cov_s @ by_s.T
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            undo = linalg.inverse(basis.landmark)
            by_pose = undo @ (by_pose @ basis.pose - basis.cross)
            own = undo @ own @ undo.T
        return landmark, by_pose, own

    landmark, by_pose, own = jax.vmap(one)(z, tag)
    joint = slots.scatter(joint, slot, granted, landmark, by_pose, own, tag)
    born = jnp.zeros_like(joint.alive).at[slot].max(granted)
    return joint._replace(lin=linearize.born(joint.lin, born, joint.landmarks))


def _in_chart(
    chart: Chart,
    pose: jax.Array,
    landmarks: jax.Array,
    dx: jax.Array,
    dl: jax.Array,
    by_pose: jax.Array,
    by_landmark: jax.Array,
    at_zero: bool,
) -> tuple[jax.Array, jax.Array]:
    """Chain Jacobians (m, Z, ·) with the derivative of retract(pose, l, ·) at (dx, dl)."""
    if at_zero:
        assert chart.basis is not None
        basis = jax.vmap(chart.basis, in_axes=(None, 0))(pose, landmarks)
    else:
        by_dx, by_dl = jax.vmap(
            jax.jacfwd(chart.retract, argnums=(2, 3)), in_axes=(None, 0, None, 0)
        )(pose, landmarks, dx, dl)
        basis = Basis(by_dx[0], by_dl[0], by_dl[1])
    return by_pose @ basis.pose + by_landmark @ basis.cross, by_landmark @ basis.landmark


def _innovation_cov(
    hp: jax.Array, by_pose: jax.Array, by_landmark: jax.Array, slot: jax.Array, capacity: int
) -> jax.Array:
    """H P Hᵀ (m, Z, m, Z) of HP (m, Z, D): only the robot's and the seen landmarks' columns."""
    m, size_z, size_l = by_landmark.shape
    own = linalg.total(hp[:, :, k, None, None] * by_pose[None, None, :, :, k] for k in range(3))
    if size_l == 0:
        return own
    at_landmark = hp[:, :, 3:].reshape(m, size_z, capacity, size_l)[:, :, slot]
    return own + linalg.total(
        at_landmark[..., k, None] * by_landmark[None, None, :, :, k] for k in range(size_l)
    )


def _squared_distance(nu: jax.Array, cov: jax.Array) -> tuple[jax.Array, jax.Array]:
    """νᵀ S⁻¹ ν () and whether S (Z, Z) is positive definite; finite where it is not."""
    factor, positive = linalg.cholesky(cov)
    return (linalg.solve_lower(factor, nu) ** 2).sum(), positive


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


def _gram(a: jax.Array, b: jax.Array) -> jax.Array:
    """Aᵀ B of A (k, D), B (k, E)."""
    if a.shape[0] > _OUTER_PRODUCTS:
        return a.T @ b
    return linalg.total(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


def _matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """A B of A (n, k), B (k, D), small n and k, as outer products."""
    return _gram(a.T, b)
