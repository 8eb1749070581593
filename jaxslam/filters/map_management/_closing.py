"""A filter wrapper that closes long loops and merges successive duplicates."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core import _validation as validation
from jaxslam.core._numbers import check_count, check_positive
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan
from jaxslam.filters._reporting import with_extra, with_removed
from jaxslam.filters.map_management._loop_closure import (
    LoopReport,
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

    Raises ValueError on no filter or a square-root filter, on every below 1, a reach or spread not
    above 0, settings that are none; from `init`, on a state that is no `slots.Joint` or keeps no
    times.
    """

    filter: Filter
    """one that keeps times and associates without tags, as
    `EkfSlam(…, associate=association.Certain(…), life=life.Recency())`"""
    _: dataclasses.KW_ONLY
    every: int = static(default=1)
    """scans from one search to the next"""
    reach: Number | None = None
    """[m] where given, two landmarks closer than that, of which one was initialized after the other
    was last measured, are merged if δ = 0 is within 99 % and √(tr cov(δ)/2) is at most spread, one
    pair a scan: so duplicates that were initialized before the loop closed are merged too"""
    spread: Number = 0.5
    """[m]"""
    settings: LoopSettings = static(default=LoopSettings())
    """of the search"""

    def __post_init__(self) -> None:
        validation.check_record("Closing", "settings", self.settings, LoopSettings)
        super().__post_init__()
        check_count("Closing: every", self.every)
        check_positive("Closing", spread=self.spread)
        if self.reach is not None:
            check_positive("Closing", reach=self.reach)
        if self.filter.square_root:
            raise ValueError(
                f"Closing: expected a filter that keeps its covariance, got {self.filter.name}, "
                "which keeps the square root of it"
            )

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = super().init(pose, pose_cov)
        check_recency("Closing", joint, self.chart)
        return joint

    def manage(self, joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        before = joint.alive
        joint, report = change_where(
            (joint.life.now % self.every == 0) & scan.valid.any(),
            lambda state: close_loop(state[0], self.chart, self.settings),
            (joint, no_closing()),
        )
        if self.reach is not None:
            joint, report = self._merge_successive(joint, report, self.reach)
        info = with_removed(info, before & ~joint.alive)
        return joint, with_extra(info, "closing", report)

    def _merge_successive(
        self, joint: Joint, report: LoopReport, reach: Number
    ) -> tuple[Joint, LoopReport]:
        older, younger, distance = successive_duplicate(joint, self.chart, reach, self.spread)
        same = distance <= chi2_quantile(0.99, 2)
        joint = change_where(
            same, lambda joint: merge_histories(joint, self.chart, older, younger), joint
        )
        return joint, report._replace(duplicates=same.astype(jnp.int32))
