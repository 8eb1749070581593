"""Peers that may be installed: what the same workload costs in another library."""

import importlib.util
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp


def dynamax_ekf(scenario, logs):
    """`dynamax`'s extended Kalman filter over logs by runs, as a call; None where not installed.

    Its state is pose and whole map from the start, under a wide prior, and its measurement all 36
    landmarks: it has neither new landmarks nor angles. So it is a measure of time alone: its
    estimates diverge where a bearing passes the seam.
    """
    if importlib.util.find_spec("dynamax") is None:
        return None
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    motion, sensor = scenario.motion, scenario.sensor
    count = len(scenario.landmarks)
    size, places = 3 + 2 * count, logs.scan.tag.shape[2]
    dtype = logs.control.dtype
    pose = jnp.asarray(scenario.pose, dtype)
    still = jnp.zeros(len(motion.noises), dtype)

    def dynamics(x, u):
        return jnp.concatenate([motion.step(x[:3], u, still), x[3:]])

    def emission(x, u):
        seen = jax.vmap(sensor.observe, in_axes=(None, 0))(x[:3], x[3:].reshape(count, 2))
        return seen.reshape(-1)

    by_noise = jax.jacfwd(motion.step, argnums=2)(pose, jnp.asarray(logs.control[0, 0]), still)
    own = by_noise @ motion.noise_cov(pose, logs.control[0, 0]) @ by_noise.T
    noise = sensor.noise_cov(logs.scan.z[0, 0, 0])
    params = ParamsNLGSSM(
        initial_mean=jnp.concatenate([pose, jnp.asarray(scenario.landmarks, dtype).reshape(-1)]),
        initial_covariance=jnp.eye(size, dtype=dtype).at[:3, :3].multiply(1e-6),
        dynamics_function=dynamics,
        dynamics_covariance=jnp.zeros((size, size), dtype).at[:3, :3].set(own),
        emission_function=emission,
        emission_covariance=jnp.kron(jnp.eye(places, dtype=dtype), noise),
    )

    def one(log):
        z = log.scan.z.reshape(log.scan.z.shape[0], -1)
        found = extended_kalman_filter(params, z, log.control, output_fields=["filtered_means"])
        return found.filtered_means[-1, :3]

    program = jax.jit(jax.vmap(one)).lower(logs).compile()
    return lambda: jax.block_until_ready(program(logs))


class Mrpt:
    """MRPT's `CRangeBearingKFSLAM2D` on a workload like it: as many corrections of as large a map,
    identities given. Compiled here, in double precision, which is all it has; `there` is False
    without CMake or MRPT's headers (Debian's `libmrpt-dev`).
    """

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.there = shutil.which("cmake") is not None and self._build()

    def _build(self) -> bool:
        source, where = Path(__file__).with_name("mrpt"), self.folder.name
        for command in (["cmake", "-S", str(source), "-B", where], ["cmake", "--build", where]):
            if subprocess.run(command, capture_output=True).returncode != 0:
                return False
        return True

    def run(self, runs: int) -> float:
        """Seconds a run, by its own clock around the filter."""
        command = [str(Path(self.folder.name) / "mrpt_slam"), str(runs)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        return float(done.stdout.split()[0])
