"""A user's Python file: the models and hand-derived Jacobians that it defines."""

import contextlib
import dataclasses
import importlib.util
import inspect
import io
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

from numpy.typing import ArrayLike

from jaxslam.core._validation import is_user_file
from jaxslam.core.claims import Jacobian
from jaxslam.core.protocols import Chart, Component, Filter, Linearizer
from jaxslam.simulation._worlds import World
from jaxslam.verify import Check, Report, build
from jaxslam.verify._user_errors import describe_error, place_of_error

_CLAIMS = ("_jacobian", "_jacobians")
"""Endings of names: f_jacobian is the hand-derived Jacobian of f."""

_EXPECTED = (
    "a Motion, a Sensor, a Factor, a class of one whose only required field is noise_cov, a "
    "function annotated to return one, a BeamModel, or a function f with an f_jacobian"
)

_ABOUT = ("arguments", "outputs", "states")
"""Endings of names: f_arguments and others are arguments of `verify_jacobians` for f."""


class UnusableFile(ValueError):
    """A file that cannot be loaded, or that defines nothing to verify."""


@dataclasses.dataclass(frozen=True)
class _Target:
    """A model or function of a user's file: the arguments of `verify_jacobians`."""

    name: str
    model: Any
    jacobian: Jacobian | None = None
    arguments: Mapping[str, Sequence[str] | int] | None = None
    outputs: Sequence[str] | None = None
    states: Sequence[ArrayLike] | None = None
    notes: tuple[str, ...] = ()
    """for the report"""


class _PrintRecorder(io.TextIOBase):
    """A replacement of standard output that records which lines of a user's file write to it."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        """the lines as "file.py:12", in order, each once"""

    def write(self, text: str) -> int:
        """Record the line that calls; the text is dropped."""
        frame = sys._getframe(1)
        while frame.f_back is not None and not is_user_file(frame.f_code.co_filename):
            frame = frame.f_back
        place = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
        if place not in self.lines:
            self.lines.append(place)
        return len(text)


@contextlib.contextmanager
def _recorded_prints() -> Iterator[_PrintRecorder]:
    """A block in which printed text is recorded instead of shown."""
    printed = _PrintRecorder()
    with contextlib.redirect_stdout(printed):
        yield printed


def load(target: str) -> list[_Target]:
    """The models and functions that `file.py` or `file.py:name` defines, in the order of the file.

    These are models with claims, as `Motion`, `Sensor`, `graphs.Factor` and `grids.BeamModel`;
    classes of them that need noise_cov alone, or nothing; functions annotated to return one, of a
    noise covariance or of nothing; and functions f with a function f_jacobian (or
    f_jacobians), whose entries may be named as f_arguments = {"pose": ("x [m]", …), …} and
    f_outputs = ("range [m]", …), and their states given as f_states = (array (S, n), …).

    Raises:
        UnusableFile: with the line, if the file is missing, does not import, or defines none.
    """
    path, name = split_target(target)
    module = import_file(path)
    keys = [key for key in vars(module) if name in ("", key)]
    targets = [t for key in keys if (t := _target(module, key)) is not None]
    skipped = [key for key in keys if isinstance(vars(module)[key], Chart | Linearizer)]
    if targets and skipped:
        note = f"not verified: {', '.join(skipped)} (no chart and no linearizer is)"
        targets[0] = dataclasses.replace(targets[0], notes=(*targets[0].notes, note))
    if targets:
        return targets
    if name and not keys:
        raise UnusableFile(f"{path.name}: there is no {name!r} to verify{names_in(module)}")
    if not name:
        raise UnusableFile(f"{path.name}: defines nothing to verify: expected {_EXPECTED}")
    hint = f"got a {type(value := vars(module)[name]).__name__}"
    if callable(value):
        hint = f"define {name}_jacobian, or call jaxslam.verify_jacobians({name}) in Python"
    raise UnusableFile(f"{path.name}: expected {name} to be {_EXPECTED}; {hint}")


def verify_file(target: str, verify_one: Callable[..., Report]) -> list[Report]:
    """Reports on all models and functions of a file.

    verify_one: `verify_jacobians` with its options.

    Raises UnusableFile as `load` does, and if none of them can be verified.
    """
    with _recorded_prints() as printed:
        targets = load(target)
    notes = tuple(f"{line} prints when the file is loaded" for line in printed.lines)
    reports, unusable = [], []
    for candidate in targets:
        try:
            reports.append(_verify(candidate, verify_one))
        except ValueError as error:
            unusable.append(str(error))
            check = Check("can be verified", False, str(error))
            reports.append(Report(candidate.name, "function", checks=(check,)))
    if len(unusable) == len(targets):
        raise UnusableFile("; ".join(unusable))
    return [dataclasses.replace(reports[0], notes=(*notes, *reports[0].notes)), *reports[1:]]


def _verify(target: _Target, verify_one: Callable[..., Report]) -> Report:
    """The report on a target, with a check that it prints nothing, since it must be pure."""
    with _recorded_prints() as printed:
        report = verify_one(
            target.model,
            target.jacobian,
            arguments=target.arguments,
            outputs=target.outputs,
            states=target.states,
            name=target.name,
        )
    where = ", ".join(printed.lines)
    quiet = Check("prints nothing", not where, f"{where} prints" if where else "")
    return dataclasses.replace(
        report,
        model=target.name,
        checks=(*report.checks, quiet),
        notes=(*target.notes, *report.notes),
    )


def split_target(target: str) -> tuple[Path, str]:
    """The file and the name, or "", of FILE.py or FILE.py:NAME.

    Raises UnusableFile on a missing file, or one that is not Python.
    """
    file, colon, name = target.rpartition(":")
    if not colon or not file.endswith(".py"):
        file, name = target, ""
    path = Path(file)
    if path.suffix != ".py":
        raise UnusableFile(f"{file}: expected a Python file, FILE.py or FILE.py:NAME")
    if not path.is_file():
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise UnusableFile(f"{file}: no such file{where}")
    return path, name


def import_file(path: Path) -> ModuleType:
    """The module of a file; raises UnusableFile where it cannot be imported."""
    name = f"_jaxslam_user_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.resolve().parent))  # it may import neighbouring modules
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise UnusableFile(f"{path.name}:{error.lineno}: {error.msg}") from error
    except (Exception, SystemExit) as error:
        where = place_of_error(error)
        why = describe_error(error).removeprefix(f"{where}: ")
        raise UnusableFile(f"{where or path.name}: does not import: {why}") from error
    finally:
        sys.path.pop(0)
        del sys.modules[name]
    return module


def names_in(module: ModuleType) -> str:
    """The functions, models, filters and scenarios that a user's file defines, to end a message."""
    names = [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not (isinstance(value, type) and not _has_claims(value))
        and (
            _has_claims(type(value))
            or isinstance(value, Filter | World)
            or (callable(value) and getattr(value, "__module__", "") == module.__name__)
        )
    ]
    return f"; it defines: {', '.join(names)}" if names else "; it defines nothing"


def _target(module: ModuleType, name: str) -> _Target | None:
    """The object to verify under a name of the module, or None."""
    value = getattr(module, name)
    about: dict[str, Any] = {ending: getattr(module, f"{name}_{ending}", None) for ending in _ABOUT}
    claims = [getattr(module, name + end) for end in _CLAIMS if hasattr(module, name + end)]
    if callable(value) and claims and not isinstance(value, Component):
        if len(claims) > 1:
            raise UnusableFile(f"expected {name}_jacobian or {name}_jacobians, got both")
        return _Target(name, value, claims[0], **about)
    if getattr(value, "__module__", "") == module.__name__ and _is_factory(value):
        try:
            value = build(value)
        except Exception as error:
            kind = "class" if isinstance(value, type) else "factory"
            raise UnusableFile(f"the {kind} {name}: {describe_error(error)}") from error
    if not _has_claims(type(value)):
        return None
    unused = [f"{name}_{end}" for end in ("arguments", "outputs") if about[end] is not None]
    notes = (f"not used: {', '.join(unused)} (a model names its entries)",) if unused else ()
    return _Target(name, value, states=about["states"], notes=notes)


def _has_claims(kind: object) -> bool:
    """Whether a class is one of models with claims."""
    if not (isinstance(kind, type) and issubclass(kind, Component)):
        return False
    return kind.claims is not Component.claims


def _is_factory(value: object) -> bool:
    """Whether this is a class of models with claims that needs noise_cov alone, or nothing; or a
    function, annotated to return one, of at most one required argument."""
    is_class = isinstance(value, type)
    with contextlib.suppress(Exception):  # what has no signature, or names what is not there
        returned = value if is_class else get_type_hints(value)["return"]
        parameters = inspect.signature(value).parameters.values()  # type: ignore[arg-type]
        required = [p.name for p in parameters if p.default is p.empty]
        return _has_claims(returned) and required in (
            [],
            ["noise_cov"] if is_class else required[:1],
        )
    return False
