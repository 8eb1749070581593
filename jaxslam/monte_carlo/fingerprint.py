"""The fingerprint of a campaign: text by which two campaigns are compared.

Two campaigns have the same fingerprint where they draw the same worlds, run the same filters over
them and score the same measures. It is taken from what the models and filters *do*: each is traced
to its jaxpr, and a digest is taken of the primitives, their parameters, their shapes and every
constant and literal, bit by bit. So a noise, a gate, a map, a chart or an edited line of a model is
seen wherever it is held, and a renamed or moved function, a comment and a memory address are not;
the same campaign built anew, in another process or on another host, has the same fingerprint.

Not seen: the inside of a host callback (`jax.pure_callback`), settings that no jaxpr shows (flags
of XLA), and the kind of processor among those of one platform. Of what scores and sums up the
results, the source is taken, that of `jaxslam.consistency`.

It takes a trace of each candidate's run, 0.1 to 0.5 s, and compiles nothing.
"""

import dataclasses
import enum
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, Literal, Var
from jax.typing import DTypeLike
from jaxtyping import PyTree

from jaxslam import consistency
from jaxslam.consistency import own_error_of
from jaxslam.monte_carlo.candidates import estimator_of, rounded
from jaxslam.protocols import Candidate
from jaxslam.sensors.suite import Suite
from jaxslam.simulation.worlds import Scenario, simulate
from jaxslam.types import Log, Trace, Truth


def fingerprint(
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    key: jax.Array,
    platform: str,
    bound: bool = False,
    dtype: DTypeLike | None = None,
) -> dict[str, str]:
    """All that must agree for two blocks of runs to be of one campaign: a short text by its name.

    The number of runs is no part of it: run i has a key of its own. platform: of the devices that
    compute, as "cpu"; rounding differs between platforms.
    """
    found = {
        **{name: _version(name) for name in ("jaxslam", "jax", "jaxlib")},
        "platform": platform,
        "dtype": str(jnp.result_type(float) if dtype is None else jnp.dtype(dtype)),
        "drawn in": str(jnp.result_type(float)),
        "key": _key(key),
        "bound": "yes" if bound else "no",
        "filters": ", ".join(filters),
        "scenario": scenario.name,
        "steps": str(scenario.steps),
    }
    for name in ("landmarks", "controls", "pose", "pose_cov"):
        found[name] = _array(getattr(scenario, name))
    motion, sensor = scenario.motion, scenario.sensor
    u, z = (jnp.zeros(len(names)) for names in (motion.controls, sensor.measurements))
    found["motion noise"] = digest(motion.noise_cov, jnp.zeros(3), u)
    if not isinstance(sensor, Suite):  # whose parts have noises of their own; "world" sees them
        found["sensor noise"] = digest(sensor.noise_cov, z)

    def world(key: jax.Array) -> tuple[Truth, Log, jax.Array]:
        truth, log = rounded(simulate(scenario, key), dtype)
        return truth, log, jax.vmap(sensor.position)(jnp.asarray(truth.landmarks))

    def results(candidate: Candidate) -> Callable[[Truth, Log, jax.Array], tuple[Trace, jax.Array]]:
        def of(truth: Truth, log: Log, key: jax.Array) -> tuple[Trace, jax.Array]:
            method, chart = estimator_of(candidate, truth, scenario)
            trace = method(log, key)
            return trace, own_error_of(chart, sensor, trace, truth)

        return of

    found["world"] = digest(world, key)
    truth, log, _ = jax.eval_shape(world, key)
    for name, candidate in filters.items():
        found[f"filter {name}"] = digest(results(candidate), truth, log, key)
    found["measures"] = _source(consistency)
    return found


def digest(function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """The digest of what a function computes of arguments of these shapes; see the module."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return _short(f"{jax.tree.structure(shapes)} {_Reader().value(closed)}")


_SKIPPED = frozenset({"name", "debug_info", "source_info"})
"""Parameters of primitives that label."""

_ADDRESS = re.compile(r"0x[0-9a-fA-F]+")


class _Reader:
    """Jaxprs, and what they hold, as text that is the same for the same computation."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Jaxpr, str]] = {}

    def jaxpr(self, jaxpr: Jaxpr) -> str:
        """The digest of a jaxpr, in which variables go by the order in which they appear."""
        if id(jaxpr) in self._known:
            return self._known[id(jaxpr)][1]
        numbers: dict[Var, int] = {}

        def bound(variables: Sequence[Var]) -> str:
            for variable in variables:
                numbers[variable] = len(numbers)
            return f"({', '.join(str(variable.aval) for variable in variables)})"

        def read(atoms: Sequence[Var | Literal]) -> str:
            return ", ".join(
                f"{atom.aval} {self.value(atom.val)}"
                if isinstance(atom, Literal)
                else f"#{numbers[atom]}"
                for atom in atoms
            )

        lines = [bound(jaxpr.constvars), bound(jaxpr.invars)]
        for eqn in jaxpr.eqns:
            parameters = {k: v for k, v in eqn.params.items() if k not in _SKIPPED}
            line = f"{eqn.primitive.name} {self.value(parameters)} {read(eqn.invars)}"
            context = f"{eqn.ctx.threefry_partitionable} {eqn.ctx.compute_type}"
            lines.append(f"{line} {context} -> {bound(eqn.outvars)}")
        lines.append(read(jaxpr.outvars))
        short = _short("\n".join(lines))
        self._known[id(jaxpr)] = jaxpr, short  # held, so that no other gets its id
        return short

    def value(self, value: object) -> str:
        """The text of a constant, or of a parameter of a primitive."""
        if hasattr(value, "jaxpr") and hasattr(value, "consts"):
            return f"{self.jaxpr(value.jaxpr)} of {self.value(list(value.consts))}"
        if isinstance(value, Jaxpr):
            return self.jaxpr(value)
        if value is None or isinstance(value, str | bytes | int | float | enum.Enum | np.dtype):
            return repr(value)
        if isinstance(value, Mapping):
            return str([(str(name), self.value(value[name])) for name in sorted(value, key=str)])
        if isinstance(value, tuple | list):
            return str([self.value(part) for part in value])
        if isinstance(value, set | frozenset):
            return str(sorted(self.value(part) for part in value))
        if hasattr(value, "dtype") and hasattr(value, "shape"):
            return _array(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            return f"{type(value).__name__} {self.value(fields)}"
        if callable(value) or hasattr(value, "call_wrapped"):
            return "function"  # a rule for transformations that are past, or a host callback
        return _ADDRESS.sub("", repr(value))


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _array(value: object) -> str:
    """Shape, dtype and a digest of the bits of an array, or of a key."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return _key(value)
    array = np.asarray(value)
    bits = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return f"{array.shape} {array.dtype} {bits[:16]}"


def _key(key: jax.Array) -> str:
    """A PRNG key as text: its kind and its numbers."""
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    data = np.asarray(jax.random.key_data(key) if typed else key)
    kind = str(jax.random.key_impl(key)) if typed else "raw"
    return f"{kind} {':'.join(map(str, data.ravel().tolist()))}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # run from its source, as by PYTHONPATH
        return "not installed"


def _source(package: ModuleType) -> str:
    """A digest of the source files of a package."""
    total = hashlib.sha256()
    for folder in package.__path__:
        for path in sorted(Path(folder).glob("*.py")):
            total.update(f"{path.name}\n".encode())
            total.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return total.hexdigest()[:16]
