"""The noises of a data set by maximum likelihood, from its log."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.association.rules import Known
from jaxslam.calibration import NoiseFit, as_associated, fit_noise
from jaxslam.core.logs.tables import POSE, split_unit
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Info, JaxOrNumPy, Log, Status
from jaxslam.datasets.dataset import Adjustable, Dataset
from jaxslam.driver import run
from jaxslam.filters.ekf.ekf_settings import EkfOptions
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.math.stats import normal_quantile


class DatasetFit(NamedTuple):
    """The noises that `fit` found for a data set."""

    found: NoiseFit
    deviations: tuple[float, ...]
    """all of them, fitted and held, in the order of `Dataset.adjustable`"""
    mount: tuple[float, ...] | None
    held: dict[str, float]
    """the parameters that were not fitted, by name, with their values"""
    used: int
    """measurements fused or born, over which the likelihood is"""
    left_out: dict[str, int]
    """others, by status with the fitted noises"""
    rounds: int
    """how often the filter decided what to use"""
    settled: bool
    """whether it decides with the noises found as it did before"""
    autocorrelation: tuple[float, float]
    """of successive whitened innovations of a landmark, and the half width of its 95 % band about
    0; NaN if none is seen twice. Outside of it errors persist, and standard errors are too small"""


_ROUNDS = 5
"""Largest number of rounds of association and fit."""


def fit(data: Dataset, *, mount: bool = False, fixed: Iterable[str] = ()) -> DatasetFit:
    """The standard deviations of the noises of a data set that maximize the likelihood of its log.

    EKF-SLAM with the options of the data set runs over the log to associate and gate its
    measurements. With these decisions fixed, `calibration.fit_noise` maximizes the likelihood of
    the used measurements. Both are repeated, up to 5 times, until the decisions do not
    change; with known tags and without a gate that is after one round. A gate also cuts the tail of
    good measurements, so the noises come out a little too small: use a gate of 0.999 or more, or
    none.

    Truth and survey are not used, except for the pose at the start. A deviation of 0 is held.

    Args:
        data: with `Dataset.adjustable`, as from `table`.
        mount: whether the pose of the sensor on the robot is fitted, too.
        fixed: names of parameters to hold, as "motion v" or "mount y".
    Raises:
        ValueError: on a data set with fixed noises, a sensor without a mount, an unknown name,
            nothing to fit, and as `fit_noise` does.
    """
    models = data.adjustable
    if models is None:
        raise ValueError(f"fit: expected a data set with adjustable noises, got {data.name}")
    names, values, free = _parameters(models, mount, tuple(fixed))
    count, key = len(models.deviations), jax.random.key(0)
    decided = data.filter_options | {"gate": None, "associate": Known()}

    def filter(parameters: JaxOrNumPy, options: EkfOptions) -> Filter:
        fitted = mount and models.mount is not None
        place = parameters[count:] if fitted else models.mount
        motion, sensor = models.models(parameters[:count], place)
        return EkfSlam(motion, sensor, data.capacity, **options)

    def info(p: jax.Array, log: Log) -> Info:
        parameters = jnp.asarray(values, p.dtype).at[free].set(p)
        return run(filter(parameters, decided), log, data.pose, data.pose_cov, key).info

    def decide(parameters: np.ndarray) -> Info:
        method = filter(parameters, data.filter_options)
        found: Info = jax.device_get(run(method, data.log, data.pose, data.pose_cov, key).info)
        return found

    parameters, logged = np.array(values), np.arange(len(values)) < count
    info_of_log = decide(parameters)
    settled, taken = False, 0
    while taken < _ROUNDS and not settled:
        taken += 1
        log = as_associated(data.log, info_of_log)
        found = fit_noise(
            info,
            values[free],
            log,
            names=[names[i] for i in free],
            deviation=logged[free].tolist(),
            guess=parameters[free],
        )
        parameters[free] = found.parameters
        info_of_log = decide(parameters)
        settled = _same(log, as_associated(data.log, info_of_log))
    outcome = {s.name.lower(): int((np.asarray(info_of_log.status) == s).sum()) for s in Status}
    kept = ("empty", "fused", "born")
    return DatasetFit(
        found=found,
        deviations=tuple(parameters[:count].tolist()),
        mount=tuple(parameters[count:].tolist()) if mount else models.mount,
        held={
            names[i]: float(values[i])
            for i in np.flatnonzero(~np.isin(np.arange(len(values)), free))
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


def _parameters(
    models: Adjustable, mount: bool, fixed: tuple[str, ...]
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The names and values of all parameters, and the indices of those to fit."""
    names, values = models.names, models.deviations
    if mount:
        if models.mount is None:
            raise ValueError("fit: expected a sensor with a mount, got one without")
        names += tuple(f"mount {name}" for name in POSE)
        values += models.mount
    plain = [split_unit(name)[0] for name in names]
    held = {split_unit(name)[0] for name in fixed}
    for name in held - set(plain):
        raise ValueError(f"fit: expected fixed parameters of {', '.join(plain)}, got {name!r}")
    free = [
        i
        for i, name in enumerate(plain)
        if name not in held and (i >= len(models.deviations) or values[i] > 0)
    ]
    if not free:
        raise ValueError("fit: expected a parameter to fit, got all held")
    return names, np.array(values), np.array(free)


def _same(one: Log, other: Log) -> bool:
    """Whether two logs use the same measurements for the same landmarks."""
    a, b = one.scan, other.scan
    return np.array_equal(a.tag, b.tag) and np.array_equal(a.valid, b.valid)
