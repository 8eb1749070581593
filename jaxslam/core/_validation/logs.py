"""The check of a log: shapes, dtypes, finite values, repeated tags."""

import jax.numpy as jnp
import numpy as np

from jaxslam.core._numbers import is_concrete, largest
from jaxslam.core.types import Log, Scan
from jaxslam.core.validation import Check, InvalidField, array_of, instance_of, require


def log_of(control_size: int, measurement_size: int, parts: tuple[int, ...] = ()) -> Check:
    """The check of a log of these sizes; what it refuses names field, row and slot.

    Shapes and kinds are always checked, values (controls and valid measurements finite and at most
    `largest`, tags >= -1, of 32 bits and not repeated within a scan) only where they are concrete.
    parts: how many measurement slots each sensor has, where there are several; a tag may then occur
    once with each.
    """

    def check(value: Log) -> Log:
        log: Log = instance_of(Log)(value)
        control, scan = log.control, log.scan
        if not isinstance(scan, Scan):
            got = type(scan).__name__
            raise InvalidField("scan", f"expected a Scan(z, tag, valid), got {got}")
        z, tag, valid = scan
        require("control", control, array_of("T", control_size, kind=np.floating))
        steps = np.shape(control)[0]
        if np.ndim(tag) != 2:  # it gives the number of measurement slots
            require("scan.tag", tag, array_of(steps, "M", kind=np.integer))
        places = np.shape(tag)[1]
        require("scan.z", z, array_of(steps, places, measurement_size, kind=np.floating))
        require("scan.tag", tag, array_of(steps, places, kind=np.integer))
        require("scan.valid", valid, array_of(steps, places, kind=np.bool_))
        if parts and places != sum(parts):
            raise InvalidField(
                "scan",
                f"expected {sum(parts)} measurement slots, {' + '.join(map(str, parts))} of the "
                f"sensors, got {places}: log.scan.z of shape {np.shape(z)}",
            )
        dtype = jnp.promote_types(jnp.result_type(control), jnp.result_type(z))
        if dtype not in (jnp.float32, jnp.float64):
            raise InvalidField("", f"expected control, scan.z of float32 or float64, got {dtype}")
        if not is_concrete(log):
            return log

        # Numbers are finite and of a size to compute with, and no tag repeats.
        mask, tags = np.asarray(valid), np.asarray(tag)
        most = largest(control, z)
        for field, noun, values, used, advice in (
            ("control", "a control", control, np.ones(steps, bool), "correct or omit the row"),
            ("scan.z", "a valid measurement", z, mask, "set log.scan.valid to False there"),
        ):
            size = np.abs(np.asarray(values, np.float64)).max(axis=-1, initial=0.0)
            _refuse(field, used & ~np.isfinite(size), f"{noun} is not finite", advice)
            _refuse(field, used & (size > most), f"{noun} is beyond ±{most:.2g}", advice)
        _refuse("scan.tag", mask & (tags < -1), "a tag is below -1")
        _refuse("scan.tag", mask & (tags > np.iinfo(np.int32).max), "a tag is beyond int32")
        # Unknown tags become -1, -2, … of each row, so that they repeat nothing.
        named = np.where(mask & (tags >= 0), tags, -1 - np.arange(places))
        for part in (
            np.split(named, np.cumsum(parts)[:-1].astype(int), axis=1) if parts else (named,)
        ):
            ordered = np.sort(part, axis=1)
            repeats = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
            _refuse("scan.tag", repeats, "a tag repeats within the scan")
        return log

    return check


def _refuse(field: str, bad: np.ndarray, fault: str, advice: str = "") -> None:
    """Raise InvalidField if an entry of `bad` is set, by row or by row and measurement slot."""
    if bad.any():
        at = zip(("row", "slot"), np.argwhere(bad)[0], strict=False)
        place = ", ".join(f"{axis} {i}" for axis, i in at)
        raise InvalidField(field, f"{fault} ({place})" + f": {advice}" * bool(advice))
