"""What a statistic of a log says beside those of its twins, and what it points to: sentences."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.consistency._log_statistics import Statistic
from jaxslam.consistency._planted_faults import Shape, window_rows
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.types import Info
from jaxslam.simulation._twin import Twin


class _Sentence(NamedTuple):
    """A sentence on a statistic, with the fields of `Meaning` in braces."""

    says: str
    points_to: str


_NOISES = "noises too {noise}, or an error below: jaxslam fit"
_WRONG = "wrong measurements: [filter] gate"
_LASTING = "errors that last: [filter] spacing"
_CONSTANT = "a constant error: jaxslam fit --calibrate mount, range"
_DELAY = "a delay: jaxslam fit --calibrate delay; or the scale of turns"
_SCALE = "a scale of the range: jaxslam fit --calibrate range"
_CORRELATION = "the innovation of the {component} {grows} with the {quantity}: correlation {beside}"

_SENTENCES = {
    "NIS / dof": _Sentence(
        "innovations are {size} than the models say: NIS / dof {beside}", _NOISES
    ),
    "NIS / dof by": _Sentence(
        "NIS / dof in the {detail} of the {quantity} is {beside}",
        "a noise or an error that depends on the {quantity}",
    ),
    "NIS / dof of a landmark": _Sentence(
        "NIS / dof of landmark {landmark} is {beside} for their worst",
        "it moved, or is not one point",
    ),
    "NIS / dof of a time": _Sentence(
        "NIS / dof is {beside} for their worst tenth, {window}", "something happened there"
    ),
    "NIS trend": _Sentence(
        "NIS {grows} with time: correlation {beside}",
        "a constant that changes, or a map that bends",
    ),
    "size": _Sentence(
        "the innovation of the {detail} is {size} than the models say: ν²/S {beside}",
        "its noise is too {noise}: jaxslam fit",
    ),
    "mean": _Sentence(
        "the innovation of the {detail} is {value:.3g} {unit} on average, of the twins "
        "{typical:.3g}",
        _CONSTANT,
    ),
    "tail": _Sentence(
        "the NIS over its mean is {detail} in {percent:.2g} %, of the twins "
        "{typical_percent:.2g} %",
        _WRONG,
    ),
    "kurtosis, larger": _Sentence(
        "the innovation of the {detail} has a kurtosis of {beside}", _WRONG
    ),
    "kurtosis, smaller": _Sentence(
        "the innovation of the {detail} has a kurtosis of {beside}", "no Gaussian noise"
    ),
    "autocorrelation": _Sentence(
        "innovations of a landmark are correlated at {detail}: {beside}", _LASTING
    ),
    "autocorrelation of a component": _Sentence(
        "successive innovations of the {component} of a landmark are correlated: {beside}",
        _LASTING,
    ),
    "correlation with speed": _Sentence(_CORRELATION, "a delay, slip or a scale of the odometry"),
    "correlation with turn rate": _Sentence(_CORRELATION, _DELAY),
    "correlation with range": _Sentence(_CORRELATION, _SCALE),
    "rejected by the gate": _Sentence(
        "the gate rejects {percent:.2g} %, of the twins {typical_percent:.2g} %",
        "wrong measurements, or noises too small",
    ),
    "log-likelihood": _Sentence(
        "the log-likelihood is {value:.5g}, of the twins {typical:.5g}",
        "noises that do not fit: jaxslam fit",
    ),
}
"""By the family of the statistic; some families have several."""


class Meaning:
    """What statistics of a log say, as sentences. info: of the log."""

    def __init__(self, world: Twin, info: Info, shapes: tuple[list[Shape], list[Shape]]) -> None:
        self._units = dict(map(split_unit, world.sensor.measurements))
        self._time = np.asarray(world.time)
        self._faults = {shape.fault.name: shape.fault for part in shapes for shape in part}
        seen, slot = np.asarray(world.seen), np.asarray(info.slot)
        held = (slot >= 0) & (seen >= 0)
        self._landmarks = {
            str(k): world.tags[row] for k, row in zip(slot[held], seen[held], strict=True)
        }

    def __call__(self, statistic: Statistic, twins: Float[np.ndarray, "R"]) -> str:
        family, detail, value, place = statistic[:3] + (statistic.place,)
        if family == "fault":
            fault = self._faults[detail]
            spread = fault.scale * float(np.std(twins))
            shown = f"{fault.scale * value:.3g} {fault.unit} (twins ± {spread:.2g})"
            when = f" {self._window(place)}" if detail == "slip" else ""
            return f"{fault.meaning.format(shown)}{when}; {fault.remedy}"
        typical = float(np.median(twins))
        larger = value > typical
        component = quantity = ""
        if family.startswith("NIS / dof by "):
            family, quantity = "NIS / dof by", family.removeprefix("NIS / dof by ")
        elif family == "correlation":
            component, _, quantity = detail.partition(" with ")
            family = f"correlation with {quantity}"
        elif family == "autocorrelation" and ", " in detail:
            component, _, _ = detail.partition(", ")
            family = "autocorrelation of a component"
        elif family == "kurtosis":
            family = "kurtosis, larger" if larger else "kurtosis, smaller"
        return "; ".join(_SENTENCES[family]).format(
            detail=detail,
            component=component,
            quantity=quantity,
            landmark=self._landmarks.get(place, place),
            window=self._window(place) if family == "NIS / dof of a time" else "",
            value=value,
            typical=typical,
            unit=self._units.get(detail) or "",
            percent=100 * value,
            typical_percent=100 * typical,
            beside=f"{value:.3g}, of the twins {typical:.3g}",
            grows="grows" if larger else "falls",
            size="larger" if larger else "smaller",
            noise="small" if larger else "large",
        )

    def _window(self, place: str) -> str:
        """The times of a tenth of the log, "" without one."""
        if not place:
            return ""
        rows = self._time[window_rows(len(self._time), int(place))]
        return f"from {rows[0]:.4g} to {rows[-1]:.4g} s"
