"""`Status` and `Info` of the measurements of a scan, for all filters."""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxslam.core.protocols import Association
from jaxslam.core.types import Info, Scan, Status

Mask = jax.Array | None


def status_of(
    valid: jax.Array,
    *,
    matched: Mask = None,
    positive: Mask = None,
    inside: Mask = None,
    new: Mask = None,
    repeated: Mask = None,
    granted: Mask = None,
    deferred: Mask = None,
    stored: Mask = None,
    singular: Mask = None,
) -> jax.Array:
    """`Status` (M,) int32 of each measurement, from masks (M,) bool; None is False everywhere.

    The first row that holds decides:

    | measurement | status |
    |---|---|
    | not valid | EMPTY |
    | matched, S not positive definite | SINGULAR |
    | matched, outside the gate, or d² not finite | REJECTED |
    | matched | FUSED |
    | new, its tag earlier in the scan | REPEATED |
    | new, a slot granted | BORN |
    | new, beyond `births` | DEFERRED |
    | new, stored for a later initialization | SIGHTED |
    | new, with a covariance that is not positive definite | SINGULAR |
    | new, none of these: no slot is free | OVERFLOW |
    | neither matched nor new | UNMATCHED |

    A singular S is SINGULAR for any gate, since d² = νᵀ S⁻¹ ν needs S⁻¹. A measurement without a
    finite value is REJECTED by `run` before a filter processes it, and one that concerns a robot
    without a pose in the map is UNMATCHED (`TeamSlam`).

    Args:
        valid: mask of the measurements of the scan.
        matched: the measurement has a landmark (or is of an absolute sensor); wins over new.
        positive: S is positive definite, alone and together with all that are fused at once, and
            so is every matrix from which the filter computes S.
        inside: d² is finite and at most the gate. Any value where S is not positive definite.
        new: the measurement has no landmark in the map.
        repeated, granted, deferred, stored, singular: outcomes of a new measurement.
    """
    no = jnp.zeros_like(valid)
    matched, new = no if matched is None else matched, no if new is None else new
    cases: list[tuple[jax.Array, Status]] = [(~valid, Status.EMPTY)]
    if positive is not None:
        cases.append((matched & ~positive, Status.SINGULAR))
    if inside is not None:
        cases.append((matched & ~inside, Status.REJECTED))
    cases.append((matched, Status.FUSED))
    outcomes = (
        (repeated, Status.REPEATED),
        (granted, Status.BORN),
        (deferred, Status.DEFERRED),
        (stored, Status.SIGHTED),
        (singular, Status.SINGULAR),
    )
    cases += [(new & mask, status) for mask, status in outcomes if mask is not None]
    cases.append((new, Status.OVERFLOW))
    masks, statuses = zip(*cases, strict=True)
    return jnp.select(list(masks), list(statuses), Status.UNMATCHED).astype(jnp.int32)


def info_of(
    status: jax.Array,
    matched: jax.Array,
    *,
    size: int | jax.Array,
    slot: jax.Array,
    born: jax.Array | None = None,
    nis: jax.Array,
    innovation: jax.Array,
    innovation_cov: jax.Array,
    log_likelihood: jax.Array,
    exhausted: jax.Array | None = None,
    extra: dict[str, PyTree] | None = None,
) -> Info:
    """The `Info` of M measurements with these statuses, zeros where a number does not apply.

    Args:
        status: (M,), from `status_of`.
        matched: (M,) bool: measurements that were compared with their landmark.
        size: Z, the dof of a fused measurement, or (M,) int.
        slot: (M,), slot of the matched landmark.
        born: (M,), slot of the new landmark; default: there is none.
        nis, innovation, innovation_cov: (M,), (M, Z), (M, Z, Z) of the matched measurements; nis
            counts where `has_distance`.
        log_likelihood: (), of the scan.
        exhausted, extra: as in `Info`.
    """
    fused = status == Status.FUSED
    none = jnp.full_like(status, -1)
    initialized = none if born is None else jnp.where(status == Status.BORN, born, none)
    return Info(
        nis=jnp.where(has_distance(status), nis, 0.0),
        dof=jnp.where(fused, size, 0).astype(jnp.int32),
        innovation=jnp.where(matched[:, None], innovation, 0.0),
        innovation_cov=jnp.where(matched[:, None, None], innovation_cov, 0.0),
        slot=jnp.where(fused, slot, initialized).astype(jnp.int32),
        status=status,
        log_likelihood=log_likelihood,
        exhausted=exhausted,
        extra=extra,
    )


class NewLandmarks(NamedTuple):
    """The outcome of the measurements without a landmark in the map, (M,) each."""

    slot: jax.Array
    """slot of the landmark, where granted"""
    granted: jax.Array
    """a landmark was started"""
    deferred: jax.Array
    """beyond `births`"""
    repeated: jax.Array
    """its tag occurs earlier in the scan"""
    stored: Mask = None
    """kept for a later initialization; None of a filter that initializes at once"""


class Innovations(Protocol):
    """The innovations of M measurements against the prior, (M,) and more axes."""

    @property
    def innovation(self) -> jax.Array: ...
    @property
    def innovation_cov(self) -> jax.Array: ...
    @property
    def nis(self) -> jax.Array: ...
    @property
    def log_likelihood(self) -> jax.Array: ...
    @property
    def inside(self) -> jax.Array: ...
    @property
    def positive(self) -> jax.Array: ...


def report_scan(
    valid: jax.Array,
    association: Association,
    matched: jax.Array,
    innovations: Innovations,
    new: NewLandmarks | None = None,
) -> Info:
    """The `Info` of the measurements of one sensor; new is None where no landmark starts."""
    outcome = {} if new is None else {"new": association.is_new, **new._asdict()}
    born = outcome.pop("slot", None)
    status = status_of(
        valid,
        matched=matched,
        positive=innovations.positive,
        inside=innovations.inside,
        **outcome,
    )
    return info_of(
        status,
        matched,
        size=innovations.innovation.shape[1],
        slot=association.slot,
        born=born,
        nis=innovations.nis,
        innovation=innovations.innovation,
        innovation_cov=innovations.innovation_cov,
        log_likelihood=innovations.log_likelihood.sum(),
        exhausted=jnp.asarray(association.exhausted),
    )


def has_distance(status: jax.Array) -> jax.Array:
    """Mask (M,) of the measurements with a squared distance: those fused or rejected."""
    return (status == Status.FUSED) | (status == Status.REJECTED)


def info_of_ignored(scan: Scan) -> Info:
    """The `Info` of an ignored scan: every valid measurement is `Status.UNMATCHED`."""
    m, size_z = scan.z.shape
    return info_of(
        status_of(scan.valid),
        jnp.zeros_like(scan.valid),
        size=0,
        slot=jnp.full(m, -1, jnp.int32),
        nis=jnp.zeros(m, scan.z.dtype),
        innovation=jnp.zeros_like(scan.z),
        innovation_cov=jnp.zeros((m, size_z, size_z), scan.z.dtype),
        log_likelihood=jnp.zeros((), scan.z.dtype),
        exhausted=jnp.asarray(False),
    )


def join_infos(infos: list[Info], size_z: int) -> Info:
    """The `Info` of the scans of several sensors, padded with zeros to innovations of size_z."""
    if len(infos) == 1:
        return infos[0]

    def join(name: str, padded_axes: int = 0) -> jax.Array:
        values = [getattr(info, name) for info in infos]
        wide = [
            jnp.pad(value, [(0, 0)] + [(0, size_z - value.shape[-1])] * padded_axes)
            for value in values
        ]
        return jnp.concatenate(wide)

    return Info(
        nis=join("nis"),
        dof=join("dof"),
        innovation=join("innovation", 1),
        innovation_cov=join("innovation_cov", 2),
        slot=join("slot"),
        status=join("status"),
        log_likelihood=jnp.stack([info.log_likelihood for info in infos]).sum(),
        exhausted=jnp.stack([jnp.asarray(info.exhausted) for info in infos]).any(),
    )


def with_extra(info: Info, name: str, record: PyTree) -> Info:
    """The `Info` with a named record of one filter family or wrapper.

    A campaign counts what the record's method `counts` returns, if it has one: arrays by name,
    whose sums over the steps are the counts.
    """
    return info._replace(extra={**(info.extra or {}), name: record})


class Pruned(NamedTuple):
    """The landmarks removed from the map; `info.extra["pruning"]`."""

    removed: jax.Array
    """(N,) bool: slots whose landmark was removed in this step"""

    def counts(self) -> dict[str, jax.Array]:
        """The counts of a campaign."""
        return {"removed": self.removed}


def with_removed(info: Info, removed: jax.Array) -> Info:
    """The `Info` with the slots removed (N,) bool added to those marked before."""
    before = (info.extra or {}).get("pruning", Pruned(jnp.zeros_like(removed)))
    return with_extra(info, "pruning", Pruned(before.removed | removed))
