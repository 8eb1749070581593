"""ROS bags written by the library rosbags: messages as tuples, in all formats."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from broken import optional

optional("rosbags.highlevel")  # without it the files that import this one are left out

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
TF = "tf2_msgs/msg/TFMessage"
STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
FORMATS = "bag", "db3", "mcap", "zstd"
SECOND = 10**9


class Message(NamedTuple):
    """A message: `make` makes it from the types of a version of ROS."""

    topic: str
    type: str
    recorded: int
    make: object


def nanoseconds(time):
    whole = np.floor(time)
    return int(whole) * SECOND + round((time - whole) * SECOND)


def header(types, stamp, frame):
    time = types("builtin_interfaces/msg/Time")(*divmod(stamp, SECOND))
    fields = {"stamp": time, "frame_id": frame}
    of = types("std_msgs/msg/Header")
    return of(seq=0, **fields) if "seq" in of.__dataclass_fields__ else of(**fields)


def scan(stamp, ranges, topic="/scan", *, recorded=None, **changed):
    """A LaserScan; the usual numbers, some changed."""
    usual = {
        "frame": "laser",
        "angle_min": -1.5,
        "angle_increment": 0.5,
        "range_min": 0.1,
        "range_max": 30.0,
    }
    of = SimpleNamespace(**usual | changed)
    values = np.asarray(ranges, np.float32)

    def make(types):
        last = of.angle_min + of.angle_increment * (len(values) - 1)
        return types("sensor_msgs/msg/LaserScan")(
            header(types, stamp, of.frame),
            of.angle_min,
            last,
            of.angle_increment,
            *(0.0, 0.1, of.range_min, of.range_max),
            values,
            np.zeros(0, np.float32),
        )

    return Message(
        topic, "sensor_msgs/msg/LaserScan", stamp if recorded is None else recorded, make
    )


def echoes(stamp, beams, topic="/echoes", *, frame="laser"):
    """A MultiEchoLaserScan: beams of several ranges each, nearest first."""

    def make(types):
        of = types("sensor_msgs/msg/LaserEcho")
        values = [of(np.asarray(beam, np.float32)) for beam in beams]
        last = -1.5 + 0.5 * (len(beams) - 1)
        return types("sensor_msgs/msg/MultiEchoLaserScan")(
            header(types, stamp, frame), -1.5, last, 0.5, 0.0, 0.1, 0.1, 30.0, values, []
        )

    return Message(topic, "sensor_msgs/msg/MultiEchoLaserScan", stamp, make)


def quaternion(heading):
    """(x, y, z, w)"""
    return 0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)


def odometry(
    stamp,
    pose,
    topic="/odom",
    *,
    recorded=None,
    base="base_link",
    turned=None,
    frame="odom",
    cov=None,
):
    """An Odometry of (x, y, θ), or of another quaternion `turned`; cov of (x, y, θ)."""
    x, y, heading = map(float, pose)

    def make(types):
        point, vector = types("geometry_msgs/msg/Point"), types("geometry_msgs/msg/Vector3")
        turn = types("geometry_msgs/msg/Quaternion")(*map(float, turned or quaternion(heading)))
        place = types("geometry_msgs/msg/Pose")(point(x, y, 0.0), turn)
        still = types("geometry_msgs/msg/Twist")(vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return types("nav_msgs/msg/Odometry")(
            header(types, stamp, frame),
            base,
            types("geometry_msgs/msg/PoseWithCovariance")(place, in_space(cov)),
            types("geometry_msgs/msg/TwistWithCovariance")(still, np.zeros(36)),
        )

    return Message(topic, "nav_msgs/msg/Odometry", stamp if recorded is None else recorded, make)


def in_space(cov):
    """The 36 numbers of a covariance of (x, y, θ)."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = 0 if cov is None else cov
    return full.reshape(-1)


def stamped_pose(stamp, pose, topic, cov=None, *, kind="PoseStamped", frame="map", turned=None):
    """A PoseStamped, PoseWithCovarianceStamped or TransformStamped of (x, y, θ)."""
    x, y, heading = map(float, pose)

    def make(types):
        turn = types("geometry_msgs/msg/Quaternion")(*map(float, turned or quaternion(heading)))
        to = header(types, stamp, frame)
        of = types(f"geometry_msgs/msg/{kind}")
        if kind == "TransformStamped":
            moved = types("geometry_msgs/msg/Vector3")(x, y, 0.0)
            return of(to, "base_link", types("geometry_msgs/msg/Transform")(moved, turn))
        place = types("geometry_msgs/msg/Pose")(types("geometry_msgs/msg/Point")(x, y, 0.0), turn)
        if kind == "PoseStamped":
            return of(to, place)
        return of(to, types("geometry_msgs/msg/PoseWithCovariance")(place, in_space(cov)))

    return Message(topic, f"geometry_msgs/msg/{kind}", stamp, make)


def transform(stamp, parent, child, moved, turned, topic="/tf"):
    """A message of one transform: a translation and a quaternion (x, y, z, w)."""

    def make(types):
        of = types("geometry_msgs/msg/Transform")(
            types("geometry_msgs/msg/Vector3")(*map(float, moved)),
            types("geometry_msgs/msg/Quaternion")(*map(float, turned)),
        )
        stamped = types("geometry_msgs/msg/TransformStamped")
        return types(TF)([stamped(header(types, stamp, parent), child, of)])

    return Message(topic, TF, stamp, make)


def fixed(parent, child, moved, turned):
    """The same, of /tf_static."""
    return transform(SECOND, parent, child, moved, turned, topic="/tf_static")


def write(folder, messages, form="bag", name="drive", empty=()):
    """Write a bag; returns its path, a file of ROS 1 or a folder. empty: (topic, type) without messages."""
    path = Path(folder) / (f"{name}.bag" if form == "bag" else name)
    store = STORES[1 if form == "bag" else 2]
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if form == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    if form == "zstd":
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    if form == "bag":
        writer.set_compression(Writer1.CompressionFormat.BZ2)

    def types(of):
        return store.types[of]

    with writer as out:
        topics = {each.topic: each.type for each in messages} | dict(empty)
        to = {
            topic: out.add_connection(topic, kind, typestore=store)
            for topic, kind in topics.items()
        }
        for topic, kind, recorded, make in sorted(messages, key=lambda each: each.recorded):
            serialize = store.serialize_ros1 if form == "bag" else store.serialize_cdr
            out.write(to[topic], recorded, serialize(make(types), kind))
    return path


def of_log(log):
    """The messages of a laser log: scans and odometry, both at their times; the mount is static."""
    angle = np.asarray(log.beams.angle)
    step = angle[:, 1] - angle[:, 0]
    ranges = np.where(log.beams.valid, log.beams.range, np.nan)
    scans = [
        scan(nanoseconds(t), r, angle_min=a[0], angle_increment=s, range_max=log.max_range)
        for t, r, a, s in zip(log.time, ranges, angle, step, strict=True)
    ]
    x, y, heading = log.mount
    mount = fixed("base_link", "laser", (x, y, 0.2), quaternion(heading))
    mount = mount._replace(recorded=scans[0].recorded)
    times = map(nanoseconds, log.odometry_time)
    return [mount, *scans, *map(odometry, times, log.odometry)]


def first(log, scans):
    """The first scans of a log, with angles and ranges rounded to the 32 bits of a LaserScan."""
    short = np.float32
    angle = np.asarray(log.beams.angle)[:scans]
    step = (angle[:, 1] - angle[:, 0]).astype(short).astype(float)
    start = angle[:, 0].astype(short).astype(float)
    beams = log.beams._replace(
        range=np.asarray(log.beams.range)[:scans].astype(short).astype(float),
        angle=start[:, None] + step[:, None] * np.arange(angle.shape[1]),
        valid=np.asarray(log.beams.valid)[:scans],
    )
    kept = {name: getattr(log, name)[:scans] for name in ("time", "corrected", "raw", "row")}
    known = log.odometry_known[:scans]
    return dataclasses.replace(log, beams=beams, odometry_known=known, **kept)
