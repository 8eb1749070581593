"""The scenario and the filters of a campaign: by name, or from a user's own file.

In place of a name, FILE.py:NAME takes NAME from a Python file: a `Scenario` or a function that
returns one, a `Filter` or a function of the scenario that returns one.
"""

import contextlib
import inspect
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

from jaxslam import filters
from jaxslam.catalog import ALL
from jaxslam.cli.common import pick
from jaxslam.consistency.campaign.candidates import check_fits, check_noise
from jaxslam.core.protocols import Candidate, Filter
from jaxslam.simulation.scenarios import SCENARIOS
from jaxslam.simulation.worlds import World
from jaxslam.verify.inputs.user_files import import_file, names_in, split_target
from jaxslam.verify.user_errors import describe_error

_OWN = "; or FILE.py:NAME, one of your own"


class UserObjects:
    """The objects of a user's files; each file is executed once."""

    def __init__(self) -> None:
        self._modules: dict[Path, ModuleType] = {}

    def scenario(self, asked: str, steps: int | None) -> World:
        """A scenario, by name or from a file; steps: None for its own number of them.

        Raises ValueError where there is none, and where a `Scenario` is to have other steps.
        """
        arguments = () if steps is None else (steps,)
        if not _in_file(asked):
            return pick("scenario", asked, SCENARIOS, _OWN)(*arguments)
        _, own = self._find("--scenario", asked)
        made = own
        if isinstance(made, World) and steps is not None:
            raise ValueError(
                f"--steps: {asked} is a Scenario, which has {made.steps}; "
                "expected a function of the number of steps"
            )
        if not isinstance(made, World) and callable(made):
            told = "the number of steps" if arguments else "nothing"
            made = self._call(asked, told, made, *arguments)
        if not isinstance(made, World):
            raise ValueError(
                f"{asked}: expected a Scenario, or a function that returns one, {_got(own, made)}"
            )
        check_noise(made)
        return made

    def filters(self, asked: str, scenario: World) -> dict[str, Candidate]:
        """The filters of a comma-separated list, or all of the catalog, by name.

        Raises ValueError where there is none, and with its name if one cannot run the scenario.
        """
        entries = [entry.strip() for entry in asked.split(",")]
        if entries == ["all"]:
            entries = list(ALL)
        if "" in entries:
            raise ValueError(
                "--filters: expected names of filters, or FILE.py:NAME, with commas between them, "
                f"or all, got {asked!r}"
            )
        found: dict[str, Candidate] = {}
        for entry in entries:
            name, candidate = (self._own if _in_file(entry) else _of_catalog)(entry, scenario)
            if name in found:
                raise ValueError(f"--filters: expected each name once, got {name} twice")
            found[name] = candidate
        return found

    @contextlib.contextmanager
    def located_errors(self) -> Iterator[None]:
        """A block whose errors in a user's file become a ValueError that begins with the line."""
        try:
            yield
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            if not any(Path(frame.filename) in self._modules for frame in frames):
                raise
            raise ValueError(describe_error(error)) from error

    def _find(self, option: str, asked: str) -> tuple[str, object]:
        """The name and the object of FILE.py:NAME."""
        path, name = split_target(asked)
        path = path.resolve()
        if path not in self._modules:
            self._modules[path] = import_file(path)
        module = self._modules[path]
        if not name:
            raise ValueError(f"{option}: expected FILE.py:NAME, got {asked}{names_in(module)}")
        if not hasattr(module, name):
            raise ValueError(f"{option}: there is no {name!r} in {path.name}{names_in(module)}")
        return name, getattr(module, name)

    def _own(self, asked: str, scenario: World) -> tuple[str, Candidate]:
        """The name of a user's filter, and the filter for the scenario.

        It is the filter's own, or NAME for one that still has that of a filter of the library.
        """
        name, own = self._find("--filters", asked)
        made = own
        if not isinstance(made, Filter) and callable(made):
            made = self._call(asked, "the scenario", made, scenario)
        if not isinstance(made, Filter) and not callable(made):
            raise ValueError(
                f"{asked}: expected a Filter, or a function of the scenario that returns one, "
                f"{_got(own, made)}"
            )
        if isinstance(made, Filter) and not (made.name in ALL or hasattr(filters, made.name)):
            name = made.name
        check_fits(name, made, scenario)
        return name, made

    def _call(
        self, asked: str, told: str, function: Callable[..., object], *arguments: object
    ) -> object:
        """What a user's function returns; `told` says what it is called with."""
        given = "one argument" if arguments else "no argument"
        try:
            inspect.signature(function).bind(*arguments)
        except TypeError as error:
            raise ValueError(f"{asked} is called with {given}: {error}") from error
        try:
            return function(*arguments)
        except Exception as error:
            raise ValueError(
                f"{asked}: called with {told}, it fails: {describe_error(error)}"
            ) from error


def _got(own: object, made: object) -> str:
    """What stands in a file in place of what was expected, or what its function returned."""
    return f"got {made!r:.60}" if made is own else f"got a function that returned {made!r:.60}"


def _in_file(asked: str) -> bool:
    """Whether an object is asked for by its file."""
    return ":" in asked or asked.endswith(".py")


def _of_catalog(name: str, scenario: World) -> tuple[str, Candidate]:
    """The name and a filter of the catalog; raises ValueError if it cannot run the scenario."""
    make = pick("filters", name, ALL, _OWN)
    try:
        return name, make(scenario, watch=True)
    except ValueError as error:
        fit = ",".join(other for other in ALL if _can_run(other, scenario))
        raise ValueError(
            f"--filters: {name} cannot run scenario {scenario.name!r}: {error}"
            + f"; those of the catalog that can: --filters {fit}" * bool(fit)
        ) from error


def _can_run(name: str, scenario: World) -> bool:
    """Whether a filter of the catalog can be made for the scenario."""
    try:
        ALL[name](scenario)
    except ValueError:
        return False
    return True
