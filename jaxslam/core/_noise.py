"""Names of `core.noise` under their old path."""

from jaxslam.core.noise import Constant, NoiseCov

__all__ = ["Constant", "NoiseCov"]
