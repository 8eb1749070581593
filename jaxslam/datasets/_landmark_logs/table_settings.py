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
from jaxslam.core._numbers import check_gate, is_number
from jaxslam.core._record import record, static
from jaxslam.core._units import TURN
from jaxslam.core.logs._tables import INTERVAL, POSE, odometry_columns, split_unit
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField
from jaxslam.datasets._dataset import Parameter
from jaxslam.math._definite import asymmetric, indefinite
from jaxslam.motion import _odometry_errors as odometry_errors
from jaxslam.sensors import _range_errors as range_errors

_Model = TypeVar("_Model", bound=Motion | Sensor)

_DEFAULT_MODELS = ("unicycle", "pose_increment", "range_bearing")
"""The default among models with the same columns."""


class Parametric(NamedTuple, Generic[_Model]):
    """A model as a function of its parameters, and with those of the file."""

    parameters: tuple[Parameter, ...]
    make: Callable[[JaxOrNumPy], _Model]
    """values, an array -> model"""
    made: _Model
    """the model of the file, without the systematic errors that it does not state"""


def fitting_model(
    section: str,
    registry: Mapping[str, Callable[..., Motion | Sensor]],
    given: Sequence[str],
    path: Path,
) -> str:
    """The model whose columns are given, by most columns and then by `_DEFAULT_MODELS`."""
    bare = {split_unit(name)[0] for name in given}
    fitting, known = [], []
    for name, factory in registry.items():
        model = factory(of_no_noise)
        names = (
            odometry_columns(model.controls, given)
            if isinstance(model, Motion)
            else model.measurements
        )
        known.append(f"{name} ({', '.join(names)})")
        if {split_unit(one)[0] for one in names} <= bare:
            fitting.append((len(names), name in _DEFAULT_MODELS, name))
    if not fitting:
        raise ValueError(
            f"{path}: [{section}] model: expected one, since no model has the columns "
            f"{', '.join(given)}; known: {'; '.join(known)}"
        )
    most = max(fitting)[:2]
    return next(name for *rank, name in fitting if tuple(rank) == most)


def of_no_noise(*_: object) -> NoReturn:
    """The noise of a model that serves only for its names, and is never evaluated."""
    raise AssertionError("a model that serves only for its names was evaluated")


GATE = 0.99
"""Default probability of the gate of an association."""

NEW_GATE = 0.9999
"""Probability of the gate beyond which a measurement is of a new landmark."""

METHODS: dict[str, Callable[..., Associate]] = {
    "nearest": Nearest,
    "global_nearest": GlobalNearest,
    "maximum_likelihood": MaximumLikelihood,
    "joint": JointCompatibility,
    "known": Known,
}


def association_options(method: object, gate: Any) -> dict[str, Any]:
    """Options of `EkfSlam` for a method by name and a gate.

    Raises InvalidField, of associate or gate, on an unknown name and a gate that is not a
    probability. By default known identities have no gate, other methods `GATE`.

    Args:
        method: one of `METHODS`.
        gate: the probability that a correct measurement passes.
    """
    check_gate("filter", gate)
    if not isinstance(method, str) or method not in METHODS:
        reason = f"expected one of {', '.join(METHODS)}, got {method!r}"
        raise InvalidField("filter", "associate", reason)
    if method == "known":
        return {} if gate is None else {"gate": gate}
    inner = GATE if gate is None else gate
    return {"associate": METHODS[method](inner, max(inner, NEW_GATE))}


FITTED = "fit.toml"
"""The file of fitted numbers, which replace those of `dataset.toml`."""


def fitted_text(parameters: Sequence[Parameter], cov: np.ndarray) -> str:
    """The text of `FITTED`: parameters by section and key, and the covariance of those with one."""
    places = {parameter.place: None for parameter in parameters}
    sections: dict[str, list[str]] = {section: [] for section, _ in places}
    for section, key in places:
        held = [one for one in parameters if one.place == (section, key)]
        numbers = ", ".join(f"{one.value:.6g}" for one in held)
        names = ", ".join(one.name.removeprefix(f"{section} ") for one in held)
        sections[section].append(f"{key} = [{numbers}]  # {names}\n")
    known = np.flatnonzero(np.diag(cov))
    if known.size:
        names = ", ".join(f'"{parameters[i].name}"' for i in known.tolist())
        rows = "".join(
            f"  [{', '.join(f'{value:.9g}' for value in row)}],\n" for row in cov[known][:, known]
        )
        sections["calibration"] = [f"parameters = [{names}]\n", f"covariance = [\n{rows}]\n"]
    return "\n".join(f"[{name}]\n" + "".join(lines) for name, lines in sections.items())


def _line_number(text: str, section: str, key: str) -> int | None:
    """The line, from 1, of a key in a section ("": at the top), or of the section, or None."""
    current, head = "", None
    for number, line in enumerate(text.split("\n"), 1):
        if heading := re.match(r"\s*\[\s*(\w+)\s*\]", line):
            current = heading[1]
            if head is None and current == (section or key):
                head = number
        elif current == section and re.match(rf"\s*{re.escape(key)}\s*=", line):
            return number
    return head


_Value = TypeVar("_Value")

UNMEASURED = {"range_only": "bearing [rad]", "bearing_only": "range [m]"}
"""What a sensor does not measure, and its option `free` is the prior of."""


def _listed(value: object) -> object:
    """A default as in TOML: lists in place of tuples, six digits."""
    if isinstance(value, tuple):
        return [_listed(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


_MOTION_NOISE = {"m/s": 0.1, "rad/s": 0.1, "m": 0.02, "rad": 0.02}
_MEASUREMENT_NOISE = {"m": 0.1, "rad": 0.05, "1": 1.0}
"""Default standard deviations by unit."""
ROOM = 100
"""Default number of landmarks, where identities are unknown."""
RANGE_BEARING = ("range [m]", "bearing [rad]")
_FILTER = ("gate", "capacity", "associate", "update", "start", "start_noise", "spacing")
_ODOMETRY_ERRORS = {
    "scale": (("travel", "turn"), (1.0, 1.0)),
    "wheels": (("outer [m]", "curvature [rad/m]"), (0.0, 0.0)),
    "heading": (("[rad]",), (0.0,)),
}
"""Keys of [motion] of `motion.Corrected`: names of their numbers, and those without an error."""
_RANGE_ERRORS = {"range": (("scale", "offset [m]"), (1.0, 0.0)), "axis": (("[rad]",), (0.0,))}
"""Keys of [sensor] of `sensors.Corrected`, likewise."""


@record
class _TableNoise:
    """The noise of a line of odometry, whatever rows divide it; see `TableSettings.motion`."""

    deviations: JaxOrNumPy
    interval: float
    per_time: bool = static()
    """whether the last control is Δt"""
    of_increments: bool = static()
    """whether they grow with Δt; else velocities, whose noise shrinks"""

    def __call__(self, pose: jax.Array, u: jax.Array) -> jax.Array:
        cov = jnp.diag(jnp.asarray(self.deviations, u.dtype) ** 2)
        if self.of_increments:
            return cov * u[-1] / self.interval
        if self.per_time:
            moving = u[-1] > 0
            return cov * jnp.where(moving, self.interval / jnp.where(moving, u[-1], 1.0), 0.0)
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

    def step(self, pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
        return self.motion.step(pose, u[:-1], w)


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    """The text and the content of a file of settings; empty without a file."""
    try:
        text = path.read_text(encoding="utf-8")
        return text, tomllib.loads(text)
    except FileNotFoundError:
        return "", {}
    except tomllib.TOMLDecodeError as problem:
        what, line = str(problem), text.count("\n") + 1
        if at := re.search(r" \(at line (\d+), column \d+\)$", what):
            what, line = what[: at.start()], int(at[1])
        raise ValueError(f"{path}:{line}: expected TOML: {what}") from problem
    except RecursionError as problem:
        raise ValueError(f"{path}: expected TOML, got brackets in brackets") from problem
    except (OSError, ValueError) as problem:  # not text, or a whole number of over 4,300 digits
        raise ValueError(f"{path}: cannot be read: {problem}") from problem


class TableSettings:
    """The settings of a folder, with its fitted numbers if wanted; `assumed` lists the defaults
    taken so far.

    Raises ValueError on a file that is not TOML, and on an unknown section or key.
    """

    def __init__(self, path: Path, fitted: bool = True) -> None:
        self.path = path
        self.assumed: list[str] = []
        self._text, self.content = _read(path)
        if not path.exists():
            self.assumed.append(f"no {path.name}")
        known = ("name", "source", "motion", "sensor", "filter", "calibration")
        self._check_keys("", self.content, known)
        for name in known:
            kind = str if name in ("name", "source") else dict
            if not isinstance(self.content.get(name, kind()), kind):
                wanted = "text" if kind is str else f"a section [{name}]"
                raise ValueError(f"{self._at('', name)}: expected {wanted}")
        numbers = path.with_name(FITTED)
        found = _read(numbers)[1] if fitted else {}
        for section in sorted(found.keys() & {"motion", "sensor", "calibration"}):
            if not isinstance(found[section], dict):
                raise ValueError(f"{numbers}: expected a section [{section}]")
            self.content[section] = self.content.get(section, {}) | found[section]
            self.assumed.append(f"[{section}] {', '.join(found[section])} of {FITTED}")

    def text(self, name: str, default: str) -> str:
        """The name or the source of the data."""
        return str(self.content.get(name, default))

    def motion(self, given: Sequence[str], interval: float) -> Parametric[Motion]:
        """The motion model; its noise is that of a line of odometry, however rows divide it.

        Velocities have the covariance σ² interval/Δt over Δt, white noise. Poses give increments
        with covariance σ² Δt/interval, and Δt as a last control. Other increments have σ².

        Args:
            given: the columns of the odometry.
            interval: the time between its lines [s].
        """
        factory, options = self._model("motion", motion.REGISTRY, given, (*_ODOMETRY_ERRORS,))
        errors = {key: options.pop(key) for key in _ODOMETRY_ERRORS if key in options}
        shell = self._built("motion", factory, options, of_no_noise)
        from_poses = odometry_columns(shell.controls, given) == POSE
        with_interval = INTERVAL in shell.controls
        count, correctable = len(shell.noises), odometry_errors.can_correct(shell)
        parameters = self._noise("motion", shell.noises, _MOTION_NOISE)
        parameters += self._errors("motion", _ODOMETRY_ERRORS if correctable else {}, errors)

        def plain(p: JaxOrNumPy) -> Motion:
            noise = _TableNoise(p[:count], interval, from_poses or with_interval, from_poses)
            model = self._built("motion", factory, options, noise)
            return _WithInterval(model, noise) if from_poses else model

        def model(p: JaxOrNumPy) -> Motion:
            if not correctable:
                return plain(p)
            scale, wheels = p[count : count + 2], p[count + 2 : count + 4]
            return motion.Corrected(plain(p), scale, wheels, p[count + 4])

        make = model if errors else plain
        return Parametric(parameters, model, make(np.array([one.value for one in parameters])))

    def sensor(self, given: Sequence[str]) -> Parametric[Sensor]:
        """The sensor. given: the columns of the measurements."""
        more = (*_RANGE_ERRORS, "across", "delay", "max_range")
        factory, options = self._model("sensor", sensors.REGISTRY, given, more)
        errors = {key: options.pop(key) for key in _RANGE_ERRORS if key in options}
        across = options.pop("across", None)
        for key in ("delay", "max_range"):  # of the log
            options.pop(key, None)
        mount, has_mount = None, "mount" in inspect.signature(factory).parameters
        if "mount" in options:
            mount = self._numbers("sensor", "mount", options.pop("mount"), POSE)
        shell = self._built("sensor", factory, options, of_no_noise)
        names = shell.measurements
        parameters = self._noise("sensor", names, _MEASUREMENT_NOISE)
        if not all(one.value for one in parameters):
            raise ValueError(f"{self._at('sensor', 'noise')}: expected numbers above 0")
        if across is not None:
            (spread,) = self._numbers("sensor", "across", across, ("[m]",))
            if names != RANGE_BEARING or spread < 0:
                raise ValueError(
                    f"{self._at('sensor', 'across')}: expected a number >= 0, of a sensor of "
                    f"{' and '.join(RANGE_BEARING)}, got {spread:g} of {', '.join(names)}"
                )
            where = "sensor", "across"
            parameters += (Parameter("sensor across [m]", spread, "noise", where),)
        at = len(parameters)
        if has_mount:
            if mount is None:
                mount = self._default("sensor", "mount", [0.0, 0.0, 0.0])
            parameters += tuple(
                Parameter(f"mount {name}", value, "mount", ("sensor", "mount"))
                for name, value in zip(POSE, mount, strict=True)
            )
        after, correctable = len(parameters), range_errors.can_correct(shell)
        known = {key: one for key, one in _RANGE_ERRORS.items() if key == "range" or key in errors}
        parameters += self._errors("sensor", known if correctable else {}, errors)

        def plain(p: JaxOrNumPy) -> Sensor:
            # NumPy for plain numbers, so that nothing is compiled.
            noise: NoiseCov = p[: len(names), None] ** 2 * np.eye(len(names))
            if across is not None:
                noise = sensors.RangeBearingNoise(p[0], p[1], across=p[2])
            more = options | {"mount": p[at : at + 3]} if has_mount else options
            return self._built("sensor", factory, more, noise)

        def model(p: JaxOrNumPy) -> Sensor:
            if not correctable:
                return plain(p)
            axis = p[after + 2] if "axis" in errors else None
            try:
                return sensors.Corrected(plain(p), p[after : after + 2], axis)
            except ValueError as problem:
                raise ValueError(f"{self.path}: [sensor] {problem}") from problem

        make = model if errors else plain
        return Parametric(parameters, model, make(np.array([one.value for one in parameters])))

    def delay(self) -> float:
        """By how much measurements are stamped later than they happened [s]."""
        return self._number("sensor", "delay", 0.0)

    def max_range(self) -> float:
        """The range from which on the sensor says nothing [m]."""
        return self._positive("sensor", "max_range", np.inf)

    def spacing(self) -> float:
        """The least time between two measurements of a landmark that are used [s]."""
        return self._positive("filter", "spacing", 0.0)

    def uncertain(self, parameters: tuple[Parameter, ...]) -> np.ndarray | None:
        """The covariance of the parameters in [calibration] (P, P), 0 of others; None without."""
        section = self.content.get("calibration")
        if section is None:
            return None
        self._check_keys("calibration", section, ("parameters", "covariance"))
        names, given = section.get("parameters"), section.get("covariance")
        known = [parameter.name for parameter in parameters]
        if not isinstance(names, list) or not names or not set(names) <= set(known):
            raise ValueError(
                f"{self._at('calibration', 'parameters')}: expected some of {', '.join(known)}, "
                f"got {names!r}"
            )
        if not isinstance(given, list) or len(given) != len(names):
            raise ValueError(
                f"{self._at('calibration', 'covariance')}: expected {len(names)} rows of numbers"
            )
        rows = np.array([self._numbers("calibration", "covariance", row, names) for row in given])
        if asymmetric(rows, 1e-6) or indefinite(rows, 1e-6):  # written with six digits
            raise ValueError(f"{self._at('calibration', 'covariance')}: expected a covariance")
        cov = np.zeros((len(known), len(known)))
        at = [known.index(name) for name in names]
        cov[np.ix_(at, at)] = rows
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
        method, gate = section.get("associate"), section.get("gate")
        if method is None:
            method = self._default("filter", "associate", "nearest" if unknown else "known")
        try:
            options |= association_options(method, gate)
        except InvalidField as problem:
            raise ValueError(f"{self._at('filter', problem.field)}: {problem.reason}") from problem
        if gate is None:
            self.assumed.append(f"[filter] gate{': none' if method == 'known' else f' = {GATE}'}")
        return options

    def capacity(self, tags: int, unknown: bool) -> int:
        """The number of landmark slots. tags: number of landmarks with a name."""
        given = self._filter().get("capacity")
        if given is None:
            return int(self._default("filter", "capacity", max(tags, 1) + ROOM * unknown))
        if type(given) is not int or given < max(tags, 1):
            raise ValueError(
                f"{self._at('filter', 'capacity')}: expected a whole number of at least "
                f"{max(tags, 1)}, the number of tags, got {given!r}"
            )
        return given

    def start(self) -> np.ndarray | None:
        """The pose (3,) before the first row; None if the file has none."""
        return self._three("start")

    def start_noise(self) -> np.ndarray:
        """The standard deviations (3,) of that pose."""
        given = self._three("start_noise")
        if given is None:
            return np.array(self._default("filter", "start_noise", [0.0, 0.0, 0.0]))
        if (given < 0).any():
            raise ValueError(f"{self._at('filter', 'start_noise')}: expected numbers of at least 0")
        return given

    def _filter(self) -> dict[str, object]:
        section: dict[str, object] = self.content.get("filter", {})
        self._check_keys("filter", section, _FILTER)
        return section

    def _three(self, key: str) -> np.ndarray | None:
        given = self._filter().get(key)
        if given is None:
            return None
        return np.array(self._numbers("filter", key, given, POSE))

    def _model(
        self,
        section: str,
        registry: Mapping[str, Callable[..., _Model]],
        given: Sequence[str],
        more: tuple[str, ...],
    ) -> tuple[Callable[..., _Model], dict[str, object]]:
        """The factory named by a section, or else by the columns, its options and `more`."""
        options: dict[str, object] = dict(self.content.get(section, {}))
        name = options.pop("model", None)
        if name is None:
            name = self._default(
                section, "model", fitting_model(section, registry, given, self.path)
            )
        if not isinstance(name, str) or name not in registry:
            raise ValueError(
                f"{self._at(section, 'model')}: expected one of {', '.join(registry)}, got {name!r}"
            )
        parameters = inspect.signature(registry[name]).parameters
        known = [key for key in parameters if key != "noise_cov"]
        self._check_keys(section, options, ("model", "noise", *known, *more))
        options.pop("noise", None)
        for key in known:
            if key not in options and key != "mount":
                default = parameters[key].default
                shown = "none" if default is None else _listed(default)
                of = ""
                if key == "free" and name in UNMEASURED:
                    of = (
                        f" (prior mean and variance of the {UNMEASURED[name]}, which is not "
                        "measured: see docs/methods/bearings_and_ranges.md)"
                    )
                self.assumed.append(f"[{section}] {key} = {shown}{of}")
        return registry[name], options

    def _noise(
        self, section: str, names: tuple[str, ...], defaults: Mapping[str, float]
    ) -> tuple[Parameter, ...]:
        """The standard deviations of the noise of a model, in its order."""
        given = self.content.get(section, {}).get("noise")
        if given is None:
            found = [defaults.get(split_unit(name)[1] or "", 0.1) for name in names]
            self.assumed.append(f"[{section}] noise = {found} ({', '.join(names)})")
        else:
            found = self._numbers(section, "noise", given, names)
            if min(found) < 0:
                raise ValueError(
                    f"{self._at(section, 'noise')}: expected standard deviations >= 0, got {given}"
                )
        return tuple(
            Parameter(f"{section} {name}", value, "noise", (section, "noise"))
            for name, value in zip(names, found, strict=True)
        )

    def _errors(
        self,
        section: str,
        known: Mapping[str, tuple[tuple[str, ...], tuple[float, ...]]],
        given: Mapping[str, object],
    ) -> tuple[Parameter, ...]:
        """The systematic errors of a model, those of the settings or none."""
        parameters: list[Parameter] = []
        for key in given:
            if key not in known:
                wanted = {"motion": "controls of travel and turn", "sensor": "a range first"}
                raise ValueError(
                    f"{self._at(section, key)}: expected a model with {wanted[section]}"
                )
        for key, (names, right) in known.items():
            values = self._numbers(section, key, given.get(key, list(right)), names)
            for name, value, without in zip(names, values, right, strict=True):
                if without == 1.0 and value <= 0:
                    raise ValueError(f"{self._at(section, key)}: expected a {name} above 0")
                parameters.append(Parameter(f"{key} {name}", value, key, (section, key)))
        return tuple(parameters)

    def _number(self, section: str, key: str, default: float) -> float:
        given = self.content.get(section, {}).get(key)
        return default if given is None else self._numbers(section, key, given, ("[s] or [m]",))[0]

    def _positive(self, section: str, key: str, default: float) -> float:
        value = self._number(section, key, default)
        if value < 0:
            raise ValueError(f"{self._at(section, key)}: expected a number >= 0, got {value:g}")
        return value

    def _numbers(self, section: str, key: str, given: object, names: Sequence[str]) -> list[float]:
        """So many numbers in a list; one may also be without it."""
        if len(names) == 1 and is_number(given):
            given = [given]
        if (
            not isinstance(given, list)
            or len(given) != len(names)
            or not all(map(is_number, given))
        ):
            raise ValueError(
                f"{self._at(section, key)}: expected {len(names)} number{'s' * (len(names) > 1)} "
                f"({', '.join(names)}), got {given!r}"
            )
        numbers = [float(value) for value in given]
        for unit, value in zip(names, numbers, strict=True):
            if "[rad]" in unit and abs(value) > TURN and key != "covariance":
                self.assumed.append(
                    f"[{section}] {key}: {unit} = {value:g} is beyond 2π: degrees? write radians"
                )
        return numbers

    def _built(
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
        self, section: str, content: Mapping[str, object], known: Sequence[str]
    ) -> None:
        for key in content:
            if key not in known:
                raise ValueError(f"{self._at(section, key)}: expected one of {', '.join(known)}")

    def _at(self, section: str, key: str) -> str:
        """The place of a key, at the beginning of a message."""
        line = _line_number(self._text, section, key)
        where = f"{self.path}:" + (f"{line}: " if line else " ")
        return where + (f"[{section}] " if section else "") + key
