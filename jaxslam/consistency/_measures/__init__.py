"""The measures of a campaign: one, or a family, a file, and a line here for each.

`register` adds one of your own: `docs/extend/measure.md`.
"""

from collections.abc import Iterable

from jaxslam.consistency._measures import (
    associations,
    coverage,
    errors,
    further,
    innovations,
    nees,
    observability,
)
from jaxslam.consistency._measures.counts import MEANINGS
from jaxslam.consistency._measures.measure import Measure
from jaxslam.core.validation import InvalidField, refusals_of

BUILT_IN: tuple[Measure, ...] = (
    *nees.MEASURES,
    innovations.NIS,
    innovations.AUTOCORRELATION,
    *coverage.COVERAGE,
    *coverage.CREDIBILITY,
    *errors.MEASURES,
    *associations.MEASURES,
    *observability.MEASURES,
    innovations.LOG_LIKELIHOOD,
)

REGISTRY: dict[str, Measure] = {measure.key: measure for measure in BUILT_IN}
"""Measures by key, in the order of tables."""


def register(measure: Measure) -> Measure:
    """Add a measure to all campaigns from now on, and return it; one of its key is replaced.

    Raises ValueError where its key is one of this package's, or without a function of a run.
    """
    names = {name for m in BUILT_IN for name in (m.key, m.column)} | {*MEANINGS}
    with refusals_of("register"):
        if measure.key in names:
            raise InvalidField("", f"{measure.key!r} is the key of a measure of jaxslam")
        if measure.of_run is None and type(measure) is Measure:
            raise InvalidField("", f"measure {measure.key!r} has no of_run")
    REGISTRY[measure.key] = measure
    return measure


def in_figure(name: str) -> list[Measure]:
    """The measures whose curves have a panel in the figure of this name."""
    return [measure for measure in REGISTRY.values() if measure.figure == name]


def measures_of(names: Iterable[str]) -> list[Measure]:
    """The measures of the registry, and one for each other of these names.

    So a stored campaign can be read without the file that registered its measures.
    """
    registered = {name for m in REGISTRY.values() for name in (m.key, m.column)}
    others = dict.fromkeys(name for name in names if name not in registered)
    return [*REGISTRY.values(), *(further.measure_of(n) or Measure(n, n) for n in others)]


__all__ = ["Measure", "register"]
