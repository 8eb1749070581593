"""The nonlinear least-squares problem of a path and a map: its cost, and a step down from a point.

The unknowns are the noises of the start and of the motions, in units of their own standard
deviations, and the map; the path is what the motions make of the noises. So the models hold
exactly at every iterate, and noise that cannot move the pose in every direction is no special case.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Motion, Sensor
from jaxslam.smoothing.chain import Chain, Policy, Start, Step
from jaxslam.smoothing.history import difference, whitened_rows

Array = jax.Array


class Problem(NamedTuple):
    """The data: what is given of the start and the motions, and the measurements that count."""

    pose: Array
    """(3,) mean of the start"""
    root: Array
    """(3, 3) of its covariance"""
    control: Array
    """(T, U)"""
    roots: Array
    """(T, W, W) of the covariances of the motions' noises"""
    z: Array
    """(T, M, Z)"""
    slot: Array
    """(T, M) int"""
    used: Array
    """(T, M) bool"""


class Point(NamedTuple):
    """An iterate."""

    start: Array
    """(3,) ξ"""
    noise: Array
    """(T, W) η"""
    path: Array
    """(T+1, 3) from the start on: x_0 = pose + L ξ, x_t = f(x_{t-1}, u_t, Q^{1/2} η_t)"""
    landmarks: Array
    """(N, L)"""


def cost(sensor: Sensor, problem: Problem, point: Point) -> Array:
    """½ |ξ|² + ½ Σ |η_t|² + ½ Σ |R^{-1/2} (z ⊖ h(x_t, l))|², minus the log posterior density.

    Up to a constant, as long as the noise covariances are taken for given; the path is read from
    the point.
    """

    def fit(z: Array, slot: Array, used: Array, pose: Array) -> Array:
        landmark = point.landmarks[slot]
        off = sensor.residual(z, sensor.observe(pose, landmark))
        white = linalg.solve_lower(linalg.cholesky(sensor.noise_cov(z))[0], off)
        return jnp.where(used, (white**2).sum(), 0.0)

    over_places = jax.vmap(fit, (0, 0, 0, None))
    each = jax.vmap(over_places)(problem.z, problem.slot, problem.used, point.path[1:])
    return 0.5 * ((point.start**2).sum() + (point.noise**2).sum() + each.sum())


def linearized(motion: Motion, sensor: Sensor, problem: Problem, point: Point) -> Chain:
    """The chain about a point, to first order in the models: that of the Gauss-Newton step.

    It has as many rows a place as that of `history.chain_of`.
    """
    spare = max(0, len(sensor.landmark) - len(sensor.measurements))

    def moved(pose: Array, u: Array, root: Array, noise: Array) -> tuple[Array, Array]:
        by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, root @ noise)
        return by_pose, by_noise @ root

    by_pose, by_noise = jax.vmap(moved)(
        point.path[:-1], problem.control, problem.roots, point.noise
    )

    def seen(z: Array, slot: Array, used: Array, pose: Array) -> tuple[Array, Array, Array]:
        *rows, _ = whitened_rows(sensor, z, pose, point.landmarks[slot])
        a, b, r = (
            jnp.pad(jnp.where(used, row, 0.0), [(0, spare)] + [(0, 0)] * (row.ndim - 1))
            for row in rows
        )
        return a, b, r

    over_places = jax.vmap(seen, (0, 0, 0, None))
    a, b, r = jax.vmap(over_places)(problem.z, problem.slot, problem.used, point.path[1:])
    nothing = jnp.zeros_like(point.path[1:])
    steps = Step(by_pose, by_noise, nothing, point.noise, problem.slot, a, b, r)
    return Chain(Start(problem.root, point.start), steps)


def rolled_out(
    motion: Motion, problem: Problem, point: Point, policy: Policy, share: Array
) -> Point:
    """A point that lies a share () of the step on, on the models themselves.

    d_t = share k_t - J a_t - K δm with a_t = f(x_{t-1}, u_t, Q^{1/2} η̄_t) - x̄_t, of the path as it
    comes out: where the models bend, the later noises answer to where the earlier ones led, as
    differential dynamic programming does (Jacobson & Mayne 1970). Without that, a small turn early
    would swing all of a long path. To first order it is share times the Gauss-Newton step. The path
    of the point it starts from (x̄) need not obey the models; what comes out does.
    """
    shift = share * policy.landmarks
    delta = shift.reshape(-1)
    start = point.start + share * policy.start.constant - policy.start.by_map @ delta
    first = problem.pose + problem.root @ start
    first = first.at[2].set(wrap(first[2]))

    def forward(pose: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        u, root, noise, reference, constant, by_pose, by_map = row
        ahead = difference(motion.step(pose, u, root @ noise), reference)
        noise = noise + share * constant - by_pose @ ahead - by_map @ delta
        pose = motion.step(pose, u, root @ noise)
        return pose, (pose, noise)

    gains = policy.steps
    data = problem.control, problem.roots, point.noise, point.path[1:]
    solved = gains.constant, gains.by_pose, gains.by_map
    _, (path, noise) = jax.lax.scan(forward, first, (*data, *solved))
    return Point(start, noise, jnp.concatenate([first[None], path]), point.landmarks + shift)
