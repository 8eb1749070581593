"""The systematic errors of a robot of MRCLAM, found in its own log."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.calibration import Calibration, calibrate
from jaxslam.charts import RightInvariant
from jaxslam.core.numbers import is_concrete
from jaxslam.datasets.mrclam.calibration import (
    MRCLAM_CALIBRATION,
    RobotCalibration,
    check_calibration,
)
from jaxslam.datasets.mrclam.reader import mrclam
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.math.stats import sigma_gate
from jaxslam.motion import Unicycle
from jaxslam.protocols import Motion, Sensor
from jaxslam.run import run
from jaxslam.sensors import RangeBearing
from jaxslam.types import Info, Log

MRCLAM_FITTED = ("forward", "outer", "turn", "curvature", "ahead", "yaw", "axis")
"""What a log tells of a `RobotCalibration`; it does not tell `depth` beside `forward`."""


class OwnCalibration(NamedTuple):
    """The calibration of a robot by its own log, and how it was found.

    `at(p, scale=1.0)` returns the log and the models (`Log`, `Motion`, `Sensor`) with other
    constants p (7,), in the order of `MRCLAM_FITTED`; ranges and travel, which no log tells apart,
    are both larger by a scale. p and the scale may be traced:

        def poses(p):
            log, motion, sensor = own.at(p[:-1], scale=1 + p[-1])
            filter = EkfSlam(motion, sensor, data.capacity, **data.filter_options)
            return run(filter, log, data.pose, data.pose_cov, key).estimate.pose

        p = [*own.found.parameters, 0.0]
        added = calibration.consider_cov(poses, p, block_diag(own.found.cov, 0.02**2))
    """

    robot: RobotCalibration
    found: Calibration
    """of `MRCLAM_FITTED`, in that order"""
    at: Callable[..., tuple[Log, Motion, Sensor]]
    """(p (7,), scale=1.0) -> log, motion, sensor"""


def mrclam_calibration(
    folder: str | Path,
    robot: int = 1,
    *,
    known: RobotCalibration = MRCLAM_CALIBRATION,
    gate: float = 5.0,
    errata: bool = True,
) -> OwnCalibration:
    """The systematic errors of one robot that make its innovations least, by its own log.

    `calibration.calibrate` on the innovations of the right-invariant EKF: wheels (`forward`,
    `outer`, `turn`, `curvature`), place and yaw of the camera (`ahead`, `yaw`), and its optical
    axis (`axis`).
    Neither the true path nor the survey is used (where there is a true path, `mrclam` cuts lines
    (0, 0) after its end). Delay, noise and `depth` are those of `known`:
    ranges and odometry in proportion larger are the same log of a larger world, so the scale of the
    map is that of `depth`.

        own = mrclam_calibration(folder, 5)
        data = mrclam(folder, 5, calibration=own.robot)

    Args:
        folder, robot, errata: as for `mrclam`.
        known: what is held, and where the search starts.
        gate: [σ] of innovations.
    Raises:
        ValueError: as `mrclam` and `calibrate` do.
    """
    check_calibration("mrclam_calibration", known)
    data = mrclam(
        folder,
        robot,
        calibration=known._replace(
            forward=1.0, outer=0.0, turn=1.0, curvature=0.0, depth=1.0, axis=0.0
        ),
        errata=errata,
    )
    bearing = np.asarray(data.log.scan.z[..., 1])
    depth = np.asarray(data.log.scan.z[..., 0]) * np.cos(bearing)

    def at(p: jax.Array, scale: jax.Array | float = 1.0) -> tuple[Log, Motion, Sensor]:
        if np.shape(p) != (len(MRCLAM_FITTED),) or (is_concrete(scale) and not float(scale) > 0):
            raise ValueError(
                f"OwnCalibration.at: expected constants of shape {(len(MRCLAM_FITTED),)} and a "
                f"scale above 0, got {np.shape(p)} and {scale}"
            )
        traced = cast("dict[str, float]", dict(zip(MRCLAM_FITTED, p, strict=True)))
        own = known._replace(**traced)
        v, omega, dt = jnp.asarray(data.log.control).T
        forward, turn = own.velocities(v, omega)
        phi = jnp.asarray(bearing)
        z = jnp.stack([scale * own.range(jnp.asarray(depth), phi), phi], axis=-1)
        log = data.log._replace(
            control=jnp.stack([scale * forward, turn, dt], axis=-1),
            scan=data.log.scan._replace(z=z),
        )
        ahead = scale * own.ahead
        mount = jnp.stack([ahead, 0.0 * ahead, own.yaw])
        return log, Unicycle(own.odometry_cov()), RangeBearing(own.measurement_cov(), mount=mount)

    def info(p: jax.Array) -> Info:
        log, motion, sensor = at(p)
        more: EkfOptions = {"gate": sigma_gate(gate), "chart": RightInvariant()}
        options = data.filter_options | more
        filter = EkfSlam(motion, sensor, data.capacity, **options)
        return run(filter, log, jnp.zeros(3), jnp.zeros((3, 3)), jax.random.key(0)).info

    found = calibrate(info, [getattr(known, name) for name in MRCLAM_FITTED])
    values = dict(zip(MRCLAM_FITTED, found.parameters.tolist(), strict=True))
    return OwnCalibration(known._replace(**values), found, at)
