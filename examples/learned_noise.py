"""Noise as a small network of measurement and control, trained by the filter's likelihood.

    python examples/learned_noise.py

The log is simulated: the noise of ranges grows with the range, that of the heading with the turn
rate. `python -m benchmarks --only learned_noise` trains the same networks on MRCLAM.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike

import jaxslam
from jaxslam.core.record import record, static


@record
class Network:
    """Standard deviations of two noises, exp(base + out tanh(hidden [x / scale, 1]))."""

    base: ArrayLike  # (2,)
    hidden: ArrayLike  # (H, 3)
    out: ArrayLike  # (2, H)
    scale: tuple[float, float] = static()

    def sigma(self, x: jax.Array) -> jax.Array:
        """(2,) of two inputs."""
        inputs = jnp.append(x / jnp.array(self.scale), 1.0)
        return jnp.exp(self.base + self.out @ jnp.tanh(self.hidden @ inputs))


@record
class OfMeasurement(Network):
    """R of range and bearing, by the predicted measurement."""

    def __call__(self, z: jax.Array) -> jax.Array:
        return jnp.diag(self.sigma(z) ** 2)


@record
class OfControl(Network):
    """Q of the velocities of `motion.Velocity`: white noise of σ(v, ω) a √second."""

    def __call__(self, pose: jax.Array, u: jax.Array) -> jax.Array:
        moves = u[2] > 0
        rate = jnp.where(moves, 1 / jnp.where(moves, u[2], 1.0), 0.0)
        return jnp.diag(jnp.append(self.sigma(u[:2]) ** 2, 0.0) * rate)


def constant(sigma: Any, width: int = 8, seed: int = 0) -> tuple[OfControl, OfMeasurement]:
    """Networks whose output is sigma (4,) until they are trained."""
    hidden = np.random.default_rng(seed).normal(size=(2, width, 3))
    base, out = jnp.log(jnp.asarray(sigma)), np.zeros((2, width))
    first = OfControl(base[:2], hidden[0], out, (0.2, 0.5))
    return first, OfMeasurement(base[2:], hidden[1], out, (2.0, 0.5))


def train(cost: Any, noises: Any, steps: int = 150, rate: float = 0.02) -> Any:
    """The noises after some steps of Adam down the cost."""
    optimizer = optax.adam(rate)

    @jax.jit
    def step(noises: Any, state: Any) -> Any:
        updates, state = optimizer.update(jax.grad(cost)(noises), state)
        return optax.apply_updates(noises, updates), state

    state = optimizer.init(noises)
    for _ in range(steps):
        noises, state = step(noises, state)
    return noises


def true_sigma(z: jax.Array) -> jax.Array:
    """Standard deviations of range and bearing in the simulation, (2,)."""
    return jnp.stack([0.02 + 0.01 * z[0] ** 2, 0.02 + 0.0 * z[0]])


def true_rate(u: jax.Array) -> jax.Array:
    """Standard deviations of travel [m/√s] and heading [rad/√s] in the simulation, (2,)."""
    return jnp.stack([0.02 + 0.0 * u[1], 0.01 + 0.1 * jnp.abs(u[1])])


POSTS = np.array([[1.0, 1.0], [3.0, -1.0], [-1.0, 3.0], [4.0, 4.0], [-3.0, -2.0]])


def simulated(runs: int, seed: int, steps: int = 150) -> Any:
    """Logs of a robot that drives straight and turns, in rows of 0.2 s."""
    control = np.tile([0.3, 0.0, 0.2], (steps, 1))
    control[:, 1] = np.where(np.arange(steps) // 25 % 2 == 0, 0.1, 0.8)

    def cov(pose: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.diag(jnp.append(true_rate(u) ** 2, 0.0)) / u[2]

    sensor = jaxslam.sensors.RangeBearing(lambda z: jnp.diag(true_sigma(z) ** 2))
    motion = jaxslam.motion.Velocity(cov)
    world = jaxslam.Scenario("posts", motion, sensor, landmarks=POSTS, controls=control)
    keys = jax.random.split(jax.random.key(seed), runs)
    return jax.device_get(jax.jit(jax.vmap(lambda key: jaxslam.simulate(world, key)[1]))(keys))


def info(noises: Any, logs: Any) -> Any:
    """The innovations of the EKF with these noises in each log."""
    models = jaxslam.motion.Velocity(noises[0]), jaxslam.sensors.RangeBearing(noises[1])
    ekf = jaxslam.filters.EkfSlam(*models, capacity=len(POSTS), correction="joint")
    start = np.zeros(3), np.zeros((3, 3)), jax.random.key(0)
    return jax.vmap(lambda log: jaxslam.run(ekf, log, *start).info)(logs)


def main() -> None:
    """Train on four logs; log L of a component and NIS/dof in others."""
    jax.config.update("jax_enable_x64", True)
    logs, others = simulated(4, seed=0), simulated(16, seed=1)
    start = np.array([0.02, 0.05, 0.1, 0.02])
    fit = jaxslam.calibration.fit_noise(
        lambda sigma, logs: info(constant(sigma), logs), start, logs
    )
    first = constant(fit.parameters)
    learned = train(lambda noises: -info(noises, logs).log_likelihood.sum() / fit.dof, first)
    for name, noises in (("constant", first), ("learned", learned)):
        found = jax.jit(info)(noises, others)
        dof = found.dof.sum()
        likelihood, nis = found.log_likelihood.sum() / dof, found.nis.sum() / dof
        print(f"{name:10} log L / dof {likelihood:.3f}, NIS/dof {nis:.3f}")


if __name__ == "__main__":
    main()
