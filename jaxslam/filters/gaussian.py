"""The atoms of every Kalman-type SLAM filter on a `Joint`: correct and augment.

With `filters.propagation`, they exploit that a motion touches the robot alone, and a measurement
the robot and one landmark: no dense D×D product is formed. They take the models as records, so one
set of equations serves every sensor, chart and linearizer. `filters.ekf_slam` binds them.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import linalg, slots
from jaxslam.filters.composition import lever_of_motion, moved_anew
from jaxslam.filters.watching import along, informed, split
from jaxslam.protocols import Basis, Chart, Here, Linearizer, Sensor
from jaxslam.slots import Joint


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
    m, size_z = z.shape
    capacity, size_l = joint.landmarks.shape
    prior_l, prior_rows = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)
    local_cov = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)
    own_noise = jax.vmap(sensor.noise_cov)(z)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))

    pose, landmark = joint.pose, prior_l
    xi = jnp.zeros(joint.cov.shape[0], z.dtype)
    for iteration in range(iterations):
        expected, by_pose, by_landmark, rest = jax.vmap(
            lambda at, landmark, cov, pose=pose: linearize.observe(
                sensor, Here(joint, chart, pose, cov, at, landmark)
            )
        )(slot, landmark, local_cov)
        noise = own_noise + rest
        nu = jax.vmap(sensor.residual)(z, expected)
        if iteration == 0:
            seen = by_pose, by_landmark
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
        hp = hx = linalg.settle(hp)
        if square_root:
            hp = linalg.settle((hx.reshape(m * size_z, -1) @ joint.cov.T).reshape(hx.shape))
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
        xi = linalg.gram(v, whitened[:, None])[:, 0]
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
    elif square_root:
        root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
        unit = jnp.eye(size_z, dtype=z.dtype)
        root = same * jnp.where(fuse[:, None, None], root, unit)[:, :, None]
        root = factor + root.reshape(m * size_z, m * size_z)
        hx = jnp.where(fuse[:, None, None], hx, 0.0).reshape(m * size_z, -1)
        cov = joint.cov - linalg.gram(v, linalg.settle(linalg.solve_lower(root, hx)))
    else:
        cov = joint.cov - linalg.gram(v, v)
    last = joint.last
    if last:
        seen_last = along(by_pose, by_landmark, *split(last.cov.T, capacity), slot)
        seen_last = jnp.where(fuse[:, None, None], seen_last, 0.0).reshape(m * size_z, 3)
        seen_last = jnp.where(keep[:, None], linalg.solve_lower(factor, seen_last), 0.0)
        step = linalg.gram(seen_last, whitened[:, None])[:, 0]
        lever = lever_of_motion(joint, chart)
        xi = xi - lever @ step
        last = last._replace(
            cov=last.cov - linalg.gram(seen_last, v),
            own=last.own - linalg.gram(seen_last, seen_last),
        )
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(capacity, size_l)
    )
    landmarks = jnp.where(joint.alive[:, None], landmarks, 0.0)
    log_det = 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum(axis=1)
    log_likelihood = -0.5 * (nis + log_det + size_z * jnp.log(2 * jnp.pi))
    watch = joint.watch
    if watch:
        watch = informed(joint, chart, *seen, slot, own_noise, fuse & positive)
    turn = poses[0][2] - joint.pose[2]
    joint = joint._replace(pose=poses[0], landmarks=landmarks, cov=cov, watch=watch, last=last)
    if last:
        joint = moved_anew(joint, turn, step, lever, chart)
    return joint, Correction(
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
    square_root: bool = False,
) -> Joint:
    """Start landmarks from measurements z (m, Z) in free slots (m,), where granted (m,).

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx: Solà (32)-(38),
    with the prior's term of (44); several in one scan are correlated through the robot.
    """
    here = Here(joint, chart, joint.pose, slots.robot_cov(joint, square_root))

    def one(z_i: jax.Array, tag_i: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        landmark, by_pose, own = linearize.invert(sensor, z_i, tag_i, here)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            by_pose = by_pose @ basis.pose - basis.cross
            if basis.landmark is not None:
                undo = linalg.inverse(basis.landmark)
                by_pose, own = undo @ by_pose, undo @ own @ undo.T
        return landmark, by_pose, own

    landmark, by_pose, own = jax.vmap(one)(z, tag)
    joint = slots.scatter(
        joint, slot, granted, landmark, by_pose, own, tag, square_root=square_root
    )
    born = jnp.zeros_like(joint.alive).at[slot].max(granted)
    return joint._replace(lin=linearize.born(joint, born))


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
    by_chart = by_pose @ basis.pose + by_landmark @ basis.cross
    return by_chart, by_landmark if basis.landmark is None else by_landmark @ basis.landmark


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
