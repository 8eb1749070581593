"""Transforms between frames in a bag: the pose of the laser on the robot, and odometry."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.datasets._laser_logs.laser_record import MOUNT_TOLERANCE, pose_text
from jaxslam.math import numpy_poses as poses

BASES = ("base_link", "base_footprint")
"""Usual names of the robot's frame."""

ODOMS = ("odom", "odom_combined")
"""Usual names of the frame in which odometry has the robot."""

TILTED, TOO_TILTED = np.deg2rad(1.0), np.deg2rad(10.0)
"""Angles between the plane of a laser and the floor that are reported, and refused [rad]."""

UPSIDE_DOWN = "the laser is upside down: the order of its beams is reversed"

_EQUAL = 1e-4
"""Difference of two static transforms [m], [rad], up to which one repeats the other."""
_UNIT = 0.01
"""Largest difference of the norm of a quaternion from 1."""
_FARTHEST = 1e9
"""Largest coordinate of a pose [m]."""


class Transform(NamedTuple):
    """A transform of a message: the pose of the child in the frame of its parent."""

    stamp: int
    """[ns]"""
    recorded: int
    """[ns]"""
    parent: str
    child: str
    pose: Float[np.ndarray, "7"]
    """x, y, z and the quaternion x, y, z, w"""
    static: bool
    """whether it is of `/tf_static`"""


class FramePair(NamedTuple):
    """Two frames between which a bag has transforms."""

    parent: str
    child: str
    number: int
    """number of transforms"""
    static: bool
    """whether the transforms are of `/tf_static`"""
    moves: bool
    """whether the child moves in the plane of its parent, by more than the tolerance of a mount"""
    turns: bool
    """whether the child turns in this plane"""

    @property
    def name(self) -> str:
        """The names of the frames, as `odom:base_link`."""
        return f"{self.parent}:{self.child}"


class LaserMount(NamedTuple):
    """The mount of a laser on the robot."""

    pose: Float[np.ndarray, "3"]
    upside_down: bool
    tilt: float
    """angle between the plane of the laser and the floor [rad]"""
    base: str
    """name of the robot's frame"""


def frame_name(name: str) -> str:
    """The name of a frame without the slash that it had in early ROS."""
    return name.lstrip("/")


def pose_of(position: Any, orientation: Any) -> Float[np.ndarray, "7"]:
    """The position and the quaternion of a message."""
    q = orientation
    return np.array([position.x, position.y, position.z, q.x, q.y, q.z, q.w], float)


def transforms_of(recorded: int, message: Any, static: bool) -> Iterator[Transform]:
    """The transforms of a message of /tf or /tf_static."""
    for stamped in message.transforms:
        yield Transform(
            stamp_of(stamped.header),
            recorded,
            frame_name(stamped.header.frame_id),
            frame_name(stamped.child_frame_id),
            pose_of(stamped.transform.translation, stamped.transform.rotation),
            static,
        )


def stamp_of(header: Any) -> int:
    """The stamp of a header [ns]."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def planar(pose: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 3"]:
    """The poses (x, y, θ) of poses with quaternions; NaN for numbers that are no pose."""
    x, y, z, w = np.where(_is_pose(pose)[:, None], pose[:, 3:], np.nan).T
    heading = np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
    return np.column_stack([pose[:, :2], heading])


def _is_pose(pose: Float[np.ndarray, "n 7"]) -> Bool[np.ndarray, "n"]:
    """The mask of poses: positions finite and within `_FARTHEST`, quaternions of norm 1."""
    near = (np.abs(pose[:, :3]) <= _FARTHEST).all(axis=1)
    within = np.where(np.abs(pose[:, 3:]) < 2, pose[:, 3:], np.nan)
    return near & (np.abs((within**2).sum(axis=1) - 1) < 2 * _UNIT)


class Frames:
    """The tree of the frames of a bag; the parent of a frame is that of its last transform."""

    def __init__(self, transforms: Sequence[Transform]) -> None:
        self._to: dict[str, list[Transform]] = {}
        for transform in transforms:
            self._to.setdefault(transform.child, []).append(transform)

    def connects(self, base: str, frame: str) -> bool:
        """Whether the pose of a frame in another is known."""
        return self.above(base)[-1] == self.above(frame)[-1]

    def above(self, frame: str) -> list[str]:
        """The chain of a frame, its parent, the parent's parent, and so on."""
        path = [frame]
        while path[-1] in self._to and (parent := self._to[path[-1]][-1].parent) not in path:
            path.append(parent)
        return path

    def pose(
        self, base: str, frame: str, corrections: list[str]
    ) -> tuple[Float[np.ndarray, "n 4 4"], str]:
        """The poses of a frame in the base, which are connected, at the times of the transforms
        between them that change, and the names of the frames of these.

        Of static transforms the last counts, as for tf2; it is described if it differs from others.

        Raises ValueError if a transform between the two is not a pose.
        """
        shared = set(self.above(base)) & set(self.above(frame))
        sides = [
            [child for child in self.above(end) if child not in shared] for end in (base, frame)
        ]
        edges = {
            child: self._edge(child, corrections) for child in dict.fromkeys(sides[0] + sides[1])
        }
        changing = [time for time, _ in edges.values() if len(time) > 1]
        times = np.unique(np.concatenate(changing)) if changing else np.zeros(1, np.int64)
        up = []
        for side in sides:
            pose = np.broadcast_to(np.eye(4), (len(times), 4, 4))
            for child in side:
                time, at = edges[child]
                pose = at[np.maximum(np.searchsorted(time, times, side="right") - 1, 0)] @ pose
            up.append(pose)
        between = ", ".join(
            f"from {self._to[child][-1].parent} to {child}"
            for child, (time, _) in edges.items()
            if len(time) > 1
        )
        return np.linalg.solve(up[0], up[1]), between

    def _edge(
        self, child: str, corrections: list[str]
    ) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 4 4"]]:
        """The times of the recording [ns] and the poses of a frame in its parent.

        The last static pose, and the poses of `/tf`; a single pose if all are equal.
        """
        parent = self._to[child][-1].parent
        transforms = [edge for edge in self._to[child] if edge.parent == parent]
        others = {edge.parent for edge in self._to[child] if edge.static} - {parent}
        if others and transforms[-1].static:
            corrections.append(
                f"{child} has static transforms from {', '.join(sorted(others))} and from {parent}:"
                " the last one is used"
            )
        pose = _matrices(np.array([edge.pose for edge in transforms]))
        if not np.isfinite(pose).all():
            bad = transforms[int(np.argmax(~np.isfinite(pose).all(axis=(1, 2))))].pose.tolist()
            raise ValueError(f"the transform from {parent} to {child} is not a pose: {bad}")
        static = np.array([edge.static for edge in transforms])
        if static.any():
            far, turned = _largest_change(pose[static], pose[static][-1])
            if far > _EQUAL or turned > _EQUAL:
                corrections.append(
                    f"the static transform from {parent} to {child} was sent again, with a change "
                    f"of {far:.4g} m and {np.rad2deg(turned):.4g}°: the last one is used"
                )
            kept = ~static
            kept[np.flatnonzero(static)[-1]] = True
            transforms = [edge for edge, keep in zip(transforms, kept, strict=True) if keep]
            pose = pose[kept]
        time = np.array([edge.recorded for edge in transforms], np.int64)
        order = np.argsort(time, kind="stable")
        if max(_largest_change(pose, pose[0])) < 1e-9:
            order = order[:1]
        return time[order], pose[order]


def _largest_change(
    pose: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "4 4"]
) -> tuple[float, float]:
    """The largest distance [m] and angle [rad] of poses from a reference."""
    far = np.linalg.norm(pose[:, :3, 3] - reference[:3, 3], axis=1).max()
    # By the sine of half the angle: its cosine has no digits for small angles.
    off = np.linalg.norm(pose[:, :3, :3] - reference[:3, :3], axis=(1, 2)).max()
    return float(far), float(2 * np.arcsin(min(off / np.sqrt(8), 1.0)))


def _matrices(pose: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 4 4"]:
    """The poses as matrices; NaN for numbers that are no pose."""
    q = np.where(_is_pose(pose)[:, None], pose[:, 3:], np.nan)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    matrix = np.tile(np.eye(4), (len(pose), 1, 1))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:, :3, :3] = np.moveaxis(np.array(rows), 2, 0)
    matrix[:, :3, 3] = pose[:, :3]
    return matrix


def laser_mount(
    frames: Frames, laser: str, bases: Sequence[str], corrections: list[str], moving: str = ""
) -> LaserMount | None:
    """The mount of a laser, by the transforms between its frame and the robot's; None without any.

    The mount is in the plane, the median over all times. The tilt may change, as by an IMU between
    two frames of the robot; the mount may not, beyond the motion by the tilt.

    Args:
        corrections: receives a description of each assumption.
        bases: the robot's frame by odometry, if known; then `BASES` are tried.
        moving: a frame that moves, which is tried last.

    Raises ValueError if the mount changes, or the plane of the laser is too far from the floor.
    """
    tried = list(dict.fromkeys([*bases, *BASES]))
    base = next((name for name in tried if frames.connects(name, laser)), None)
    if base is None and moving and frames.connects(moving, laser):
        base = moving
    if base is None:
        above = frames.above(laser)
        corrections.append(
            f"no transform from {' or '.join(tried)} to the laser's frame {laser!r}: the laser is "
            "taken to be at the robot's centre, looking ahead"
            + f"; its frame is below {above[-1]!r}"
            * (len(above) > 1)
        )
        return None
    pose, changing = frames.pose(base, laser, corrections)
    up = pose[:, 2, 2]
    upside_down = bool(np.median(up) < 0)
    mounts = np.column_stack([pose[:, :2, 3], np.arctan2(pose[:, 1, 0], pose[:, 0, 0])])
    mount = np.median(mounts[:, :2], axis=0)
    middle = mounts[np.argmin(np.hypot(*(mounts[:, :2] - mount).T)), 2]
    turned = poses.wrapped(mounts[:, 2] - middle)
    mount = np.append(mount, poses.wrapped(middle + np.median(turned)))
    tilts = np.arccos(np.minimum(np.where(upside_down, -up, up), 1.0))
    tilt, most = float(np.quantile(tilts, 0.95)), float(tilts.max())
    if tilt > TOO_TILTED:
        raise ValueError(
            f"the laser's frame {laser!r} is tilted by {np.rad2deg(tilt):.3g}° against {base}; "
            f"expected at most {np.rad2deg(TOO_TILTED):.3g}°"
        )
    far = float(np.hypot(*(mounts[:, :2] - mount[:2]).T).max())
    turn = float(np.abs(poses.wrapped(mounts[:, 2] - mount[2])).max())
    height = float(np.abs(pose[:, 2, 3]).max())
    if far > MOUNT_TOLERANCE[0] + height * np.sin(most) or turn > MOUNT_TOLERANCE[1]:
        raise ValueError(
            f"the transform {changing} changes by {far:.4g} m and {np.rad2deg(turn):.4g}°, so the "
            "laser moves on the robot; expected one mount, or one that is given"
        )
    if np.ptp(tilts) > _EQUAL:
        corrections.append(
            f"the transform {changing} changes: the laser is tilted by up to "
            f"{np.rad2deg(most):.3g}°, its mount in the plane is constant to {round(far, 4):g} m "
            f"and {round(np.rad2deg(turn), 3):g}°, and its ranges are taken for level ones"
        )
    elif tilt > TILTED:
        corrections.append(
            f"the laser is tilted by {np.rad2deg(tilt):.3g}°: its ranges are taken for level ones"
        )
    if bases and base not in bases:
        corrections.append(
            f"no transform from {bases[0]}, the frame of the odometry, to the laser's frame "
            f"{laser!r}: the mount is that on {base}"
        )
    if upside_down:
        corrections.append(UPSIDE_DOWN)
    return LaserMount(mount, upside_down, tilt, base)


def mount_text(mount: LaserMount) -> str:
    """A mount as text."""
    return f"{pose_text(mount.pose)} on {mount.base}" + (", upside down" * mount.upside_down)


def frame_pairs(transforms: Sequence[Transform]) -> tuple[FramePair, ...]:
    """The pairs of frames with transforms, by name, and the mask of those that move."""
    by_pair: dict[tuple[str, str, bool], list[Transform]] = {}
    for edge in transforms:
        by_pair.setdefault((edge.parent, edge.child, edge.static), []).append(edge)
    pairs = []
    for (parent, child, static), edges in sorted(by_pair.items()):
        path = planar(np.array([edge.pose for edge in edges]))
        path = path[np.isfinite(path).all(axis=1)]
        far = np.hypot(*np.ptp(path[:, :2], axis=0)) if len(path) else 0.0
        turn = np.abs(poses.wrapped(path[:, 2] - path[:1, 2])).max() if len(path) else 0.0
        moves = not static and far > MOUNT_TOLERANCE[0]
        turns = not static and turn > MOUNT_TOLERANCE[1]
        pairs.append(FramePair(parent, child, len(edges), static, bool(moves), bool(turns)))
    return tuple(pairs)


def odometry_pairs(
    pairs: Sequence[FramePair], frames: Frames, laser: str
) -> tuple[list[FramePair], list[FramePair]]:
    """The pairs of frames of `/tf` that are odometry, and others that move.

    Odometry are, in this order, the first kind of pair that a bag has:

    1. pairs with the usual names (`ODOMS` to `BASES`);
    2. pairs that move in the plane, with the laser below them;
    3. pairs that move in the plane, without a transform to the laser.

    A pair that only turns, as a joint does, is no odometry.
    """
    dynamic = [pair for pair in pairs if not pair.static]
    odometry = [pair for pair in dynamic if is_named_odometry(pair)]
    moving = [pair for pair in dynamic if pair.moves]
    if not odometry:
        chain = frames.above(laser)
        odometry = [pair for pair in moving if pair.child in chain and pair.parent in chain]
    if not odometry:
        odometry = [pair for pair in moving if not frames.connects(pair.child, laser)]
    others = [pair for pair in dynamic if (pair.moves or pair.turns) and pair not in odometry]
    return odometry, others


def pairs_text(pairs: Sequence[FramePair]) -> str:
    """Pairs of frames with the numbers of their transforms."""
    return ", ".join(f"{pair.name} ({pair.number:,})" for pair in pairs)


def is_named_odometry(pair: FramePair) -> bool:
    """Whether the names are usual ones of odometry; of `robot1/odom` the last part counts."""
    parent, child = (frame.rsplit("/", 1)[-1] for frame in (pair.parent, pair.child))
    return parent in ODOMS and child in BASES
