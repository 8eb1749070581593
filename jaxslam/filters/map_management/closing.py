"""A filter wrapper that closes long loops and merges successive duplicates."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam import validation
from jaxslam.core.numbers import check_count
from jaxslam.filters.map_management.loop_closure import (
    Closing,
    LoopSettings,
    check_recency,
    close_loop,
    no_closing,
)
from jaxslam.filters.map_management.successive import merge_histories, successive_duplicate
from jaxslam.filters.map_management.wrapping import joint_of, managed
from jaxslam.filters.reporting import with_extra, with_removed
from jaxslam.math.stats import chi2_quantile
from jaxslam.math.xla import change_where
from jaxslam.protocols import Filter
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


def closing(
    filter: Filter,
    *,
    every: int = 1,
    reach: float | None = None,
    spread: float = 0.5,
    settings: LoopSettings | None = None,
) -> Filter:
    """The filter with a search for a closed loop after each scan (`close_loop`).

    `info.extra["closing"]` is the `Closing` of the step; a landmark merged into an older one counts
    as removed (`info.extra["pruning"]`). The filter must keep times and associate without tags, as
    `pruning(ekf_slam(…, associate=association.certain(…)), life.recency())`.

    Args:
        filter: the filter.
        every: scans from one search to the next.
        reach: [m] where given, two landmarks closer than that, of which one was initialized after
            the other was last measured, are merged if δ = 0 is within 99 % and √(tr cov(δ)/2) is at
            most spread, one pair a scan: so duplicates that were initialized before the loop closed
            are merged too.
        spread: [m]
        settings: of the search; default `LoopSettings()`.
    Raises:
        ValueError: on no filter or a square-root filter, on every below 1, a reach or spread not
            above 0, settings that are none; from `init`, on a state that is no `slots.Joint` or
            keeps no times.
    """
    validation.check_record("closing", "filter", filter, Filter)
    check_count("closing: every", every)
    settings = LoopSettings() if settings is None else settings
    validation.check_record("closing", "settings", settings, LoopSettings)
    if not (reach is None or reach > 0) or not spread > 0:
        raise ValueError(f"closing: expected a reach and a spread above 0, got {reach}, {spread}")
    if filter.square_root:
        raise ValueError(
            f"closing: expected a filter that keeps its covariance, got {filter.name}, which keeps "
            "the square root of it"
        )
    chart, gate = filter.chart, chi2_quantile(0.99, 2)

    def init(pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = joint_of("closing", filter, filter.init(pose, pose_cov))
        check_recency("closing", joint, chart)
        return joint

    def manage(joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        before = joint.alive
        joint, report = change_where(
            (joint.life.now % every == 0) & scan.valid.any(),
            lambda state: close_loop(state[0], chart, settings),
            (joint, no_closing()),
        )
        if reach is not None:
            joint, report = merge_successive(joint, report, reach)
        info = with_removed(info, before & ~joint.alive)
        return joint, with_extra(info, "closing", report)

    def merge_successive(joint: Joint, report: Closing, reach: float) -> tuple[Joint, Closing]:
        older, younger, distance = successive_duplicate(joint, chart, reach, spread)
        same = distance <= gate
        joint = change_where(
            same, lambda joint: merge_histories(joint, chart, older, younger), joint
        )
        return joint, report._replace(duplicates=same.astype(jnp.int32))

    return managed("closing", filter, init, manage)
