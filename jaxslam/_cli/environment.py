"""Text for the report of a problem: versions, devices, and settings of JAX."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version

import jax

from jaxslam.core._optional import first_line

_PACKAGES = (
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "matplotlib",
    "jaxtyping",
    "rosbags",
    "distributed",
    "mpi4py",
    "cloudpickle",
)


def environment_text(verbose: bool) -> str:
    """The line of versions.

    verbose: also other packages, the machine, JAX's devices, and the environment variables that
    change JAX.
    """
    first = (
        f"jaxslam {version('jaxslam')} (jax {jax.__version__}, Python {platform.python_version()})"
    )
    if not verbose:
        return first
    lines = [first, f"{platform.platform()}, {os.cpu_count()} processors"]
    for name in _PACKAGES:
        try:
            lines.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            lines.append(f"{name}: not installed")
    try:
        lines += [f"device {d.id}: {d.platform}, {d.device_kind}" for d in jax.devices()]
    except Exception as error:  # of a plugin without its device
        lines.append(f"device: none ({first_line(error)})")
    flags = sorted(name for name in os.environ if name.startswith(("JAX_", "XLA_", "JAXSLAM_")))
    return "\n".join([*lines, *(f"{name}={os.environ[name]}" for name in flags)])
