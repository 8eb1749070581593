"""Noise covariances of models: constant, or a function of the state or the measurement."""

from jaxslam.core._noise import Constant, NoiseCov

__all__ = ["Constant", "NoiseCov"]
