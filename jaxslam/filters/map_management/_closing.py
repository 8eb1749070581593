"""A filter wrapper that closes long loops and merges successive duplicates."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    instance_of,
    or_none,
    positive,
    refusals_of,
)
from jaxslam.filters._reporting import with_extra, with_removed
from jaxslam.filters.map_management._loop_closure import (
    LoopSettings,
    check_recency,
    close_loop,
    merge_histories,
    no_closing,
    successive_duplicate,
)
from jaxslam.filters.map_management._merging import Managed
from jaxslam.math._arrays import Number
from jaxslam.math._xla import change_where
from jaxslam.math.stats import chi2_quantile


@record
class Closing(Managed):
    """The filter with a search for a closed loop after each scan (`close_loop`).

    `info.extra["closing"]` is the `LoopReport` of the step; a landmark merged into an older one
    counts as removed (`info.extra["pruning"]`).

    Raises ValueError on no filter or a square-root filter, a period below 1, a reach or spread not
    above 0, or settings of another class; from `init`, on a state that is no `slots.Joint` or keeps
    no times.
    """

    filter: Filter
    """a filter that keeps times and associates without tags, as
    `EkfSlam(…, associate=association.Certain(…), life=life.Recency())`"""
    _: dataclasses.KW_ONLY
    period: int = static(default=1, check=at_least(1))
    """number of scans from one search to the next"""
    reach: Number | None = field(default=None, check=or_none(positive))
    """[m] distance below which two landmarks, one of which was initialized after the last
    measurement of the second, are merged if δ = 0 is within 99 % and √(tr cov(δ)/2) is at most
    spread, one pair a scan: so duplicates that were initialized before the loop closed are merged
    too. None merges none"""
    spread: Number = field(default=0.5, check=positive)
    """[m] see reach"""
    settings: LoopSettings = static(default=LoopSettings(), check=instance_of(LoopSettings))
    """settings of the search"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.filter.square_root:
            name = self.filter.name
            reason = f"expected one that keeps its covariance, got {name}, which keeps its root"
            raise InvalidField("filter", reason)

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = super().init(pose, pose_cov)
        with refusals_of("Closing"):
            check_recency(joint)
        return joint

    def manage(self, joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        # A merged landmark counts as removed, whichever way it was merged.
        before = joint.alive
        joint, report = change_where(
            (joint.life.now % self.period == 0) & scan.valid.any(),
            lambda state: close_loop(state[0], self.chart, self.settings),
            (joint, no_closing()),
        )
        if self.reach is not None:
            older, younger, distance = successive_duplicate(
                joint, self.chart, self.reach, self.spread
            )
            same = distance <= chi2_quantile(0.99, 2)
            joint = change_where(
                same, lambda joint: merge_histories(joint, self.chart, older, younger), joint
            )
            report = report._replace(duplicates=same.astype(jnp.int32))
        info = with_removed(info, before & ~joint.alive)
        return joint, with_extra(info, "closing", report)
