"""A filter over a recorded log: its run, its errors and its entries of the summary."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxslam._cli.campaigns.piecewise import PiecewiseRun, run_in_pieces
from jaxslam._cli.recorded.filter_choice import chosen_filters
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core.protocols import Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Log, Status
from jaxslam.datasets import Dataset
from jaxslam.datasets._evaluation import Evaluation, evaluate, joint_map_cov
from jaxslam.datasets._uncertain_constants import consider_constants
from jaxslam.math._definite import is_indefinite
from jaxslam.results._files import Json

MAX_NIS_PER_DOF, MAX_NEES_RATIO = 30.0, 100.0
"""NIS / dof, and the NEES of pose or landmarks over the honest one, above which noises are not the
cause: innovations of 5 σ, errors of 10 σ."""
FITTING_NIS_PER_DOF = 3.0
"""NIS / dof up to which innovations fit, with noises that may be somewhat small."""

WRONG_UNITS = "models or units are wrong (degrees under [rad], millimetres under [m], the mount)"


class FilterRun(NamedTuple):
    """The results of a filter on a data set."""

    result: PiecewiseRun
    evaluation: Evaluation
    summary: Json


def run_filter(
    name: str,
    filter: Filter,
    data: Dataset,
    film_steps: Int[np.ndarray, "F"] | None = None,
    innovations: bool = False,
) -> FilterRun:
    """Run one filter over a data set; the covariance is checked if the state has P.

    film_steps: the steps whose whole estimates are kept for a film; None without one.
    innovations: whether the infos are kept (`PiecewiseRun.kept`).
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    pose, pose_cov = np.asarray(data.pose, np.float64), np.asarray(data.pose_cov, np.float64)
    state = jax.eval_shape(filter.init, pose, pose_cov)
    # The square-root filter holds a factor of P, so its P cannot lose definiteness.
    has_covariance = isinstance(state, Joint) and name != "square_root"
    log, unplaced = on_true_poses(data) if name == "mapping" else (data.log, 0)
    with Progress(f"{data.name}, {name}", "steps") as progress:
        began = time.perf_counter()
        # The reader has checked the values; `asarray` converts the log to the chosen dtype.
        result = run_in_pieces(
            filter,
            jax.tree.map(jnp.asarray, log),
            pose,
            pose_cov,
            progress=progress,
            check=(lambda state: is_positive_definite(np.asarray(state.cov)))
            if has_covariance
            else None,
            at=film_steps,
            watch=plot.probe,
            keep=(lambda info: info._replace(extra=None)) if innovations else (lambda info: None),
        )
    seconds = time.perf_counter() - began
    map_cov, constants = joint_map_cov(filter, result.final), ""
    if data.adjustable is not None and data.adjustable.cov is not None:
        constants = "left out"
    if has_covariance:
        added = consider_constants(data, lambda *models: chosen_filters(data, name, models)[name])
        if added is not None:
            constants = "added"
            # (N, 2, N, 2) -> (N, 2, 2): the blocks of each landmark with itself.
            point_covs = np.moveaxis(np.diagonal(added.points, axis1=0, axis2=2), -1, 0)
            path, last = result.path, result.last
            result = result._replace(
                path=path._replace(pose_cov=path.pose_cov + added.pose),
                last=last._replace(
                    pose_cov=last.pose_cov + added.pose[-1],
                    point_covs=last.point_covs + point_covs,
                ),
            )
            map_cov = None if map_cov is None else map_cov + added.points
    evaluation = evaluate(data, result.path, result.last, map_cov)
    summary = _summary(result, unplaced, constants, seconds) | evaluation.errors
    if evaluation.map_test is not None:
        summary |= evaluation.map_test.rows()
    notes = suspicions(summary)
    return FilterRun(result, evaluation, summary | ({"notes": notes} if notes else {}))


def on_true_poses(data: Dataset) -> tuple[Log, int]:
    """The log with true poses as controls, for mapping, and the number of measurements left out.

    Without a true pose, the measurements are left out and the control is the last known pose.
    """
    assert data.true_path is not None
    is_placed = np.ones(data.steps, bool) if data.true_at is None else data.true_at
    scan = data.log.scan
    valid = np.asarray(scan.valid) & is_placed[:, None]
    # The last row with a true pose, before the first such row the first one.
    row = np.where(is_placed, np.arange(data.steps), int(np.argmax(is_placed)))
    latest = np.maximum.accumulate(row)
    left_out = int(np.sum(scan.valid)) - int(valid.sum())
    return Log(jnp.asarray(data.true_path[latest]), scan._replace(valid=valid)), left_out


def is_positive_definite(cov: Float[np.ndarray, "D D"]) -> bool:
    """Whether a covariance is finite and has no negative eigenvalue; 0 may be one."""
    return bool(np.isfinite(cov).all()) and not is_indefinite(cov)


def _summary(result: PiecewiseRun, unplaced: int, constants: str, seconds: float) -> Json:
    """The entries of the summary that the run alone determines.

    Args:
        unplaced: number of measurements left out for want of a true pose.
        constants: what became of the uncertainty of calibrated constants; "" if there is none.
    """
    nis = np.where(result.status == Status.FUSED, result.nis, 0.0).sum()
    dof = int(result.dof.sum())
    definite = "not checked"
    if result.checked:
        definite = f"at {sum(result.passed)} of {len(result.passed)} checked steps"
        failed = [k for k, passed in zip(result.checked, result.passed, strict=True) if not passed]
        if failed:
            ellipsis = ", …" if len(failed) > 5 else ""
            definite += f", not at {', '.join(map(str, failed[:5]))}{ellipsis}"
    innovations = {  # of filters that have innovations
        "NIS / dof": float(nis / max(dof, 1)),
        "log-likelihood": float(result.log_likelihood.sum()),
    }
    return {
        "landmarks": int(result.last.alive.sum()),
        "status": {
            s.name.lower(): int((result.status == s).sum()) for s in Status if s != Status.EMPTY
        },
        **({"measurements without a true pose, left out": unplaced} if unplaced else {}),
        **(innovations if dof else {}),
        "P positive definite": definite,
        **({"uncertainty of constants": constants} if constants else {}),
        "final pose": [float(value) for value in result.last.pose],
        "seconds": round(seconds, 2),
    }


def suspicions(summary: Json) -> list[str]:
    """Sentences on numbers of a run that no honest filter with the models of the data has."""
    status = summary["status"]
    assert isinstance(status, dict)
    nis, total = float(str(summary.get("NIS / dof", 0.0))), sum(status.values())
    if nis > MAX_NIS_PER_DOF:
        return [f"NIS / dof is {nis:.4g}, where 1 is honest: {WRONG_UNITS}"]
    if (rejected := status["rejected"]) > total / 2:
        return [f"the gate rejects {rejected:,} of {total:,}: {WRONG_UNITS}"]
    notes = []
    for name, value in summary.items():
        if name.startswith("pose NEES, median"):
            reference, honest = "truth", 2.37  # the median of χ² with 3 degrees of freedom
        elif name.startswith("landmark NEES"):
            reference, honest = "survey", 2.0
        else:
            continue
        if (nees := float(str(value))) > honest * MAX_NEES_RATIO:
            large = f"{name.partition(' (')[0]} is {nees:.4g}, where {honest:g} is honest"
            if nis > FITTING_NIS_PER_DOF:
                notes.append(f"{large}, and NIS / dof is {nis:.4g}: {WRONG_UNITS}")
                continue
            notes.append(
                f"{large}, though the innovations fit: the {reference} may have other units "
                "(degrees under [rad], millimetres under [m]), stamps or axes than the log"
            )
    return notes
