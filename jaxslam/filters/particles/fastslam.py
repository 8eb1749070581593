"""FastSLAM 1.0 and 2.0: particles for the robot's path, and a small EKF for each landmark."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.particles import landmark_ekf
from jaxslam.filters.particles.proposal import Sight, look
from jaxslam.filters.particles.slam_state import (
    Particles,
    drawn,
    empty,
    finite,
    moments,
    over_particles,
)
from jaxslam.filters.reporting import has_distance
from jaxslam.linearize import first_order
from jaxslam.math import linalg
from jaxslam.math.stats import chi2_quantile
from jaxslam.math.xla import where_any
from jaxslam.protocols import Associate, Differentiable, Filter, Life, Motion, Resample, Sensor
from jaxslam.resampling import weights
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import normalized
from jaxslam.sensors.suite import Suite
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array

# The probability that a measurement of a landmark lies within d² = edge, where no gate says more.
_NEAR = 0.99


def fastslam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    particles: int,
    *,
    proposal: Literal["motion", "measurement"] = "measurement",
    resample: Resample | Differentiable = systematic,
    threshold: float = 0.5,
    associate: Associate | None = None,
    gate: float | None = None,
    births: int | None = None,
    life: Life | None = None,
) -> Filter:
    """FastSLAM: the posterior of the path by weighted particles, of the map given each path exactly
    (but for linearization) by independent landmark Gaussians. The state is a `particles.Particles`.

    "motion", FastSLAM 1.0 (Montemerlo, Thrun, Koller & Wegbreit 2002, "FastSLAM: A factored
    solution to the simultaneous localization and mapping problem"): poses are drawn from the motion
    with its noise, and weighted by the scan. "measurement", 2.0 (Montemerlo et al. 2003, "FastSLAM
    2.0: An improved particle filtering algorithm …"): the pose is a Gaussian that the motion
    predicts and the scan corrects, place by place, and is drawn from what is left;
    the weight is the density of the scan with the pose integrated out (`proposal.look`), which
    does not depend on the draw. So resampling comes first here, and copies of one particle get
    poses of their own.

    Resampling happens in steps with ESS = 1/Σ w² below threshold·P. Where all weights underflow,
    all become 1/P and `Info.underflow` says so; the log-likelihood, -∞, is then given as 0, so who
    adds it up looks at `underflow` too. A particle that a motion or a scan leaves without a finite
    pose keeps the one before and weighs nothing (`Info.invalid`).

    What an `Info` says of places is said of the most likely particle (by its weight before
    resampling), whose slots are those of the estimate; its innovations are given its path, with the
    covariance of a pose not drawn yet in 2.0. Only nis is the mean over the particles by their
    weights after the scan: of an honest filter that is dof, E_z Σ_p (w_p N_p(z)/p(z)) d²_p =
    Σ_p w_p E_{N_p} d²_p, where the most likely particle's, chosen for fitting well, is less. Its
    log_likelihood is that of the scan given all before, log Σ w p(scan | particle), of the places
    that a particle has landmarks for. Estimates: `particles.moments`.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`.
        capacity: landmark slots N of each particle. A new landmark that finds a particle's map full
            is dropped there (`Status.OVERFLOW`, and `Particles.lost` for each particle).
        particles: P, at least 1.
        proposal: what poses are drawn from.
        resample: one of `jaxslam.resampling`. Through `stop_gradient` of one, the gradient of
            `Info.log_likelihood` is consistent; through `soft` it is biased, and more so through
            none, which leaves out what resampling does to it.
        threshold: of ESS, as a share of P; 0 never resamples, 1 in every step with unequal weights.
        associate: default `association.known()`. Any other decides for each particle by its map.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
        births: at most so many new landmarks a scan and particle, the rest `Status.DEFERRED`.
        life: which landmarks stay in each particle's map (`jaxslam.life`), as by negative evidence:
            `life.existence` keeps log-odds (P, N) in `Particles.life`; default all.
    Raises:
        ValueError: on a capacity, particles or births below 1, a threshold outside [0, 1], a
            gate not above 0, an unknown proposal, a life that is none, a resample that is no
            function, or a sensor that is a suite, absolute, or whose landmarks turn into points.
    """
    validation.check_models("fastslam", motion, sensor)
    validation.check_parts("fastslam", associate=associate)
    counts = {"capacity": capacity, "particles": particles, "births": births}
    _check(sensor, counts, threshold, gate, (proposal, resample, life))
    associate = associate or known_association()
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    edge = chi2_quantile(_NEAR, size_z) if gate is None else gate
    seen_from = partial(look, sensor=sensor, associate=associate, gate=gate, edge=edge)
    change_map = partial(landmark_ekf.after_scan, sensor=sensor, births=births, life=life)

    def init(pose: Array, pose_cov: Array) -> Particles:
        state = empty(pose, pose_cov, particles, capacity, size_l)
        if life is not None:
            state = state._replace(life=jax.vmap(life.init)(state.pose, state.landmarks))
        return state

    def predict(state: Particles, u: Array, key: Array) -> Particles:
        if proposal == "measurement":

            def ahead(pose: Array, cov: Array) -> tuple[Array, Array]:
                moved, by_pose, noise = first_order.motion_at(motion, pose, u, pose)
                return moved, linalg.symmetrize(
                    linalg.matmul(linalg.matmul(by_pose, cov), by_pose.T) + noise
                )

            return _kept_finite(state, *jax.vmap(ahead)(state.pose, state.pose_cov))
        key_pending, key_noise = jax.random.split(key)
        kind = state.pose.dtype
        start = jax.vmap(drawn)(
            state.pose, state.pose_cov, jax.random.normal(key_pending, state.pose.shape, kind)
        )
        normals = jax.random.normal(key_noise, (particles, len(motion.noises)), kind)

        def moved(pose: Array, normal: Array) -> Array:
            return motion.step(pose, u, linalg.root_psd(motion.noise_cov(pose, u)) @ normal)

        pose = jax.vmap(moved)(start, normals)
        return _kept_finite(state._replace(pose=start), pose, jnp.zeros_like(state.pose_cov))

    def update(state: Particles, scan: Scan, key: Array) -> tuple[Particles, Info]:
        # Padding may hold anything, and is multiplied by zero further down.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        key_resample, key_draw = jax.random.split(key)
        pose, cov, fit, rest, sight = jax.vmap(partial(seen_from, scan=scan))(
            state.pose, state.pose_cov, state.landmarks, state.covs, state.alive, state.tag
        )
        state = _kept_finite(state, pose, cov)
        log_likelihood = normalized(state.log_weight + fit)[1]
        weight, _, some = normalized(state.log_weight + fit + rest)
        nis = over_particles(sight.nis, sight.matched, weight)
        ess = 1.0 / jnp.exp(2 * weight).sum()
        resampled = ess < threshold * particles
        invalid = state.invalid.sum()
        state = state._replace(log_weight=weight, best=(), invalid=jnp.zeros_like(state.invalid))

        def survivors(carried: tuple[Particles, Sight, Array]) -> tuple[Particles, Sight, Array]:
            chosen, after = weights.survivors(resample, carried[2], key_resample)
            ancestor = jnp.where(resampled, chosen, jnp.arange(particles))
            state, sight, before = jax.tree.map(lambda x: x[ancestor], carried)
            return (
                state._replace(log_weight=jnp.where(resampled, after, state.log_weight)),
                sight,
                before,
            )

        state, sight, before = where_any(
            resampled, survivors, lambda carried: carried, (state, sight, weight)
        )
        best = jnp.argmax(before).astype(jnp.int32)
        normals = jax.random.normal(key_draw, state.pose.shape, state.pose.dtype)
        pose = jax.vmap(drawn)(state.pose, state.pose_cov, normals)
        state = state._replace(pose=pose, pose_cov=jnp.zeros_like(state.pose_cov))
        state, infos = jax.vmap(change_map, in_axes=(0, 0, None))(state, sight, scan)
        info: Info = jax.tree.map(lambda of_all: of_all[best], infos)
        info = info._replace(
            nis=jnp.where(has_distance(info.status), nis, 0.0),
            log_likelihood=log_likelihood,
            exhausted=sight.exhausted.any(),
            ess=ess,
            resampled=resampled,
            underflow=~some,
            invalid=invalid,
        )
        return state._replace(best=best), info

    def estimate(state: Particles) -> Estimate:
        return moments(state, sensor)

    return Filter(
        name="fastslam",
        control_size=len(motion.controls),
        measurement_size=size_z,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
    )


def _kept_finite(state: Particles, pose: Array, cov: Array) -> Particles:
    """The state with new poses (P, 3) and their covariances (P, 3, 3); where one is not finite, the
    old ones, without weight."""
    good = finite(pose) & jnp.isfinite(cov).all(axis=(1, 2))
    return state._replace(
        pose=jnp.where(good[:, None], pose, state.pose),
        pose_cov=jnp.where(good[:, None, None], cov, state.pose_cov),
        log_weight=jnp.where(good, state.log_weight, -jnp.inf),
        invalid=state.invalid | ~good,
    )


def _check(
    sensor: Sensor, counts: dict[str, Any], threshold: float, gate: float | None, options: Any
) -> None:
    for name, value in counts.items():
        if value is not None or name != "births":
            linalg.check_count(f"fastslam: {name}", value)
    proposal, resample, life = options
    if proposal not in ("motion", "measurement"):
        raise ValueError(f'fastslam: expected proposal "motion" or "measurement", got {proposal!r}')
    if not callable(resample):
        raise ValueError(f"fastslam: expected resample to be a function, got {resample!r}")
    if life is not None and not isinstance(life, Life):
        raise ValueError(
            f"fastslam: expected life to be a Life, as of life.existence, got {life!r}"
        )
    if linalg.is_concrete(threshold) and not 0 <= threshold <= 1:
        raise ValueError(f"fastslam: expected a threshold from 0 to 1, got {threshold}")
    linalg.check_gate("fastslam", gate)
    if isinstance(sensor, Suite) or not sensor.landmark or sensor.reduced is not None:
        raise ValueError(
            "fastslam: expected one sensor of landmarks that stay what they are, not a suite, an "
            f"absolute sensor or landmarks that turn into points, got {sensor.name}"
        )
