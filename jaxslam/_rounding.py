"""What the precision of the arithmetic leaves of a run: how large rounding is beside the noise.

A covariance P and an innovation covariance S = H P Hᵀ + R are sums and differences of numbers as
large as the largest variance V of a position, so they are rounded by about eps V. That decides a
result as soon as it is not far below the noise R: of a start with σ = 30 m and ranges measured to
5 cm, float32 leaves one of its seven digits. Coordinates are rounded by eps |x|.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam.charts import Euclidean
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Log, Status, Trace
from jaxslam.math._arrays import float64
from jaxslam.math.numpy_poses import wrapped

STEPS = 1000
"""As many steps of a run, at most, are computed again in float64."""

SAME = 0.02
"""The relative difference of a run's NEES or NIS between precisions that is no doubt."""


class Rounding(NamedTuple):
    """The rounding of a run in one precision."""

    dtype: np.dtype
    variance: float
    """V, the largest variance of a position [m²]"""
    reach: float
    """|x|, the largest coordinate [m]"""
    least: float
    """λ, the least eigenvalue of the covariances R or S of the measurements; 0 of exact ones, whose
    doubt is another"""
    square_root: bool
    """whether the filter holds a root of P, which is rounded by eps √V"""
    may_be_root: bool
    """whether it could, by its option `covariance`"""
    first_order: bool
    """whether it is a method of this package that linearizes by Jacobians"""

    @property
    def of_covariance(self) -> float:
        """eps V, relative to λ."""
        return self._eps * self.variance / self.least if self.least > 0 else np.inf

    @property
    def of_position(self) -> float:
        """eps |x|, relative to √λ."""
        return self._eps * self.reach / self.least**0.5 if self.least > 0 else np.inf

    @property
    def may_decide(self) -> bool:
        """Whether a result may depend on it. Wrong verdicts of the first-order filters of the
        package have been seen from ten times this on (`python -m benchmarks --only precision`); of
        differences of sigma points, and of a user's code, nothing is known beforehand."""
        return not (self.first_order and self.of_covariance < 1e-3 and self.of_position < 1e-2)

    @property
    def doubt(self) -> str:
        """The doubt on a result that must be expected to depend on it; else ""."""
        if not self.least > 0:
            return ""
        if not self.of_position < 0.1:
            return (
                f"coordinates up to {self.reach:.3g} m are rounded by {self._eps * self.reach:.2g} "
                f"m in {self.dtype}, beside a measurement noise of {self.least**0.5:.2g}: take "
                "positions relative to a place nearby"
            )
        of_root = self._eps * (self.variance / self.least) ** 0.5
        if not (of_root if self.square_root else self.of_covariance) < 0.01:
            return (
                f"variances up to {self.variance:.3g} m² are rounded by "
                f"{self._eps * self.variance:.2g} m² in {self.dtype}, beside a measurement noise "
                f"of variance {self.least:.2g}: {self.remedy}"
            )
        return ""

    @property
    def remedy(self) -> str:
        """Advice against the rounding."""
        advice = "set jax_enable_x64" if self.dtype == np.float32 else "begin with less variance"
        if self.square_root or not self.may_be_root:
            return advice
        return (
            f'{advice}, or give the filter covariance="square_root", which keeps twice the digits'
        )

    @property
    def _eps(self) -> float:
        return float(np.finfo(self.dtype).eps)


def rounding_of(
    method: object,
    dtype: np.dtype,
    covs: Float[np.ndarray, "K 3 3"],
    places: Float[np.ndarray, "J 2"],
    least: float,
) -> Rounding:
    """The rounding of a run of a filter, or an estimator.

    V is the largest variance of the pose's position, or what its heading adds at the far end of the
    map; about the origin, in a chart that turns the map about it.

    Args:
        covs: of the pose, that of the start among them.
        places: positions, that of the start first.
        least: the least eigenvalue of R or S.
    """
    reach, size = (float(np.abs(offset).max()) for offset in (places, places - places[0]))
    turns = not isinstance(getattr(method, "chart", Euclidean()), Euclidean)
    lever = reach if turns else size
    covs = np.asarray(covs, np.float64)
    with np.errstate(all="ignore"):
        variances = np.maximum(covs[:, 0, 0], covs[:, 1, 1]) + lever**2 * covs[:, 2, 2]
    variance = float(np.abs(variances).max(initial=0.0))
    by_jacobians = getattr(getattr(method, "linearize", None), "iterates", True)
    return Rounding(
        dtype=np.dtype(dtype),
        variance=variance,
        reach=reach,
        least=least,
        square_root=bool(getattr(method, "square_root", False)),
        may_be_root=_may_be_root(method),
        first_order=by_jacobians and type(method).__module__.partition(".")[0] == "jaxslam",
    )


def _may_be_root(method: object) -> bool:
    """Whether a filter has an option by which it holds a root of P."""
    try:
        changed: Any = dataclasses.replace(method, covariance="square_root")  # type: ignore[type-var]
    except (TypeError, ValueError):  # it has no such option, or refuses this one
        return False
    return bool(changed.square_root)


class _HostTrace(NamedTuple):
    """The numbers of a run that are compared, on the host."""

    pose: Float[np.ndarray, "T 3"]
    pose_cov: Float[np.ndarray, "T 3 3"]
    status: Int[np.ndarray, "T M"]
    nis: Float[np.ndarray, "T M"]
    dof: Int[np.ndarray, "T M"]


def doubt_on_run(
    drive: Callable[..., Trace],
    arguments: tuple[Filter, Log, ArrayLike, ArrayLike, jax.Array],
    trace: Trace,
) -> str:
    """A sentence on the precision of a run, where that decides its result; else "".

    drive: called with the arguments filter, log, pose, pose_cov and key, it gives the trace. In
    float64 it computes the first `STEPS` again.
    """
    filter, log, pose, pose_cov, key = arguments
    dtype = np.dtype(trace.estimate.pose.dtype)
    start, start_cov = (np.asarray(jax.device_get(x), np.float64) for x in (pose, pose_cov))
    if dtype != np.float32 and max(np.abs(start[:2]).max(), np.abs(start_cov).max()) < 1e6:
        return ""  # without waiting for the trace
    single = _on_host(trace)
    alive, points, innovation_cov = jax.device_get(
        (trace.estimate.alive, trace.estimate.points, trace.info.innovation_cov)
    )
    fused = single.status == Status.FUSED
    variances = np.diagonal(innovation_cov, axis1=2, axis2=3)[fused]
    rounding = rounding_of(
        filter,
        dtype,
        np.concatenate([single.pose_cov, start_cov[None, :3, :3]]),
        np.concatenate([start[None, :2], single.pose[:, :2], points[-1:][alive[-1:]]]),
        float(variances[variances > 0].min(initial=np.inf)),
    )
    suspect = rounding.may_decide or (single.status == Status.SINGULAR).any()
    if dtype != np.float32 or not suspect or rounding.of_position >= 0.1:
        return rounding.doubt
    part = jax.tree.map(lambda leaf: np.asarray(jax.device_get(leaf))[:STEPS], log)
    single = jax.tree.map(lambda leaf: leaf[:STEPS], single)

    def in_float64(key: jax.Array) -> _HostTrace:
        with float64():
            control, z = part.control.astype(np.float64), part.scan.z.astype(np.float64)
            wide = Log(control, part.scan._replace(z=z))
            return _on_host(drive(filter, wide, start, start_cov, key))

    try:
        double = in_float64(key)
        difference = _difference(single, double)
        another = in_float64(jax.random.fold_in(key, 0)) if difference else double
    except Exception:  # a user's filter that computes in float32 alone
        return rounding.doubt
    if not np.array_equal(double.pose, another.pose, equal_nan=True):
        return rounding.doubt  # it draws random numbers, others in float64
    return f"precision decides: {difference}: {rounding.remedy}" if difference else ""


def _on_host(trace: Trace) -> _HostTrace:
    estimate, info = trace.estimate, trace.info
    parts = estimate.pose, estimate.pose_cov, info.status, info.nis, info.dof
    return _HostTrace(*jax.device_get(parts))


def _difference(single: _HostTrace, double: _HostTrace) -> str:
    """The difference of a run in float32 from that in float64, in words; "" within rounding."""
    both = single, double
    fused = [run.status == Status.FUSED for run in both]
    used = [int(mask.sum()) for mask in fused]
    nis = [
        np.where(mask, run.nis, 0.0).sum(dtype=np.float64) / max(run.dof.sum(), 1)
        for mask, run in zip(fused, both, strict=True)
    ]
    error = single.pose.astype(np.float64) - double.pose
    error[:, 2] = wrapped(error[:, 2])
    sigma = np.sqrt(np.maximum(np.diagonal(double.pose_cov, axis1=1, axis2=2), 0.0))
    apart = np.abs(error[sigma > 0]) / sigma[sigma > 0]
    far = float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))
    if used[0] == used[1] and abs(nis[0] - nis[1]) <= SAME * nis[1] and far < 0.1:
        return ""
    return (
        f"in float32 and in float64, {used[0]:,} and {used[1]:,} measurements are used, NIS/dof is "
        f"{nis[0]:.4g} and {nis[1]:.4g}, and poses are up to {far:.2g} σ apart"
    )
