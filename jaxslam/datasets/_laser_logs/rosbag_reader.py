"""Laser logs from ROS bags: scans, odometry at each, and the mount of the laser."""

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core.validation import InvalidField, finite, or_none, refusals_of, require
from jaxslam.datasets._account import Account
from jaxslam.datasets._laser_logs.bag_messages import TRANSFORMS, Bag, Topic, open_bag
from jaxslam.datasets._laser_logs.bag_transforms import (
    UPSIDE_DOWN,
    FramePair,
    Frames,
    LaserMount,
    Transform,
    frame_name,
    frame_pairs,
    is_named_odometry,
    laser_mount,
    mount_text,
    odometry_pairs,
    pairs_text,
    planar,
    pose_of,
    stamp_of,
    transforms_of,
)
from jaxslam.datasets._laser_logs.laser_beams import beams_of
from jaxslam.datasets._laser_logs.laser_record import LaserLog, wrapped_path
from jaxslam.math import numpy_poses as poses
from jaxslam.math._odometry_jumps import LONG, odometry_jumps, step_sizes

LASER_SCAN = "sensor_msgs/LaserScan"
MULTI_ECHO = "sensor_msgs/MultiEchoLaserScan"
ODOMETRY = "nav_msgs/Odometry"

BACKWARD = 0.1
"""Largest share of the messages of a topic whose stamps go back."""

APART = 10**9
"""Difference between the stamp and the time of the recording that is reported [ns]."""

GAP = 10**9
"""Time between two messages of odometry that is reported where a scan is in between [ns]."""

OPTIONS = {"scan": "--laser", "odometry": "--odometry"}
"""Arguments that choose a topic, and the options of the commands for them."""


def rosbag(
    path: str | Path,
    scan: str | None = None,
    odometry: str | None = None,
    *,
    max_range: float = 50.0,
    mount: ArrayLike | None = None,
) -> LaserLog:
    """A laser log from a bag of ROS 1 (`.bag`) or ROS 2 (a folder, `.mcap`, `.db3`, zstd or not).

    The parts `NAME_0.bag`, `NAME_1.bag`, … in a folder are one recording.

    Needs the library rosbags: `pip install 'jaxslam[ros]'`.

    | messages | read as |
    |---|---|
    | `sensor_msgs/LaserScan` of one topic | the scans; each at the stamp of its header |
    | `sensor_msgs/MultiEchoLaserScan` of one | the same by the first echo of each beam, if there |
    | topic | is no `LaserScan` |
    | `nav_msgs/Odometry` of one topic | raw odometry; the robot's frame is `child_frame_id` |
    | `/tf`, without a topic of odometry | raw odometry from `odom` to `base_link` or |
    | | `base_footprint`; else of the only frames that move, with the laser below them |
    | `/tf_static`, else `/tf` | the mount, along the chain from the robot's frame to that of |
    | | the scans; of a static transform that is sent again, the last |

    Messages of other topics are counted in `dropped`. Where several topics are possible, `scan` or
    `odometry` names one.

    **Ranges** at `range_max` or above, also ∞, are without a return; below `range_min`, NaN and -∞
    are not valid. **Angles** increase in the result: a scan with a negative increment, or of a
    laser upside down, is reversed. The motion within a scan is not corrected.

    **Odometry** is interpolated on SE(2) at the stamp of each scan. A scan before the first or
    after the last message takes its pose, the steps to and from it are unknown, and they are
    counted. So are scans between two messages more than 1 s and ten median intervals apart, and the
    steps over a jump, where odometry was set to zero or to another pose on the way. Without
    odometry all steps are unknown, and `raw` stands still: laser SLAM and `jaxslam localize` then
    use laser odometry alone.

    **Mount**: in the plane. A laser may be tilted by up to 10°, also by a changing roll and pitch,
    as an IMU gives them; `corrections` says so.

    **Stamps** are those of the headers; the times of the recording if all headers have zero.
    Messages whose stamps go back, or repeat, are dropped and counted, so that most are kept.

    Args:
        path: the file or the folder.
        scan: topic of the scans; default: the only one.
        odometry: topic of the odometry, or `odom:base_link`, the names of two frames of `/tf`;
            default: the only topic, else the only such pair, else the only pair that moves.
        max_range: ranges from this one [m], or from `range_max`, are without a return.
        mount: (3,) [m, m, rad] in place of that of the transforms.
    Raises:
        ValueError: with the file: if it is damaged or no bag; without scans; on several topics, or
            a topic that is not there, empty or of another type; on angles that are not finite,
            scans of several frames, a mount that changes or is tilted by more than 10°; if more
            than a tenth of the stamps go back, or no scan is within the time of the odometry. Also
            if rosbags is not installed, on a max_range that is not above 0, and a mount that is
            not three finite numbers.
    """
    with refusals_of("rosbag"):
        if not max_range > 0:
            raise InvalidField("max_range", f"expected a number above 0, got {max_range}")
        given_mount = require("mount", mount, or_none(finite(3)))
    account = Account()
    source = Account()  # of the source of odometry, after the notes on the scans
    with open_bag(path) as bag:
        account.corrections += bag.notes
        laser = _pick_topic(bag, "scan", (LASER_SCAN, MULTI_ECHO), scan)
        if laser is None:
            raise bag.error(
                f"expected a topic of {LASER_SCAN} with messages, got {listed_topics(bag.topics)}"
            )
        wheels = None
        if odometry is None or ":" not in odometry:  # not two frames, as `odom:base_link`
            wheels = _pick_topic(bag, "odometry", (ODOMETRY,), odometry)
        messages = _read(bag, laser, wheels, account)
        transforms = messages.transforms
        frame, *others = sorted({scan.frame for scan in messages.scans})
        if others:
            frames = ", ".join([frame, *others])
            raise bag.error(f"{laser}: expected scans of one frame, got {frames}")
        if wheels is None or not Frames(transforms).connects(messages.base, frame):
            transforms = transforms + read_transforms(bag, static=False)
        if wheels is None:
            messages = _odometry_of_transforms(bag, messages, transforms, frame, odometry, source)
        placed, upside_down = _mount(bag, transforms, frame, messages, given_mount, account)
        for topic in bag.topics:
            if topic.name not in (laser, wheels) and topic.type not in TRANSFORMS:
                account.drop(f"messages {topic.name}", topic.count)
        stamp, kept = in_order(bag, laser, "scans", messages.scans, account)
        scans = [_sort_angles(messages.scans[k], upside_down) for k in kept]
        account.corrections += source.corrections
        joined = _odometry_at(bag, stamp, messages, wheels, account)
    beams, limit = beams_of(scans, max_range, account)
    return LaserLog(
        name=Path(path).resolve().name.split(".")[0],
        source=str(path),
        laser=laser,
        placed=False,
        time=seconds(stamp),
        beams=beams,
        corrected=np.zeros((len(scans), 3)),
        raw=wrapped_path(joined.raw),
        odometry_known=joined.step_known,
        row=joined.row,
        odometry=wrapped_path(joined.poses),
        odometry_time=seconds(joined.stamp),
        max_range=limit,
        mount=placed,
        **account.fields,
    )


class BagContents(NamedTuple):
    """The contents of a bag, without its scans."""

    topics: tuple[Topic, ...]
    start: float
    """start of the recording [s], NaN without messages"""
    end: float
    """end of the recording [s]"""
    lasers: dict[str, str]
    """mount of each topic with scans, or the reason why it has none"""
    odometry: dict[str, int]
    """number of transforms of each pair of frames of `/tf` that is odometry for a laser"""
    frames: dict[str, str]
    """number of transforms of each pair of frames `parent:child`, and whether the child moves"""
    notes: tuple[str, ...]
    """notes on the files"""


def rosbag_contents(path: str | Path) -> BagContents:
    """The topics, time, frames and mounts of a bag, without its scans.

    Raises ValueError, with the file, if the bag cannot be read.
    """
    with open_bag(path) as bag:
        transforms = read_transforms(bag, static=True) + read_transforms(bag, static=False)
        frames, pairs = Frames(transforms), frame_pairs(transforms)
        wheels = [topic for topic in bag.topics if topic.type == ODOMETRY and topic.count]
        base = ""
        if len(wheels) == 1:
            base = frame_name(bag.first(wheels[0].name).child_frame_id)
        lasers = {}
        odometry = {pair.name: pair.number for pair in pairs if is_named_odometry(pair)}
        for topic in bag.topics:
            if topic.type in (LASER_SCAN, MULTI_ECHO) and topic.count:
                frame = frame_name(bag.first(topic.name).header.frame_id)
                moving, _ = odometry_pairs(pairs, frames, frame)
                odometry |= {pair.name: pair.number for pair in moving}
                notes: list[str] = []
                try:
                    placed = laser_mount(
                        frames, frame, [base] * bool(base), notes, _only_child(moving)
                    )
                    lasers[topic.name] = notes[0] if placed is None else mount_text(placed)
                except ValueError as problem:
                    lasers[topic.name] = str(problem)
        listed: dict[str, str] = {}
        for pair in pairs:
            how = "static" if pair.static else "moves" if pair.moves else "turns" * pair.turns
            text = f"{pair.number:,} transforms" + f", {how}" * bool(how)
            listed[pair.name] = "; ".join(filter(None, [listed.get(pair.name), text]))
        return BagContents(
            bag.topics, bag.start, bag.end, lasers, odometry, listed, tuple(bag.notes)
        )


def _only_child(pairs: Sequence[FramePair]) -> str:
    """The frame that moves, if there is one pair."""
    return pairs[0].child if len(pairs) == 1 else ""


class Stamped(Protocol):
    """A message with two times [ns]: the stamp of its header, and that of the recording."""

    @property
    def stamp(self) -> int: ...

    @property
    def recorded(self) -> int: ...


class _ScanMessage(NamedTuple):
    """A scan of n beams."""

    stamp: int
    """[ns]"""
    recorded: int
    """[ns]"""
    frame: str
    ranges: Float[np.ndarray, "n"]
    """[m], 0 where the beam has none"""
    angles: Float[np.ndarray, "n"]
    limit: float
    """`range_max` [m], infinite if it is not finite and above 0"""
    bad_limit: bool


class _PoseMessage(NamedTuple):
    """A message of odometry."""

    stamp: int
    """[ns]"""
    recorded: int
    """[ns]"""
    pose: Float[np.ndarray, "7"]


class _Messages(NamedTuple):
    """The messages that are used."""

    scans: list[_ScanMessage]
    odometry: list[_PoseMessage]
    base: str
    """the frame of the robot by odometry; empty if unknown"""
    transforms: list[Transform]


class _Odometry(NamedTuple):
    """T poses of odometry, and the odometry at K scans."""

    poses: Float[np.ndarray, "T 3"]
    stamp: Int[np.ndarray, "T"]
    """[ns]"""
    row: Int[np.ndarray, "K"]
    raw: Float[np.ndarray, "K 3"]
    step_known: Bool[np.ndarray, "K"]


def listed_topics(topics: Sequence[Topic]) -> str:
    """The text of topics with their types and counts."""
    listed = (f"{topic.name} ({topic.type}, {topic.count:,})" for topic in topics)
    return ", ".join(listed) or "no topics"


def _pick_topic(bag: Bag, argument: str, kinds: tuple[str, ...], name: str | None) -> str | None:
    """The named topic; else the only topic with messages of the first type that has any."""
    option = OPTIONS[argument]
    expected = " or ".join(kinds)
    if name is None:
        for kind in kinds:
            candidates = [topic for topic in bag.topics if topic.type == kind and topic.count]
            if len(candidates) > 1:
                first = candidates[0].name
                raise bag.error(
                    f"expected one topic of {kind}, got {listed_topics(candidates)}; choose by "
                    f"{argument}={first!r} ({option} {first})"
                )
            if candidates:
                return candidates[0].name
        return None
    topic = next((topic for topic in bag.topics if topic.name in (name, f"/{name}")), None)
    if topic is None:
        listed = listed_topics([topic for topic in bag.topics if topic.type in kinds] or bag.topics)
        raise bag.error(f"{argument} ({option}): expected a topic of {listed}; got {name!r}")
    if topic.type not in kinds:
        raise bag.error(
            f"{argument} ({option}): expected a topic of {expected}, got {topic.name} of "
            f"{topic.type}"
        )
    if not topic.count:
        raise bag.error(f"{argument} ({option}): the topic {topic.name} has no messages")
    return topic.name


def _read(bag: Bag, laser: str, wheels: str | None, account: Account) -> _Messages:
    """The scans, the odometry of a topic if one is named, and the static transforms."""
    scans: list[_ScanMessage] = []
    odometry: list[_PoseMessage] = []
    base = ""
    for name, recorded, message in bag.messages({laser} | ({wheels} if wheels else set())):
        stamp = stamp_of(message.header)
        if name == laser:
            scans.append(_scan_of(bag, laser, len(scans), stamp, recorded, message))
        else:
            base = base or frame_name(message.child_frame_id)
            pose = message.pose.pose
            odometry.append(_PoseMessage(stamp, recorded, pose_of(pose.position, pose.orientation)))
    read = {laser: len(scans), wheels: len(odometry)}
    for topic in bag.topics:
        if topic.name in read and read[topic.name] != topic.count:
            account.correct(
                f"{topic.name} has {read[topic.name]:,} messages; the index of the bag says "
                f"{topic.count:,}"
            )
    if not any(len(scan.ranges) for scan in scans):
        raise bag.error(f"{laser}: expected scans with beams, got {len(scans)} of 0 beams")
    return _Messages(scans, odometry, base, read_transforms(bag, static=True))


def _scan_of(
    bag: Bag, topic: str, number: int, stamp: int, recorded: int, message: Any
) -> _ScanMessage:
    """The scan of a message."""
    first, step = float(message.angle_min), float(message.angle_increment)
    values = message.ranges
    if len(values) and hasattr(values[0], "echoes"):  # MULTI_ECHO
        values = [beam.echoes[0] if len(beam.echoes) else np.nan for beam in values]
    with np.errstate(invalid="ignore"):  # a signalling NaN
        ranges = np.asarray(values, np.float64)
    if not (np.isfinite(first) and np.isfinite(step)) or (step == 0 and len(ranges) > 1):
        raise bag.error(
            f"{topic}: scan {number}: expected a finite angle_min and angle_increment, which is "
            f"not 0, got {first} and {step}"
        )
    shortest, limit = float(message.range_min), float(message.range_max)
    good = 0 < limit < np.finfo(np.float32).max
    with np.errstate(invalid="ignore"):
        absent = np.isnan(ranges) | (ranges <= 0) | (ranges < shortest)
    return _ScanMessage(
        stamp,
        recorded,
        frame_name(message.header.frame_id),
        np.where(absent, 0.0, np.minimum(ranges, np.finfo(float).max)),
        first + step * np.arange(len(ranges)),
        limit if good else np.inf,
        not good,
    )


def _sort_angles(scan: _ScanMessage, upside_down: bool) -> _ScanMessage:
    """The scan with increasing angles, seen from above."""
    angles = -scan.angles if upside_down else scan.angles
    if len(angles) > 1 and angles[1] < angles[0]:
        return scan._replace(angles=angles[::-1], ranges=scan.ranges[::-1])
    return scan._replace(angles=angles)


def read_transforms(bag: Bag, static: bool) -> list[Transform]:
    """The transforms of `/tf_static`, or of `/tf`."""
    names = [
        topic.name
        for topic in bag.topics
        if topic.type in TRANSFORMS and topic.name.endswith("static") == static
    ]
    return [
        transform
        for _, recorded, message in bag.messages(names)
        for transform in transforms_of(recorded, message, static)
    ]


def _odometry_of_transforms(
    bag: Bag,
    messages: _Messages,
    transforms: Sequence[Transform],
    laser: str,
    pair: str | None,
    account: Account,
) -> _Messages:
    """The messages with odometry from two frames of `/tf`: the named pair, or the only pair."""
    option = OPTIONS["odometry"]
    pairs = frame_pairs(transforms)
    candidates, others = odometry_pairs(pairs, Frames(transforms), laser)
    if pair is not None:
        parent, child = (frame_name(name) for name in pair.split(":", 1))
        if (parent, child) not in {(frames.parent, frames.child) for frames in pairs}:
            names = ", ".join(sorted({frames.name for frames in pairs}))
            raise bag.error(
                f"odometry ({option}): expected two frames of the transforms "
                f"{names or '(none)'}; got {pair!r}"
            )
    elif len(candidates) > 1:
        first = candidates[0].name
        raise bag.error(
            f"expected odometry in one pair of frames, got {pairs_text(candidates)}; choose by "
            f"odometry={first!r} ({option} {first})"
        )
    elif not candidates:
        account.correct(
            "no odometry is read: raw odometry stands still, and laser odometry takes its place; "
            f"frames of /tf that move: {pairs_text(others)}, of which {option} "
            f"{others[0].name} reads one"
            if others
            else "the bag has no odometry: raw odometry stands still, and laser odometry takes its "
            "place"
        )
        return messages
    else:
        parent, child = candidates[0].parent, candidates[0].child
        if not is_named_odometry(candidates[0]):
            account.correct(
                f"odometry is the transform from {parent} to {child}, the only frames of /tf that "
                "move in the plane"
            )
    odometry = [
        _PoseMessage(edge.stamp, edge.recorded, edge.pose)
        for edge in transforms
        if (edge.parent, edge.child) == (parent, child)
    ]
    return messages._replace(odometry=odometry, base=child)


def _mount(
    bag: Bag,
    transforms: Sequence[Transform],
    frame: str,
    messages: _Messages,
    given_mount: Float[np.ndarray, "3"] | None,
    account: Account,
) -> tuple[Float[np.ndarray, "3"], bool]:
    """The pose of the laser on the robot, and whether the laser is upside down."""
    notes: list[str] = []
    placed: LaserMount | None = None
    frames = Frames(transforms)
    moving, _ = odometry_pairs(frame_pairs(transforms), frames, frame)
    try:
        placed = laser_mount(
            frames, frame, [messages.base] * bool(messages.base), notes, _only_child(moving)
        )
    except ValueError as problem:
        if given_mount is None:
            raise bag.error(str(problem)) from problem
    if given_mount is None:
        account.corrections += notes
        return np.zeros(3) if placed is None else placed.pose, bool(placed and placed.upside_down)
    if placed is not None and placed.upside_down:
        account.correct(UPSIDE_DOWN)
    return given_mount, bool(placed and placed.upside_down)


def in_order(
    bag: Bag,
    topic: str,
    kind: str,
    messages: Sequence[Stamped],
    account: Account,
) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """The increasing stamps [ns] of the messages that are kept, and their indices.

    kind: plural noun for the counts in `dropped`.

    Raises ValueError if more than `BACKWARD` of the stamps go back.
    """
    stamp = np.array([message.stamp for message in messages], np.int64)
    recorded = np.array([message.recorded for message in messages], np.int64)
    if not stamp.any():
        account.correct(f"all stamps of {topic} are 0: times are those of the recording")
        stamp = recorded
    late = np.abs(stamp - recorded)
    far = int((late > APART).sum())
    account.correct(
        f"stamps of {topic} differ from the times of the recording by more than "
        f"{APART * 1e-9:g} s in {far:,} of {len(stamp):,} messages, by up to "
        f"{late.max() * 1e-9:.6g} s",
        far,
    )
    kept = _longest_in_order(stamp)
    if back := len(stamp) - len(kept):
        if back > BACKWARD * len(stamp):
            at = int(np.argmax(np.diff(stamp) < 0)) + 1
            raise bag.error(
                f"{topic}: the stamps of {back:,} of {len(stamp):,} messages go back, first by "
                f"{(stamp[at - 1] - stamp[at]) * 1e-9:.6g} s at message {at}; expected at most "
                f"{BACKWARD:.0%}"
            )
        account.drop(f"{kind} whose stamp goes back", back)
    new = np.diff(stamp[kept], prepend=stamp[kept[0]] - 1) > 0
    account.drop(f"{kind} with the stamp of the one before", (~new).sum())
    kept = kept[new]
    return stamp[kept], kept


def _longest_in_order(stamp: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """The indices of a longest subsequence that does not decrease."""
    if (np.diff(stamp) >= 0).all():
        return np.arange(len(stamp))
    ends: list[int] = []  # the least last stamp of a subsequence, by its length
    at: list[int] = []
    before = np.full(len(stamp), -1)
    for k, value in enumerate(stamp.tolist()):
        length = bisect_right(ends, value)
        before[k] = at[length - 1] if length else -1
        ends[length : length + 1] = [value]
        at[length : length + 1] = [k]
    path = [at[-1]]
    while (k := int(before[path[-1]])) >= 0:
        path.append(k)
    return np.array(path[::-1])


def _odometry_at(
    bag: Bag,
    time: Int[np.ndarray, "K"],
    messages: _Messages,
    wheels: str | None,
    account: Account,
) -> _Odometry:
    """The odometry at each scan, interpolated; without messages zero, with unknown steps.

    Raises ValueError if no scan is within the time of the odometry.
    """
    first = np.arange(len(time)) == 0
    if not messages.odometry:
        no_row, no_stamp = np.full(len(time), -1), np.zeros(0, int)
        return _Odometry(np.zeros((0, 3)), no_stamp, no_row, np.zeros((len(time), 3)), first)
    topic = wheels or "odometry in /tf"
    path = planar(np.array([message.pose for message in messages.odometry]))
    good = np.isfinite(path).all(axis=1)
    if not good.any():
        raise bag.error(f"{topic}: none of {len(path):,} messages has a pose in the plane")
    account.drop("odometry without a pose", (~good).sum())
    usable = [message for message, fine in zip(messages.odometry, good, strict=True) if fine]
    stamp, kept = in_order(bag, topic, "odometry", usable, account)
    path = path[good][kept]
    row = np.searchsorted(stamp, time, side="right") - 1
    within = (row >= 0) & (time <= stamp[-1])
    if not within.any():
        (a, b), (c, d) = seconds(time[[0, -1]]), seconds(stamp[[0, -1]])
        raise bag.error(
            f"expected scans within the time of {topic}, from {c:.3f} s to {d:.3f} s, got scans "
            f"from {a:.3f} s to {b:.3f} s"
        )
    outside = int((~within).sum())
    account.correct(
        f"scans before the first or after the last message of {topic}, which take its pose: "
        f"{outside:,}",
        outside,
    )
    lower = np.maximum(row, 0)
    upper = np.minimum(lower + 1, len(stamp) - 1)
    between = np.maximum(stamp[upper] - stamp[lower], 1)
    share = np.clip((time - stamp[lower]) / between, 0.0, 1.0)
    inside = (share > 0) & (share < 1)
    interval = np.diff(stamp, prepend=stamp[:1])
    median = np.median(interval[1:]) if len(stamp) > 1 else 0.0
    gap = (between > GAP) & (between > LONG * median) & inside
    apart = f"scans between two messages of {topic} that are more than {GAP * 1e-9:g} s"
    account.correct(
        f"{apart} and {LONG:g} median intervals apart, with unknown steps: {int(gap.sum()):,}",
        gap.any(),
    )
    slow = int(((between > GAP) & inside & ~gap).sum())
    account.correct(f"{apart} apart, with a constant velocity in between: {slow:,}", slow)
    jump = odometry_jumps(path, seconds(stamp - stamp[0]))
    if jump.any():
        at = int(np.argmax(jump))
        far, turn = step_sizes(path)[at]
        account.correct(
            f"jumps of {topic}, which are no motion, so that the steps over them are unknown: "
            f"{int(jump.sum()):,}, first by {far:.3g} m and {np.rad2deg(turn):.3g}° in "
            f"{interval[at] * 1e-9:.3g} s at {seconds(stamp[at : at + 1])[0]:.3f} s"
        )
    # Not over gaps and jumps: there a scan has the pose of the message before it.
    share[gap | (jump[upper] & inside)] = 0.0
    step = poses.between(path[lower], path[upper])
    raw = poses.compose(path[lower], poses.part(step, share))
    jumps = np.cumsum(jump)[lower]
    step_known = within & np.concatenate([[True], within[:-1]])
    step_known &= ~gap & ~np.concatenate([[False], gap[:-1]])
    step_known &= np.diff(jumps, prepend=jumps[:1]) == 0
    return _Odometry(path, stamp, row, raw, first | step_known)


def seconds(stamp: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Nanoseconds as seconds, rounded once."""
    return np.asarray(stamp // 10**9 + (stamp % 10**9) * 1e-9)
