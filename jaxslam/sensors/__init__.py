"""Sensors: those that determine a landmark are one a file, others in `partial` and `absolute`.

The conformance tests run over `REGISTRY`."""

from collections.abc import Callable

from jaxslam._public import publish
from jaxslam.core._names import Named
from jaxslam.core.protocols import Sensor
from jaxslam.sensors._absolute import Absolute, Compass, PositionFix, Speed, TurnRate
from jaxslam.sensors._bearing_inverse_depth import BearingInverseDepth
from jaxslam.sensors._bearing_rate import BearingRate
from jaxslam.sensors._line import Line
from jaxslam.sensors._partial import BearingOnly, RangeOnly
from jaxslam.sensors._range_bearing import RangeBearing, RangeBearingNoise
from jaxslam.sensors._range_bearing_signature import RangeBearingSignature
from jaxslam.sensors._range_errors import Corrected
from jaxslam.sensors._range_rate import RangeRate
from jaxslam.sensors._relative_position import RelativePosition
from jaxslam.sensors._suite import Part, Suite

REGISTRY: dict[str, Callable[..., Sensor]] = Named(
    {
        "bearing_inverse_depth": BearingInverseDepth,
        "bearing_only": BearingOnly,
        "bearing_rate": BearingRate,
        "compass": Compass,
        "line": Line,
        "position_fix": PositionFix,
        "range_bearing": RangeBearing,
        "range_bearing_signature": RangeBearingSignature,
        "range_only": RangeOnly,
        "range_rate": RangeRate,
        "relative_position": RelativePosition,
        "speed": Speed,
        "turn_rate": TurnRate,
    }
)

__all__ = [
    "REGISTRY",
    "Absolute",
    "BearingInverseDepth",
    "BearingOnly",
    "BearingRate",
    "Compass",
    "Corrected",
    "Line",
    "Part",
    "PositionFix",
    "RangeBearing",
    "RangeBearingNoise",
    "RangeBearingSignature",
    "RangeOnly",
    "RangeRate",
    "RelativePosition",
    "Speed",
    "Suite",
    "TurnRate",
]

publish(__name__)
