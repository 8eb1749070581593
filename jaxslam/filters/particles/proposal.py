"""What a scan says of one particle: how likely it is, and where the robot stands.

Everything here acts on one particle, pose (3,), landmarks (N, L) and their covariances (N, L, L);
`filters.fastslam` vmaps it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import derivatives
from jaxslam.association.predicted import predicted
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.math.gaussians import LOG_2PI, log_det_of
from jaxslam.protocols import Associate, Association, Prediction, Sensor
from jaxslam.types import Scan

Array = jax.Array


class Sight(NamedTuple):
    """How a scan fits one particle, place by place, before anything was drawn."""

    slot: Array
    """(M,) of the landmark measured, 0 where none"""
    matched: Array
    """(M,) bool"""
    is_new: Array
    """(M,) bool"""
    used: Array
    """(M,) bool: matched, in the gate, and its S positive definite"""
    positive: Array
    """(M,) bool: its S is positive definite"""
    inside: Array
    """(M,) bool: in the gate; without one, of a d² that did not overflow"""
    innovation: Array
    """(M, Z)"""
    innovation_cov: Array
    """(M, Z, Z)"""
    nis: Array
    """(M,)"""
    exhausted: Array
    """() bool, of the association"""


def look(
    pose: Array,
    pose_cov: Array,
    landmarks: Array,
    covs: Array,
    alive: Array,
    tag: Array,
    scan: Scan,
    *,
    sensor: Sensor,
    associate: Associate,
    gate: float | None,
    edge: float,
) -> tuple[Array, Array, Array, Array, Sight]:
    """The pose Gaussian (3,), (3, 3) given the scan too, its log-likelihood (), (), and `Sight`.

    Place by place, each linearized where those before left the pose (Montemerlo et al. 2003,
    FastSLAM 2.0): with H_x, H_l at the pose's mean and the landmark's, C the landmark's covariance,

        S = H_x P H_xᵀ + H_l C H_lᵀ + R    x ← x + P H_xᵀ S⁻¹ ν    P ← P - P H_xᵀ S⁻¹ H_x P
        log w += log N(ν; 0, S)

    the product of which is the density of the scan given the path, with the pose integrated out. P
    = 0 (a pose that is drawn already) moves nothing, and leaves the weights of FastSLAM 1.0. P is
    not inverted, so it may be singular. A measurement outside the gate counts as one on the gate,
    and one that is of no landmark as one at d² = edge of a landmark known exactly, log N = -(edge +
    log |2πR|)/2: a particle gains nothing by explaining less. The likelihoods are the sums over
    places matched to a landmark, and over the others.
    """
    prediction = _prediction(pose, pose_cov, landmarks, covs, alive, tag, sensor)
    found = Association(*associate(prediction, scan))
    slot = jnp.maximum(found.slot, 0)
    matched = scan.valid & (found.slot >= 0) & ~found.is_new

    def place(
        carry: tuple[Array, Array, Array, Array], row: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array, Array, Array], tuple[Array, ...]]:
        x, p, fit, rest = carry
        z, landmark, cov, matched, valid = row
        by_pose, by_landmark = derivatives.observe_jacobians(sensor, x, landmark)
        noise = sensor.noise_cov(z)
        nu = sensor.residual(z, sensor.observe(x, landmark))
        hp = linalg.matmul(by_pose, p)
        s = linalg.matmul(hp, by_pose.T) + noise
        s = linalg.symmetrize(s + linalg.matmul(linalg.matmul(by_landmark, cov), by_landmark.T))
        factor, positive = linalg.cholesky(s)
        white = linalg.solve_lower(factor, nu)
        nis = linalg.total(white**2)
        finite = jnp.isfinite(nis)
        inside = finite if gate is None else finite & (nis <= gate)
        used = matched & positive & inside
        v = jnp.where(used, linalg.solve_lower(factor, hp), 0.0)
        x = x + linalg.matmul(jnp.where(used, white, 0.0)[None], v)[0]
        x = jnp.concatenate([x[:2], wrap(x[2:])])
        p = p - linalg.gram(v, v)
        clipped = nis if gate is None else jnp.where(inside, nis, gate)
        seen = -0.5 * (clipped + log_det_of(factor) + len(nu) * LOG_2PI)
        other = -0.5 * (edge + log_det_of(linalg.cholesky(noise)[0]) + len(nu) * LOG_2PI)
        of_map = matched & positive
        fit = fit + jnp.where(of_map, seen, 0.0)
        rest = rest + jnp.where(valid & ~of_map, other, 0.0)
        return (x, p, fit, rest), (
            used,
            positive,
            inside,
            nu,
            s,
            jnp.where(finite, nis, 0.5 * float(jnp.finfo(nis.dtype).max)),
        )

    rows: tuple[Array, ...] = (scan.z, landmarks[slot], covs[slot], matched, scan.valid)
    none = jnp.zeros((), pose.dtype)
    (pose, pose_cov, fit, rest), done = jax.lax.scan(place, (pose, pose_cov, none, none), rows)
    used, positive, inside, nu, s, nis = done
    sight = Sight(
        slot=slot,
        matched=matched,
        is_new=scan.valid & found.is_new,
        used=used,
        positive=positive,
        inside=inside,
        innovation=jnp.where(matched[:, None], nu, 0.0),
        innovation_cov=jnp.where(matched[:, None, None], s, 0.0),
        nis=jnp.where(matched, nis, 0.0),
        exhausted=jnp.asarray(found.exhausted),
    )
    return pose, pose_cov, fit, rest, sight


def _prediction(
    pose: Array,
    pose_cov: Array,
    landmarks: Array,
    covs: Array,
    alive: Array,
    tag: Array,
    sensor: Sensor,
) -> Prediction:
    """One particle's map as an association may see it: landmarks share the pose's error alone."""

    def slopes() -> tuple[Array, Array, Array]:
        """ẑ (N, Z), H_x P (N, Z, 3) against H_x (N, Z, 3), and H_l C H_lᵀ (N, Z, Z)."""

        def one(landmark: Array, cov: Array) -> tuple[Array, Array, Array]:
            by_pose, by_landmark = derivatives.observe_jacobians(sensor, pose, landmark)
            own = linalg.matmul(linalg.matmul(by_landmark, cov), by_landmark.T)
            return sensor.observe(pose, landmark), by_pose, own

        return jax.vmap(one)(landmarks, covs)

    def measurements() -> tuple[Array, Array]:
        expected, by_pose, own = slopes()
        robot = jax.vmap(lambda h: linalg.matmul(linalg.matmul(h, pose_cov), h.T))(by_pose)
        return expected, linalg.symmetrize(robot + own)

    def cross() -> Array:
        _, by_pose, own = slopes()
        shared = jnp.einsum("izx,xy,jwy->izjw", by_pose, pose_cov, by_pose)
        every = jnp.arange(alive.shape[0])
        return shared.at[every, :, every, :].add(own)

    return predicted(sensor, tag, alive, measurements, cross)
