"""The file `dataset.toml` of a table: models, noises, gate and start, with defaults."""

import inspect
import re
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import motion, sensors
from jaxslam.association import (
    GlobalNearest,
    JointCompatibility,
    Known,
    MaximumLikelihood,
    Nearest,
)
from jaxslam.core._noise import NoiseCov
from jaxslam.core._numbers import is_number
from jaxslam.core._record import record, static
from jaxslam.core._units import TURN
from jaxslam.core.logs._tables import INTERVAL, POSE, odometry_columns, split_unit
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField, or_none, probability, require
from jaxslam.datasets._dataset import Parameter
from jaxslam.math._definite import is_asymmetric, is_indefinite
from jaxslam.motion import _odometry_errors as odometry_errors
from jaxslam.sensors import _range_errors as range_errors

_Model = TypeVar("_Model", bound=Motion | Sensor)

_DEFAULT_MODELS = ("unicycle", "pose_increment", "range_bearing")
"""The default among models with the same columns."""


class Parametric(NamedTuple, Generic[_Model]):
    """A model as a function of its parameters, and the model of the file."""

    parameters: tuple[Parameter, ...]
    at: Callable[[JaxOrNumPy], _Model]
    """array of values -> model"""
    model: _Model
    """the model with the values of the file, without systematic errors that the file does not
    state"""


def fitting_model(
    section: str,
    registry: Mapping[str, Callable[..., Motion | Sensor]],
    header: Sequence[str],
    path: Path,
) -> str:
    """The model whose columns are in the header, by most columns and then by `_DEFAULT_MODELS`."""
    columns_of_file = {split_unit(name)[0] for name in header}
    # A motion without odometry, whose columns are none, fits any file.
    registry = {name: factory for name, factory in registry.items() if name != "constant_velocity"}
    fitting, described = [], []
    for name, factory in registry.items():
        model = factory(of_no_noise)
        columns = (
            odometry_columns(model.controls, header)
            if isinstance(model, Motion)
            else model.measurements
        )
        described.append(f"{name} ({', '.join(columns)})")
        if {split_unit(column)[0] for column in columns} <= columns_of_file:
            fitting.append((len(columns), name in _DEFAULT_MODELS, name))
    if not fitting:
        raise ValueError(
            f"{path}: [{section}] model: expected one, since no model has the columns "
            f"{', '.join(header)}; known: {'; '.join(described)}"
        )
    # Of equal models the first in the registry, which `max` over the names would not be.
    best = max(fitting)[:2]
    return next(name for *rank, name in fitting if tuple(rank) == best)


def of_no_noise(*_: object) -> NoReturn:
    """The noise of a model that serves only for its names, and is never evaluated."""
    raise AssertionError("a model that serves only for its names was evaluated")


GATE = 0.99
"""Default probability of the gate of an association: one correct measurement of a hundred is lost,
and few wrong ones pass."""

NEW_GATE = 0.9999
"""Probability of the gate beyond which a measurement is of a new landmark. What lies between the
two gates is neither used nor new, so a correct measurement starts a second landmark once in 10⁴."""

METHODS: dict[str, Callable[..., Associate]] = {
    "nearest": Nearest,
    "global_nearest": GlobalNearest,
    "maximum_likelihood": MaximumLikelihood,
    "joint": JointCompatibility,
    "known": Known,
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


def _line_number(text: str, section: str, key: str) -> int | None:
    """The line, from 1, of a key in a section ("": at the top), or of the section, or None."""
    current, heading_line = "", None
    for number, line in enumerate(text.split("\n"), 1):
        if heading := re.match(r"\s*\[\s*(\w+)\s*\]", line):
            current = heading[1]
            if heading_line is None and current == (section or key):
                heading_line = number
        elif current == section and re.match(rf"\s*{re.escape(key)}\s*=", line):
            return number
    return heading_line


_Value = TypeVar("_Value")

UNMEASURED = {"range_only": "bearing [rad]", "bearing_only": "range [m]"}
"""The quantity that a sensor does not measure, by the name of the sensor; the option `free` of the
sensor is its prior."""

_MOTION_NOISE = {"m/s": 0.1, "rad/s": 0.1, "m": 0.02, "rad": 0.02}
"""Default standard deviations of odometry by unit."""
_MEASUREMENT_NOISE = {"m": 0.1, "rad": 0.05, "1": 1.0}
"""Default standard deviations of measurements by unit."""
_LARGEST_DEVIATION = 1.0
"""[rad] standard deviation of an angle above which it says nearly nothing, and may be of degrees"""

ROOM = 100
"""Default number of landmarks, where identities are unknown."""
RANGE_BEARING = ("range [m]", "bearing [rad]")
_FILTER = (
    *("gate", "new_gate", "capacity", "associate", "update", "births"),
    *("start", "start_noise", "start_covariance", "spacing"),
)
_ODOMETRY_ERRORS = {
    "scale": (("travel", "turn"), (1.0, 1.0)),
    "wheels": (("outer [m]", "curvature [rad/m]"), (0.0, 0.0)),
    "heading": (("[rad]",), (0.0,)),
}
"""Keys of [motion] for `motion.Corrected`: the names of the numbers, and their values without an
error."""
_RANGE_ERRORS = {"range": (("scale", "offset [m]"), (1.0, 0.0)), "axis": (("[rad]",), (0.0,))}
"""Keys of [sensor] for `sensors.Corrected`: the names of the numbers, and their values without an
error."""


@record
class _TableNoise:
    """The noise of a line of odometry, whatever rows divide it; see `TableSettings.motion`."""

    deviations: JaxOrNumPy
    """standard deviations over one interval"""
    interval: float
    """time between lines of odometry [s]"""
    per_time: bool = static()
    """whether the last control is Δt"""
    of_increments: bool = static()
    """whether the covariance grows with Δt, as of increments; else it shrinks, as of velocities"""
    walks: JaxOrNumPy | None = None
    """standard deviations, in a second, of the further states whose rates are the last noises"""

    def __call__(self, pose: jax.Array, u: jax.Array) -> jax.Array:
        cov = jnp.diag(jnp.asarray(self.deviations, u.dtype) ** 2)
        if self.of_increments:
            return cov * u[-1] / self.interval
        if self.per_time:
            moving = u[-1] > 0
            # The inner `where` keeps gradients finite at Δt = 0.
            per_time = jnp.where(moving, 1 / jnp.where(moving, u[-1], 1.0), 0.0)
            cov = cov * (self.interval * per_time)
            if self.walks is not None:
                walks = jnp.diag(jnp.asarray(self.walks, u.dtype) ** 2) * per_time
                cov = jax.scipy.linalg.block_diag(cov, walks)
        return cov


@record
class _WithInterval(Motion):
    """A motion model with Δt as a last control, which only its noise depends on."""

    motion: Motion
    noise_cov: _TableNoise

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.motion.name

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.motion.controls, INTERVAL)

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.noises

    @property
    def perturb(self) -> Callable[[jax.Array, jax.Array], jax.Array] | None:
        return None if self.motion.perturb is None else self._perturb

    def step(self, pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
        return self.motion.step(pose, u[:-1], w)

    def _perturb(self, u: jax.Array, w: jax.Array) -> jax.Array:
        return jnp.concatenate([self.motion.perturb(u[:-1], w), u[-1:]])


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    """The text and the content of a file of settings; empty without a file."""
    try:
        text = path.read_text(encoding="utf-8")
        return text, tomllib.loads(text)
    except FileNotFoundError:
        return "", {}
    except tomllib.TOMLDecodeError as problem:
        # Before Python 3.14 only the text has the line: "… (at line 3, column 7)".
        reason, line = str(problem), text.count("\n") + 1
        if place := re.search(r" \(at line (\d+), column \d+\)$", reason):
            reason, line = reason[: place.start()], int(place[1])
        raise ValueError(f"{path}:{line}: expected TOML: {reason}") from problem
    except RecursionError as problem:
        raise ValueError(f"{path}: expected TOML, got brackets in brackets") from problem
    except (OSError, ValueError) as problem:  # not text, or a whole number of over 4,300 digits
        raise ValueError(f"{path}: cannot be read: {problem}") from problem


class TableSettings:
    """The settings of a folder, with its fitted numbers unless `fitted` is False.

    `assumed` lists the defaults that replaced missing settings so far, `default_noises` the
    sections without a noise among them.

    Raises ValueError on a file that is not TOML, and on an unknown section or key.
    """

    def __init__(self, path: Path, fitted: bool = True) -> None:
        self.path = path
        self.assumed: list[str] = []
        self._state_names: tuple[str, ...] = ()
        self.default_noises: list[str] = []
        self._text, self.content = _read(path)
        if not path.exists():
            self.assumed.append(f"no {path.name}")
        names = ("name", "source", "motion", "sensor", "filter", "calibration", "state")
        self._check_keys("", self.content, names)
        for name in names:
            kind = str if name in ("name", "source") else dict
            if not isinstance(self.content.get(name, kind()), kind):
                expected = "text" if kind is str else f"a section [{name}]"
                raise ValueError(f"{self._at('', name)}: expected {expected}")
        fit_path = path.with_name(FITTED)
        numbers = _read(fit_path)[1] if fitted else {}
        for section in sorted(numbers.keys() & {"motion", "state", "sensor", "calibration"}):
            if not isinstance(numbers[section], dict):
                raise ValueError(f"{fit_path}: expected a section [{section}]")
            self.content[section] = self.content.get(section, {}) | numbers[section]
            self.assumed.append(f"[{section}] {', '.join(numbers[section])} of {FITTED}")

    def text(self, name: str, default: str) -> str:
        """The name or the source of the data."""
        return str(self.content.get(name, default))

    def motion(self, header: Sequence[str], interval: float) -> Parametric[Motion]:
        """The motion model; its noise is the noise of a line of odometry, however rows divide it.

        Velocities have the covariance σ² interval/Δt over Δt, white noise. Poses give increments
        with covariance σ² Δt/interval, and Δt as a last control. Other increments have σ².

        Args:
            header: the columns of the odometry.
            interval: the time between its lines [s].
        """
        factory, options = self._model("motion", motion.REGISTRY, header, (*_ODOMETRY_ERRORS,))
        errors = {key: options.pop(key) for key in _ODOMETRY_ERRORS if key in options}
        bare = self._build("motion", factory, options, of_no_noise)
        from_poses = odometry_columns(bare.controls, header) == POSE
        with_interval = INTERVAL in bare.controls
        correctable = odometry_errors.can_correct(bare)
        own_states = len(bare.state) - 3  # whose rates are the last noises
        count = len(bare.noises) - own_states
        of_errors = self._states(bare, errors, correctable)
        parameters: tuple[Parameter, ...] = ()
        if count:
            parameters = self._noise("motion", bare.noises[:count], _MOTION_NOISE)
        elif "noise" in self.content.get("motion", {}):
            raise ValueError(
                f"{self._at('motion', 'noise')}: expected none: {bare.name} has no odometry, and "
                "[state] noise says how its velocities change"
            )
        adjustable = {key: row for key, row in _ODOMETRY_ERRORS.items() if key not in of_errors}
        parameters += self._errors("motion", adjustable if correctable else {}, errors)
        before_walks = len(parameters)
        parameters += tuple(
            Parameter(f"state {name}", value, "noise", ("state", "noise"))
            for name, value in zip(self._state_names, self._state("noise"), strict=True)
        )

        # p is the noise (count,), then scale (2,), wheels (2,) and heading if correctable and no
        # state, then the walks of the states.
        def uncorrected(p: JaxOrNumPy) -> Motion:
            walks = p[before_walks:] if own_states else None
            noise = _TableNoise(p[:count], interval, from_poses or with_interval, from_poses, walks)
            model = self._build("motion", factory, options, noise)
            return _WithInterval(model, noise) if from_poses else model

        def corrected(p: JaxOrNumPy) -> Motion:
            if not correctable:
                return uncorrected(p)
            values: dict[str, JaxOrNumPy] = {}
            at = count
            for key, (names, neutral) in _ODOMETRY_ERRORS.items():
                if key in of_errors:
                    values[key] = np.array(neutral)
                else:
                    values[key], at = p[at : at + len(names)], at + len(names)
            values["heading"] = values["heading"][0]
            model = motion.Corrected(uncorrected(p), **values)
            if not of_errors:
                return model
            return motion.Augmented(model, of_errors, p[before_walks:])

        values = np.array([parameter.value for parameter in parameters])
        return Parametric(
            parameters, corrected, (corrected if errors or of_errors else uncorrected)(values)
        )

    def _states(
        self, bare: Motion, errors: Mapping[str, object], correctable: bool
    ) -> tuple[str, ...]:
        """The systematic errors that [state] names as further states, and `_state_names` set."""
        section = self.content.get("state", {})
        self._check_keys("state", section, ("names", "start", "start_noise", "noise"))
        of_model = [split_unit(name)[0] for name in bare.state[3:]]
        names = section.get("names", of_model)
        possible = of_model or (list(_ODOMETRY_ERRORS) if correctable else [])
        fit = isinstance(names, list) and all(name in possible for name in names)
        if (
            not fit
            or (of_model and names != of_model)
            or len(set(names)) < len(names)
            or (section and not names)
        ):
            among = ", ".join(possible) or "none"
            raise ValueError(
                f"{self._at('state', 'names')}: expected {'' if of_model else 'some of '}{among}, "
                f"the states of {bare.name}, got {names!r}"
            )
        if of_model:
            self._state_names = tuple(bare.state[3:])
            return ()
        self._state_names = tuple(
            f"{key} {name}" for key in names for name in _ODOMETRY_ERRORS[key][0]
        )
        if stated := [key for key in names if key in errors]:
            raise ValueError(
                f"{self._at('motion', stated[0])}: expected none beside [state], whose start it is"
            )
        return tuple(names)

    def _state(self, key: str) -> list[float]:
        """The numbers of a key of [state], one for each further state."""
        if not self._state_names:
            return []
        numbers = self._numbers(
            "state", key, self.content.get("state", {}).get(key), self._state_names
        )
        if key != "start" and min(numbers) < 0:
            raise ValueError(f"{self._at('state', key)}: expected numbers of at least 0")
        return numbers

    def further_start(self) -> tuple[np.ndarray, np.ndarray]:
        """The further states (E,) before the first row, and their covariance (E, E)."""
        return np.array(self._state("start")), np.diag(np.square(self._state("start_noise")))

    def sensor(self, header: Sequence[str]) -> Parametric[Sensor]:
        """The sensor. header: the columns of the measurements."""
        further = (*_RANGE_ERRORS, "across", "share", "delay", "max_range", "outliers")
        factory, options = self._model("sensor", sensors.REGISTRY, header, further)
        errors = {key: options.pop(key) for key in _RANGE_ERRORS if key in options}
        across, share = options.pop("across", None), options.pop("share", None)
        for key in ("delay", "max_range", "outliers"):  # of the log, not arguments of the model
            options.pop(key, None)
        mount, has_mount = None, "mount" in inspect.signature(factory).parameters
        if "mount" in options:
            mount = self._numbers("sensor", "mount", options.pop("mount"), POSE)
        bare = self._build("sensor", factory, options, of_no_noise)
        names = bare.measurements
        parameters = self._noise("sensor", names, _MEASUREMENT_NOISE)
        share = 0.0 if share is None else self._of_range_bearing("share", share, "[1]", names)
        # A share of the range is noise enough of a range.
        if not all(p.value for p in parameters if not (share and p.name == "sensor range [m]")):
            raise ValueError(f"{self._at('sensor', 'noise')}: expected numbers above 0")
        if across is not None:
            spread = self._of_range_bearing("across", across, "[m]", names)
            parameters += (Parameter("sensor across [m]", spread, "noise", ("sensor", "across")),)
        before_mount = len(parameters)
        if has_mount:
            if mount is None:
                mount = self._default("sensor", "mount", [0.0, 0.0, 0.0])
            parameters += tuple(
                Parameter(f"mount {name}", value, "mount", ("sensor", "mount"))
                for name, value in zip(POSE, mount, strict=True)
            )
        before_errors, correctable = len(parameters), range_errors.can_correct(bare)
        # `range` can always be fitted, the axis only where the file states it.
        adjustable = {
            key: row for key, row in _RANGE_ERRORS.items() if key == "range" or key in errors
        }
        parameters += self._errors("sensor", adjustable if correctable else {}, errors)

        # p is the noise (m,), across, mount (3,), range (2,) and axis, each if there is one.
        def uncorrected(p: JaxOrNumPy) -> Sensor:
            # NumPy for plain numbers, so that nothing is compiled.
            noise: NoiseCov = p[: len(names), None] ** 2 * np.eye(len(names))
            if across is not None or share:
                wide = 0.0 if across is None else p[2]
                noise = sensors.RangeBearingNoise(p[0], p[1], share, wide)
            place = {"mount": p[before_mount : before_mount + 3]} if has_mount else {}
            return self._build("sensor", factory, options | place, noise)

        def corrected(p: JaxOrNumPy) -> Sensor:
            if not correctable:
                return uncorrected(p)
            axis = p[before_errors + 2] if "axis" in errors else None
            try:
                return sensors.Corrected(uncorrected(p), p[before_errors : before_errors + 2], axis)
            except ValueError as problem:
                raise ValueError(f"{self.path}: [sensor] {problem}") from problem

        values = np.array([parameter.value for parameter in parameters])
        return Parametric(parameters, corrected, (corrected if errors else uncorrected)(values))

    def _of_range_bearing(
        self, key: str, value: object, unit: str, measurements: tuple[str, ...]
    ) -> float:
        """The number of a key that only a sensor of range and bearing has."""
        (number,) = self._numbers("sensor", key, value, (unit,))
        if measurements != RANGE_BEARING or number < 0:
            raise ValueError(
                f"{self._at('sensor', key)}: expected a number >= 0, of a sensor of "
                f"{' and '.join(RANGE_BEARING)}, got {number:g} of {', '.join(measurements)}"
            )
        return number

    def delay(self) -> float:
        """The time by which measurements are stamped later than they happened [s]."""
        return self._number("sensor", "delay", 0.0)

    def max_range(self) -> float:
        """The range from which on the sensor says nothing [m]."""
        return self._positive("sensor", "max_range", np.inf)

    def outliers(self) -> float:
        """The share of measurements that are of anything but their landmark, in twins."""
        share = self._positive("sensor", "outliers", 0.0)
        if share > 1:
            place = self._at("sensor", "outliers")
            raise ValueError(f"{place}: expected a share from 0 to 1, got {share:g}")
        return share

    def spacing(self) -> float:
        """The least time between two measurements of a landmark that are used [s]."""
        return self._positive("filter", "spacing", 0.0)

    def calibration_cov(self, parameters: tuple[Parameter, ...]) -> np.ndarray | None:
        """The covariance of the parameters in [calibration] (P, P), 0 of others; None without."""
        section = self.content.get("calibration")
        if section is None:
            return None
        self._check_keys("calibration", section, ("parameters", "covariance"))
        names, matrix = section.get("parameters"), section.get("covariance")
        all_names = [parameter.name for parameter in parameters]
        if not isinstance(names, list) or not names or not set(names) <= set(all_names):
            raise ValueError(
                f"{self._at('calibration', 'parameters')}: expected some of "
                f"{', '.join(all_names)}, got {names!r}"
            )
        if not isinstance(matrix, list) or len(matrix) != len(names):
            raise ValueError(
                f"{self._at('calibration', 'covariance')}: expected {len(names)} rows of numbers"
            )
        rows = np.array([self._numbers("calibration", "covariance", row, names) for row in matrix])
        if is_asymmetric(rows, 1e-6) or is_indefinite(rows, 1e-6):  # written with six digits
            raise ValueError(f"{self._at('calibration', 'covariance')}: expected a covariance")
        cov = np.zeros((len(all_names), len(all_names)))
        places = [all_names.index(name) for name in names]
        cov[np.ix_(places, places)] = rows
        return cov

    def filter_options(self, unknown: bool) -> dict[str, Any]:
        """The options of `EkfSlam`. unknown: whether tags are unknown."""
        section = self._filter()
        update = section.get("update")
        if update is None:
            update = self._default("filter", "update", "sequential")
        if update != "sequential" and update != "joint":
            raise ValueError(
                f'{self._at("filter", "update")}: expected "sequential" or "joint", got {update!r}'
            )
        options: dict[str, Any] = {"correction": update}
        if (births := section.get("births")) is not None:
            if type(births) is not int or births < 1:  # a bool is an int, too
                raise ValueError(
                    f"{self._at('filter', 'births')}: expected a whole number of at least 1, got "
                    f"{births!r}"
                )
            options["births"] = births
        method, gate = section.get("associate"), section.get("gate")
        if method is None:
            method = self._default("filter", "associate", "nearest" if unknown else "known")
        try:
            options |= association_options(method, gate, section.get("new_gate"))
        except InvalidField as problem:
            raise ValueError(f"{self._at('filter', problem.field)}: {problem.reason}") from problem
        if gate is None:
            self.assumed.append(f"[filter] gate{': none' if method == 'known' else f' = {GATE}'}")
        return options

    def capacity(self, tags: int, unknown: bool) -> int:
        """The number of landmark slots. tags: number of landmarks with a name."""
        capacity = self._filter().get("capacity")
        if capacity is None:
            return int(self._default("filter", "capacity", max(tags, 1) + ROOM * unknown))
        if type(capacity) is not int or capacity < max(tags, 1):  # a bool is an int, too
            raise ValueError(
                f"{self._at('filter', 'capacity')}: expected a whole number of at least "
                f"{max(tags, 1)}, the number of tags, got {capacity!r}"
            )
        return capacity

    def start(self) -> np.ndarray | None:
        """The pose (3,) before the first row; None if the file has none."""
        return self._pose("start")

    def start_cov(self) -> np.ndarray:
        """The covariance (3, 3) of the pose at the start."""
        deviations, matrix = self._pose("start_noise"), self._filter().get("start_covariance")
        if matrix is not None:
            place = self._at("filter", "start_covariance")
            if deviations is not None:
                raise ValueError(f"{place}: expected no start_noise beside it")
            if not isinstance(matrix, list) or len(matrix) != 3:
                raise ValueError(f"{place}: expected 3 rows of numbers ({', '.join(POSE)})")
            rows = [self._numbers("filter", "start_covariance", row, POSE) for row in matrix]
            cov = np.array(rows)
            if is_asymmetric(cov) or is_indefinite(cov):
                raise ValueError(f"{place}: expected a covariance")
            return cov
        if deviations is None:
            deviations = np.array(self._default("filter", "start_noise", [0.0, 0.0, 0.0]))
        if (deviations < 0).any():
            raise ValueError(f"{self._at('filter', 'start_noise')}: expected numbers of at least 0")
        return np.diag(deviations) ** 2

    def _filter(self) -> dict[str, object]:
        section: dict[str, object] = self.content.get("filter", {})
        self._check_keys("filter", section, _FILTER)
        return section

    def _pose(self, key: str) -> np.ndarray | None:
        value = self._filter().get(key)
        return None if value is None else np.array(self._numbers("filter", key, value, POSE))

    def _model(
        self,
        section: str,
        registry: Mapping[str, Callable[..., _Model]],
        header: Sequence[str],
        further: tuple[str, ...],
    ) -> tuple[Callable[..., _Model], dict[str, object]]:
        """The factory of the model, which the section names or the columns determine, and options.

        further: keys that the section may have beside the arguments of the model.
        """
        options: dict[str, object] = dict(self.content.get(section, {}))
        name = options.pop("model", None)
        if name is None:
            name = self._default(
                section, "model", fitting_model(section, registry, header, self.path)
            )
        if not isinstance(name, str) or name not in registry:
            raise ValueError(
                f"{self._at(section, 'model')}: expected one of {', '.join(registry)}, got {name!r}"
            )
        parameters = inspect.signature(registry[name]).parameters
        arguments = [key for key in parameters if key != "noise_cov"]
        self._check_keys(section, options, ("model", "noise", *arguments, *further))
        options.pop("noise", None)
        for key in arguments:
            if key in options or key == "mount":
                continue
            default = parameters[key].default
            note = f"[{section}] {key} = {'none' if default is None else _as_toml(default)}"
            if key == "free" and name in UNMEASURED:
                note += (
                    f" (prior mean and variance of the {UNMEASURED[name]}, which is not "
                    "measured: see docs/methods/bearings_and_ranges.md)"
                )
            self.assumed.append(note)
        return registry[name], options

    def _noise(
        self, section: str, names: tuple[str, ...], defaults: Mapping[str, float]
    ) -> tuple[Parameter, ...]:
        """The standard deviations of the noise of a model, in its order."""
        noise = self.content.get(section, {}).get("noise")
        if noise is None:
            deviations = [defaults.get(split_unit(name)[1] or "", 0.1) for name in names]
            self.assumed.append(f"[{section}] noise = {deviations} ({', '.join(names)})")
            self.default_noises.append(section)
        else:
            deviations = self._numbers(section, "noise", noise, names)
            if min(deviations) < 0:
                raise ValueError(
                    f"{self._at(section, 'noise')}: expected standard deviations >= 0, got {noise}"
                )
        return tuple(
            Parameter(f"{section} {name}", value, "noise", (section, "noise"))
            for name, value in zip(names, deviations, strict=True)
        )

    def _errors(
        self,
        section: str,
        adjustable: Mapping[str, tuple[tuple[str, ...], tuple[float, ...]]],
        errors: Mapping[str, object],
    ) -> tuple[Parameter, ...]:
        """The systematic errors of a model: the values of the settings, or those without an error.

        Args:
            adjustable: by key the names of the numbers, and their values without an error.
            errors: the values in the settings, by key.
        """
        for key in errors:
            if key not in adjustable:
                model = {"motion": "controls of travel and turn", "sensor": "a range first"}
                raise ValueError(
                    f"{self._at(section, key)}: expected a model with {model[section]}"
                )
        parameters: list[Parameter] = []
        for key, (names, neutral) in adjustable.items():
            values = self._numbers(section, key, errors.get(key, list(neutral)), names)
            for name, value, without_error in zip(names, values, neutral, strict=True):
                if without_error == 1.0 and value <= 0:  # a factor
                    raise ValueError(f"{self._at(section, key)}: expected a {name} above 0")
                parameters.append(Parameter(f"{key} {name}", value, key, (section, key)))
        return tuple(parameters)

    def _number(self, section: str, key: str, default: float) -> float:
        value = self.content.get(section, {}).get(key)
        return default if value is None else self._numbers(section, key, value, ("[s] or [m]",))[0]

    def _positive(self, section: str, key: str, default: float) -> float:
        value = self._number(section, key, default)
        if value < 0:
            raise ValueError(f"{self._at(section, key)}: expected a number >= 0, got {value:g}")
        return value

    def _numbers(self, section: str, key: str, value: object, names: Sequence[str]) -> list[float]:
        """The numbers of a list, one for each name; a single one may stand without a list."""
        if len(names) == 1 and is_number(value):
            value = [value]
        if (
            not isinstance(value, list)
            or len(value) != len(names)
            or not all(map(is_number, value))
        ):
            raise ValueError(
                f"{self._at(section, key)}: expected {len(names)} number{'s' * (len(names) > 1)} "
                f"({', '.join(names)}), got {value!r}"
            )
        numbers = [float(number) for number in value]
        for name, number in zip(names, numbers, strict=True):
            if "[rad]" in name and abs(number) > TURN and "covariance" not in key:
                self.assumed.append(
                    f"[{section}] {key}: {name} = {number:g} is beyond 2π: degrees? write radians"
                )
            elif "[rad]" in name and number > _LARGEST_DEVIATION and key == "noise":
                self.assumed.append(
                    f"[{section}] {key}: {name} = {number:g} is a standard deviation of "
                    f"{np.rad2deg(number):.3g}°: degrees? write radians"
                )
        return numbers

    def _build(
        self,
        section: str,
        factory: Callable[..., _Model],
        options: dict[str, object],
        noise: object,
    ) -> _Model:
        try:
            with warnings.catch_warnings():  # `_numbers` has noted a mount beyond 2π
                warnings.filterwarnings("ignore", message=".*beyond 2π")
                return factory(noise, **options)
        except (ValueError, TypeError) as problem:
            raise ValueError(f"{self.path}: [{section}] {problem}") from problem

    def _default(self, section: str, key: str, value: _Value) -> _Value:
        shown = f'"{value}"' if isinstance(value, str) else value
        self.assumed.append(f"[{section}] {key} = {shown}")
        return value

    def _check_keys(
        self, section: str, content: Mapping[str, object], expected: Sequence[str]
    ) -> None:
        for key in content:
            if key not in expected:
                raise ValueError(f"{self._at(section, key)}: expected one of {', '.join(expected)}")

    def _at(self, section: str, key: str) -> str:
        """The place of a key, at the beginning of a message."""
        line = _line_number(self._text, section, key)
        return (
            f"{self.path}:{f'{line}: ' if line else ' '}{f'[{section}] ' if section else ''}{key}"
        )


def _as_toml(value: object) -> object:
    """A default as in TOML: lists in place of tuples, six digits."""
    if isinstance(value, tuple):
        return [_as_toml(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
