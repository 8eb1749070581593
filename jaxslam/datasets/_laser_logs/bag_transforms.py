"""Transforms between frames in a bag: the pose of the laser on the robot, and odometry."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.datasets._laser_logs.laser_record import MOUNT_TOLERANCE, pose_text

BASES = ("base_link", "base_footprint")
"""Usual names of the robot's frame."""

ODOMS = ("odom", "odom_combined")
"""Usual names of the frame in which odometry has the robot."""

TILTED, TOO_TILTED = np.deg2rad(1.0), np.deg2rad(10.0)
"""Angles between the plane of a laser and the floor that are reported, and refused [rad]."""

UPSIDE_DOWN = "the laser is upside down: the order of its beams is reversed"

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


class LaserMount(NamedTuple):
    """How a laser is mounted on the robot."""

    pose: Float[np.ndarray, "3"]
    upside_down: bool
    tilt: float
    """between its plane and the floor [rad]"""
    base: str
    """the frame of the robot"""


def frame_name(name: str) -> str:
    """The name of a frame without the slash that it had in early ROS."""
    return name.lstrip("/")


def pose_of(position: Any, orientation: Any) -> Float[np.ndarray, "7"]:
    """The position and the quaternion of a message."""
    q = orientation
    return np.array([position.x, position.y, position.z, q.x, q.y, q.z, q.w], float)


def transforms_of(recorded: int, message: Any) -> Iterator[Transform]:
    """The transforms of a message of /tf or /tf_static."""
    for each in message.transforms:
        moved = each.transform
        yield Transform(
            stamp_of(each.header),
            recorded,
            frame_name(each.header.frame_id),
            frame_name(each.child_frame_id),
            pose_of(moved.translation, moved.rotation),
        )


def stamp_of(header: Any) -> int:
    """The stamp of a header [ns]."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def planar(pose: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 3"]:
    """The poses (x, y, θ) of poses with quaternions; NaN for one of those that are none."""
    x, y, z, w = np.where(_is_pose(pose)[:, None], pose[:, 3:], np.nan).T
    heading = np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
    return np.column_stack([pose[:, :2], heading])


def _is_pose(pose: Float[np.ndarray, "n 7"]) -> Bool[np.ndarray, "n"]:
    """Whether positions are finite and within `_FARTHEST`, and quaternions have norm 1."""
    near = (np.abs(pose[:, :3]) <= _FARTHEST).all(axis=1)
    within = np.where(np.abs(pose[:, 3:]) < 2, pose[:, 3:], np.nan)
    return near & (np.abs((within**2).sum(axis=1) - 1) < 2 * _UNIT)


class Frames:
    """The tree of the frames of a bag, in which each has one parent."""

    def __init__(self, transforms: Sequence[Transform]) -> None:
        self._to: dict[str, list[Transform]] = {}
        for each in transforms:
            self._to.setdefault(each.child, []).append(each)

    def connects(self, base: str, frame: str) -> bool:
        """Whether the pose of a frame in another is known."""
        return self._above(base)[-1] == self._above(frame)[-1]

    def pose(self, base: str, frame: str) -> Float[np.ndarray, "4 4"]:
        """The pose of a frame in the base, which are connected.

        Raises ValueError if a transform between the two changes, or is not one.
        """
        shared = set(self._above(base)) & set(self._above(frame))
        pose: np.ndarray = np.linalg.solve(self._up(base, shared), self._up(frame, shared))
        return pose

    def _above(self, frame: str) -> list[str]:
        """A frame, its parent, the parent of that, and so on."""
        path = [frame]
        while path[-1] in self._to and (parent := self._to[path[-1]][-1].parent) not in path:
            path.append(parent)
        return path

    def _up(self, frame: str, shared: set[str]) -> Float[np.ndarray, "4 4"]:
        """The pose of a frame in the first of the shared frames above it."""
        pose = np.eye(4)
        for child in self._above(frame):
            if child in shared:
                break
            pose = self._fixed(child) @ pose
        return pose

    def _fixed(self, child: str) -> Float[np.ndarray, "4 4"]:
        """The pose of a frame in its parent, which may not change."""
        of = self._to[child]
        poses = np.array([_matrix(each.pose) for each in of])
        between = f"the transform from {of[-1].parent} to {child}"
        if not np.isfinite(poses).all():
            raise ValueError(f"{between} is not a pose: {of[-1].pose.tolist()}")
        far = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max()
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], poses[0, :3, :3]) - 1) / 2
        turned = np.arccos(np.clip(cosine, -1, 1)).max()
        if far > MOUNT_TOLERANCE[0] or turned > MOUNT_TOLERANCE[1]:
            raise ValueError(
                f"{between} changes by {far:.4g} m and {np.rad2deg(turned):.4g}°, so the laser "
                "moves on the robot; expected one mount, or one that is given"
            )
        return np.asarray(poses[0])


def _matrix(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """A pose as a matrix; NaN if it is none."""
    known = bool(_is_pose(pose[None])[0])
    x, y, z, w = pose[3:] / np.linalg.norm(pose[3:]) if known else np.full(4, np.nan)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = pose[:3]
    return out


def laser_mount(
    frames: Frames, laser: str, base: str | None, corrections: list[str]
) -> LaserMount | None:
    """The mount of a laser, by the transforms between its frame and the robot's.

    base: the robot's frame by odometry; if the laser is not connected to it, `BASES` are tried.
    None, which is described, if none is connected.

    Raises ValueError if the mount changes, or the plane of the laser is too far from the floor.
    """
    tried = ([base] if base else []) + [one for one in BASES if one != base]
    found = next((one for one in tried if frames.connects(one, laser)), None)
    if found is None:
        corrections.append(
            f"no transform from {' or '.join(tried)} to the laser's frame {laser!r}: the laser is "
            "taken to be at the robot's centre, looking ahead"
        )
        return None
    pose = frames.pose(found, laser)
    up = pose[2, 2]
    tilt = float(np.arccos(min(abs(up), 1.0)))
    x, y = pose[:2, 3]
    mount = np.array([x, y, np.arctan2(pose[1, 0], pose[0, 0])])
    if tilt > TOO_TILTED:
        raise ValueError(
            f"the laser's frame {laser!r} is tilted by {np.rad2deg(tilt):.3g}° against {found}; "
            f"expected at most {np.rad2deg(TOO_TILTED):.3g}°"
        )
    if tilt > TILTED:
        corrections.append(
            f"the laser is tilted by {np.rad2deg(tilt):.3g}°: its ranges are taken for level ones"
        )
    if base and found != base:
        corrections.append(
            f"no transform from {base}, the frame of the odometry, to the laser's frame {laser!r}: "
            f"the mount is that on {found}"
        )
    if up < 0:
        corrections.append(UPSIDE_DOWN)
    return LaserMount(mount, bool(up < 0), tilt, found)


def mount_text(mount: LaserMount) -> str:
    """A mount as text."""
    return f"{pose_text(mount.pose)} on {mount.base}" + (", upside down" * mount.upside_down)


def odometry_edges(transforms: Sequence[Transform]) -> Mapping[tuple[str, str], int]:
    """The pairs of frames that are odometry by their names, and the number of their transforms."""
    pairs = Counter((each.parent, each.child) for each in transforms)
    return {
        pair: count
        for pair, count in pairs.items()
        if _last(pair[0]) in ODOMS and _last(pair[1]) in BASES
    }


def _last(frame: str) -> str:
    """The last part of a frame's name, as `odom` of `robot1/odom`."""
    return frame.rsplit("/", 1)[-1]
