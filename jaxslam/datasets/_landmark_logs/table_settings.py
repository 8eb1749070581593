"""The file `dataset.toml` of a table: models, noises, gate and start, with defaults."""

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxslam import association, motion, sensors
from jaxslam.core._noise import NoiseCov
from jaxslam.core.logs._tables import INTERVAL, POSE, odometry_columns, split_unit
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import (
    Check,
    InvalidField,
    InvalidFile,
    at_least,
    in_range,
    instance_of,
    one_of,
    or_none,
    probability,
    require,
)
from jaxslam.datasets._dataset import Parameter
from jaxslam.datasets._landmark_logs import settings_file as toml
from jaxslam.datasets._landmark_logs.settings_file import REQUIRED, Key, number, numbers
from jaxslam.datasets._landmark_logs.table_models import (
    Parametric,
    TableNoise,
    WithInterval,
    fitting_model,
    of_no_noise,
)
from jaxslam.motion._odometry_errors import can_correct as _has_turn
from jaxslam.sensors._range_errors import can_correct as _has_range

_Model = TypeVar("_Model", bound=Motion | Sensor)

GATE = 0.99
"""Default probability of the gate of an association: one correct measurement of a hundred is lost,
and few wrong ones pass."""

NEW_GATE = 0.9999
"""Probability of the gate beyond which a measurement is of a new landmark. What lies between the
two gates is neither used nor new, so a correct measurement starts a second landmark once in 10⁴."""

METHODS: dict[str, Callable[..., Associate]] = {
    "nearest": association.Nearest,
    "global_nearest": association.GlobalNearest,
    "maximum_likelihood": association.MaximumLikelihood,
    "joint": association.JointCompatibility,
    "known": association.Known,
}


def association_options(method: object, gate: Any, new_gate: Any = None) -> dict[str, Any]:
    """Options of `EkfSlam` for a method by name and its gates.

    Raises InvalidField, of associate, gate or new_gate, on an unknown name, a gate that is not a
    probability, and a new_gate of known identities or below the gate. By default known identities
    have no gate, other methods `GATE`.

    Args:
        method: one of `METHODS`.
        gate: the probability that a correct measurement passes.
        new_gate: the probability of the gate of new landmarks; by default `NEW_GATE`, or the gate
            if that is larger.
    """
    require("gate", gate, or_none(probability))
    if not isinstance(method, str) or method not in METHODS:
        raise InvalidField("associate", f"expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "known":
        if new_gate is not None:
            raise InvalidField("new_gate", f"expected none of known tags, got {new_gate}")
        return {} if gate is None else {"gate": gate}
    own_gate = GATE if gate is None else gate
    beyond = max(own_gate, NEW_GATE) if new_gate is None else new_gate
    try:
        return {"associate": METHODS[method](own_gate, beyond)}
    except InvalidField as problem:
        raise InvalidField("new_gate", problem.reason) from problem


FITTED = "fit.toml"
"""Name of the file of fitted numbers, which replace the numbers of `dataset.toml`."""


def fitted_text(parameters: Sequence[Parameter], cov: np.ndarray) -> str:
    """The text of `FITTED`: parameters by section and key, and the covariance of those with one."""
    places = dict.fromkeys(parameter.place for parameter in parameters)
    sections: dict[str, list[str]] = {section: [] for section, _ in places}
    for section, key in places:
        at_key = [parameter for parameter in parameters if parameter.place == (section, key)]
        numbers = ", ".join(f"{parameter.value:.6g}" for parameter in at_key)
        names = ", ".join(parameter.name.removeprefix(f"{section} ") for parameter in at_key)
        sections[section].append(f"{key} = [{numbers}]  # {names}\n")
    uncertain = np.flatnonzero(np.diag(cov))
    if uncertain.size:
        names = ", ".join(f'"{parameters[i].name}"' for i in uncertain.tolist())
        rows = "".join(
            f"  [{', '.join(f'{value:.9g}' for value in row)}],\n"
            for row in cov[np.ix_(uncertain, uncertain)]
        )
        sections["calibration"] = [f"parameters = [{names}]\n", f"covariance = [\n{rows}]\n"]
    return "\n".join(f"[{name}]\n" + "".join(lines) for name, lines in sections.items())


# --- the schema ---------------------------------------------------------------------------------

UNMEASURED = {"range_only": "bearing [rad]", "bearing_only": "range [m]"}
"""The quantity that a sensor does not measure, by the name of the sensor; the option `free` of the
sensor is its prior."""

ROOM = 100
"""Default number of landmarks, where identities are unknown."""
_ODOMETRY_ERRORS, _RANGE_ERRORS = ("scale", "wheels", "heading"), ("range", "axis")
"""Keys of [motion] for `motion.Corrected`, and of [sensor] for `sensors.Corrected`."""
_OF_PARAMETERS = ("noise", "across", "mount", *_ODOMETRY_ERRORS, *_RANGE_ERRORS)
"""Keys whose numbers are parameters of a model."""


def _model_key(registry: Mapping[str, Callable[..., Motion | Sensor]]) -> Key:
    """The key of a model, by default that of the columns."""

    def default(context: Mapping[str, Any]) -> str:
        return fitting_model(registry, context["header"])

    return Key("model", default=default, check=one_of(*registry), note=True)


def _noise_key(**by_unit: float) -> Key:
    """The key of standard deviations, with its defaults by unit."""

    def default(context: Mapping[str, Any]) -> list[float]:
        return [by_unit.get(split_unit(name)[1] or "", 0.1) for name in context["names"]]

    return Key("noise", numbers, None, default, toml.not_negative, note=True)


def _scales(count: int) -> Check:
    """The check that the first numbers are above 0."""

    def check(values: list[float]) -> None:
        if min(values[:count]) <= 0:
            raise ValueError(f"expected a scale above 0, got {values}")

    return check


def _has_both(sensor: Sensor) -> bool:
    return sensor.measurements == ("range [m]", "bearing [rad]")


def _has_axis(sensor: Sensor) -> bool:
    return _has_range(sensor) and "bearing [rad]" in sensor.measurements


def _has_mount(sensor: Sensor) -> bool:
    return "mount" in inspect.signature(type(sensor)).parameters


def _slots(context: Mapping[str, Any]) -> int:
    return max(int(context["tags"]), 1) + ROOM * bool(context["unknown"])


def _method(context: Mapping[str, Any]) -> str:
    return "nearest" if context["unknown"] else "known"


SCHEMA = {
    "": (
        Key("name", default=lambda context: context["folder"], check=instance_of(str)),
        Key("source", default="", check=instance_of(str)),
    ),
    "motion": (
        _model_key(motion.REGISTRY),
        _noise_key(**{"m/s": 0.1, "rad/s": 0.1, "m": 0.02, "rad": 0.02}),
        # The defaults of systematic errors are the numbers without an error.
        Key("scale", numbers, ("travel", "turn"), [1.0, 1.0], _scales(2), of=_has_turn),
        Key("wheels", numbers, ("outer [m]", "curvature [rad/m]"), [0.0, 0.0], of=_has_turn),
        Key("heading", numbers, ("[rad]",), [0.0], of=_has_turn),
    ),
    "sensor": (
        _model_key(sensors.REGISTRY),
        _noise_key(**{"m": 0.1, "rad": 0.05, "1": 1.0}),
        Key("across", numbers, ("across [m]",), None, toml.not_negative, of=_has_both),
        Key("mount", numbers, POSE, [0.0, 0.0, 0.0], note=True, of=_has_mount),
        # `range` can always be fitted, the axis only where the file states it.
        Key("range", numbers, ("scale", "offset [m]"), [1.0, 0.0], _scales(1), of=_has_range),
        Key("axis", numbers, ("[rad]",), of=_has_axis),
        Key("share", number, ("[1]",), 0.0, toml.not_negative, of=_has_both),
        Key("delay", number, ("[s]",), 0.0),
        Key("max_range", number, ("[m]",), np.inf, toml.not_negative),
        Key("outliers", number, ("[1]",), 0.0, in_range(0.0, 1.0)),
    ),
    "filter": (
        Key("capacity", default=_slots, check=at_least(1), note=True),
        Key("start", numbers, POSE),
        Key("start_noise", numbers, POSE, [0.0, 0.0, 0.0], toml.not_negative, note=True),
        Key("start_covariance", toml.rows, POSE, check=toml.covariance),
        Key("update", default="sequential", check=one_of("sequential", "joint"), note=True),
        Key("births", check=at_least(1)),
        Key("associate", default=_method, check=one_of(*METHODS), note=True),
        Key("gate", default=lambda of: None if of["associate"] == "known" else GATE, note=True),
        Key("new_gate"),
        Key("spacing", number, ("[s]",), 0.0, toml.not_negative),
    ),
    "state": (
        Key("names", toml.some_names, None, lambda context: context["of_model"]),
        Key("start", numbers, None, REQUIRED),
        Key("start_noise", numbers, None, REQUIRED, toml.not_negative),
        Key("noise", numbers, None, REQUIRED, toml.not_negative),
    ),
    "calibration": (
        Key("parameters", toml.some_names, None, REQUIRED),
        Key("covariance", toml.rows, None, REQUIRED, toml.covariance),
    ),
}
"""The keys of `dataset.toml` by section, but for arguments of a model, which are keys of its
section."""


# --- the settings -------------------------------------------------------------------------------


class TableSettings(toml.SettingsFile):
    """The settings of a folder, with its fitted numbers unless `fitted` is False."""

    def __init__(self, path: Path, fitted: bool = True) -> None:
        super().__init__(path, SCHEMA, FITTED if fitted else None)
        for section in ("filter", "state", "calibration"):
            self.refuse_unknown(section)
        self.further_start = np.zeros(0), np.zeros((0, 0))
        """the further states (E,) before the first row, and their covariance (E, E)"""
        self.default_noises: tuple[str, ...] = ()
        """the sections, of those read, whose noise is a default"""

    def motion(self, header: Sequence[str], interval: float) -> Parametric[Motion]:
        """The motion model; its noise is the noise of a line of odometry, however rows divide it.

        Velocities have the covariance σ² interval/Δt over Δt, white noise. Poses give increments
        with covariance σ² Δt/interval, and Δt as a last control. Other increments have σ².

        Args:
            header: the columns of the odometry.
            interval: the time between its lines [s].
        """
        bare, build = self._model("motion", motion.REGISTRY, header)
        columns = odometry_columns(bare.controls, header)
        from_poses = columns == POSE
        per_time = from_poses or INTERVAL in bare.controls
        keys = {key.name: key for key in self.keys["motion"] if key.name in _ODOMETRY_ERRORS}
        # Further states are of the model, and their rates are its last noises, or they are errors.
        of_model, of_errors = bare.state[3:], self._errors_as_states(bare, list(keys))
        noises = bare.noises[: len(bare.noises) - len(of_model)]
        if not noises and "noise" in self.stated("motion"):
            reason = f"expected none: {bare.name} has no odometry, and [state] noise says how its "
            raise self.error("motion", "noise", reason + "velocities change")
        parameters = self._parameters("motion", noises, without=of_errors)
        states = of_model or tuple(
            f"{key} {name}" for key in of_errors for name in keys[key].names or ()
        )
        if states:
            parameters += self._parameters("state", states)
            state = self.read("state", "start", "start_noise", names=states)
            start_cov = np.diag(np.square(state["start_noise"]))
            self.further_start = np.array(state["start"]), start_cov
        at = _slices(parameters)

        def uncorrected(p: JaxOrNumPy) -> Motion:
            walks = p[at["state", "noise"]] if of_model else None
            noise = TableNoise(
                p[at.get(("motion", "noise"), slice(0))], interval, per_time, from_poses, walks
            )
            model = build(noise)
            return WithInterval(model, noise) if from_poses else model

        def corrected(p: JaxOrNumPy) -> Motion:
            scale, wheels, heading = (
                np.array(key.default) if name in of_errors else p[at["motion", name]]
                for name, key in keys.items()
            )
            model = motion.Corrected(uncorrected(p), scale, wheels, heading[0])
            if not of_errors:
                return model
            return motion.Augmented(model, of_errors, p[at["state", "noise"]])

        has_error = bool(of_errors) or not keys.keys().isdisjoint(self.stated("motion"))
        return _parametric(parameters, uncorrected, corrected if keys else uncorrected, has_error)

    def _errors_as_states(self, bare: Motion, possible: list[str]) -> tuple[str, ...]:
        """The systematic errors, of the possible ones, that [state] names as further states."""
        of_model = [split_unit(name)[0] for name in bare.state[3:]]
        possible = of_model or possible
        names = self.read("state", "names", names=possible, of_model=of_model)["names"]
        is_partial = (of_model and names != of_model) or (self.stated("state") and not names)
        if is_partial or len(set(names)) < len(names):
            expected = ", ".join(possible) or "none"
            reason = f"expected {expected}, the states of {bare.name}, got {names!r}"
            raise self.error("state", "names", reason)
        if of_model:
            return ()
        for name in names:
            if name in self.stated("motion"):
                reason = "expected none beside [state], whose start it is"
                raise self.error("motion", name, reason)
        return tuple(names)

    def sensor(self, header: Sequence[str]) -> Parametric[Sensor]:
        """The sensor. header: the columns of the measurements."""
        bare, build = self._model("sensor", sensors.REGISTRY, header)
        names = bare.measurements
        parameters = self._parameters("sensor", names)
        at = _slices(parameters)
        values, stated = _values(parameters), self.stated("sensor")
        share = self.read("sensor", "share").get("share", 0.0)
        # A share of the range is noise enough of a range.
        if not values[at["sensor", "noise"]][1 if share else 0 :].all():
            raise self.error("sensor", "noise", "expected numbers above 0")

        def uncorrected(p: JaxOrNumPy) -> Sensor:
            # NumPy for plain numbers, so that nothing is compiled.
            noise: NoiseCov = p[: len(names), None] ** 2 * np.eye(len(names))
            if "across" in stated or share:
                across = p[at["sensor", "across"]][0] if "across" in stated else 0.0
                noise = sensors.RangeBearingNoise(p[0], p[1], share, across)
            if ("sensor", "mount") in at:
                return build(noise, mount=p[at["sensor", "mount"]])
            return build(noise)

        def corrected(p: JaxOrNumPy) -> Sensor:
            axis = p[at["sensor", "axis"]][0] if "axis" in stated else None
            return sensors.Corrected(uncorrected(p), p[at["sensor", "range"]], axis)

        can_err = ("sensor", "range") in at
        has_error = not stated.keys().isdisjoint(_RANGE_ERRORS)
        return _parametric(
            parameters, uncorrected, corrected if can_err else uncorrected, has_error
        )

    def filter(self, tags: int, unknown: bool) -> tuple[int, np.ndarray, dict[str, Any]]:
        """The number of landmark slots, the covariance (3, 3) of the start, options of `EkfSlam`.

        Args:
            tags: number of landmarks with a name.
            unknown: whether some are measured without one.
        """
        stated = self.stated("filter")
        start = "start_covariance" if "start_covariance" in stated else "start_noise"
        if start != "start_noise" and "start_noise" in stated:
            raise self.error("filter", start, "expected no start_noise beside it")
        keys = ("capacity", start, "update", "births", "associate", "gate", "new_gate")
        values = self.read("filter", *keys, tags=tags, unknown=unknown)
        capacity, cov = values["capacity"], values[start]
        if capacity < tags:
            reason = f"expected at least {tags}, the number of tags, got {capacity}"
            raise self.error("filter", "capacity", reason)
        if start == "start_noise":
            cov = np.diag(cov) ** 2
        births = {} if values["births"] is None else {"births": values["births"]}
        method = (values[key] for key in ("associate", "gate", "new_gate"))
        try:
            options = {"correction": values["update"], **births, **association_options(*method)}
        except InvalidField as problem:
            raise self.error("filter", problem.field, problem.reason) from problem
        return capacity, cov, options

    def calibration_cov(self, parameters: tuple[Parameter, ...]) -> np.ndarray | None:
        """The covariance of the parameters in [calibration] (P, P), 0 of others; None without."""
        if "calibration" not in self.content:
            return None
        names = [parameter.name for parameter in parameters]
        (uncertain,) = self.read("calibration", "parameters", names=names).values()
        cov = np.zeros((len(names), len(names)))
        places = np.ix_(*2 * ([names.index(name) for name in uncertain],))
        (cov[places],) = self.read("calibration", "covariance", names=uncertain).values()
        return cov

    def _model(
        self,
        section: str,
        registry: Mapping[str, Callable[..., _Model]],
        header: Sequence[str],
    ) -> tuple[_Model, Callable[..., _Model]]:
        """The model of a section with no noise, and the model by its noise and options.

        The keys of the section become those of this model.
        """
        (name,) = self.read(section, "model", header=header).values()
        arguments = inspect.signature(registry[name]).parameters
        hint = (
            f" (prior mean and variance of the {UNMEASURED.get(name)}, which is not measured: see "
            "docs/methods/bearings_and_ranges.md)"
        )
        of_arguments = []
        for argument, parameter in arguments.items():
            if argument not in ("noise_cov", "mount"):
                shown = "none" if parameter.default is None else toml.as_toml(parameter.default)
                note = f" = {shown}" + hint * (argument == "free" and name in UNMEASURED)
                of_arguments.append(Key(argument, note=note))
        self.keys[section] = (*SCHEMA[section], *of_arguments)
        values = self.read(section, *(key.name for key in of_arguments))
        options = {key: value for key, value in values.items() if key in self.stated(section)}

        def build(noise: object, **further: Any) -> _Model:
            try:
                with warnings.catch_warnings():  # a mount beyond 2π is noted
                    warnings.filterwarnings("ignore", message=".*beyond 2π")
                    return registry[name](noise, **options, **further)
            except (ValueError, TypeError) as problem:
                if isinstance(problem, InvalidField) and problem.field in options:
                    raise self.error(section, problem.field, problem.reason) from problem
                raise InvalidFile(self.path, f"[{section}] {problem}") from problem

        bare = build(of_no_noise)
        of_model = (key for key in self.keys[section] if key.of is None or key.of(bare))
        self.keys[section] = tuple(of_model)
        self.refuse_unknown(section, f", the keys of {name}")

        return bare, build

    def _parameters(
        self, section: str, names: Sequence[str], without: Sequence[str] = ()
    ) -> tuple[Parameter, ...]:
        """The parameters in a section, but for some keys. names: of the noise."""
        parameters: list[Parameter] = []
        keys = [key for key in self.keys[section] if key.name in _OF_PARAMETERS]
        if not names:  # of a robot without odometry
            keys = [key for key in keys if key.name != "noise"]
        elif "noise" not in self.stated(section):
            self.default_noises += (section,)
        values = self.read(section, *(key.name for key in keys), names=names)
        for key in keys:
            # The names of noises begin with the section, those of errors with the key.
            is_noise = key.name in ("noise", "across")
            label, group = (section, "noise") if is_noise else (key.name, key.name)
            if key.name not in without and values[key.name] is not None:
                parameters += (
                    Parameter(f"{label} {name}", value, group, (section, key.name))
                    for name, value in zip(key.names or names, values[key.name], strict=True)
                )
        return tuple(parameters)


def _parametric(
    parameters: tuple[Parameter, ...],
    uncorrected: Callable[[JaxOrNumPy], _Model],
    corrected: Callable[[JaxOrNumPy], _Model],
    has_error: bool,
) -> Parametric[_Model]:
    """A model by its parameters, and at their values, with the errors only if it has some."""
    model = (corrected if has_error else uncorrected)(_values(parameters))
    return Parametric(parameters, corrected, model)


def _values(parameters: Sequence[Parameter]) -> np.ndarray:
    return np.array([parameter.value for parameter in parameters])


def _slices(parameters: Sequence[Parameter]) -> dict[tuple[str, str], slice]:
    """Where the numbers of each section and key are among those of all parameters."""
    places = [parameter.place for parameter in parameters]
    begins = {place: places.index(place) for place in places}
    return {place: slice(i, i + places.count(place)) for place, i in begins.items()}
