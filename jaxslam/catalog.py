"""All filters by name, configured for a scenario: the variants of EKF-SLAM, and filters to compare
them with.

A variant is a chart, a linearizer or an option, given in one line; `monte_carlo` and the command
line run them side by side.

Looked up by name; the error of an unknown one has suggestions for typos.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam._driver import run
from jaxslam.charts import LeftInvariant, RightInvariant
from jaxslam.core._names import Named
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Candidate, Estimator, Filter
from jaxslam.core.types import Truth
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.filters._ekf.monitor import Monitored
from jaxslam.filters._information.eif_slam import EifSlam, InPieces
from jaxslam.filters._information.seif import Seif
from jaxslam.filters._known.dead_reckoning import DeadReckoning
from jaxslam.filters._known.localization import Localization
from jaxslam.filters._known.mapping import Mapping
from jaxslam.filters._particles.fastslam import FastSlam
from jaxslam.filters._particles.particle_localization import ParticleLocalization
from jaxslam.graphs.smoothing._batch_map import BatchMap
from jaxslam.graphs.smoothing._fixed_lag import FixedLag
from jaxslam.linearize._other_points import AtTruth, FirstEstimate, Observability
from jaxslam.linearize._unscented import Unscented
from jaxslam.simulation._worlds import World

__all__ = ["ALL", "FILTERS", "KINDS", "SMOOTHERS", "ideal", "on_given_poses", "variant"]

_WINDOW = 5
"""motions and scans in the window of the fixed-lag smoother"""

_SLAM_PARTICLES = 50
"""particles of FastSLAM; few, for campaigns of all filters"""

_LOCALIZATION_PARTICLES = 300
"""particles of Monte-Carlo localization, at every step"""

_LEAST_AREA, _LARGEST_AREA = 8, 20
"""active landmarks of the sparse information filter"""

_OF_MAPS = "gate", "associate", "births"
"""the options of `EkfSlam` that all filters which initialize landmarks have"""


def variant(scenario: World, *, watch: bool = False, **options: Any) -> Filter:
    """EKF-SLAM with the scenario's options, which these arguments of `filters.EkfSlam` replace.

    watch: with an observability monitor (`filters.Monitored`).
    """
    filter = EkfSlam(
        scenario.motion,
        scenario.sensor,
        _capacity(scenario),
        **{**scenario.filter_options, **options},
    )
    return Monitored(filter) if watch else filter


def ideal(scenario: World, *, watch: bool = False, **options: Any) -> Callable[[Truth], Filter]:
    """The ideal EKF, with Jacobians at the truth: a function of the truth that returns a filter."""
    return _LinearizedAtTruth(variant(scenario, **options), watch)


def on_given_poses(scenario: World, **options: Any) -> Filter:
    """Mapping, whose controls are the poses, with those options of `EkfSlam` that it has."""
    return Mapping(scenario.sensor, _capacity(scenario), **_options(scenario, options, *_OF_MAPS))


# --- functions of a run's truth: records, so that their numbers are arguments of the programs -----


@record
class _LinearizedAtTruth:
    """An EKF, as a function of the truth that it is linearized at."""

    ekf: Filter
    watch: bool = static()

    def __call__(self, truth: Truth) -> Filter:
        filter: Filter = replace(self.ekf, linearize=AtTruth(truth))
        return Monitored(filter) if self.watch else filter


@record
class _InTrueMap:
    """A localization filter, as a function of the truth whose map it gets."""

    filter: Localization | ParticleLocalization

    def __call__(self, truth: Truth) -> Filter:
        return replace(self.filter, landmarks=truth.landmarks)


@record
class _OnTruePath:
    """A filter of mapping, as a function of the truth whose poses it gets."""

    filter: Filter
    start: ArrayLike
    further: tuple[int, ...] = static(default=())
    """which of `Truth.further` the sensor asks for, in its order"""

    def __call__(self, truth: Truth) -> Estimator:
        poses = jnp.asarray(truth.pose)
        if self.further:
            poses = jnp.concatenate(
                [poses, jnp.asarray(truth.further)[:, np.array(self.further)]], axis=1
            )
        exact = np.zeros((3 + len(self.further),) * 2)
        return lambda log, key: run(
            self.filter, log._replace(control=poses), self.start, exact, key
        )


def _on_true_path(filter: Filter, world: World) -> _OnTruePath:
    rows = [world.motion.state.index(name) for name in filter.robot_state]
    return _OnTruePath(filter, np.asarray(world.pose)[rows], tuple(k - 3 for k in rows[3:]))


# --- filters for a scenario: each takes the options of `EkfSlam`, and uses the ones that it has ---


def _capacity(scenario: World) -> int:
    """The slots of the world's filters, by default one for each landmark."""
    return scenario.capacity or int(np.shape(scenario.landmarks)[0])


def _options(scenario: World, overrides: dict[str, Any], *names: str) -> dict[str, Any]:
    """The options of these names, of the scenario or in place of the scenario's."""
    options = {**scenario.filter_options, **overrides}
    return {name: options[name] for name in names if name in options}


def _fastslam(
    scenario: World, proposal: Literal["motion", "measurement"], **options: Any
) -> Filter:
    return FastSlam(
        scenario.motion,
        scenario.sensor,
        _capacity(scenario),
        _SLAM_PARTICLES,
        proposal=proposal,
        **_options(scenario, options, *_OF_MAPS),
    )


def _particle_localization(scenario: World, **options: Any) -> Candidate:
    return _InTrueMap(
        ParticleLocalization(
            scenario.motion,
            scenario.sensor,
            scenario.landmarks,
            _LOCALIZATION_PARTICLES,
            least=_LOCALIZATION_PARTICLES,
            threshold=0.5,
            **_options(scenario, options, "gate", "associate"),
        )
    )


def _fixed_lag(scenario: World, *, first_estimates: bool = False, **options: Any) -> Filter:
    capacity = _capacity(scenario)
    clutter = 0 if scenario.spurious is None else scenario.spurious.places
    return FixedLag(
        scenario.motion,
        scenario.sensor,
        capacity,
        (scenario.places or capacity) + clutter,
        window=_WINDOW,
        first_estimates=first_estimates,
        **_options(scenario, options, *_OF_MAPS),
    )


def _batch_map(scenario: World, **options: Any) -> BatchMap:
    start = np.asarray(scenario.pose), np.asarray(scenario.pose_cov)
    used = _options(scenario, options, *_OF_MAPS)
    return BatchMap(scenario.motion, scenario.sensor, _capacity(scenario), *start, **used)


def _eif_slam(scenario: World, **options: Any) -> Filter:
    used = _options(scenario, options, "gate")
    return EifSlam(scenario.motion, scenario.sensor, _capacity(scenario), **used)


def _seif(scenario: World, **options: Any) -> Filter:
    """The sparse information filter, with half the map active and all links.

    It reports covariances from its whole Ω, not from Markov-blanket marginals, so that a campaign
    evaluates the sparsification alone. With all of the map active it would be `EifSlam` by
    definition. All landmarks that a scan measures must be active at once; so a scan of more
    measurement slots than half of what is active (in `cloister` all 36 columns are measured in
    every step) is divided (`InPieces`).
    """
    capacity = _capacity(scenario)
    active = min(max(min(_LARGEST_AREA, capacity // 2), _LEAST_AREA), capacity)
    filter = Seif(
        scenario.motion,
        scenario.sensor,
        capacity,
        active=active,
        links=max(1, capacity - 1),
        exact_marginals=True,
        **_options(scenario, options, "gate"),
    )
    return filter if active == capacity else InPieces(filter, active // 2)


_BY_KIND: dict[str, dict[str, Callable[..., Candidate]]] = {
    "Kalman filter": {
        "ekf": variant,
        "ideal": ideal,
        "iterated": lambda world, **options: variant(world, iterations=3, **options),
        "square_root": lambda world, **options: variant(world, covariance="square_root", **options),
    },
    "consistent Jacobians": {
        "fej": lambda world, **options: variant(world, linearize=FirstEstimate(), **options),
        "oc": lambda world, **options: variant(world, linearize=Observability(), **options),
    },
    "error coordinates": {
        "right_invariant": lambda world, **options: variant(
            world, chart=RightInvariant(), **options
        ),
        "left_invariant": lambda world, **options: variant(world, chart=LeftInvariant(), **options),
    },
    "unscented": {
        "ukf": lambda world, **options: variant(world, linearize=Unscented(), **options),
        "ukf_right": lambda world, **options: variant(
            world, chart=RightInvariant(), linearize=Unscented(), **options
        ),
    },
    "smoothing": {
        "fixed_lag": _fixed_lag,
        "fixed_lag_fej": lambda world, **options: _fixed_lag(
            world, first_estimates=True, **options
        ),
        "batch_map": _batch_map,
    },
    "information": {"eif_slam": _eif_slam, "seif": _seif},
    "particles": {
        "fastslam1": lambda world, **options: _fastslam(world, "motion", **options),
        "fastslam2": lambda world, **options: _fastslam(world, "measurement", **options),
        "particle_localization": _particle_localization,
    },
    "baselines": {
        "dead_reckoning": lambda world, **options: DeadReckoning(world.motion, world.sensor),
        "localization": lambda world, **options: _InTrueMap(
            Localization(
                world.motion,
                world.sensor,
                world.landmarks,
                **_options(world, options, "correction", "gate", "iterations"),
            )
        ),
        # Its pose has no NEES: it is exact.
        "mapping": lambda world, **options: _on_true_path(on_given_poses(world, **options), world),
    },
}
"""Filters by kind and name. Baselines are the worst and the best cases of a SLAM filter: no
measurements, a known map, and a known path."""

_EKF_KINDS = "Kalman filter", "consistent Jacobians", "error coordinates", "unscented"


def _in_kinds(*kinds: str) -> Named[Callable[..., Candidate]]:
    return Named({name: make for kind in kinds for name, make in _BY_KIND[kind].items()})


KINDS: Named[tuple[str, ...]] = Named({kind: tuple(names) for kind, names in _BY_KIND.items()})
"""The names by kind of filter; figures of many filters are divided so."""

FILTERS = _in_kinds(*_EKF_KINDS)
"""The variants of EKF-SLAM by name; each takes a scenario, further options of `EkfSlam`, and
`watch` of `variant`, and returns what `monte_carlo` runs on it."""

SMOOTHERS = _in_kinds("smoothing")
"""The fixed-lag smoothers, and the batch solution of the whole log; see FILTERS."""

ALL = _in_kinds(*_BY_KIND)
"""All filters, which the command line knows, and runs for `--filters all`; see FILTERS."""
