"""The file `dataset.toml` of a table: models, noises, gate and start, with defaults."""

import inspect
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam import motion, sensors
from jaxslam.association import (
    GlobalNearest,
    JointCompatibility,
    Known,
    MaximumLikelihood,
    Nearest,
)
from jaxslam.core.logs.tables import INTERVAL, POSE, odometry_columns, split_unit
from jaxslam.core.protocols import Associate, Motion, Sensor
from jaxslam.core.record import record, static
from jaxslam.core.types import JaxOrNumPy
from jaxslam.filters.ekf.ekf_settings import EkfOptions
from jaxslam.math import stats

_Model = TypeVar("_Model", bound=Motion | Sensor)

_DEFAULT_MODELS = ("unicycle", "pose_increment", "range_bearing")
"""The default among models with the same columns."""


class Parametric(NamedTuple, Generic[_Model]):
    """A model as a function of its noise deviations and its mount, with those of the file."""

    names: tuple[str, ...]
    deviations: tuple[float, ...]
    mount: tuple[float, ...] | None
    """None for a model without one"""
    make: Callable[[JaxOrNumPy, ArrayLike | None], _Model]
    """(deviations (W,) an array, mount (3,) or None) -> model"""

    def made(self) -> _Model:
        """The model with the numbers of the file."""
        return self.make(np.array(self.deviations), self.mount)


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


def association_options(method: object, gate: object, size: int) -> EkfOptions:
    """Options of `EkfSlam` for a method by name and a gate by probability.

    Raises ValueError, "associate: …" or "gate: …", on an unknown name and a gate that is not a
    probability. By default known identities have no gate, other methods `GATE`.

    Args:
        method: one of `METHODS`.
        gate: the probability that a correct measurement passes.
        size: numbers of a measurement.
    """
    probability = None if gate is None else _probability(gate)
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"associate: expected one of {', '.join(METHODS)}, got {method!r}")
    if method == "known":
        return {} if probability is None else {"gate": stats.chi2_quantile(probability, size)}
    inner = GATE if probability is None else probability
    beyond = stats.chi2_quantile(max(inner, NEW_GATE), size)
    limit = inner if method == "joint" else stats.chi2_quantile(inner, size)
    return {"associate": METHODS[method](limit, beyond)}


def _probability(gate: object) -> float:
    """The gate as a probability; ValueError if it is not one."""
    if not isinstance(gate, int | float) or isinstance(gate, bool) or not 0 < gate < 1:
        raise ValueError(f"gate: expected a probability between 0 and 1, got {gate!r}")
    return gate


def is_number(value: object) -> bool:
    """Whether a value of a file is a finite number."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )


FITTED = "fit.toml"
"""The file of fitted numbers, which replace those of `dataset.toml`."""


def fitted_text(
    numbers: Mapping[str, Mapping[str, Sequence[float]]], comments: Mapping[str, str]
) -> str:
    """The text of `FITTED` with numbers by section and key, and comments by "section.key"."""
    parts = []
    for section, keys in numbers.items():
        lines = [
            f"{key} = [{', '.join(f'{value:.4g}' for value in values)}]"
            f"  # {comments[f'{section}.{key}']}\n"
            for key, values in keys.items()
        ]
        parts.append(f"[{section}]\n" + "".join(lines))
    return "\n".join(parts)


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

_MOTION_NOISE = {"m/s": 0.1, "rad/s": 0.1, "m": 0.02, "rad": 0.02}
_MEASUREMENT_NOISE = {"m": 0.1, "rad": 0.05, "1": 1.0}
"""Default standard deviations by unit."""
ROOM = 100
"""Default number of landmarks, where identities are unknown."""
_FILTER = ("gate", "capacity", "associate", "update", "start", "start_noise")


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
    except (OSError, UnicodeDecodeError) as problem:
        raise ValueError(f"{path}: cannot be read: {problem}") from problem


class TableSettings:
    """The settings of a folder; `assumed` lists the defaults taken so far.

    Raises ValueError on a file that is not TOML, and on an unknown section or key.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.assumed: list[str] = []
        self._text, self.content = _read(path)
        if not path.exists():
            self.assumed.append(f"no {path.name}")
        fitted = _read(path.with_name(FITTED))[1]
        for section in fitted.keys() & {"motion", "sensor"}:
            self.content[section] = self.content.get(section, {}) | fitted[section]
            self.assumed.append(f"[{section}] {', '.join(fitted[section])} of {FITTED}")
        known = ("name", "source", "motion", "sensor", "filter")
        self._check_keys("", self.content, known)
        for name in known:
            kind = str if name in ("name", "source") else dict
            if not isinstance(self.content.get(name, kind()), kind):
                wanted = "text" if kind is str else f"a section [{name}]"
                raise ValueError(f"{self._at('', name)}: expected {wanted}")

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
        factory, options = self._model("motion", motion.REGISTRY, given)
        shell = self._built("motion", factory, options, of_no_noise)
        from_poses = odometry_columns(shell.controls, given) == POSE
        with_interval = INTERVAL in shell.controls

        def model(deviations: JaxOrNumPy, mount: ArrayLike | None = None) -> Motion:
            noise = _TableNoise(deviations, interval, from_poses or with_interval, from_poses)
            plain = self._built("motion", factory, options, noise)
            return _WithInterval(plain, noise) if from_poses else plain

        deviations = self._noise("motion", shell.noises, _MOTION_NOISE)
        return Parametric(shell.noises, tuple(deviations), None, model)

    def sensor(self, given: Sequence[str]) -> Parametric[Sensor]:
        """The sensor. given: the columns of the measurements."""
        factory, options = self._model("sensor", sensors.REGISTRY, given)
        mount, has_mount = None, "mount" in inspect.signature(factory).parameters
        if "mount" in options:
            mount = self._numbers("sensor", "mount", options.pop("mount"), POSE)
        names = self._built("sensor", factory, options, of_no_noise).measurements
        deviations = self._noise("sensor", names, _MEASUREMENT_NOISE)
        if not all(deviations):
            raise ValueError(f"{self._at('sensor', 'noise')}: expected numbers above 0")
        if has_mount and mount is None:
            mount = self._default("sensor", "mount", [0.0, 0.0, 0.0])

        def model(deviations: JaxOrNumPy, mount: ArrayLike | None) -> Sensor:
            # NumPy for plain numbers, so that nothing is compiled.
            cov = deviations[:, None] ** 2 * np.eye(len(names))
            more = options if mount is None else options | {"mount": mount}
            return self._built("sensor", factory, more, cov)

        return Parametric(names, tuple(deviations), None if mount is None else tuple(mount), model)

    def filter_options(self, size: int, unknown: bool) -> EkfOptions:
        """The options of `EkfSlam`. size: of a measurement; unknown: whether tags are unknown."""
        section = self._filter()
        update = section.get("update")
        if update is None:
            update = self._default("filter", "update", "sequential")
        if update != "sequential" and update != "joint":
            raise ValueError(
                f'{self._at("filter", "update")}: expected "sequential" or "joint", got {update!r}'
            )
        options: EkfOptions = {"correction": update}
        method, gate = section.get("associate"), section.get("gate")
        if method is None:
            method = self._default("filter", "associate", "nearest" if unknown else "known")
        try:
            options |= association_options(method, gate, size)
        except ValueError as problem:
            key, _, reason = str(problem).partition(": ")
            raise ValueError(f"{self._at('filter', key)}: {reason}") from problem
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
        self, section: str, registry: Mapping[str, Callable[..., _Model]], given: Sequence[str]
    ) -> tuple[Callable[..., _Model], dict[str, object]]:
        """The factory named by a section, or else by the columns, and its options."""
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
        known = [key for key in inspect.signature(registry[name]).parameters if key != "noise_cov"]
        self._check_keys(section, options, ("model", "noise", *known))
        options.pop("noise", None)
        return registry[name], options

    def _noise(
        self, section: str, names: tuple[str, ...], defaults: Mapping[str, float]
    ) -> list[float]:
        """The standard deviations of the noise of a model, in its order."""
        given = self.content.get(section, {}).get("noise")
        if given is None:
            usual = [defaults.get(split_unit(name)[1] or "", 0.1) for name in names]
            self.assumed.append(f"[{section}] noise = {usual} ({', '.join(names)})")
            return usual
        found = self._numbers(section, "noise", given, names)
        if min(found) < 0:
            raise ValueError(
                f"{self._at(section, 'noise')}: expected standard deviations >= 0, got {given}"
            )
        return found

    def _numbers(self, section: str, key: str, given: object, names: Sequence[str]) -> list[float]:
        if (
            not isinstance(given, list)
            or len(given) != len(names)
            or not all(map(is_number, given))
        ):
            raise ValueError(
                f"{self._at(section, key)}: expected {len(names)} numbers "
                f"({', '.join(names)}), got {given!r}"
            )
        return [float(value) for value in given]

    def _built(
        self,
        section: str,
        factory: Callable[..., _Model],
        options: dict[str, object],
        noise: object,
    ) -> _Model:
        try:
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
