"""Calibration from a filter's innovations: systematic errors, and noises by their likelihood.

`calibrate` finds parameters of which the noise covariances do not depend, by Gauss-Newton on the
whitened innovations, also where associations change; `fit_noise` maximizes the likelihood, for
standard deviations and other parameters, with the associations held; `consider_cov` is the
covariance that uncertain parameters add to a result. `delayed` is a log whose measurements
are late, by a delay that can be such a parameter.
"""

from jaxslam._public import publish
from jaxslam.calibration._delay import delayed
from jaxslam.calibration._maximum_likelihood import NoiseFit, as_associated, fit_noise
from jaxslam.calibration._systematic import Calibration, calibrate, consider_cov

__all__ = [
    "Calibration",
    "NoiseFit",
    "as_associated",
    "calibrate",
    "consider_cov",
    "delayed",
    "fit_noise",
]

publish(__name__)
