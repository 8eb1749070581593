"""What a scan does to one particle's map, from a pose that is drawn, hence known.

Everything here acts on one particle; `filters.fastslam` vmaps it.
"""

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.particles.proposal import Sight
from jaxslam.filters.particles.slam_state import Particles, moments
from jaxslam.filters.reporting import info_of, seen_before, status_of, with_removed
from jaxslam.linearize import first_order
from jaxslam.math import linalg
from jaxslam.math.xla import where_any
from jaxslam.protocols import Life, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan, Status

Array = jax.Array


def after_scan(
    own: Particles,
    sight: Sight,
    scan: Scan,
    *,
    sensor: Sensor,
    births: int | None,
    life: Life | None,
) -> tuple[Particles, Info]:
    """One particle with its map corrected, then grown, then judged by its `Life`."""
    landmarks, covs = correct(own.pose, own.landmarks, own.covs, scan.z, sight, sensor=sensor)
    own = own._replace(landmarks=landmarks, covs=covs)
    given_up = jnp.zeros_like(own.alive)
    if life is not None and life.make_room is not None:
        needed = sight.is_new.sum() - (~own.alive).sum()
        measured = slots.concerned(sight.slot, sight.used, len(own.alive))
        given_up = life.make_room(_joint(own), needed, measured)
        own = _without(own, given_up)
    at, granted, deferred, repeated, new, new_covs = where_any(
        sight.is_new.any(),
        lambda own: (
            *births_of(sight, scan.tag, own.alive, births),
            *start(own.pose, scan.z, sensor=sensor),
        ),
        lambda own: no_births(own, sight),
        own,
    )
    into = jnp.where(granted, at, own.alive.shape[0])
    status = status_of(
        scan.valid,
        matched=sight.matched,
        positive=sight.positive,
        inside=sight.inside,
        new=sight.is_new,
        repeated=repeated,
        granted=granted,
        deferred=deferred,
    )
    own = own._replace(
        landmarks=own.landmarks.at[into].set(new, mode="drop"),
        covs=own.covs.at[into].set(new_covs, mode="drop"),
        alive=own.alive.at[into].set(True, mode="drop"),
        tag=own.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
        lost=own.lost + (status == Status.OVERFLOW).sum().astype(jnp.int32),
    )
    info = info_of(
        status,
        sight.matched,
        size=scan.z.shape[1],
        slot=sight.slot,
        born=at,
        nis=sight.nis,
        innovation=sight.innovation,
        innovation_cov=sight.innovation_cov,
        log_likelihood=jnp.zeros((), scan.z.dtype),
    )
    if life is not None:
        memory, dead = life.after(_joint(own), info, lambda: moments(_alone(own), sensor))
        own = _without(own._replace(life=memory), dead)
        info = with_removed(info, given_up | dead)
    return own, info


def correct(
    pose: Array, landmarks: Array, covs: Array, z: Array, sight: Sight, *, sensor: Sensor
) -> tuple[Array, Array]:
    """Each landmark measured, corrected by its own EKF from a pose that is known: the particle's.

    With S = H_l C H_lᵀ + R: l ← l + C H_lᵀ S⁻¹ ν, C ← C - C H_lᵀ S⁻¹ H_l C.
    """

    def one(z: Array, landmark: Array, cov: Array) -> tuple[Array, Array]:
        by_landmark = jax.jacfwd(sensor.observe, argnums=1)(pose, landmark)
        hc = linalg.matmul(by_landmark, cov)
        s = linalg.symmetrize(linalg.matmul(hc, by_landmark.T) + sensor.noise_cov(z))
        factor, _ = linalg.cholesky(s)
        white = linalg.solve_lower(factor, sensor.residual(z, sensor.observe(pose, landmark)))
        v = linalg.solve_lower(factor, hc)
        return landmark + linalg.matmul(white[None], v)[0], cov - linalg.gram(v, v)

    new, new_covs = jax.vmap(one)(z, landmarks[sight.slot], covs[sight.slot])
    at = jnp.where(sight.used, sight.slot, landmarks.shape[0])
    return landmarks.at[at].set(new, mode="drop"), covs.at[at].set(new_covs, mode="drop")


def start(pose: Array, z: Array, *, sensor: Sensor) -> tuple[Array, Array]:
    """The landmarks (M, L) that z (M, Z) would begin, and their covariances (M, L, L).

    l = g(x, z, s̄), C = G_z R G_zᵀ + G_s S G_sᵀ: the pose of a particle has no error.
    """

    def one(z: Array) -> tuple[Array, Array]:
        landmark, _, own = first_order.invert_at(sensor, pose, z, pose, z)
        return landmark, linalg.symmetrize(own)

    return jax.vmap(one)(z)


def births_of(
    sight: Sight, tag: Array, alive: Array, quota: int | None
) -> tuple[Array, Array, Array, Array]:
    """A free slot (M,) for each new landmark, and which are granted, deferred, repeated (M,)."""
    m = tag.shape[0]
    repeated = sight.is_new & seen_before(tag, sight.is_new)
    wanted = sight.is_new & ~repeated
    deferred = wanted & (jnp.cumsum(wanted) > (m if quota is None else quota))
    slot, granted = slots.allocate(alive, wanted & ~deferred)
    return slot, granted, deferred, repeated


def no_births(own: Particles, sight: Sight) -> tuple[Array, ...]:
    """What `births_of` and `start` say where nothing is new."""
    m, size = sight.slot.shape[0], own.landmarks.shape[1]
    none, kind = jnp.zeros_like(sight.is_new), own.landmarks.dtype
    slot = jnp.zeros(m, jnp.int32)
    return slot, none, none, none, jnp.zeros((m, size), kind), jnp.zeros((m, size, size), kind)


def _joint(own: Particles) -> Joint:
    """As a `Life` sees it; the covariance is that of each landmark alone, (N, L, L)."""
    return Joint(own.pose, own.landmarks, own.covs, own.alive, own.tag, lin=(), life=own.life)


def _alone(own: Particles) -> Particles:
    """This particle as if there were no other."""
    alone: Particles = jax.tree.map(lambda x: x[None], own)
    return alone._replace(
        log_weight=jnp.zeros_like(alone.log_weight), best=jnp.zeros((), jnp.int32)
    )


def _without(own: Particles, dead: Array) -> Particles:
    """The slots dead (N,) emptied."""
    eye = jnp.eye(own.landmarks.shape[1], dtype=own.covs.dtype)
    return own._replace(
        landmarks=jnp.where(dead[:, None], 0.0, own.landmarks),
        covs=jnp.where(dead[:, None, None], eye[None], own.covs),
        alive=own.alive & ~dead,
        tag=jnp.where(dead, -1, own.tag),
    )
