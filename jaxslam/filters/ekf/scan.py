"""What the scan of one sensor does to a `Joint`: it corrects, then starts new landmarks."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.ekf.augmentation import augment
from jaxslam.filters.ekf.predicted_measurements import prediction_of
from jaxslam.filters.ekf.update import correct, correct_in_turn
from jaxslam.filters.reporting import info_of, joined, nothing_of, seen_before, status_of
from jaxslam.math.xla import where_any
from jaxslam.protocols import Associate, Association, Chart, Life, Linearizer, Sensor
from jaxslam.sensors.suite import Part, Suite, on_ground, split_scan
from jaxslam.slots import Joint
from jaxslam.types import Info, Scan


class Births(NamedTuple):
    """What became of the measurements of a scan that are of no landmark of the map, (M,) each."""

    slot: jax.Array
    granted: jax.Array
    deferred: jax.Array
    repeated: jax.Array
    given_up: jax.Array
    """(N,) slots that were emptied to make room"""


ScanUpdate = Callable[[Joint, Scan], tuple[Joint, Info, jax.Array]]
"""(joint, scan) -> joint, info, and the slots (N,) bool that were emptied to make room."""


def scan_update(
    sensor: Sensor,
    *,
    absolute: bool,
    associate: Associate,
    update: str,
    births: int | None,
    life: Life | None,
    without: Callable[[Joint, jax.Array], Joint],
    chart: Chart,
    linearize: Linearizer,
    square_root: bool,
    options: dict[str, Any],
    reserved: Any = None,
) -> ScanUpdate:
    """The update by one sensor, of options as `ekf_slam` has them.

    absolute: every valid measurement corrects the robot. without: (joint, dead) -> the joint with
    those slots freed. options: gate, iterations, joseph.
    births: 0 for none at all. reserved: (N,) bool, slots that no new landmark may take.
    """
    size_z = len(sensor.measurements)
    options = options | {
        "sensor": sensor,
        "chart": chart,
        "linearize": linearize,
        "square_root": square_root,
    }
    predict_scan = partial(
        prediction_of,
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        square_root=square_root,
    )
    at_once = partial(correct, **options)
    in_turn = partial(correct_in_turn, **options)
    add_landmarks = partial(
        augment,
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        square_root=square_root,
    )

    def update_map(joint: Joint, scan: Scan) -> tuple[Joint, Info, jax.Array]:
        # Padding may hold anything, and is multiplied by zero further down.
        z = jnp.where(scan.valid[:, None], scan.z, 0.0)
        if not absolute:
            found = Association(*associate(predict_scan(joint), scan._replace(z=z)))
            slot, is_new, exhausted = found.slot, found.is_new, jnp.asarray(found.exhausted)
            matched = scan.valid & (slot >= 0) & ~is_new
            is_new = scan.valid & is_new
        else:
            slot, is_new = jnp.full_like(scan.tag, -1), jnp.zeros_like(scan.valid)
            matched, exhausted = scan.valid, jnp.asarray(False)
        parts = (z, jnp.maximum(slot, 0), matched)
        by_scan = at_once if update == "joint" and len(scan.tag) > 0 else in_turn
        joint, done = by_scan(joint, *parts)

        def start(joint: Joint) -> tuple[Joint, Births]:
            repeated = is_new & seen_before(scan.tag, is_new)
            wanted = is_new & ~repeated
            rank = jnp.cumsum(wanted)
            deferred = jnp.zeros_like(wanted) if births is None else wanted & (rank > births)
            wanted = wanted & ~deferred
            given_up = jnp.zeros_like(joint.alive)
            if life is not None and life.make_room is not None:
                needed = wanted.sum() - (~joint.alive).sum()
                used = matched & done.inside & done.positive
                given_up = life.make_room(
                    joint, needed, slots.concerned(found.slot, used, len(joint.alive))
                )
                joint = without(joint, given_up)
            taken = joint.alive if reserved is None else joint.alive | reserved
            if births is None or births >= len(wanted):
                slot, granted = slots.allocate(taken, wanted)
                joint = add_landmarks(joint, z, scan.tag, slot, granted)
            else:  # no more places than may be granted
                turn = wanted[None, :] & (rank[None, :] == 1 + jnp.arange(births)[:, None])
                place, there = slots.where_set(turn)
                slot, granted = slots.allocate(taken, there)
                joint = add_landmarks(joint, z[place], scan.tag[place], slot, granted)
                mine = jnp.clip(rank - 1, 0, births - 1)
                slot, granted = slot[mine], wanted & granted[mine]
            return joint, Births(slot, granted, deferred, repeated, given_up)

        def start_none(joint: Joint) -> tuple[Joint, Births]:
            none, given_up = jnp.zeros_like(is_new), jnp.zeros_like(joint.alive)
            return joint, Births(jnp.zeros_like(slot), none, none, none, given_up)

        if births == 0:  # places that are for robots
            joint, born = start_none(joint)
            born = born._replace(deferred=is_new)
        else:
            joint, born = where_any(is_new.any(), start, start_none, joint)

        status = status_of(
            scan.valid,
            matched=matched,
            positive=done.positive,
            inside=done.inside,
            new=is_new,
            repeated=born.repeated,
            granted=born.granted,
            deferred=born.deferred,
        )
        info = info_of(
            status,
            matched,
            size=size_z,
            slot=slot,
            born=born.slot,
            nis=done.nis,
            innovation=done.innovation,
            innovation_cov=done.innovation_cov,
            log_likelihood=done.log_likelihood.sum(),
            exhausted=exhausted,
        )
        return joint, info, born.given_up

    return update_map


def part_updates(sensor: Sensor, size_l: int, **options: Any) -> list[tuple[int, ScanUpdate]]:
    """The update by each sensor of a suite, with how many places of a scan it has.

    Of a sensor that is no suite: its own, with -1 places, which are all of them. Places for robots
    are left alone.
    """
    if not isinstance(sensor, Suite):
        return [(-1, scan_update(sensor, absolute=not sensor.landmark, **options))]
    return [
        (
            part.places,
            left_alone if part.sees == "robots" else part_update(part, size_l, **options),
        )
        for part in sensor.parts
    ]


def part_update(part: Part, size_l: int, **options: Any) -> ScanUpdate:
    """The update by one sensor of a suite, whose rows of z may be longer than its own."""
    one = scan_update(on_ground(part.sensor, size_l), absolute=part.absolute, **options)
    size_z = len(part.sensor.measurements)
    return lambda joint, scan: one(joint, scan._replace(z=scan.z[:, :size_z]))


def left_alone(joint: Joint, scan: Scan) -> tuple[Joint, Info, jax.Array]:
    """A `ScanUpdate` that uses nothing: every valid place is `Status.UNMATCHED`."""
    return joint, nothing_of(scan), jnp.zeros_like(joint.alive)


def in_order(
    joint: Joint, scan: Scan, parts: list[tuple[int, ScanUpdate]]
) -> tuple[Joint, Info, jax.Array]:
    """A scan through several updates, one after the other, each with its own places of it.

    Raises ValueError if the scan does not have their places.
    """
    if len(parts) == 1 and parts[0][0] == -1:
        return parts[0][1](joint, scan)
    infos, given_up = [], jnp.zeros_like(joint.alive)
    places = [count for count, _ in parts]
    for own, (_, update) in zip(split_scan(scan, places), parts, strict=True):
        joint, info, gone = update(joint, own)
        infos.append(info)
        given_up = given_up | gone
    return joint, joined(infos, scan.z.shape[1]), given_up
