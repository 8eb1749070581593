"""Weighted poses in a known map: the state of Monte-Carlo localization."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filters.particles.slam_state import mean_and_spread
from jaxslam.math import linalg
from jaxslam.math.angles import wrap

Array = jax.Array


class Cloud(NamedTuple):
    """P places for particles, of which the first `active` are in use; the others weigh nothing."""

    pose: Array
    """(P, 3), finite also where not in use"""
    log_weight: Array
    """(P,) Σ exp = 1, -inf where not in use"""
    active: Array
    """() int"""
    best: Array
    """() int: the most likely particle"""
    fresh: Array
    """() bool: nothing was drawn yet"""
    start_cov: Array
    """(3, 3) of the start while it is not drawn yet, then zero"""
    fast: Array
    """() short-term average of how well scans fit"""
    slow: Array
    """() long-term average of the same; both 0 before the first scan"""
    due: Array
    """() bool: to be resampled before the next motion"""
    lost: Array
    """() the probability of a particle to be drawn from the whole box then"""
    resampled: Array
    """() bool: what became of the particles since the last scan: resampled,"""
    injected: Array
    """() int: drawn from the box,"""
    invalid: Array
    """() int: left without a finite pose by the motion,"""
    capped: Array
    """() bool: and wanted beyond the capacity"""


def begun(pose: Array, start_cov: Array, particles: int) -> Cloud:
    """P times the same pose (3,), not yet drawn from N(pose, start_cov) or a box of that spread."""
    kind = pose.dtype
    zero, no, none = jnp.zeros((), kind), jnp.asarray(False), jnp.zeros((), jnp.int32)
    return Cloud(
        pose=jnp.broadcast_to(pose, (particles, 3)),
        log_weight=jnp.full(particles, -math.log(particles), kind),
        active=jnp.asarray(particles, jnp.int32),
        best=none,
        fresh=jnp.asarray(True),
        start_cov=start_cov,
        fast=zero,
        slow=zero,
        due=no,
        lost=zero,
        resampled=no,
        injected=none,
        invalid=none,
        capped=no,
    )


def in_use(state: Cloud) -> Array:
    """Which places hold a particle, (P,) bool."""
    return jnp.arange(state.pose.shape[0]) < state.active


def moments(state: Cloud) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3): `particles.mean_and_spread`, or what the start says."""
    mean, spread = mean_and_spread(state.pose, state.log_weight, state.best)
    return mean, spread + state.start_cov


def gaussian(pose: Array, cov: Array, key: Array) -> Array:
    """Poses of N(pose, cov), as many as pose (P, 3) has; cov (3, 3) may be singular or zero."""
    normals = jax.random.normal(key, pose.shape, pose.dtype)
    drawn = pose + linalg.matmul(normals, linalg.cholesky(cov)[0].T)
    return jnp.concatenate([drawn[:, :2], wrap(drawn[:, 2:])], axis=1)


def uniform(box: Array, count: int, key: Array) -> Array:
    """Poses (count, 3) in a box (2, 2), rows its lowest and highest (x, y); any heading."""
    share = jax.random.uniform(key, (count, 3), box.dtype)
    low, high = box[0][None], box[1][None]
    heading = wrap(2 * math.pi * share[:, 2:])
    return jnp.concatenate([low + (high - low) * share[:, :2], heading], axis=1)


def box_moments(box: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of `uniform`; of the heading, which has no mean, 0 ± π/√3."""
    width = box[1] - box[0]
    mean = jnp.concatenate([0.5 * (box[0] + box[1]), jnp.zeros(1, box.dtype)])
    variance = jnp.concatenate([width**2, jnp.full(1, 4 * math.pi**2, box.dtype)]) / 12
    return mean, jnp.diag(variance)


def averaged(
    state: Cloud, off: Array, places: Array, forget: tuple[float, float] | None, slack: float
) -> tuple[Array, Array, Array]:
    """The averages fast and slow (), and the share to inject (), after a scan of so many places.

    See `particle_localization`. off: (P,) Σ d²/2; forget: the rates, slow first, or None.
    """
    if forget is None:
        return state.fast, state.slow, jnp.zeros_like(state.fast)
    there = jnp.isfinite(off)
    each = jnp.where(there, jnp.exp(-jnp.where(there, off, 0.0) / jnp.maximum(places, 1)), 0.0)
    fit = jax.lax.stop_gradient((jnp.exp(state.log_weight) * each).sum())
    first = state.slow <= 0
    slow, fast = (
        jnp.where(first, fit, before + rate * (fit - before))
        for before, rate in ((state.slow, forget[0]), (state.fast, forget[1]))
    )
    safe = jnp.where(slow > 0, slow, 1.0)
    lost = jnp.where(slow > 0, jnp.maximum(0.0, 1 - slack * fast / safe), 0.0)
    seen = places > 0
    return (
        jnp.where(seen, fast, state.fast),
        jnp.where(seen, slow, state.slow),
        jnp.where(seen, lost, jnp.zeros_like(lost)),
    )
