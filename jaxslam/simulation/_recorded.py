"""Worlds of runs that were recorded, or simulated by other means, for campaigns."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxslam._public import publish
from jaxslam.core._record import FrozenDict, record, static
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core._validation import log_of
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log, Truth
from jaxslam.core.validation import (
    InvalidField,
    array_of,
    finite,
    instance_of,
    refusals_of,
    require,
)
from jaxslam.sensors._suite import Suite
from jaxslam.simulation._worlds import World


@record
class RecordedWorld(World):
    """A world of R runs that were recorded: run i of a campaign is record i (`recorded_world`)."""

    name: str = static()
    motion: Motion = field()
    sensor: Sensor = field()
    truth: Truth = field()
    """(R, …)"""
    log: Log = field()
    """(R, …)"""
    pose: ArrayLike = (0.0, 0.0, 0.0)
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    filter_options: dict[str, Any] = static(default=FrozenDict())
    published: Mapping[str, Mapping[str, float]] = static(default=FrozenDict())
    source: str = static(default="")
    """see `Scenario` for these fields"""

    @property
    def landmarks(self) -> ArrayLike:  # type: ignore[override]
        return self.truth.landmarks[0]

    @property
    def controls(self) -> ArrayLike:  # type: ignore[override]
        return self.log.control[0]

    @property
    def recorded_runs(self) -> int:  # type: ignore[override]
        return len(self.truth.pose)

    def draw(self, key: Array) -> tuple[Truth, Log]:
        return self._record(jax.random.randint(key, (), 0, self.recorded_runs))

    def run(self, key: Array, number: int | Array) -> tuple[Truth, Log]:
        return self._record(number)

    def _record(self, number: int | Array) -> tuple[Truth, Log]:
        record: tuple[Truth, Log] = jax.tree.map(
            lambda leaf: jnp.asarray(leaf)[number], (self.truth, self.log)
        )
        return record


def recorded_world(
    motion: Motion,
    sensor: Sensor,
    logs: Sequence[Log],
    poses: Sequence[ArrayLike],
    landmarks: ArrayLike,
    *,
    name: str = "recorded",
    pose: ArrayLike = (0.0, 0.0, 0.0),
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    starts: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    filter_options: dict[str, Any] | None = None,
    published: Mapping[str, Mapping[str, float]] | None = None,
    source: str = "",
) -> RecordedWorld:
    """A world of R runs with known truth, in which run i of a campaign is record i.

    So logs of another simulator, of robots under motion capture, or of a front end that is not a
    pure function (laser odometry) are judged as draws are. `simulate` takes one of the records by
    its key. A campaign of more than R runs is refused.

    Args:
        motion, sensor: the models that filters and the bound assume of the logs.
        logs: (R,) each with T rows and M measurement slots; in a row without measurements none is
            valid.
        poses: (R, T, 3) true pose at each row [m, m, rad]; of a motion model with E further numbers
            in its state (R, T, 3 + E), all of them.
        landmarks: (N, L) true landmarks, of all runs, or (R, N, L); the tag of one is its row.
        pose, pose_cov: (3,) and (3, 3), or of all 3 + E numbers, the filter's prior of the pose
            before the first control, of every run: transform records that begin elsewhere.
        starts: (R, 3), or (R, 3 + E), true pose before the first control; default `pose`.
        origin: (R, T, M) tag of the landmark that each measurement is truly of, -1 of none, where
            associations are to be scored.
        filter_options, published, source: as of `Scenario`.
    Raises:
        ValueError: on no runs, a log that `run` would refuse (which), runs of different shapes, a
            tag without a landmark, a truth that is not finite, and as `Scenario` does.
    Warns:
        UserWarning: on true headings that fit their path in degrees.
    """
    with refusals_of("recorded_world"):
        require("motion", motion, instance_of(Motion))
        require("sensor", sensor, instance_of(Sensor))

        # The logs, of one shape.
        if isinstance(logs, Log) or not isinstance(logs, Sequence) or not logs:
            empty = "an empty " * (isinstance(logs, Sequence) and not logs)
            got = f"{empty}{type(logs).__name__}"
            raise InvalidField("logs", f"expected a list of Log, one a run, got {got}")
        slots = sensor.places if isinstance(sensor, Suite) else ()
        is_log = log_of(len(motion.controls), len(sensor.measurements), slots)
        shapes = []
        for i, log in enumerate(logs):
            require(f"logs[{i}]", log, is_log)
            shapes.append(np.shape(log.scan.tag))
            if shapes[i] != shapes[0]:
                raise InvalidField(
                    "logs",
                    "expected the same numbers of rows and measurement slots, got "
                    f"{shapes[0]} in run 0 and {shapes[i]} in run {i}",
                )
        log = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *logs)
        runs, steps, places = log.scan.tag.shape
        size = len(motion.state)

        # The truth of each run: a map of all runs and a start of all are repeated.
        table = np.asarray(landmarks, np.float64)
        if table.ndim == 2:
            table = np.broadcast_to(table, (runs, *table.shape))
        if starts is None:
            start = np.asarray(require("pose", pose, finite(size)), np.float64)
            starts = np.broadcast_to(start, (runs, size))
        robots = np.asarray(poses, np.float64)
        require("poses", robots, array_of(runs, steps, size))
        truth = Truth(
            robots[..., :3],
            table,
            np.zeros((runs, steps), np.int32),
            np.asarray(starts, np.float64),
            None if origin is None else np.asarray(origin),
            robots[..., 3:] if size > 3 else None,
        )
        require("landmarks", table, array_of(runs, "N", len(sensor.landmark)))
        require("starts", truth.start, array_of(runs, size))
        if truth.origin is not None:
            require("origin", truth.origin, array_of(runs, steps, places, kind=np.integer))
        numbers = {"poses": robots, "landmarks": table, "starts": truth.start}
        for argument, values in numbers.items():
            for run, row, *_ in np.argwhere(~np.isfinite(values))[:1]:
                advice = f", row {row}: cut the log to rows with a true pose"
                raise InvalidField(
                    argument,
                    f"expected finite numbers of run {run}{advice * (argument == 'poses')}",
                )

        # The landmark of each tag is a row of the map.
        tags = np.where(log.scan.valid, log.scan.tag, -1)
        for run, row, _ in np.argwhere(tags >= table.shape[1])[:1]:
            raise InvalidField(
                "logs",
                f"expected tags below {table.shape[1]}, the number of landmarks, got {tags.max()} "
                f"(run {run}, row {row})",
            )
        if wrong := [i for i, path in enumerate(truth.pose) if are_headings_in_degrees(path)]:
            warnings.warn(
                f"recorded_world: the true headings of run {wrong[0]} contradict the directions "
                "between its positions, which fit them as degrees: expected [rad]",
                stacklevel=2,
            )
        return RecordedWorld(
            name=name,
            motion=motion,
            sensor=sensor,
            truth=truth,
            log=log,
            pose=pose,
            pose_cov=pose_cov,
            filter_options=filter_options or {},
            published=published or {},
            source=source,
        )


publish("jaxslam", RecordedWorld, recorded_world)
