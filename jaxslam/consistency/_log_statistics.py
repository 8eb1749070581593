"""Statistics of the innovations of one run: what its log says of the models, without a truth.

Each is a number whose distribution under the models the twins of the log show (`_model_check`). A
statistic has a family, which says what it points to, and a detail. By NumPy, on the host.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.consistency._planted_faults import WINDOWS, Shape, window_rows
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Info, Status
from jaxslam.math.stats import chi2_quantile

LAGS = 10
"""Largest lag of the autocorrelation, in measurements of one landmark."""

_FEW = 10
"""Measurements of a landmark, or of a part of the log, from which on it is judged alone."""

_TAIL = 0.99
"""The quantile of the NIS above which a measurement is in the tail."""

GENERAL = ("NIS / dof", "size", "rejected by the gate", "log-likelihood")
"""Families that every error of the models changes, and that name none."""

_PARTS = ("lower third", "middle third", "upper third")


class Rates(NamedTuple):
    """How the robot moves in each row, by its odometry; the same for a log and its twins."""

    speed: Float[np.ndarray, "T"]
    """[m/s], or [m] a row"""
    turn: Float[np.ndarray, "T"]
    """[rad/s], or [rad] a row"""


class Statistic(NamedTuple):
    """A statistic of a run."""

    family: str
    detail: str
    """which component, landmark, lag or part; "" of all"""
    value: float
    """as it is shown; NaN where the run does not have it"""
    score: float
    """the value on a scale on which it spreads evenly, for tails: a logarithm, a root"""
    place: str = ""
    """where a largest value is: the landmark, the part of the log"""
    spread: float = 0.0
    """least deviation of the score, where that of few runs may be 0"""

    @property
    def name(self) -> str:
        """Family and detail."""
        return f"{self.family}, {self.detail}" if self.detail else self.family


def fused_of(info: Info) -> Bool[np.ndarray, "*runs T M"]:
    """Which measurements a filter fused, with an innovation whose covariance is known."""
    variances = np.diagonal(np.asarray(info.innovation_cov), axis1=-2, axis2=-1)
    fused: np.ndarray = (np.asarray(info.status) == Status.FUSED) & (variances > 0).all(axis=-1)
    return fused


class FusedInnovations(NamedTuple):
    """The fused measurements of a run, in the order of rows and slots."""

    nu: Float[np.ndarray, "K Z"]
    cov: Float[np.ndarray, "K Z Z"]
    nis: Float[np.ndarray, "K"]
    row: Int[np.ndarray, "K"]
    slot: Int[np.ndarray, "K"]
    predicted: Float[np.ndarray, "K Z"]
    """ẑ"""
    unit: Float[np.ndarray, "K Z"]
    """ν over its own standard deviation"""
    white: Float[np.ndarray, "K Z"]
    """L⁻¹ ν with L Lᵀ = S"""

    @classmethod
    def of(
        cls, info: Info, z: Float[np.ndarray, "T M Z"], sensor_names: tuple[str, ...]
    ) -> "FusedInnovations":
        """The fused innovations among the infos of a run whose scans had z."""
        fused = fused_of(info)
        row = np.nonzero(fused)[0]
        nu = np.asarray(info.innovation, np.float64)[fused]
        cov = np.asarray(info.innovation_cov, np.float64)[fused]
        deviation = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        white = np.empty_like(nu)
        factor = np.linalg.cholesky(cov)
        for i in range(nu.shape[1]):  # forward substitution, over all at once
            rest = nu[:, i] - np.einsum("kj,kj->k", factor[:, i, :i], white[:, :i])
            white[:, i] = rest / factor[:, i, i]
        turns = np.array([name.endswith("[rad]") for name in sensor_names])
        predicted = np.asarray(z, np.float64)[fused] - nu
        wrapped = predicted - 2 * np.pi * np.ceil((predicted - np.pi) / (2 * np.pi))
        return cls(
            nu=nu,
            cov=cov,
            nis=np.asarray(info.nis, np.float64)[fused],
            row=row,
            slot=np.asarray(info.slot)[fused],
            predicted=np.where(turns, wrapped, predicted),
            unit=nu / deviation,
            white=white,
        )


def statistics_of(
    info: Info,
    z: Float[np.ndarray, "T M Z"],
    valid: Bool[np.ndarray, "T M"],
    sensor: Sensor,
    rates: Rates,
    time: Float[np.ndarray, "T"],
    shapes: tuple[list[Shape], list[Shape]],
) -> list[Statistic]:
    """The statistics of a run, in the same order of every run of a log and its twins.

    Args:
        info: (T, M) of the filter.
        z, valid: of the scans.
        sensor: for the names of what it measures.
        rates: of the robot. time: of the rows.
        shapes: of the faults, and of slips in parts of the log.
    """
    run = FusedInnovations.of(info, z, sensor.measurements)
    size = run.nu.shape[1]
    statistics = [*_sizes(run, sensor, rates, time), *_correlations(run, sensor, rates)]

    # The tails of the distribution, whatever the size.
    limit = float(chi2_quantile(_TAIL, size)) * _mean(run.nis)
    beyond = tail_count(np.sort(size * run.nis), limit)
    statistics.append(_count("tail", "above the 99 % quantile", beyond, max(len(run.nis), 1)))
    for i, name in enumerate(_names(sensor)):
        square = _mean(run.unit[:, i] ** 2)
        kurtosis = _mean(run.unit[:, i] ** 4) / square**2 if square > 0 else np.nan
        statistics.append(_positive("kurtosis", name, kurtosis))

    # The amount of each fault, and the slip of the part of the log in which it is clearest.
    innovation = np.where(fused_of(info)[..., None], np.asarray(info.innovation, np.float64), 0.0)
    faults, slips = shapes
    for shape in faults:
        amount = shape.amount(innovation)
        statistics.append(Statistic("fault", shape.fault.name, amount, amount))
    if slips:
        amounts = np.array([shape.amount(innovation) for shape in slips])
        clear = np.abs(amounts) * np.sqrt([shape.information for shape in slips])
        k = int(np.argmax(clear))
        score = float(np.log(clear[k]))
        statistics.append(Statistic("fault", "slip", float(amounts[k]), score, str(k)))

    rejected = int((np.asarray(info.status) == Status.REJECTED).sum())
    statistics.append(_count("rejected by the gate", "", rejected, max(int(valid.sum()), 1)))
    likelihood = float(np.asarray(info.log_likelihood, np.float64).sum())
    statistics.append(Statistic("log-likelihood", "", likelihood, likelihood))
    return statistics


def _sizes(
    run: FusedInnovations, sensor: Sensor, rates: Rates, time: Float[np.ndarray, "T"]
) -> Iterator[Statistic]:
    """The size of the innovations: in all, by component, by what is measured, landmark and time."""
    size = run.nu.shape[1]
    yield _positive("NIS / dof", "", run.nis.sum() / max(size * len(run.nis), 1))
    for i, name in enumerate(_names(sensor)):
        yield _positive("size", name, _mean(run.unit[:, i] ** 2))
        # The mean ν of most weight; its standard deviation is that of the mean of ν / σ.
        weight = 1 / run.cov[:, i, i]
        mean = (run.nu[:, i] * weight).sum() / weight.sum() if len(weight) else np.nan
        yield Statistic("mean", name, float(mean), float(mean))
    by = _polar(run, sensor) | {"turn rate": np.abs(rates.turn[run.row])}
    level = _mean(run.nis)
    for quantity, values in by.items():
        parts = np.array_split(np.argsort(values, kind="stable"), 3)
        for part, rows in zip(_PARTS, parts, strict=True):
            # Scored beside that of all, which other errors change.
            value = _mean(run.nis[rows]) / size
            family = f"NIS / dof by {quantity}"
            yield Statistic(family, part, value, _positive("", "", size * value / level).score)
    slots, index = np.unique(run.slot, return_inverse=True)
    yield _largest("NIS / dof of a landmark", run, index, [str(slot) for slot in slots])
    yield Statistic("NIS trend", "", *2 * (_correlation(run.nis, time[run.row]),))
    window = np.zeros(len(time), int)
    for k in range(0, WINDOWS, 2):  # tenths that do not overlap
        window[window_rows(len(time), k)] = k
    yield _largest("NIS / dof of a time", run, window[run.row], [str(k) for k in range(WINDOWS)])


def _correlations(run: FusedInnovations, sensor: Sensor, rates: Rates) -> Iterator[Statistic]:
    """Correlations of innovations: with those before them, and with what should not matter."""
    order = np.argsort(run.slot, kind="stable")  # by landmark, in order of time
    slot, white, unit = run.slot[order], run.white[order], run.unit[order]
    for lag in range(1, LAGS + 1):
        pairs = slot[lag:] == slot[:-lag]
        value = _products(white[lag:][pairs], white[:-lag][pairs])
        yield Statistic("autocorrelation", f"lag {lag}", value, value)
    pairs = slot[1:] == slot[:-1]
    for i, name in enumerate(_names(sensor)):
        value = _products(unit[1:, i][pairs], unit[:-1, i][pairs])
        yield Statistic("autocorrelation", f"{name}, lag 1", value, value)
    by = {"speed": rates.speed[run.row], "turn rate": rates.turn[run.row]}
    by |= {name: values for name, values in _polar(run, sensor).items() if name == "range"}
    for i, name in enumerate(_names(sensor)):
        for quantity, values in by.items():
            value = _correlation(run.unit[:, i], values)
            yield Statistic("correlation", f"{name} with {quantity}", value, value)


def tail_count(increasing: Float[np.ndarray, "N"], limit: float) -> float:
    """The number of values above a limit, interpolated linearly between the two beside it.

    From n values above it falls to n - 1 as the least of them falls to the limit: whole numbers
    have ties among twins, which no rank resolves. Below the largest value it is that value over the
    limit - 1, at least -1.
    """
    above = len(increasing) - int(np.searchsorted(increasing, limit, side="right"))
    if above == 0:
        return float(increasing[-1]) / limit - 1.0 if len(increasing) and limit > 0 else -1.0
    least = float(increasing[-above])
    below = float(increasing[-above - 1]) if above < len(increasing) else 0.0
    return above - 1 + (least - limit) / (least - below)


def _names(sensor: Sensor) -> list[str]:
    return [split_unit(name)[0] for name in sensor.measurements]


def _polar(run: FusedInnovations, sensor: Sensor) -> dict[str, np.ndarray]:
    """The predicted range and bearing of each measurement, as far as something says them."""
    names = _names(sensor)
    if names[:2] == ["ahead", "left"]:
        ahead, left = run.predicted[:, :2].T
        return {"range": np.hypot(ahead, left), "bearing": np.arctan2(left, ahead)}
    return {
        name: run.predicted[:, names.index(name)] for name in ("range", "bearing") if name in names
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else np.nan


def _products(a: np.ndarray, b: np.ndarray) -> float:
    """Σ a·b / √(Σ|a|² Σ|b|²)."""
    scale = np.sqrt(np.sum(a**2) * np.sum(b**2))
    return float(np.sum(a * b) / scale) if scale > 0 else np.nan


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """The correlation of two samples; NaN where one does not vary."""
    if a.size < _FEW or np.ptp(b) <= 1e-9 * np.abs(b).max():  # rounding of a constant
        return np.nan
    return _products(a - a.mean(), b - b.mean())


def _positive(family: str, detail: str, value: float) -> Statistic:
    score = float(np.log(value)) if value > 0 else np.nan
    return Statistic(family, detail, float(value), score)


def _count(family: str, detail: str, count: float, total: int) -> Statistic:
    """A share; twice the root of a count has a deviation near 1 (Anscombe 1948).

    Below 0, where an interpolated count has no event, the score goes on as a line.
    """
    score = 2 * float(np.sqrt(max(count, 0.0) + 0.375)) + min(count, 0.0)
    return Statistic(family, detail, max(count, 0.0) / total, score, spread=1.0)


def _largest(
    family: str, run: FusedInnovations, index: Int[np.ndarray, "K"], names: list[str]
) -> Statistic:
    """The NIS/dof of the group whose NIS is farthest above the others', in its deviations."""
    size, count = run.nu.shape[1], len(names)
    dof = size * np.bincount(index, minlength=count)
    nis = np.bincount(index, run.nis, minlength=count)
    judged = dof >= size * _FEW
    if not judged.any():
        return Statistic(family, "", np.nan, np.nan)
    level = nis.sum() / dof.sum()
    excess = np.full(count, -np.inf)
    excess[judged] = (nis[judged] / level - dof[judged]) / np.sqrt(2 * dof[judged])
    k = int(np.argmax(excess))
    # A largest of some standard numbers is skewed to the right.
    return Statistic(family, "", nis[k] / dof[k], float(np.arcsinh(excess[k])), names[k])
