"""Checks of a log: shapes, dtypes, finite values, repeated tags."""

import jax.numpy as jnp
import numpy as np

from jaxslam.core._numbers import check_array, is_concrete, largest
from jaxslam.core.types import Log, Scan
from jaxslam.core.validation import InvalidField


def check_log(
    name: str,
    log: Log,
    *,
    control_size: int,
    measurement_size: int,
    parts: tuple[int, ...] = (),
) -> None:
    """Raise ValueError, naming caller, field and row, unless a log is well formed.

    Shapes and kinds are always checked, values (controls and valid measurements finite and at most
    `largest`, tags >= -1, of 32 bits and not repeated within a scan) only where they are concrete.
    parts: how many measurement slots each sensor has, where there are several; a tag may then occur
    once with each.
    """
    control, scan = log.control, log.scan
    if not isinstance(scan, Scan):
        got = type(scan).__name__
        raise InvalidField(name, "log.scan", f"expected a Scan(z, tag, valid), got {got}")
    z, tag, valid = scan
    check_array(f"{name}: log.control", control, ("T", control_size), np.floating)
    steps = np.shape(control)[0]
    if np.ndim(tag) != 2:  # it gives the number of measurement slots
        check_array(f"{name}: log.scan.tag", tag, (steps, "M"), np.integer)
    places = np.shape(tag)[1]
    check_array(f"{name}: log.scan.z", z, (steps, places, measurement_size), np.floating)
    check_array(f"{name}: log.scan.tag", tag, (steps, places), np.integer)
    check_array(f"{name}: log.scan.valid", valid, (steps, places), np.bool_)
    if parts and places != sum(parts):
        raise InvalidField(
            name,
            "log.scan",
            f"expected {sum(parts)} measurement slots, {' + '.join(map(str, parts))} of the "
            f"sensors, got {places}: log.scan.z of shape {np.shape(z)}",
        )
    dtype = jnp.promote_types(jnp.result_type(control), jnp.result_type(z))
    if dtype not in (jnp.float32, jnp.float64):
        reason = f"expected float32 or float64, got {dtype}"
        raise InvalidField(name, "log.control, log.scan.z", reason)
    if not is_concrete(log):
        return
    mask, tags = np.asarray(valid), np.asarray(tag)
    most = largest(control, z)
    for field, noun, values, used, advice in (
        (
            "log.control",
            "a control",
            control,
            np.ones(steps, bool),
            "correct or omit the row",
        ),
        ("log.scan.z", "a valid measurement", z, mask, "set log.scan.valid to False there"),
    ):
        size = np.abs(np.asarray(values, np.float64)).max(axis=-1, initial=0.0)
        _refuse(name, field, used & ~np.isfinite(size), f"{noun} is not finite", advice)
        _refuse(name, field, used & (size > most), f"{noun} is beyond ±{most:.2g}", advice)
    _refuse(name, "log.scan.tag", mask & (tags < -1), "a tag is below -1")
    beyond = mask & (tags > np.iinfo(np.int32).max)
    _refuse(name, "log.scan.tag", beyond, "a tag is beyond int32")
    # Unknown tags become -1, -2, … of each row, so that they repeat nothing.
    named = np.where(mask & (tags >= 0), tags, -1 - np.arange(places))
    for part in np.split(named, np.cumsum(parts)[:-1].astype(int), axis=1) if parts else (named,):
        ordered = np.sort(part, axis=1)
        repeats = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        _refuse(name, "log.scan.tag", repeats, "a tag repeats within the scan")


def _refuse(name: str, field: str, bad: np.ndarray, fault: str, advice: str = "") -> None:
    """Raise InvalidField if an entry of `bad` is set, by row or by row and measurement slot."""
    if bad.any():
        at = zip(("row", "slot"), np.argwhere(bad)[0], strict=False)
        where = ", ".join(f"{axis} {i}" for axis, i in at)
        raise InvalidField(name, field, f"{fault} ({where})" + f": {advice}" * bool(advice))
