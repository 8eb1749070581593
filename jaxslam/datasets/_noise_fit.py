"""Noises and systematic errors of a data set by maximum likelihood, from its log."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam import calibration
from jaxslam._driver import run
from jaxslam.association._rules import Known
from jaxslam.calibration import Calibration, NoiseFit, as_associated, fit_noise
from jaxslam.charts import RightInvariant
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.types import Info, Scan, Status
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.datasets._dataset import Dataset, Parameter
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.math.stats import normal_quantile


class DatasetFit(NamedTuple):
    """The parameters that `fit` found for a data set."""

    noise_fit: NoiseFit
    """the fitted parameters with their errors, and the likelihood"""
    parameters: tuple[Parameter, ...]
    """all parameters, fitted and held, in the order of `Dataset.adjustable`"""
    cov: Float[np.ndarray, "P P"]
    """covariance of the parameters: of fitted systematic errors from the fit, of held ones from
    `Dataset.adjustable`; 0 of noises and of parameters that the log does not determine"""
    held: dict[str, float]
    """values by name of the parameters that were not fitted"""
    used: int
    """number of measurements in the likelihood: those fused or born"""
    left_out: dict[str, int]
    """number of other measurements by status, with the fitted noises"""
    rounds: int
    """number of passes that selected the measurements anew"""
    settled: bool
    """whether a pass with the fitted parameters selects the same measurements as before"""
    autocorrelation: tuple[float, float]
    """correlation of successive whitened innovations of a landmark, and the half width of its 95 %
    band about 0; NaN if no landmark is seen twice. Outside the band errors persist, and standard
    errors are too small"""

    @property
    def values(self) -> Float[np.ndarray, "P"]:
        """The numbers of all parameters."""
        return np.array([parameter.value for parameter in self.parameters])

    @property
    def by_name(self) -> dict[str, float]:
        """The numbers of all parameters by name without unit."""
        return {split_unit(parameter.name)[0]: parameter.value for parameter in self.parameters}


_ROUNDS = 5
"""Largest number of rounds of association and fit."""


def fit(
    data: Dataset,
    *,
    calibrate: Iterable[str] = (),
    fixed: Iterable[str] = (),
    options: dict[str, Any] | None = None,
) -> DatasetFit:
    """Noises and systematic errors of a data set that maximize the likelihood of its log.

    EKF-SLAM with the options of the data set runs over the log to associate and gate its
    measurements. With these decisions fixed, `calibration.fit_noise` maximizes the likelihood of
    the used measurements. Both are repeated, up to 5 times, until the decisions do not
    change; with known tags and without a gate that is after one round. A gate also cuts the tail of
    good measurements, so the noises come out a little too small: use a gate of 0.999 or more, or
    none. If all noises are held, `calibration.calibrate` weights the innovations by them instead,
    and decides anew at each step: a likelihood would prefer constants with which a noise that is
    too large comes out smaller. Of point landmarks the error coordinates are right-invariant,
    unless the options say others: the plain EKF gains heading that nothing measured, and fits its
    noise to it.

    Truth and survey are not used, except for the pose at the start. A deviation of 0 is held.

    Args:
        data: with `Dataset.adjustable`, as from `table` or `mrclam`.
        calibrate: groups of systematic errors to fit besides the noises: of a table "mount",
            "scale", "wheels", "heading", "range", "axis", "delay".
        fixed: names of parameters to hold, as "motion v" or "mount y", or groups, as "noise".
        options: of `EkfSlam`, in place of those of the data set, as {"gate": None}.
    Raises:
        ValueError: on a data set with fixed noises, an unknown name or group, nothing to fit, and
            as `fit_noise` does.
    """
    models = data.adjustable
    groups = tuple(calibrate)
    with refusals_of("fit"):
        if models is None:
            raise InvalidField("data", f"expected one with adjustable noises, got {data.name}")
        free = _free_indices(models.parameters, groups, tuple(fixed))
    start, key = models.values, jax.random.key(0)
    names = [parameter.name for parameter in models.parameters]
    is_noise = np.array([parameter.group == "noise" for parameter in models.parameters])
    chart: dict[str, Any] = {"chart": RightInvariant()} if data.sensor.of_points else {}
    selecting = chart | data.filter_options | (options or {})
    replaying = selecting | {"gate": None, "associate": Known()}

    def run_with(parameters: jax.Array, options: dict[str, Any], used: Scan | None) -> Info:
        """Run the filter over the log. used: the tags and measurements to use; None for all."""
        log, motion, sensor = models.at(parameters)
        if used is not None:
            log = log._replace(scan=log.scan._replace(tag=used.tag, valid=used.valid))
        method = EkfSlam(motion, sensor, data.capacity, **options)
        return run(method, log, data.pose, data.pose_cov, key).info

    def all_parameters(p: jax.Array) -> jax.Array:
        """The free parameters p among those that are held."""
        return jnp.asarray(start, p.dtype).at[free].set(p)

    def replay(p: jax.Array, scan: Scan) -> Info:
        return run_with(all_parameters(p), replaying, scan)

    def select(parameters: np.ndarray) -> Info:
        """Run the filter that associates and gates, in the precision of the log."""
        cast = jnp.asarray(parameters, jnp.asarray(data.log.control).dtype)
        info: Info = jax.device_get(run_with(cast, selecting, None))
        return info

    parameters = start.copy()
    info = info_at_start = select(parameters)
    settled, rounds = not is_noise[free].any(), 0
    if settled:  # no noise is free
        calibrated = calibration.calibrate(
            lambda p: run_with(all_parameters(p), selecting, None), start[free]
        )
        parameters[free] = calibrated.parameters
        info = select(parameters)
        result = _as_fit(calibrated, [names[i] for i in free], info_at_start, info)
    while rounds < _ROUNDS and not settled:
        rounds += 1
        scan = as_associated(data.log, info).scan
        result = fit_noise(
            replay,
            start[free],
            scan,
            names=[names[i] for i in free],
            deviation=is_noise[free].tolist(),
            guess=parameters[free],
        )
        parameters[free] = result.parameters
        info = select(parameters)
        next_scan = as_associated(data.log, info).scan
        settled = np.array_equal(scan.tag, next_scan.tag) and np.array_equal(
            scan.valid, next_scan.valid
        )
    outcome = {s.name.lower(): int((np.asarray(info.status) == s).sum()) for s in Status}
    used_or_empty = ("empty", "fused", "born")
    is_free = np.isin(np.arange(len(start)), free)
    prior = np.zeros((len(start), len(start))) if models.cov is None else models.cov
    cov = np.where(is_free | is_free[:, None], 0.0, prior)
    cov[np.ix_(free, free)] = result.cov
    is_determined = ~is_noise & np.isfinite(np.diag(cov))
    return DatasetFit(
        noise_fit=result,
        parameters=tuple(
            parameter._replace(value=float(value))
            for parameter, value in zip(models.parameters, parameters, strict=True)
        ),
        cov=np.where(np.outer(is_determined, is_determined), cov, 0.0),
        held={
            names[i]: float(start[i])
            for i in np.flatnonzero(~is_free)
            if is_noise[i] or models.parameters[i].group in groups
        },
        used=outcome["fused"] + outcome["born"],
        left_out={name: n for name, n in outcome.items() if n and name not in used_or_empty},
        rounds=rounds,
        settled=settled,
        autocorrelation=autocorrelation(info),
    )


def autocorrelation(info: Info) -> tuple[float, float]:
    """The correlation of successive innovations of a landmark, and 1.96 standard deviations of it.

    Σ w·w' / √(Σ|w|² Σ|w'|²) over all pairs, w = L⁻¹ν with S = L Lᵀ; of white innovations about 0.
    """
    fused = np.asarray(info.status) == Status.FUSED
    nu, cov = np.asarray(info.innovation)[fused], np.asarray(info.innovation_cov)[fused]
    slot = np.asarray(info.slot)[fused]
    # A sensor of a suite may have fewer numbers than another; the rest of its rows is zero.
    unused = np.diagonal(cov, axis1=1, axis2=2) == 0
    cov = cov + unused[:, None, :] * np.eye(nu.shape[1])
    white = np.linalg.solve(np.linalg.cholesky(cov), nu[..., None])[..., 0]
    order = np.argsort(slot, kind="stable")  # by landmark, in order of time
    pair = slot[order][1:] == slot[order][:-1]
    first, second = white[order][:-1][pair], white[order][1:][pair]
    if not first.size:
        return np.nan, np.nan
    correlation = np.sum(first * second) / np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(correlation), normal_quantile(0.975) / float(np.sqrt(first.size))


def _as_fit(calibrated: Calibration, names: list[str], before: Info, after: Info) -> NoiseFit:
    """The result of `calibrate` as a `NoiseFit`.

    before, after: infos of the runs with the parameters at the start and with the calibrated ones.
    """

    def nis_per_dof(info: Info) -> tuple[float, int]:
        fused = np.asarray(info.status) == Status.FUSED
        dof = int(np.asarray(info.dof)[fused].sum())
        return float(np.asarray(info.nis)[fused].sum() / max(dof, 1)), dof

    error = np.sqrt(np.diag(calibrated.cov))
    return NoiseFit(
        names=tuple(names),
        start=calibrated.path[0],
        parameters=calibrated.parameters,
        error=error,
        robust_error=error,
        cov=calibrated.cov,
        log_likelihood=(float(before.log_likelihood.sum()), float(after.log_likelihood.sum())),
        nis_per_dof=(nis_per_dof(before)[0], nis_per_dof(after)[0]),
        dof=nis_per_dof(after)[1],
        path=calibrated.path,
        converged=calibrated.converged,
        upper={},
        loose={},
    )


def _free_indices(
    parameters: tuple[Parameter, ...], calibrate: tuple[str, ...], fixed: tuple[str, ...]
) -> np.ndarray:
    """The indices of the parameters to fit."""
    groups = [parameter.group for parameter in parameters]
    names = [split_unit(parameter.name)[0] for parameter in parameters]
    errors = dict.fromkeys(group for group in groups if group != "noise")
    for group in calibrate:
        if group not in errors:
            raise InvalidField(
                "calibrate",
                f"expected some of {', '.join(errors) or 'nothing'}, which this data set can "
                f"adjust, got {group!r}",
            )
    held = {split_unit(name)[0] for name in fixed}
    allowed = dict.fromkeys([*names, *groups])
    for name in sorted(held - set(allowed)):
        raise InvalidField("fixed", f"expected some of {', '.join(allowed)}, got {name!r}")
    free = [
        i
        for i, (name, group) in enumerate(zip(names, groups, strict=True))
        if not held & {name, group}
        and (group in calibrate or (group == "noise" and parameters[i].value > 0))
    ]
    if not free:
        raise InvalidField("fixed", "expected a parameter to fit, got all held")
    return np.array(free)
