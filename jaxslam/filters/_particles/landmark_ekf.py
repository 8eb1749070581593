"""The landmark EKFs of one particle, given its drawn pose.

All functions act on one particle; `FastSlam` vmaps them, `Mapping` has only one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.protocols import Life, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan, Status
from jaxslam.filters._particles.particle_settings import ParticleMapSettings
from jaxslam.filters._particles.proposal import ParticleInnovations
from jaxslam.filters._particles.scan_association import ParticleAssociation
from jaxslam.filters._particles.slam_particles import SlamParticles, as_only_particle, slam_estimate
from jaxslam.filters._reporting import info_of, status_of, with_removed
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import gaussian_terms
from jaxslam.math._xla import where_any


def update_map(
    particle: SlamParticles,
    association: ParticleAssociation,
    innovations: ParticleInnovations,
    scan: Scan,
    settings: ParticleMapSettings,
) -> tuple[SlamParticles, Info]:
    """One particle with its landmarks corrected, new ones initialized, and `Life` applied.

    The log-likelihood of the `Info` is left at 0.
    """
    particle = _correct_landmarks(particle, association.slot, innovations.used, scan, settings)
    particle, evicted = _evict_for_new(particle, association, innovations.used, settings.life)
    particle, new = _initialize_particle_landmarks(particle, association.is_new, scan, settings)
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
        slot=association.slot,
        born=new.slot,
        nis=innovations.nis,
        innovation=innovations.innovation,
        innovation_cov=innovations.innovation_cov,
        log_likelihood=jnp.zeros((), scan.z.dtype),
        exhausted=association.exhausted,
    )
    return _remove_landmarks(particle, info, evicted, settings)


def _correct_landmarks(
    particle: SlamParticles,
    slot: Int[Array, "M"],
    used: Bool[Array, "M"],
    scan: Scan,
    settings: ParticleMapSettings,
) -> SlamParticles:
    """The landmarks of a particle, each corrected by a separate EKF at a known pose.

    With S = H_l C H_lᵀ + R(ẑ): l ← l + C H_lᵀ S⁻¹ ν, C ← C - C H_lᵀ S⁻¹ H_l C.
    """
    sensor, pose = settings.sensor, particle.pose

    def one(z: Array, known: Array, landmark: Array, cov: Array) -> tuple[Array, Array]:
        z_hat = sensor.observe(pose, landmark)
        by_landmark = jax.jacfwd(sensor.observe, argnums=1)(pose, landmark)
        hc = linalg.matmul(by_landmark, cov)
        noise = first_order.predicted_noise(sensor, z_hat, z, known)
        s = linalg.symmetrize(linalg.matmul(hc, by_landmark.T) + noise)
        terms = gaussian_terms(sensor.residual(z, z_hat), s)
        v = linalg.solve_lower(terms.factor, hc)
        return landmark + linalg.matmul(terms.whitened[None], v)[0], cov - linalg.gram(v, v)

    landmarks, covs = jax.vmap(one)(scan.z, used, particle.landmarks[slot], particle.covs[slot])
    into = jnp.where(used, slot, particle.landmarks.shape[0])
    return particle._replace(
        landmarks=particle.landmarks.at[into].set(landmarks, mode="drop"),
        covs=particle.covs.at[into].set(covs, mode="drop"),
    )


def _evict_for_new(
    particle: SlamParticles,
    association: ParticleAssociation,
    used: Bool[Array, "M"],
    life: Life | None,
) -> tuple[SlamParticles, Bool[Array, "N"]]:
    """The particle without the landmarks evicted for new ones, and which those are."""
    alive = particle.alive
    if life is None or life.make_room is None:
        return particle, jnp.zeros_like(alive)
    needed = association.is_new.sum() - (~alive).sum()
    measured = slots.slot_mask(association.slot, used, len(alive))
    evicted = life.make_room(_as_joint(particle), needed, measured)
    return _without_landmarks(particle, evicted), evicted


class _AllocatedSlots(NamedTuple):
    """The slots of new landmarks, and the outcome of measurements without a landmark."""

    slot: Int[Array, "M"]
    """a free landmark slot, where granted"""
    granted: Bool[Array, "M"]
    deferred: Bool[Array, "M"]
    """beyond `births`, the limit of a scan"""
    repeated: Bool[Array, "M"]
    """of a tag that occurs earlier in the scan"""


def _initialize_particle_landmarks(
    particle: SlamParticles, is_new: Bool[Array, "M"], scan: Scan, settings: ParticleMapSettings
) -> tuple[SlamParticles, _AllocatedSlots]:
    """The particle with new landmarks in free slots, as many as fit."""
    kind, m = particle.landmarks.dtype, is_new.shape[0]
    capacity, size = particle.landmarks.shape

    def initialize(particle: SlamParticles) -> tuple[_AllocatedSlots, Array, Array]:
        allocated = _allocate_slots(is_new, scan.tag, particle.alive, settings.quota)
        return allocated, *_invert_scan(particle.pose, scan.z, settings.sensor)

    def nothing_new(particle: SlamParticles) -> tuple[_AllocatedSlots, Array, Array]:
        no = jnp.zeros_like(is_new)
        allocated = _AllocatedSlots(jnp.zeros(m, jnp.int32), no, no, no)
        return allocated, jnp.zeros((m, size), kind), jnp.zeros((m, size, size), kind)

    new, landmarks, covs = where_any(is_new.any(), initialize, nothing_new, particle)
    into = jnp.where(new.granted, new.slot, capacity)
    particle = particle._replace(
        landmarks=particle.landmarks.at[into].set(landmarks, mode="drop"),
        covs=particle.covs.at[into].set(covs, mode="drop"),
        alive=particle.alive.at[into].set(True, mode="drop"),
        tag=particle.tag.at[into].set(scan.tag.astype(jnp.int32), mode="drop"),
    )
    return particle, new


def _invert_scan(
    pose: Float[Array, "3"], z: Float[Array, "M Z"], sensor: Sensor
) -> tuple[Float[Array, "M L"], Float[Array, "M L L"]]:
    """The new landmarks of measurements, and their covariances.

    l = g(x, z, s̄), C = G_z R G_zᵀ + G_s S G_sᵀ: the pose of a particle has no error.
    """

    def one(z: Float[Array, "Z"]) -> tuple[Float[Array, "L"], Float[Array, "L L"]]:
        landmark, _, landmark_cov = first_order.invert_at(sensor, pose, z, pose, z)
        return landmark, linalg.symmetrize(landmark_cov)

    return jax.vmap(one)(z)


def _allocate_slots(
    is_new: Bool[Array, "M"], tag: Int[Array, "M"], alive: Bool[Array, "N"], quota: int | None
) -> _AllocatedSlots:
    """A free slot for each new landmark, in the order of the scan."""
    repeated = is_new & slots.seen_before(tag, is_new)
    wanted = is_new & ~repeated
    deferred = wanted & (jnp.cumsum(wanted) > (tag.shape[0] if quota is None else quota))
    slot, granted = slots.allocate(alive, wanted & ~deferred)
    return _AllocatedSlots(slot, granted, deferred, repeated)


def _remove_landmarks(
    particle: SlamParticles, info: Info, evicted: Bool[Array, "N"], settings: ParticleMapSettings
) -> tuple[SlamParticles, Info]:
    """The particle without the landmarks that its `Life` removes; `Pruned.removed` marks them."""
    life = settings.life
    if life is None:
        return particle, info

    def alone() -> Estimate:
        return slam_estimate(as_only_particle(particle), settings.sensor)

    memory, dead = life.after(_as_joint(particle), info, alone)
    particle = _without_landmarks(particle._replace(life=memory), dead)
    return particle, with_removed(info, evicted | dead)


def _as_joint(particle: SlamParticles) -> Joint:
    """The particle as a `Joint` for `Life`, with landmark covariances (N, L, L) as its cov."""
    joint = particle
    return Joint(
        joint.pose, joint.landmarks, joint.covs, joint.alive, joint.tag, lin=(), life=joint.life
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
