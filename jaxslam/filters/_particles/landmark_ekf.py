"""The landmark EKFs of one particle, given its drawn pose.

All functions act on one particle; `FastSlam` vmaps them, `Mapping` has only one.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.protocols import Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan, Status
from jaxslam.filters._gaussian_correction import correct_gaussian
from jaxslam.filters._particles.particle_map import ParticleMapFilter
from jaxslam.filters._particles.proposal import ParticleInnovations
from jaxslam.filters._particles.scan_association import ParticleAssociation
from jaxslam.filters._particles.slam_particles import SlamParticles, as_only_particle, slam_estimate
from jaxslam.filters._reporting import NewLandmarks, info_of, status_of, with_removed
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import where_any


def update_map(
    filter: ParticleMapFilter,
    particle: SlamParticles,
    association: ParticleAssociation,
    innovations: ParticleInnovations,
    scan: Scan,
) -> tuple[SlamParticles, Info]:
    """One particle with its landmarks corrected, new ones initialized, and `Life` applied.

    The log-likelihood of the `Info` is left at 0.
    """
    # Landmarks are corrected before eviction, so that `Life` makes room by the current map.
    slot, used, life = association.slot, innovations.used, filter.life
    particle = _correct_landmarks(filter.sensor, particle, slot, used, scan)
    measured = slots.slot_mask(slot, used, len(particle.alive))
    particle, new, evicted = _initialize_landmarks(
        filter, particle, association.is_new, measured, scan
    )
    status = status_of(
        scan.valid,
        matched=association.matched,
        positive=innovations.positive,
        inside=innovations.inside,
        new=association.is_new,
        repeated=new.repeated,
        granted=new.granted,
        deferred=new.deferred,
    )
    overflow = (status == Status.OVERFLOW).sum().astype(jnp.int32)
    particle = particle._replace(lost=particle.lost + overflow)
    info = info_of(
        status,
        association.matched,
        size=scan.z.shape[1],
        slot=slot,
        born=new.slot,
        nis=innovations.nis,
        innovation=innovations.innovation,
        innovation_cov=innovations.innovation_cov,
        log_likelihood=jnp.zeros((), scan.z.dtype),
        exhausted=association.exhausted,
    )
    if life is None:
        return particle, info
    estimate = partial(slam_estimate, as_only_particle(particle), filter.sensor)
    memory, dead = life.after(_as_joint(particle), info, estimate)
    particle = _without_landmarks(particle._replace(life=memory), dead)
    return particle, with_removed(info, evicted | dead)


def _correct_landmarks(
    sensor: Sensor,
    particle: SlamParticles,
    slot: Int[Array, "M"],
    used: Bool[Array, "M"],
    scan: Scan,
) -> SlamParticles:
    """The landmarks of a particle, each corrected by a separate EKF at a known pose.

    With S = H_l C H_lᵀ + R(ẑ): l ← l + C H_lᵀ S⁻¹ ν, C ← C - C H_lᵀ S⁻¹ H_l C.
    """
    pose = particle.pose

    def correct(z: Array, used: Array, landmark: Array, cov: Array) -> tuple[Array, Array]:
        z_hat = sensor.observe(pose, landmark)
        by_landmark = jax.jacfwd(sensor.observe, argnums=1)(pose, landmark)
        noise = first_order.predicted_noise(sensor, z_hat, z, used)
        correction = correct_gaussian(sensor.residual(z, z_hat), by_landmark, cov, noise)
        return landmark + correction.xi, correction.cov

    landmarks, covs = jax.vmap(correct)(scan.z, used, particle.landmarks[slot], particle.covs[slot])
    into = jnp.where(used, slot, particle.landmarks.shape[0])  # beyond the end: dropped
    return particle._replace(
        landmarks=particle.landmarks.at[into].set(landmarks, mode="drop"),
        covs=particle.covs.at[into].set(covs, mode="drop"),
    )


def _initialize_landmarks(
    filter: ParticleMapFilter,
    particle: SlamParticles,
    is_new: Bool[Array, "M"],
    measured: Bool[Array, "N"],
    scan: Scan,
) -> tuple[SlamParticles, NewLandmarks, Bool[Array, "N"]]:
    """The particle with new landmarks in free slots, in the order of the scan, as many as fit.

    l = g(x, z, s̄), C = G_z R G_zᵀ + G_s S G_sᵀ: the pose of a particle has no error.

    measured: landmarks that the scan corrected, which do not make room for new ones. Returns also
    the slots (N,) that were emptied to make room.
    """
    dtype, m = particle.landmarks.dtype, is_new.shape[0]
    capacity, size = particle.landmarks.shape
    births = m if filter.births is None else filter.births

    def requests() -> tuple[Bool[Array, "M"], Bool[Array, "M"], Bool[Array, "M"]]:
        """The measurements that start a landmark if a slot is free, the repeated, the deferred."""
        repeated = is_new & slots.seen_before(scan.tag, is_new)
        wanted = is_new & ~repeated
        deferred = wanted & (jnp.cumsum(wanted) > births)
        return wanted & ~deferred, repeated, deferred

    evicted = jnp.zeros_like(particle.alive)
    if filter.life is not None and filter.life.make_room is not None:
        needed = requests()[0].sum() - (~particle.alive).sum()
        evicted = filter.life.make_room(_as_joint(particle), needed, measured)
        particle = _without_landmarks(particle, evicted)

    def initialize(particle: SlamParticles) -> tuple[NewLandmarks, Array, Array]:
        def invert(z: Float[Array, "Z"]) -> tuple[Float[Array, "L"], Float[Array, "L L"]]:
            landmark, _, cov = first_order.invert_at(
                filter.sensor, particle.pose, z, particle.pose, z
            )
            return landmark, linalg.symmetrize(cov)

        wanted, repeated, deferred = requests()
        slot, granted = slots.allocate(particle.alive, wanted)
        return NewLandmarks(slot, granted, deferred, repeated), *jax.vmap(invert)(scan.z)

    def leave(particle: SlamParticles) -> tuple[NewLandmarks, Array, Array]:
        no = jnp.zeros_like(is_new)
        new = NewLandmarks(jnp.zeros(m, jnp.int32), no, no, no)
        return new, jnp.zeros((m, size), dtype), jnp.zeros((m, size, size), dtype)

    new, landmarks, covs = where_any(is_new.any(), initialize, leave, particle)
    into = jnp.where(new.granted, new.slot, capacity)  # beyond the end: dropped
    particle = particle._replace(
        landmarks=particle.landmarks.at[into].set(landmarks, mode="drop"),
        covs=particle.covs.at[into].set(covs, mode="drop"),
        alive=particle.alive.at[into].set(True, mode="drop"),
        tag=particle.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
    )
    return particle, new, evicted


def _as_joint(particle: SlamParticles) -> Joint:
    """The particle as a `Joint` for `Life`, with landmark covariances (N, L, L) as its cov."""
    return Joint(
        particle.pose,
        particle.landmarks,
        particle.covs,
        particle.alive,
        particle.tag,
        lin=(),
        life=particle.life,
    )


def _without_landmarks(particle: SlamParticles, dead: Bool[Array, "N"]) -> SlamParticles:
    """The particle with these slots emptied."""
    eye = jnp.eye(particle.landmarks.shape[1], dtype=particle.covs.dtype)
    return particle._replace(
        landmarks=jnp.where(dead[:, None], 0.0, particle.landmarks),
        covs=jnp.where(dead[:, None, None], eye[None], particle.covs),
        alive=particle.alive & ~dead,
        tag=jnp.where(dead, -1, particle.tag),
    )
