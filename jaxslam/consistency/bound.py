"""The posterior Cramér-Rao bound: what no filter can be better than."""

from typing import Any

import jax

from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.linearize.at_truth import at_truth
from jaxslam.run import run
from jaxslam.simulate import Scenario
from jaxslam.types import Estimate, Log, Truth


def posterior_bound(scenario: Scenario, truth: Truth, log: Log, key: jax.Array) -> Estimate:
    """The bound on the covariance of any estimate, along a true trajectory; as `Estimate`s, (T,).

    Tichavský, Muravchik & Nehorai (IEEE Trans. Signal Processing 46(5), 1998) give the recursion
    J_{k+1} = D22 - D21 (J_k + D11)⁻¹ D12, D11 = FᵀQ⁻¹F, D12 = -FᵀQ⁻¹, D22 = Q⁻¹ + HᵀR⁻¹H, with
    Jacobians at the truth. Its inverse is the covariance of the Kalman filter of that linear
    system, which also exists for a singular Q or P0; so this runs the ideal EKF without gate and
    with every birth allowed, and only its covariances mean something. Averaged over runs it bounds
    mean square errors. The noise of a measurement is what the sensor states for what it measured.
    """
    options: dict[str, Any] = scenario.filter_options | {"gate": None, "births": None}
    capacity = truth.landmarks.shape[0]
    ideal = ekf_slam(
        scenario.motion, scenario.sensor, capacity, **options, linearize=at_truth(truth)
    )
    return run(ideal, log, scenario.pose, scenario.pose_cov, key).estimate
