"""Odometry and laser scans as the log that `run` takes, and its scans as beams again."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.numbers import is_concrete
from jaxslam.types import Beams, Log, Scan

BEAM = ("range [m]", "angle [rad]")
"""The measurements of such a log."""

BEAM = ("range [m]", "angle [rad]")
"""The measurements of such a log."""

NOTHING = 1e6
"""Range [m] in a log of a beam that met nothing and is infinite in the scan: a log is finite."""


def beam_log(control: ArrayLike, beams: Beams) -> Log:
    """The log of T controls and T scans of B beams: measurements (range, angle), without tags.

    A beam that says nothing (`Beams`) is not valid in the log. An infinite range becomes `NOTHING`.
    Arrays are NumPy's, within a trace JAX's.

    Args:
        control: (T, U) of the motion model; row t led to where scan t was taken.
        beams: with leading T.
    Raises:
        ValueError: shapes that do not fit; outside a trace, angles of valid beams that are not
            finite, or no valid beam at all.
    """
    if not isinstance(beams, Beams):
        raise ValueError(f"beam_log: expected Beams, got {type(beams).__name__}")
    shapes = [np.shape(part) for part in beams]
    if len(shapes[0]) != 2 or len(set(shapes)) != 1:
        told = ", ".join(map(str, shapes))
        raise ValueError(f"beam_log: expected as many ranges, angles and masks (T, B), got {told}")
    steps = shapes[0][0]
    if np.ndim(control) != 2 or np.shape(control)[0] != steps:
        raise ValueError(
            f"beam_log: expected a control (U,) for each of {steps} scans, got {np.shape(control)}"
        )
    concrete = is_concrete(control, beams)
    xp: ModuleType = np if concrete else jnp
    moved, ranges, angle, valid = (xp.asarray(part) for part in (control, *beams))
    met, free = Beams(ranges, angle, valid).returns()
    usable = xp.asarray(met | free)
    if concrete:
        lost = valid & (ranges > 0) & ~np.isfinite(angle)
        if lost.any():
            step = int(np.argmax(lost.any(axis=1)))
            raise ValueError(f"beam_log: scan {step}: the angle of a valid beam is not finite")
        if not usable.any():
            raise ValueError(f"beam_log: none of {steps} scans has a valid beam")
    z = xp.stack([xp.minimum(ranges, NOTHING), angle], axis=-1)
    scan = Scan(
        z=xp.where(usable[..., None], z, 0.0).astype(moved.dtype),
        tag=xp.full(shapes[0], -1, np.int32),
        valid=usable,
    )
    return Log(moved, scan)


def beams_of(scan: Scan, every: int) -> Beams:
    """Each n-th beam of a scan of such a log; those not valid are of range 0."""
    z, there = scan.z[::every], scan.valid[::every]
    used = there & (z[:, 0] > 0)
    clean = jnp.where(used[:, None], z, 0.0)
    return Beams(clean[:, 0], clean[:, 1], used)
