"""The scenario and the filters of a campaign: by name, or from a Python file of the user.

In place of a name, FILE.py:NAME takes NAME from a Python file: a `Scenario` or a function that
returns one, a `Filter` or a function of the scenario that returns one.
"""

import contextlib
import inspect
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

from jaxslam._cli.common import pick
from jaxslam.catalog import ALL
from jaxslam.consistency.campaign._candidates import candidate_for, check_noise
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.core.validation import refusals_of, require
from jaxslam.simulation._worlds import World
from jaxslam.simulation.scenarios import SCENARIOS
from jaxslam.verify._inputs.user_files import import_file, names_in, split_target
from jaxslam.verify._user_errors import describe_error

_FROM_FILE = "; or FILE.py:NAME, one of your own"


class UserObjects:
    """The objects of a user's files; each file is executed once."""

    def __init__(self) -> None:
        self._modules: dict[Path, ModuleType] = {}

    def scenario(self, entry: str, steps: int | None) -> World:
        """A scenario, by name or from a file; steps: None for its default.

        Raises ValueError on an unknown one, and on a number of steps for a `Scenario`.
        """
        arguments = () if steps is None else (steps,)
        if not _in_file(entry):
            return pick("scenario", entry, SCENARIOS, _FROM_FILE)(*arguments)
        _, value = self._find("--scenario", entry)
        if isinstance(value, World) and steps is not None:
            raise ValueError(
                f"--steps: {entry} is a Scenario, which has {value.steps}; "
                "expected a function of the number of steps"
            )
        world = value
        if not isinstance(value, World) and callable(value):
            words = "the number of steps" if arguments else "nothing"
            world = self._call(entry, words, value, *arguments)
        if not isinstance(world, World):
            raise ValueError(
                f"{entry}: expected a Scenario, or a function that returns one, "
                f"{_mismatch(value, world)}"
            )
        with refusals_of("--scenario"):
            check_noise(world)
        return world

    def filters(self, names: str, scenario: World) -> dict[str, Candidate]:
        """The filters of a comma-separated list, or all of the catalog, by name.

        Raises ValueError on an unknown one, and on one that cannot run the scenario.
        """
        entries = [entry.strip() for entry in names.split(",")]
        if entries == ["all"]:
            entries = list(ALL)
        if "" in entries:
            raise ValueError(
                "--filters: expected names of filters, or FILE.py:NAME, with commas between them, "
                f"or all, got {names!r}"
            )
        candidates: dict[str, Candidate] = {}
        for entry in entries:
            name, candidate = (self._from_file if _in_file(entry) else _from_catalog)(
                entry, scenario
            )
            if name in candidates:
                raise ValueError(f"--filters: expected each name once, got {name} twice")
            candidates[name] = candidate
        return candidates

    @contextlib.contextmanager
    def located_errors(self) -> Iterator[None]:
        """A block that turns an error in a user's file into a ValueError with file and line."""
        try:
            yield
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            if not any(Path(frame.filename) in self._modules for frame in frames):
                raise
            raise ValueError(describe_error(error)) from error

    def _find(self, option: str, entry: str) -> tuple[str, object]:
        """The name and the object of FILE.py:NAME."""
        path, name = split_target(entry)
        path = path.resolve()
        if path not in self._modules:
            self._modules[path] = import_file(path)
        module = self._modules[path]
        if not name:
            raise ValueError(f"{option}: expected FILE.py:NAME, got {entry}{names_in(module)}")
        if not hasattr(module, name):
            raise ValueError(f"{option}: {path.name} has no {name!r}{names_in(module)}")
        return name, getattr(module, name)

    def _from_file(self, entry: str, scenario: World) -> tuple[str, Candidate]:
        """NAME of a user's file, and the filter for the scenario."""
        name, value = self._find("--filters", entry)
        candidate = value
        if not isinstance(value, Filter) and callable(value):
            candidate = self._call(entry, "the scenario", value, scenario)
        if not isinstance(candidate, Filter) and not callable(candidate):
            raise ValueError(
                f"{entry}: expected a Filter, or a function of the scenario that returns one, "
                f"{_mismatch(value, candidate)}"
            )
        with refusals_of("--filters"):
            require(name, candidate, candidate_for(scenario))
        return name, candidate

    def _call(
        self, entry: str, words: str, function: Callable[..., object], *arguments: object
    ) -> object:
        """The result of a user's function; words: a description of its argument."""
        count = "one argument" if arguments else "no argument"
        try:
            inspect.signature(function).bind(*arguments)
        except TypeError as error:
            raise ValueError(f"{entry} is called with {count}: {error}") from error
        try:
            return function(*arguments)
        except Exception as error:
            raise ValueError(
                f"{entry}: called with {words}, it fails: {describe_error(error)}"
            ) from error


def _mismatch(value: object, result: object) -> str:
    """A phrase on the object in the file, or on the result of the function in the file."""
    source = "got" if result is value else "got a function that returned"
    return f"{source} {result!r:.60}"


def _in_file(entry: str) -> bool:
    """Whether an entry names a file."""
    return ":" in entry or entry.endswith(".py")


def _from_catalog(name: str, scenario: World) -> tuple[str, Candidate]:
    """The name and a filter of the catalog; ValueError if it cannot run the scenario."""
    build = pick("filters", name, ALL, _FROM_FILE)
    try:
        return name, build(scenario, watch=True)
    except ValueError as error:
        possible = []
        for candidate in ALL:
            with contextlib.suppress(ValueError):
                ALL[candidate](scenario)
                possible.append(candidate)
        raise ValueError(
            f"--filters: {name} cannot run scenario {scenario.name!r}: {error}"
            + f"; those of the catalog that can: --filters {','.join(possible)}" * bool(possible)
        ) from error
