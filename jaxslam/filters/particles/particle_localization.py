"""Monte-Carlo localization: where the robot is in a known map, by particles, from anywhere."""

import math
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.known.localization import checked_map
from jaxslam.filters.particles import pose_state
from jaxslam.filters.particles.likelihood import ScanLikelihood, in_order, no_fit, scan_likelihood
from jaxslam.filters.particles.pose_state import Cloud
from jaxslam.filters.particles.settings import (
    check_numbers,
    check_resample,
    checked_box,
    checked_least,
)
from jaxslam.filters.particles.slam_state import finite, over_particles
from jaxslam.filters.reporting import info_of, status_of
from jaxslam.math import linalg
from jaxslam.math.stats import chi2_quantile
from jaxslam.protocols import Associate, Differentiable, Filter, Motion, Resample, Sensor
from jaxslam.resampling.kld import bins_of, enough
from jaxslam.resampling.systematic import systematic
from jaxslam.resampling.weights import effective_size, normalized, survivors
from jaxslam.sensors.suite import Suite
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array

# The probability that a measurement of a landmark lies within d² = edge, where no gate says more.
_NEAR = 0.99


def particle_localization(
    motion: Motion,
    sensor: Sensor,
    landmarks: ArrayLike,
    particles: int,
    *,
    tags: ArrayLike | None = None,
    box: ArrayLike | None = None,
    start: Literal["gaussian", "uniform"] = "gaussian",
    associate: Associate | None = None,
    gate: float | None = None,
    resample: Resample | Differentiable = systematic,
    threshold: float = 1.0,
    bins: tuple[float, float, float] = (0.5, 0.5, math.radians(15)),
    error: float = 0.05,
    confidence: float = 0.99,
    least: int | None = None,
    forget: tuple[float, float] | None = (0.01, 0.1),
    slack: float = 1.0,
) -> Filter:
    """Monte-Carlo localization with a number of particles that adapts, and recovery when lost.

    Poses are drawn from the motion with its noise and weighted by the scan, p(z | x, map), the map
    being without error (Dellaert, Fox, Burgard & Thrun 1999; Thrun, Burgard & Fox, "Probabilistic
    Robotics", table 8.2). The state is a `Cloud`. Particles are resampled before a motion, if
    the last scan left ESS = 1/Σ w² below threshold · (particles in use); then so many of the draws
    are used as the KLD bound asks for the bins that these occupy after the motion (Fox 2001;
    `resampling.kld`), at most `particles`, of which the others weigh nothing (`Info.active`,
    `Info.capped`).

    A robot that was carried away is found again by particles from the whole box (table 8.3). With
    c the average over the particles, by weight, of exp(-Σ d²/2m) over the m places of a scan,

        slow ← slow + α_slow (c - slow)     fast ← fast + α_fast (c - fast)

    each particle drawn is from the box with probability max(0, 1 - slack · fast/slow) instead
    (`Info.injected`). c is the table's likelihood in units of its peak and per place, so that it
    does not depend on how many landmarks are in view; the first scan sets both averages; scans
    without a measurement change nothing. slack above 1 injects less (Gutmann & Fox 2002).

    The estimate is that of the weighted particles after a scan, before anything is drawn anew:
    `particles.mean_and_spread`, which is one point and one ellipse also where the particles are in
    several places. Where all weights underflow, all in use become equal (`Info.underflow`). A
    motion that leaves a pose which is not finite is undone, and the particle weighs nothing
    (`Info.invalid`). What an `Info` says of places is said of the most likely particle, and nis is
    the mean over the particles by weight, as of `fastslam`; log_likelihood is log Σ w p(scan | x)
    of places matched to a landmark.

    Shapes are fixed, so that a step costs what its capacity does, however few particles are in use.

    Particles stand for a density that the scan makes sharper than they are dense: with a precise
    sensor none may lie within its noise, and all may agree on a wrong place. Then take more
    particles, or give the sensor more noise than it has, as is customary; the estimate then claims
    less than it could.

    Args:
        motion, sensor: any; with a `sensors.suite`, absolute sensors weigh too.
        landmarks: (N, L) the map, in the sensor's parameters.
        particles: the capacity P, at least 1.
        tags: (N,) int, different; default the row numbers.
        box: (2, 2) the lowest and the highest (x, y) [m] where the robot may be; without one,
            nothing is injected.
        start: "gaussian", the pose and covariance that `run` is told (the latter may be zero), or
            "uniform", the whole box and any heading, whatever it is told (global localization).
        associate: default `association.known()`, by tag. Any other decides for each particle, by
            its pose alone (maximum_likelihood with an infinite gate: the most likely landmark).
        gate: a measurement whose squared Mahalanobis distance exceeds this counts as one on the
            gate, and is reported as rejected; default none.
        resample: one of `jaxslam.resampling`; also `soft` or `stop_gradient` of one.
        threshold: of ESS, as a share; 1 resamples (and chooses the number) in every step with
            unequal weights, 0 only to inject. Where odometry is precise beside the scans, copies
            stay together, and a lower one is more honest.
        bins: sizes in x [m], y [m], θ [rad].
        error, confidence: of the bound: with this probability the Kullback-Leibler divergence is
            below the error.
        least: never fewer particles; default 50, or the capacity if that is less. As many as the
            capacity: a fixed number.
        forget: α_slow, α_fast with 0 < α_slow <= α_fast <= 1; None injects nothing.
        slack: above 0.
    Raises:
        ValueError: on counts below 1 or least above particles, a map or tags as `localization`
            refuses them, a box that is not finite or has no inside, start "uniform" without a box,
            a threshold outside [0, 1], a gate, bins, error or slack not above 0, a confidence not
            within (0, 1), or rates that do not fit.
    """
    validation.check_models("particle_localization", motion, sensor)
    validation.check_parts("particle_localization", associate=associate)
    points, names = checked_map("particle_localization", sensor, landmarks, tags)
    least = checked_least(particles, least)
    check_resample(resample)
    check_numbers(threshold, gate, slack, forget, (bins, error, confidence))
    limits = checked_box(box, start)
    inject = limits is not None and forget is not None
    parts = _parts(sensor, points, names, associate or known_association(), gate)

    def look(pose: Array, scan: Scan) -> ScanLikelihood:
        of_all = [(len(scan.tag) if n < 0 else n, size, of_one) for n, size, of_one in parts]
        return in_order(pose, scan, of_all)

    def init(pose: Array, pose_cov: Array) -> Cloud:
        if start == "uniform":
            pose, pose_cov = pose_state.box_moments(jnp.asarray(limits, pose.dtype))
        return pose_state.begun(pose, pose_cov, particles)

    def begun(state: Cloud, key: Array) -> Cloud:
        if start == "uniform":
            first = pose_state.uniform(jnp.asarray(limits, state.pose.dtype), particles, key)
        else:
            first = pose_state.gaussian(state.pose, state.start_cov, key)
        return state._replace(
            pose=jnp.where(state.fresh, first, state.pose),
            start_cov=jnp.zeros_like(state.start_cov),
            fresh=jnp.asarray(False),
        )

    def renewed(state: Cloud, key: Array) -> tuple[Array, Array, Array]:
        """P poses to go on with, in random order, their log-weights, and which are from the box."""
        key_resample, key_order, key_which, key_box = jax.random.split(key, 4)
        ancestor, log_weight = survivors(resample, state.log_weight, key_resample)
        # Ancestors ascend, and only the first so many may be used.
        order = jax.random.permutation(key_order, particles)
        pose, log_weight = state.pose[ancestor[order]], log_weight[order]
        new = jnp.zeros(particles, bool)
        if inject:
            new = jax.random.uniform(key_which, (particles,), pose.dtype) < state.lost
            anywhere = pose_state.uniform(jnp.asarray(limits, pose.dtype), particles, key_box)
            pose = jnp.where(new[:, None], anywhere, pose)
            log_weight = jnp.where(new, -math.log(particles), log_weight)
        return pose, log_weight, new

    def predict(state: Cloud, u: Array, key: Array) -> Cloud:
        key_start, key_renew, key_noise = jax.random.split(key, 3)
        state = begun(state, key_start)
        due = state.due
        chosen, log_weight, new = renewed(state, key_renew)
        old = jnp.where(due, chosen, state.pose)
        normals = jax.random.normal(key_noise, (particles, len(motion.noises)), old.dtype)

        def moved(pose: Array, normal: Array) -> Array:
            return motion.step(pose, u, linalg.root_psd(motion.noise_cov(pose, u)) @ normal)

        pose = jax.vmap(moved)(old, normals)
        good = finite(pose)
        pose = jnp.where(good[:, None], pose, old)
        count, few = enough(bins_of(pose, bins), least, error, confidence)
        active = jnp.where(due, count, state.active)
        used = jnp.arange(particles) < active
        log_weight = jnp.where(used, log_weight, -jnp.inf)
        # The sum becomes 1; its gradient is the resampling method's.
        log_weight = log_weight - normalized(jax.lax.stop_gradient(log_weight))[1]
        log_weight = jnp.where(due, log_weight, state.log_weight)
        return state._replace(
            pose=pose,
            log_weight=jnp.where(good, log_weight, -jnp.inf),
            active=active,
            due=jnp.asarray(False),
            lost=jnp.zeros_like(state.lost),
            resampled=state.resampled | due,
            injected=state.injected + (due & new & used).sum().astype(jnp.int32),
            invalid=state.invalid + (used & ~good).sum().astype(jnp.int32),
            capped=state.capped | (due & few),
        )

    def update(state: Cloud, scan: Scan, key: Array) -> tuple[Cloud, Info]:
        state = begun(state, key)
        # Padding may hold anything, and is multiplied by zero further down.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        fit = jax.vmap(look, (0, None))(state.pose, scan)
        log_likelihood = normalized(state.log_weight + fit.log_density.sum(axis=1))[1]
        # Beside d², a weight has log |2πR|, which is the same for all.
        off = 0.5 * fit.counted.sum(axis=1)
        weight, _, some = normalized(state.log_weight - off)
        even = -jnp.log(state.active.astype(weight.dtype))
        weight = jnp.where(
            some, weight, jnp.where(pose_state.in_use(state), even, jnp.full_like(weight, -jnp.inf))
        )
        best = jnp.argmax(weight).astype(jnp.int32)
        ess = effective_size(weight)
        fast, slow, lost = pose_state.averaged(state, off, fit.there[0].sum(), forget, slack)
        due = ess < threshold * state.active
        if inject:
            due = due | (lost > 0)
        own: ScanLikelihood = jax.tree.map(lambda of_all: of_all[best], fit)
        info = info_of(
            status_of(scan.valid, matched=own.matched, positive=own.positive, inside=own.inside),
            own.matched,
            size=jnp.concatenate(_dof(parts, len(scan.tag))),
            slot=own.slot,
            nis=over_particles(fit.nis, fit.matched, weight),
            innovation=own.innovation,
            innovation_cov=own.cov,
            log_likelihood=log_likelihood,
            exhausted=fit.exhausted.any(),
            ess=ess,
            resampled=state.resampled,
            underflow=~some,
            invalid=state.invalid,
            active=state.active,
            injected=state.injected,
            capped=state.capped,
        )
        none = jnp.zeros_like(state.injected)
        state = state._replace(
            log_weight=weight,
            best=best,
            fast=fast,
            slow=slow,
            due=due,
            lost=lost,
            resampled=jnp.asarray(False),
            injected=none,
            invalid=none,
            capped=jnp.asarray(False),
        )
        return state, info

    def estimate(state: Cloud) -> Estimate:
        pose, cov = pose_state.moments(state)
        return Estimate(
            pose=pose,
            pose_cov=cov,
            points=jax.vmap(sensor.position)(jnp.asarray(points, pose.dtype)),
            point_covs=jnp.zeros((len(names), 2, 2), pose.dtype),
            alive=jnp.ones(len(names), bool),
            tag=jnp.asarray(names),
        )

    return Filter(
        name="particle_localization",
        control_size=len(motion.controls),
        measurement_size=len(sensor.measurements),
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=euclidean(),
        places=sensor.places if isinstance(sensor, Suite) else (),
    )


def _parts(
    sensor: Sensor, points: Any, names: np.ndarray, associate: Associate, gate: float | None
) -> list[tuple[int, int, Any]]:
    """(places, Z, likelihood) of each sensor of a suite; -1 places are all, of one alone."""

    def part(one: Sensor, places: int) -> tuple[int, int, Any]:
        size = len(one.measurements)
        edge = chi2_quantile(_NEAR, size) if gate is None else gate
        return (
            places,
            size,
            partial(
                scan_likelihood,
                sensor=one,
                landmarks=points,
                tag=names,
                absolute=not one.landmark,
                associate=associate,
                gate=gate,
                edge=edge,
            ),
        )

    if not isinstance(sensor, Suite):
        return [part(sensor, -1)]
    return [
        (each.places, len(each.sensor.measurements), no_fit)
        if each.sees == "robots"
        else part(each.sensor, each.places)
        for each in sensor.parts
    ]


def _dof(parts: list[tuple[int, int, Any]], places: int) -> list[Array]:
    return [jnp.full(places if n < 0 else n, size, jnp.int32) for n, size, _ in parts]
