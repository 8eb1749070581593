"""The filters of a campaign by name, configured for a scenario."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, Unpack

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam._driver import run
from jaxslam.charts import LeftInvariant, RightInvariant
from jaxslam.core._names import Named
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Candidate, Estimator, Filter
from jaxslam.core.types import Truth
from jaxslam.filters._ekf.ekf_settings import EkfOptions
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


def variant(scenario: World, *, watch: bool = False, **options: Unpack[EkfOptions]) -> Filter:
    """EKF-SLAM with the scenario's options, which these arguments of `filters.EkfSlam` replace.

    watch: with an observability monitor (`filters.Monitored`).
    """
    filter = EkfSlam(
        scenario.motion,
        scenario.sensor,
        _capacity(scenario),
        **(scenario.filter_options | options),
    )
    return Monitored(filter) if watch else filter


def ideal(
    scenario: World, *, watch: bool = False, **options: Unpack[EkfOptions]
) -> Callable[[Truth], Filter]:
    """The ideal EKF, with Jacobians at the truth: a function of the truth that returns a filter."""
    return _AtTheTruth(variant(scenario, **options), watch)


@record
class _AtTheTruth:
    """An EKF, as a function of the truth that it is linearized at."""

    ekf: Filter
    watch: bool = static()

    def __call__(self, truth: Truth) -> Filter:
        filter: Filter = replace(self.ekf, linearize=AtTruth(truth))
        return Monitored(filter) if self.watch else filter


@record
class _InTheTrueMap:
    """A localization filter, as a function of the truth whose map it is given."""

    filter: Localization | ParticleLocalization

    def __call__(self, truth: Truth) -> Filter:
        return replace(self.filter, landmarks=truth.landmarks)


@record
class _OnTheTruePath:
    """A filter of mapping, as a function of the truth whose poses it is given."""

    filter: Filter
    start: ArrayLike

    def __call__(self, truth: Truth) -> Estimator:
        poses = jnp.asarray(truth.pose)
        return lambda log, key: run(
            self.filter, log._replace(control=poses), self.start, np.zeros((3, 3)), key
        )


def _without_measurements(scenario: World, **options: Unpack[EkfOptions]) -> Filter:
    """Dead reckoning in a scenario; it has none of the options of `EkfSlam`."""
    return DeadReckoning(scenario.motion, scenario.sensor)


def _options(scenario: World, more: EkfOptions, *names: str) -> dict[str, Any]:
    """Those of the scenario's options and of some more that have these names."""
    given = {**scenario.filter_options, **more}
    return {name: given[name] for name in names if name in given}


_OF_MAPS = "gate", "associate", "births"
"""The options of filters that initialize landmarks, without those only of `EkfSlam`."""


def _in_a_known_map(scenario: World, **options: Unpack[EkfOptions]) -> Callable[[Truth], Filter]:
    """Localization in the true map, with those options of `EkfSlam` that it has."""
    mine = _options(scenario, options, "correction", "gate", "iterations")
    return _InTheTrueMap(Localization(scenario.motion, scenario.sensor, scenario.landmarks, **mine))


def on_given_poses(scenario: World, **options: Unpack[EkfOptions]) -> Filter:
    """Mapping, whose controls are the poses, with those options of `EkfSlam` that it has."""
    mine = _options(scenario, options, *_OF_MAPS)
    return Mapping(scenario.sensor, _capacity(scenario), **mine)


def _on_the_true_path(
    scenario: World, **options: Unpack[EkfOptions]
) -> Callable[[Truth], Estimator]:
    """Mapping from the true path; options as above. Its pose has no NEES: it is exact."""
    return _OnTheTruePath(on_given_poses(scenario, **options), np.asarray(scenario.pose))


def _by_particles(
    scenario: World, proposal: Literal["motion", "measurement"], **options: Unpack[EkfOptions]
) -> Filter:
    """FastSLAM of 50 particles, with those options of `EkfSlam` that it has."""
    return FastSlam(
        scenario.motion,
        scenario.sensor,
        _capacity(scenario),
        _SLAM_PARTICLES,
        proposal=proposal,
        **_options(scenario, options, *_OF_MAPS),
    )


def _by_particles_in_a_known_map(
    scenario: World, **options: Unpack[EkfOptions]
) -> Callable[[Truth], Filter]:
    """Monte-Carlo localization in the true map, of 300 particles; options as above."""
    count, mine = _LOCALIZATION_PARTICLES, _options(scenario, options, "gate", "associate")
    return _InTheTrueMap(
        ParticleLocalization(
            scenario.motion,
            scenario.sensor,
            scenario.landmarks,
            count,
            least=count,
            threshold=0.5,
            **mine,
        )
    )


def _in_a_window(
    scenario: World, *, first_estimates: bool = False, **options: Unpack[EkfOptions]
) -> Filter:
    """The fixed-lag smoother of 5 steps, with those options of `EkfSlam` that it has."""
    capacity = _capacity(scenario)
    false = 0 if scenario.spurious is None else scenario.spurious.places
    return FixedLag(
        scenario.motion,
        scenario.sensor,
        capacity,
        (scenario.places or capacity) + false,
        window=_WINDOW,
        first_estimates=first_estimates,
        **_options(scenario, options, *_OF_MAPS),
    )


def _in_one_batch(scenario: World, **options: Unpack[EkfOptions]) -> BatchMap:
    """The graph of the whole log (`smoothing.BatchMap`), with those options of `EkfSlam` that it
    has."""
    start = np.asarray(scenario.pose), np.asarray(scenario.pose_cov)
    mine = _options(scenario, options, *_OF_MAPS)
    return BatchMap(scenario.motion, scenario.sensor, _capacity(scenario), *start, **mine)


_WINDOW = 5
"""motions and scans in the window of the fixed-lag smoother in the catalog"""

_SLAM_PARTICLES = 50
"""number of particles of FastSLAM in the catalog; small, for campaigns of all filters."""

_LOCALIZATION_PARTICLES = 300
"""of Monte-Carlo localization in the catalog, at every step"""


def _in_canonical_form(scenario: World, **options: Unpack[EkfOptions]) -> Filter:
    """The exact information filter in a scenario; of the options of `EkfSlam` it takes the gate."""
    mine = _options(scenario, options, "gate")
    return EifSlam(scenario.motion, scenario.sensor, _capacity(scenario), **mine)


def _sparse_in_canonical_form(scenario: World, **options: Unpack[EkfOptions]) -> Filter:
    """The sparse information filter in a scenario; of the options of `EkfSlam` it takes the gate.

    It has half the map active, 8 landmarks at least and 20 at most, and all links. It reports
    covariances from its whole Ω, not from Markov-blanket marginals, so that a campaign evaluates
    the sparsification alone. With all of the map active it would be `EifSlam` by definition. All
    landmarks that a scan measures must be active at once; so a scan of more measurement slots than
    half of what is active (in `cloister` all 36 columns are measured in every step) is divided
    (`InPieces`).
    """
    count = _capacity(scenario)
    active = min(max(min(_LARGEST_AREA, count // 2), _LEAST_AREA), count)
    filter = Seif(
        scenario.motion,
        scenario.sensor,
        count,
        active=active,
        links=max(1, count - 1),
        exact_marginals=True,
        **_options(scenario, options, "gate"),
    )
    return filter if active == count else InPieces(filter, active // 2)


def _capacity(scenario: World) -> int:
    return int(np.shape(scenario.landmarks)[0])


_LEAST_AREA, _LARGEST_AREA = 8, 20
"""active landmarks of the sparse information filter in the catalog"""


FILTERS: Named[Callable[..., Candidate]] = Named(
    {
        "ekf": variant,
        "ideal": ideal,
        "iterated": lambda world, **more: variant(world, iterations=3, **more),
        "fej": lambda world, **more: variant(world, linearize=FirstEstimate(), **more),
        "oc": lambda world, **more: variant(world, linearize=Observability(), **more),
        "right_invariant": lambda world, **more: variant(world, chart=RightInvariant(), **more),
        "left_invariant": lambda world, **more: variant(world, chart=LeftInvariant(), **more),
        "ukf": lambda world, **more: variant(world, linearize=Unscented(), **more),
        "ukf_right": lambda world, **more: variant(
            world, chart=RightInvariant(), linearize=Unscented(), **more
        ),
        "square_root": lambda world, **more: variant(world, covariance="square_root", **more),
    }
)
"""By name; each takes a scenario, further options of `EkfSlam`, and `watch` of `variant`, and
returns what `monte_carlo` runs on it."""

BASELINES: Named[Callable[..., Candidate]] = Named(
    {
        "dead_reckoning": _without_measurements,
        "localization": _in_a_known_map,
        "mapping": _on_the_true_path,
    }
)
"""The worst and the best cases of a SLAM filter: no measurements, a known map, and a known path; as
FILTERS."""

PARTICLES: Named[Callable[..., Candidate]] = Named(
    {
        "fastslam1": lambda world, **more: _by_particles(world, "motion", **more),
        "fastslam2": lambda world, **more: _by_particles(world, "measurement", **more),
        "particle_localization": _by_particles_in_a_known_map,
    }
)
"""The particle filters; as FILTERS."""

CANONICAL: Named[Callable[..., Candidate]] = Named(
    {"eif_slam": _in_canonical_form, "seif": _sparse_in_canonical_form}
)
"""The information filters, exact and sparse; as FILTERS."""

SMOOTHERS: Named[Callable[..., Candidate]] = Named(
    {
        "fixed_lag": _in_a_window,
        "fixed_lag_fej": lambda world, **more: _in_a_window(world, first_estimates=True, **more),
        "batch_map": _in_one_batch,
    }
)
"""The fixed-lag smoothers, and the batch solution of the whole log; as FILTERS."""

KINDS: Named[tuple[str, ...]] = Named(
    {
        "Kalman filter": ("ekf", "ideal", "iterated", "square_root"),
        "consistent Jacobians": ("fej", "oc"),
        "error coordinates": ("right_invariant", "left_invariant"),
        "unscented": ("ukf", "ukf_right"),
        "smoothing": ("fixed_lag", "fixed_lag_fej", "batch_map"),
        "information": ("eif_slam", "seif"),
        "particles": ("fastslam1", "fastslam2", "particle_localization"),
        "baselines": ("dead_reckoning", "localization", "mapping"),
    }
)
"""The names by kind of filter; figures of many filters are divided so."""

ALL = Named(FILTERS | SMOOTHERS | CANONICAL | PARTICLES | BASELINES)
"""All filters, which the command line knows, and runs for `--filters all`."""
