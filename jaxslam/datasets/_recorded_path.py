"""Poses that were recorded with their times, and covariances where there are some: from a topic or
two frames of a ROS bag, a CSV file as `jaxslam run` writes it, or a file of the TUM benchmark."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core.logs._streams import geodesic_poses, known_poses
from jaxslam.core.logs._tables import LATEST, POSE, TIME, split_unit
from jaxslam.core.validation import InvalidFile
from jaxslam.datasets._account import Account
from jaxslam.datasets._csv import CsvTable
from jaxslam.datasets._laser_logs.bag_messages import Bag, is_bag, open_bag
from jaxslam.datasets._laser_logs.bag_transforms import (
    Frames,
    Transform,
    frame_name,
    frame_pairs,
    planar,
    pose_of,
    stamp_of,
)
from jaxslam.datasets._laser_logs.rosbag_reader import (
    in_order,
    listed_topics,
    read_transforms,
    seconds,
)
from jaxslam.datasets._lines import TextFile
from jaxslam.math.numpy_poses import between, compose, wrapped

COVARIANCE = ("c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt")
"""Columns of the upper triangle of the covariance, in the units of the pose."""

TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")

PLANAR = np.array([0, 1, 5])
"""Rows of x, y and the turn about z in the covariance of ROS, of x, y, z and turns about them."""


def _with_covariance(message: Any) -> tuple[Any, Any, Any]:
    return message.pose.pose.position, message.pose.pose.orientation, message.pose.covariance


MESSAGES: dict[str, Callable[[Any], tuple[Any, Any, Any]]] = {
    "nav_msgs/Odometry": _with_covariance,
    "geometry_msgs/PoseWithCovarianceStamped": _with_covariance,
    "geometry_msgs/PoseStamped": lambda of: (of.pose.position, of.pose.orientation, None),
    "geometry_msgs/TransformStamped": lambda of: (
        of.transform.translation,
        of.transform.rotation,
        None,
    ),
}
"""Position, orientation and covariance of a message, by its type."""


class RecordedPath(NamedTuple):
    """K poses of a recording, in the order of their times."""

    source: str
    time: Float[np.ndarray, "K"]
    """[s]"""
    pose: Float[np.ndarray, "K 3"]
    """[m, m, rad], headings in (-π, π]"""
    cov: Float[np.ndarray, "K 3 3"] | None
    """claimed covariance of (x, y, θ), unchecked; None where the source has none"""
    frame: str
    """name of the frame of the poses; empty if unknown"""
    dropped: dict[str, int]
    """numbers of poses that are left out, by reason"""
    notes: tuple[str, ...]


def recorded_path(source: str | Path) -> RecordedPath:
    """The poses of a recorded robot.

    | source | read as |
    |---|---|
    | `BAG:/topic` | messages of `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, |
    | | `PoseWithCovarianceStamped` or `TransformStamped`, each at the stamp of its header |
    | `BAG:parent:child` | the pose of a frame in another by `/tf`, without covariance, as |
    | | `BAG:map:base_link`; frames between the two are interpolated |
    | `FILE.csv`, `FILE.csv.gz` | columns t or time, x, y, theta, and the upper triangle of the |
    | | covariance c_xx, c_xy, c_xt, c_yy, c_yt, c_tt, as of `jaxslam run`; units in |
    | | the header, as `t [ns]`, or else s, m and rad |
    | another file | lines `t x y z qx qy qz qw` of the TUM benchmark, without covariance |

    A BAG is one of `rosbag`, and needs the library rosbags. Of poses in space x, y and the turn
    about z are read.

    Raises:
        ValueError: with the file, and its line or topic: on a source that cannot be read, a topic
            or a frame that is not there, without messages or of another type, poses in several
            frames, stamps of which more than a tenth go back; in files also on times that do not
            rise, numbers that are not finite, headings without a unit that fit the positions in
            degrees, and a covariance of fewer than six columns.
    """
    text = str(source)
    places = [k for k, letter in enumerate(text) if letter == ":"]
    # A path may have a colon, as C:\drive.bag: the longest that exists counts.
    ends = [k for k in reversed([*places, len(text)]) if Path(text[:k]).exists()]
    end = ends[0] if ends else next((k for k in places if is_bag(text[:k])), len(text))
    path, inside = Path(text[:end]), text[end + 1 :]
    if is_bag(path):
        return _path_in_bag(text, path, inside)
    if inside:
        raise InvalidFile(path, f"expected a ROS bag before {inside!r}, or a file alone")
    name = path.name.removesuffix(".gz")
    return _path_in_csv(path) if name.endswith(".csv") else _path_in_tum(path)


def _path_in_csv(path: Path) -> RecordedPath:
    # A column without a unit is in that of the name, as `jaxslam run` writes it.
    file = CsvTable(path, needs_units=False)
    wanted = ("time [s]" if "time" in file.names else TIME, *POSE)
    entries = [name for name in COVARIANCE if name in file.names]
    if missing := [name for name in COVARIANCE if name not in entries] if entries else []:
        raise file.error(f"expected all of {', '.join(COVARIANCE)}, or none, got no {missing[0]}")
    if entries and split_unit(file.header[file.place(POSE[2])])[1] == "deg":
        raise file.error("expected theta [rad] beside a covariance, got theta [deg]")
    columns = file.columns((*wanted, *entries), "of a path", optional=COVARIANCE)
    time = columns.columns[wanted[0]]
    _check_times(time, lambda row, reason: columns.error(row, wanted[0], reason))
    pose = columns.values(wanted[1:])
    account = Account()
    account.correct(file.dialect, file.dialect)
    if are_headings_in_degrees(pose):
        unit = "write radians" if entries else "write theta [deg]"
        reason = "expected theta in radians, but it fits the positions in degrees"
        raise file.error(f"{reason}: {unit}")
    cov = None
    if entries:
        upper, lower = np.triu_indices(3)
        cov = np.empty((len(time), 3, 3))
        cov[:, upper, lower] = cov[:, lower, upper] = columns.values(entries)
    return _make_path(str(path), time, pose, cov, account=account)


def _path_in_tum(path: Path) -> RecordedPath:
    file = TextFile(path, comment="#")
    lines, table = file.table(TUM)
    _check_times(table[:, 0], lambda row, reason: file.error(lines[row], reason))
    pose = planar(table[:, 1:])
    if not (finite := np.isfinite(pose).all(axis=1)).all():
        row = int(np.argmin(finite))
        got = table[row, 4:].tolist()
        raise file.error(lines[row], f"expected a quaternion of norm 1, got {got}")
    return _make_path(str(path), table[:, 0], pose, None)


def _check_times(time: Float[np.ndarray, "K"], error: Callable[[int, str], ValueError]) -> None:
    """Raise ValueError unless times are seconds and rise. error: (row, reason) -> the error."""
    if late := np.flatnonzero(np.abs(time) > LATEST).tolist():
        raise error(
            late[0],
            f"expected a time in seconds, got {time[late[0]]:.4g}: name the column of a CSV "
            "t [ns], t [us] or t [ms], or divide",
        )
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        before, after = time[back[0] : back[0] + 2].tolist()
        raise error(int(back[0]) + 1, f"expected a time above {before}, got {after}")


def _make_path(
    source: str,
    time: Float[np.ndarray, "K"],
    pose: Float[np.ndarray, "K 3"],
    cov: Float[np.ndarray, "K 3 3"] | None,
    *,
    frame: str = "",
    account: Account | None = None,
) -> RecordedPath:
    pose = np.column_stack([pose[:, :2], wrapped(pose[:, 2])])
    dropped, notes = (account or Account()).fields.values()
    return RecordedPath(source, time, pose, cov, frame, dropped, notes)


class _StampedPose(NamedTuple):
    """A message with a pose."""

    stamp: int
    """[ns]"""
    recorded: int
    """[ns]"""
    frame: str
    pose: Float[np.ndarray, "7"]
    cov: Float[np.ndarray, "3 3"] | None


def _path_in_bag(source: str, path: Path, inside: str) -> RecordedPath:
    """The poses of a topic `/topic` of a bag, or of a frame in another, `parent:child`."""
    with open_bag(path) as bag:
        with_poses = [topic for topic in bag.topics if topic.type in MESSAGES and topic.count]
        topic = next((topic for topic in bag.topics if topic.name in (inside, f"/{inside}")), None)
        if topic is None and ":" in inside.strip(":"):
            return _path_of_frames(source, bag, *inside.rsplit(":", 1))
        if topic is None:
            raise bag.error(
                f"expected BAG:/topic, of {listed_topics(with_poses)}, or two frames of /tf, as "
                f"BAG:map:base_link; got {inside!r}"
            )
        if topic.type not in MESSAGES:
            raise bag.error(
                f"{topic.name}: expected messages of {', '.join(MESSAGES)}, got {topic.type}"
            )
        messages = []
        for _, recorded, message in bag.messages({topic.name}):
            position, orientation, covariance = MESSAGES[topic.type](message)
            cov = None
            if covariance is not None:
                # 36 numbers of a message, by rows
                cov = np.asarray(covariance, np.float64).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]
            messages.append(
                _StampedPose(
                    stamp_of(message.header),
                    recorded,
                    frame_name(message.header.frame_id),
                    pose_of(position, orientation),
                    cov,
                )
            )
        if not messages:
            raise bag.error(f"{topic.name}: the topic has no messages")
        frame, *others = sorted({message.frame for message in messages})
        if others:
            raise bag.error(
                f"{topic.name}: expected poses in one frame, got {', '.join([frame, *others])}"
            )
        account = Account()
        account.corrections += bag.notes
        pose = planar(np.array([message.pose for message in messages]))
        finite = np.isfinite(pose).all(axis=1)
        if not finite.any():
            raise bag.error(f"{topic.name}: none of {len(pose):,} messages has a pose in the plane")
        account.drop("messages without a pose", (~finite).sum())
        usable = [message for message, fine in zip(messages, finite, strict=True) if fine]
        stamp, kept = in_order(bag, topic.name, "messages", usable, account)
        covs = [usable[k].cov for k in kept if usable[k].cov is not None]
    return _make_path(
        source,
        seconds(stamp),
        pose[finite][kept],
        np.array(covs) if covs else None,
        frame=frame,
        account=account,
    )


def _path_of_frames(source: str, bag: Bag, parent: str, child: str) -> RecordedPath:
    """The poses of a frame in another by the transforms of a bag, composed in the plane.

    They are at the stamps of the transform between the two that has the most; others are
    interpolated at these, and where they are unknown there is no pose.
    """
    parent, child = frame_name(parent.removeprefix("/tf:")), frame_name(child)
    transforms = read_transforms(bag, static=True) + read_transforms(bag, static=False)
    frames = Frames(transforms)
    names = {name for edge in transforms for name in (edge.parent, edge.child)}
    if not {parent, child} <= names or not frames.connects(parent, child) or parent == child:
        pairs = ", ".join(dict.fromkeys(pair.name for pair in frame_pairs(transforms)))
        raise bag.error(
            f"expected two frames of the transforms {pairs or '(none)'}, with a path between them; "
            f"got {parent}:{child}"
        )
    above = frames.above(parent), frames.above(child)
    shared = set(above[0]) & set(above[1])
    chains = [
        [
            (frame, next(edge for edge in reversed(transforms) if edge.child == frame).parent)
            for frame in side
            if frame not in shared
        ]
        for side in above
    ]
    account = Account()
    account.corrections += bag.notes
    paths = {
        frame: _path_of_edge(bag, transforms, frame, above_it, account)
        for side in chains
        for frame, above_it in side
    }
    stamp = max((stamp for stamp, _ in paths.values()), key=len)
    if len(stamp) < 2:
        raise bag.error(f"{parent}:{child}: expected frames that move, got one pose in all")
    start = stamp[0]  # whole numbers of so many digits are no float64
    rows = (stamp - start) * 1e-9
    is_known = np.ones(len(stamp), bool)
    ends = []
    for side in chains:
        pose = np.zeros((len(stamp), 3))
        for frame, _ in side:
            clock, path = (paths[frame][0] - start) * 1e-9, paths[frame][1]
            if len(clock) > 1:
                path, in_time = known_poses(clock, path, rows, interpolate=geodesic_poses)
                is_known &= in_time
            pose = compose(path, pose)
        ends.append(pose)
    if not is_known.any():
        raise bag.error(f"{parent}:{child}: the transforms between the two have no time in common")
    account.drop("times at which a transform between is unknown", (~is_known).sum())
    pose = between(*ends)[is_known]
    return _make_path(
        source,
        seconds(stamp)[is_known],
        pose,
        None,
        frame=parent,
        account=account,
    )


def _path_of_edge(
    bag: Bag,
    transforms: Sequence[Transform],
    child: str,
    parent: str,
    account: Account,
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """The stamps [ns] and poses of a frame in its parent; the last one of a static transform."""
    edges = [edge for edge in transforms if (edge.parent, edge.child) == (parent, child)]
    moving = [edge for edge in edges if not edge.static]
    pose = planar(np.array([edge.pose for edge in moving or edges[-1:]]))
    if not np.isfinite(pose).all():
        row = int(np.argmin(np.isfinite(pose).all(axis=1)))
        bad = (moving or edges[-1:])[row].pose.tolist()
        raise bag.error(f"the transform from {parent} to {child} is not a pose: {bad}")
    if not moving:
        return np.zeros(1, np.int64), pose
    name = f"/tf from {parent} to {child}"
    stamp, kept = in_order(bag, name, f"transforms to {child}", moving, account)
    return stamp, pose[kept]
