"""The records exchanged by simulators, filters and campaigns, with their shapes.

All are NamedTuples, hence pytrees; leading axes are added by `vmap` (runs) and `scan` (time).
T steps, M measurement slots a step, N landmark slots, Z measurement size, L landmark size.
Masks and status codes, never NaN, mark absent data.
"""

import warnings
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._reprs import describe, short_repr, text_of
from jaxslam.core.logs import _streams as streams
from jaxslam.core.logs import _tables as tables
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.math._arrays import is_concrete
from jaxslam.math._pose_covariances import covariance_faults

__all__ = [
    "Beams",
    "Estimate",
    "Info",
    "JaxOrNumPy",
    "Log",
    "Recording",
    "Scan",
    "Status",
    "Trace",
    "Truth",
]

JaxOrNumPy: TypeAlias = Array | np.ndarray
"""The array of a record that is made in either: a compiled function takes both, and an operation
of NumPy compiles nothing."""


class Status(IntEnum):
    """The outcome of a measurement; `Info.status` holds one a measurement slot.

    `filters.status_of` has the decision table.
    """

    EMPTY = 0
    """No measurement there (padding)."""
    FUSED = 1
    """Corrected the map."""
    BORN = 2
    """Started a new landmark."""
    REJECTED = 3
    """Failed the gate, or not finite; dropped."""
    OVERFLOW = 4
    """A new landmark, but the map is full; dropped."""
    DEFERRED = 5
    """A new landmark beyond `births`, the limit of new landmarks a scan; dropped in this scan."""
    REPEATED = 6
    """Its new tag occurs earlier in the same scan; dropped."""
    SINGULAR = 7
    """Its innovation covariance is not positive definite, so that it cannot be gated; dropped."""
    UNMATCHED = 8
    """Association found it neither of a landmark nor new (between two gates, ambiguous, or of
    unknown identity where a tag is required), a robot it concerns has no pose in the map yet, or it
    is a beam that entered no weight (`grids.GridLocalization`); dropped."""
    SIGHTED = 9
    """Of no landmark yet; kept as a stored measurement (`filters.DelayedSlam`)."""

    @property
    def is_kept(self) -> bool:
        """Whether the measurement serves the map."""
        return self in (Status.FUSED, Status.BORN, Status.SIGHTED)

    @property
    def is_dropped(self) -> bool:
        """Whether there is a measurement, and the map does not get it."""
        return self != Status.EMPTY and not self.is_kept


class Scan(NamedTuple):
    """The measurements of one step, padded to M slots."""

    z: Float[Array, "M Z"]
    """measurements; any finite number where not valid."""
    tag: Int[Array, "M"]
    """landmark identity, -1 = unknown."""
    valid: Bool[Array, "M"]

    def __repr__(self) -> str:
        return short_repr(self)


class Log(NamedTuple):
    """The data of a robot. Row t: the control that led *to* pose t, and the scan taken there."""

    control: Float[Array, "T U"]
    """the interval Δt, where a model needs one, is part of it."""
    scan: Scan
    """with leading T."""

    @classmethod
    def from_streams(
        cls,
        odometry: tuple[ArrayLike, ArrayLike],
        measurements: tuple[ArrayLike, ArrayLike, ArrayLike],
        rule: streams.Rule,
        rows: ArrayLike | None = None,
    ) -> "Log":
        """The log of a stream of odometry and a stream of measurements, in NumPy.

        Args:
            odometry: times (K,), and values (K, V).
            measurements: times (J,) in any order, tags (J,), and values (J, Z). Those of one time
                are a scan, padded to the largest one with z 0, tag -1.
            rule: what a row's control is: `core.logs.hold`, `divide`, `relative`, or a function.
            rows: (T,) the times of the rows, rising; default every time of either stream.

        Raises:
            ValueError: on a measurement at a time without a row.
        """
        return cls.from_rows(streams.align_streams(odometry, measurements, rule, rows))

    @classmethod
    def from_rows(cls, rows: streams.Rows) -> "Log":
        """The log of aligned rows; arrays are NumPy's."""
        held: PyTree = rows  # the fields are declared as JAX arrays
        return cls(held.control, Scan(held.z, held.tag, held.valid))

    @classmethod
    def from_records(
        cls,
        odometry: tables.Tabular,
        measurements: tables.Tabular | Sequence[tables.Tabular],
        motion: PyTree,
        sensor: PyTree,
    ) -> "Recording":
        """The log of lines of odometry and measurements, each with its times.

            log, time, tags, dropped = Log.from_records(odometry, measurements, motion, sensor)

        odometry has columns t and the motion's controls without Δt; measurements has t, tag and
        what the sensor measures (no tag for a sensor of no landmark, as a compass). Either is a
        sequence of rows in this order (lists, an array of NumPy or JAX), or has columns with names:
        a mapping, a structured array, a data frame. A name may have a unit, as "bearing [deg]";
        else it is the model's. With `PoseIncrement` columns named t, x, y, theta may be a path of
        poses. Of a `sensors.Suite` measurements are one such table a part, in order: (of_laser,
        of_compass).

        There is a row at every time of either. A velocity holds until the next; poses are
        interpolated, but not in a gap, an interval above ten times the median; other controls stand
        as they are, and measurements must be at their times. Tags are whole numbers or text, in any
        order; None, "", NaN, -1 and a missing value of pandas or NumPy are unknown. Measurements
        before the first or after the last line of odometry, or in a gap between poses, are dropped
        and counted; the last velocity holds for the longest interval.

        Args:
            motion, sensor: the models.
        Raises:
            ValueError: with row and column, on a missing column, a value that is not finite,
                times that go back (of odometry: or repeat), a tag twice at a time, or more
                measurements at a time than the suite has slots.
        Warns:
            UserWarning: on angles or turn rates beyond 2π, which may be in degrees, on stamps that
                may be in milliseconds or nanoseconds, and on jumps of a path of poses, as where
                odometry was set to zero: the step before a jump takes its place.
        """
        controls, parts = motion.controls, getattr(sensor, "parts", None)  # parts of a suite
        with refusals_of("Log.from_records"):
            moved = tables.columns_of(
                "odometry",
                odometry,
                lambda columns: (tables.TIME, *tables.odometry_columns(controls, columns)),
            )
            sources: list[tuple[str, PyTree, PyTree, int | None]] = []
            if parts is None:
                sources = [("measurements", sensor, measurements, None)]
            else:
                if not isinstance(measurements, Sequence) or len(measurements) != len(parts):
                    parts_text = ", ".join(part.sensor.name for part in parts)
                    raise InvalidField(
                        "measurements",
                        f"expected a table for each of the {len(parts)} sensors of the suite, "
                        f"({parts_text}), got {describe(measurements)}",
                    )
                if any(part.sees == "robots" for part in parts):
                    raise InvalidField(
                        "sensor",
                        "expected sensors of landmarks; of a team make the log of each robot by "
                        "Log.from_streams, with the rows of all, and put them side by side",
                    )
                sources = [
                    (f"measurements[{i}] of {part.sensor.name}", part.sensor, table, part.places)
                    for i, (part, table) in enumerate(zip(parts, measurements, strict=True))
                ]
            seen = []
            for argument, model, source, places in sources:
                names = tables.measurement_columns(model.measurements, model.landmark)
                table = tables.columns_of(argument, source, lambda _, names=names: names)  # type: ignore[misc]
                seen.append(tables.Seen(table, model.measurements, places))
        for table in (moved, *(part.table for part in seen)):
            for sign in tables.wrong_units(table):
                warnings.warn(f"{sign} in the column's name", stacklevel=2)
        if jump := tables.replace_jumps(moved):
            warnings.warn(jump, stacklevel=2)
        with refusals_of("Log.from_records"):
            rows, tags, dropped = tables.align_tables(moved, seen, controls)
        return Recording(cls.from_rows(rows), rows.time, tags, dropped)

    def __repr__(self) -> str:
        return short_repr(self)


class Recording(NamedTuple):
    """The result of `Log.from_records`."""

    log: Log
    time: PyTree
    """(T,) the time of each row"""
    tags: tuple[int | str, ...]
    """the names of the landmarks with tags 0, 1, …, N-1, sorted"""
    dropped: dict[str, int]
    """number of measurements that are not in the log, by reason"""

    def __repr__(self) -> str:
        return short_repr(self)


class Truth(NamedTuple):
    """The true states of a simulation."""

    pose: Float[JaxOrNumPy, "T 3"]
    """true pose at each scan [m, m, rad]."""
    landmarks: Float[JaxOrNumPy, "N L"]
    """true landmarks, in the order of their tags."""
    missed: Int[JaxOrNumPy, "T"]
    """landmarks in view for which the scan had no free slot."""
    start: Float[JaxOrNumPy, "R"]
    """true pose before the first control; of a motion model with further numbers in its state, all
    R = 3 + E."""
    origin: Int[JaxOrNumPy, "T M"] | None = None
    """the tag of the landmark each measurement is truly of, -1 of none; None but in a world with
    `spurious` data."""
    further: Float[JaxOrNumPy, "T E"] | None = None
    """the true further numbers of the robot at each scan, `Motion.state[3:]`; None where E = 0."""

    @property
    def robot(self) -> Float[JaxOrNumPy, "T R"]:
        """The true pose and further numbers of the robot at each scan, R = 3 + E."""
        if self.further is None:
            return self.pose
        if isinstance(self.pose, np.ndarray) and isinstance(self.further, np.ndarray):
            return np.concatenate([self.pose, self.further], axis=-1)
        return jnp.concatenate([jnp.asarray(self.pose), jnp.asarray(self.further)], axis=-1)

    def __repr__(self) -> str:
        return short_repr(self)


class Estimate(NamedTuple):
    """Means and marginal covariances in map coordinates, for any chart of the filter."""

    pose: Float[JaxOrNumPy, "3"]
    """x [m], y [m], θ [rad] in (-π, π]."""
    pose_cov: Float[JaxOrNumPy, "3 3"]
    points: Float[JaxOrNumPy, "N 2"]
    """landmark positions [m]; 0 where not alive."""
    point_covs: Float[JaxOrNumPy, "N 2 2"]
    alive: Bool[JaxOrNumPy, "N"]
    tag: Int[JaxOrNumPy, "N"]
    """-1 where not alive."""
    further: Float[JaxOrNumPy, "E"] | None = None
    """the further numbers of the robot, `Motion.state[3:]`; None where its state is the pose."""
    further_cov: Float[JaxOrNumPy, "E E"] | None = None

    def __repr__(self) -> str:
        return short_repr(self)


class Info(NamedTuple):
    """The results of one update for each measurement slot."""

    nis: Float[Array, "M"]
    """normalized innovation squared of fused and rejected measurements, else 0. Within a joint
    update: of a measurement given those before it, so that the sum is the joint NIS."""
    dof: Int[Array, "M"]
    """Z where fused, else 0."""
    innovation: Float[Array, "M Z"]
    """z ⊖ ẑ of measurements matched to a landmark (fused, rejected or singular), else 0."""
    innovation_cov: Float[Array, "M Z Z"]
    """S of the same measurements, else 0."""
    slot: Int[Array, "M"]
    """the landmark slot corrected or initialized, -1 if none."""
    status: Int[Array, "M"]
    """see `Status`."""
    log_likelihood: Float[Array, ""]
    """Σ log N(innovation; 0, S) over fused measurements."""
    exhausted: Bool[Array, ""] | None = None
    """the search for the best association ended at its budget; None without a search"""
    extra: dict[str, PyTree] | None = None
    """records of a family or wrapper of filters, by name, as
    "particles" for a `filters.ParticleInfo`."""

    @property
    def overflow(self) -> jax.Array:
        """Whether at least one measurement was dropped because the map was full, () bool."""
        return (self.status == Status.OVERFLOW).any(-1)

    def tally(self, status: Status) -> jax.Array:
        """The number of measurements with that status: () of a step, (T,) of a whole trace."""
        return (self.status == status).sum(-1)

    def __repr__(self) -> str:
        return short_repr(self)


class Trace(NamedTuple):
    """The result of `run`: the estimates of a run, and the report of each step."""

    estimate: Estimate
    """with leading T, after each update."""
    info: Info
    """with leading T."""
    final: PyTree
    """the filter's state at the end."""
    probe: PyTree
    """results of the caller's probe after each update, leading T; None without one."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is wrong with a run, each with its count; () if nothing is.

        An estimate or Info with NaN or ∞, a pose covariance that is not symmetric or not positive
        definite by more than rounding, and over half of the measurements not used. Of the values of
        one run or of many, outside of a trace (else ValueError). Beams are measurements of which a
        filter may leave out most: they have no innovation, and are not counted.
        """
        if not is_concrete(self.estimate, self.info):
            raise InvalidField(
                "doubts", "it needs values: use it outside of jax.jit and jax.vmap", owner="Trace"
            )
        estimate, info = jax.device_get((self.estimate, self.info))
        pose, cov = np.asarray(estimate.pose), np.asarray(estimate.pose_cov)
        steps, faults = pose[..., 0].size, covariance_faults(pose, cov)
        finite = np.ones(pose.shape[:-1], bool)
        for leaf in map(np.asarray, jax.tree.leaves((estimate, info._replace(extra=None)))):
            rows = leaf.reshape(*finite.shape, -1)
            finite &= np.isfinite(rows).all(axis=-1) if leaf.dtype.kind == "f" else True
        counts = {
            "estimate or Info is not finite": ~finite,
            "pose_cov is not symmetric": faults.asymmetric,
            "pose_cov is not positive definite": faults.indefinite,
        }
        doubts = [
            f"{fault} in {int(bad.sum()):,} of {steps:,} steps"
            for fault, bad in counts.items()
            if bad.any()
        ]
        # (runs, T·M): one row without a leading axis.
        statuses = np.asarray(info.status)
        became = statuses.reshape(int(np.prod(statuses.shape[:-2])), -1)
        kept = [status for status in Status if status.is_kept]
        measured, used = (became != Status.EMPTY).sum(axis=1), np.isin(became, kept).sum(axis=1)
        starved = (measured > 2 * used) & (np.shape(info.innovation)[-1] > 0)
        if starved.any():
            lost, total = (int(count[starved].sum()) for count in (measured - used, measured))
            reasons = [
                (int((became[starved] == status).sum()), status.name.lower())
                for status in Status
                if status.is_dropped
            ]
            listed = ", ".join(f"{count:,} {reason}" for count, reason in reasons if count)
            runs = f" in {starved.sum():,} of {len(became):,} runs" * (statuses.ndim > 2)
            doubts.append(f"{lost:,} of {total:,} measurements were not used{runs}: {listed}")
        return tuple(doubts)

    def __repr__(self) -> str:
        lines = [
            f"{name}={text}" for name, text in zip(self._fields, map(text_of, self), strict=True)
        ]
        # Fields are absent where JAX has mapped a tree to another kind of leaf.
        pose: PyTree = getattr(self.estimate, "pose", None)
        status: PyTree = getattr(self.info, "status", None)
        arrays = all(isinstance(leaf, np.ndarray | Array) for leaf in jax.tree.leaves(self[:2]))
        if arrays and is_concrete(self[:2]) and np.shape(pose)[:-1] == np.shape(status)[:-1] != ():
            became = {s: int((jax.device_get(status) == s).sum()) for s in Status if s}
            counts = [f"{count:,} {s.name.lower()}" for s, count in became.items() if count]
            steps = " × ".join(map(str, np.shape(pose)[:-1]))
            lines = [
                f"{steps} steps: {', '.join(counts) or 'no measurements'}",
                *self.doubts,
                *lines,
            ]
        return "Trace(" + ",\n      ".join(lines) + ")"


class Beams(NamedTuple):
    """A scan of a laser: B beams, in the frame of its mount.

    The meaning of a range, everywhere in the package (`returns`):

    | range [m] | meaning |
    |---|---|
    | above 0, below the maximum range | an obstacle at this distance |
    | the maximum range (less a millionth) or more, ∞ | no obstacle up to the maximum range |
    | 0, below 0, NaN, -∞; any, where `valid` is false or the angle is not finite | nothing |
    """

    range: Float[JaxOrNumPy, "B"]
    """[m]"""
    angle: Float[JaxOrNumPy, "B"]
    """direction of each beam [rad], counter-clockwise from the x axis"""
    valid: Bool[JaxOrNumPy, "B"]
    """false for a beam without information: a dropout or padding. A beam that met nothing has the
    laser's maximum range, and is valid."""

    def __repr__(self) -> str:
        return short_repr(self)

    def returns(
        self, max_range: float | JaxOrNumPy = np.inf, *, min_range: float | JaxOrNumPy = 0.0
    ) -> tuple[Bool[JaxOrNumPy, "*n"], Bool[JaxOrNumPy, "*n"]]:
        """Masks of the beams with an obstacle nearer than max_range [m], and of those without one.

        The others have no information, nor has a range of min_range or less. See the table of
        `Beams`.
        """
        with np.errstate(invalid="ignore"):  # comparisons with NaN, which are false
            says = (self.range > min_range) & self.valid.astype(bool)
            says = says & (self.angle > -np.inf) & (self.angle < np.inf)
            met = self.range < max_range * (1 - 1e-6)  # less the rounding of float32
        return says & met, says & ~met
