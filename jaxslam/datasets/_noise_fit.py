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
from jaxslam.datasets._dataset import Dataset, Parameter
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.math.stats import normal_quantile


class DatasetFit(NamedTuple):
    """The parameters that `fit` found for a data set."""

    found: NoiseFit
    parameters: tuple[Parameter, ...]
    """all of them, fitted and held, in the order of `Dataset.adjustable`"""
    cov: Float[np.ndarray, "P P"]
    """of the fitted systematic errors among them, and of held ones as known beforehand; 0 of
    noises, and of those that the log does not determine"""
    held: dict[str, float]
    """the parameters that were not fitted, by name, with their values"""
    used: int
    """measurements fused or born, over which the likelihood is"""
    left_out: dict[str, int]
    """others, by status with the fitted noises"""
    rounds: int
    """how often the filter decided what to use"""
    settled: bool
    """whether it decides with the parameters found as it did before"""
    autocorrelation: tuple[float, float]
    """of successive whitened innovations of a landmark, and the half width of its 95 % band about
    0; NaN if none is seen twice. Outside of it errors persist, and standard errors are too small"""

    @property
    def values(self) -> Float[np.ndarray, "P"]:
        """The numbers of all parameters."""
        return np.array([parameter.value for parameter in self.parameters])

    @property
    def by_name(self) -> dict[str, float]:
        """The same by their names without units."""
        return {split_unit(name)[0]: value for name, value, *_ in self.parameters}


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
    if models is None:
        raise ValueError(f"fit: expected a data set with adjustable noises, got {data.name}")
    groups = tuple(calibrate)
    free = _free(models.parameters, groups, tuple(fixed))
    start, key = models.values, jax.random.key(0)
    names = [parameter.name for parameter in models.parameters]
    noise = np.array([parameter.group == "noise" for parameter in models.parameters])
    chart: dict[str, Any] = {"chart": RightInvariant()} if data.sensor.of_points else {}
    chosen = chart | data.filter_options | (options or {})
    decided = chosen | {"gate": None, "associate": Known()}

    def run_with(parameters: jax.Array, options: dict[str, Any], used: Scan | None) -> Info:
        """used: a scan with the tags and measurements to use; None for those of the log."""
        log, motion, sensor = models.at(parameters)
        if used is not None:
            log = log._replace(scan=log.scan._replace(tag=used.tag, valid=used.valid))
        method = EkfSlam(motion, sensor, data.capacity, **options)
        return run(method, log, data.pose, data.pose_cov, key).info

    def info(p: jax.Array, scan: Scan) -> Info:
        return run_with(jnp.asarray(start, p.dtype).at[free].set(p), decided, scan)

    def decide(parameters: np.ndarray) -> Info:
        # In the precision of the log, whatever that of the parameters.
        held = jnp.asarray(parameters, jnp.asarray(data.log.control).dtype)
        found: Info = jax.device_get(run_with(held, chosen, None))
        return found

    parameters = start.copy()
    info_of_log = before_fit = decide(parameters)
    settled, taken = not noise[free].any(), 0
    if settled:

        def decided_anew(p: jax.Array) -> Info:
            held = jnp.asarray(start, p.dtype).at[free].set(p)
            return run_with(held, chosen, None)

        calibrated = calibration.calibrate(decided_anew, start[free])
        parameters[free] = calibrated.parameters
        info_of_log = decide(parameters)
        found = _as_fit(calibrated, [names[i] for i in free], before_fit, info_of_log)
    while taken < _ROUNDS and not settled:
        taken += 1
        scan = as_associated(data.log, info_of_log).scan
        found = fit_noise(
            info,
            start[free],
            scan,
            names=[names[i] for i in free],
            deviation=noise[free].tolist(),
            guess=parameters[free],
        )
        parameters[free] = found.parameters
        info_of_log = decide(parameters)
        settled = _same(scan, as_associated(data.log, info_of_log).scan)
    outcome = {s.name.lower(): int((np.asarray(info_of_log.status) == s).sum()) for s in Status}
    kept = ("empty", "fused", "born")
    fitted = np.isin(np.arange(len(start)), free)
    before = np.zeros((len(start), len(start))) if models.cov is None else models.cov
    cov = np.where(fitted | fitted[:, None], 0.0, before)
    cov[np.ix_(free, free)] = found.cov
    known = ~noise & np.isfinite(np.diag(cov))
    return DatasetFit(
        found=found,
        parameters=tuple(
            parameter._replace(value=float(value))
            for parameter, value in zip(models.parameters, parameters, strict=True)
        ),
        cov=np.where(np.outer(known, known), cov, 0.0),
        held={
            names[i]: float(start[i])
            for i in np.flatnonzero(~fitted)
            if noise[i] or models.parameters[i].group in groups
        },
        used=outcome["fused"] + outcome["born"],
        left_out={name: n for name, n in outcome.items() if n and name not in kept},
        rounds=taken,
        settled=settled,
        autocorrelation=autocorrelation(info_of_log),
    )


def autocorrelation(info: Info) -> tuple[float, float]:
    """The correlation of successive innovations of a landmark, and 1.96 standard deviations of it.

    Σ w·w' / √(Σ|w|² Σ|w'|²) over all pairs, w = L⁻¹ν with S = L Lᵀ; of white innovations about 0.
    """
    fused = np.asarray(info.status) == Status.FUSED
    nu, cov = np.asarray(info.innovation)[fused], np.asarray(info.innovation_cov)[fused]
    slot = np.asarray(info.slot)[fused]
    # A part of a suite may have fewer numbers than another.
    unused = np.diagonal(cov, axis1=1, axis2=2) == 0
    cov = cov + unused[:, None, :] * np.eye(nu.shape[1])
    white = np.linalg.solve(np.linalg.cholesky(cov), nu[..., None])[..., 0]
    order = np.argsort(slot, kind="stable")  # by landmark, in order of time
    pair = slot[order][1:] == slot[order][:-1]
    one, other = white[order][:-1][pair], white[order][1:][pair]
    if not one.size:
        return np.nan, np.nan
    found = np.sum(one * other) / np.sqrt(np.sum(one**2) * np.sum(other**2))
    return float(found), normal_quantile(0.975) / float(np.sqrt(one.size))


def _as_fit(found: Calibration, names: list[str], before: Info, after: Info) -> NoiseFit:
    """The result of `calibrate` in the form of `fit_noise`, with what it found both runs to be."""

    def nis_per_dof(info: Info) -> tuple[float, int]:
        fused = np.asarray(info.status) == Status.FUSED
        dof = int(np.asarray(info.dof)[fused].sum())
        return float(np.asarray(info.nis)[fused].sum() / max(dof, 1)), dof

    error = np.sqrt(np.diag(found.cov))
    return NoiseFit(
        names=tuple(names),
        start=found.path[0],
        parameters=found.parameters,
        error=error,
        robust_error=error,
        cov=found.cov,
        log_likelihood=(float(before.log_likelihood.sum()), float(after.log_likelihood.sum())),
        nis_per_dof=(nis_per_dof(before)[0], nis_per_dof(after)[0]),
        dof=nis_per_dof(after)[1],
        path=found.path,
        converged=found.converged,
        upper={},
        loose={},
    )


def _free(
    parameters: tuple[Parameter, ...], calibrate: tuple[str, ...], fixed: tuple[str, ...]
) -> np.ndarray:
    """The indices of the parameters to fit."""
    groups = [parameter.group for parameter in parameters]
    plain = [split_unit(parameter.name)[0] for parameter in parameters]
    errors = dict.fromkeys(group for group in groups if group != "noise")
    for group in calibrate:
        if group not in errors:
            raise ValueError(
                f"fit: expected calibrate to be some of {', '.join(errors) or 'nothing'}, which "
                f"this data set can adjust, got {group!r}"
            )
    held = {split_unit(name)[0] for name in fixed}
    known = dict.fromkeys([*plain, *groups])
    for name in sorted(held - set(known)):
        raise ValueError(f"fit: expected fixed parameters of {', '.join(known)}, got {name!r}")
    free = [
        i
        for i, (name, group) in enumerate(zip(plain, groups, strict=True))
        if not held & {name, group}
        and (group in calibrate or (group == "noise" and parameters[i].value > 0))
    ]
    if not free:
        raise ValueError("fit: expected a parameter to fit, got all held")
    return np.array(free)


def _same(a: Scan, b: Scan) -> bool:
    """Whether two logs use the same measurements for the same landmarks."""
    return np.array_equal(a.tag, b.tag) and np.array_equal(a.valid, b.valid)
