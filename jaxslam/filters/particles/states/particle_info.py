"""The particle-specific results of an update."""

from typing import NamedTuple

from jax import Array
from jaxtyping import Bool, Float, Int


class ParticleInfo(NamedTuple):
    """The record `info.extra["particles"]`; None for fields that the filter does not have."""

    ess: Float[Array, "*T"]
    """effective number of particles, 1/Σ w², after the scan and before resampling"""
    resampled: Bool[Array, "*T"]
    """the particles were resampled"""
    underflow: Bool[Array, "*T"]
    """no particle had a weight left, and all were given the same; log_likelihood is then 0, not
    -∞"""
    invalid: Int[Array, "*T"]
    """particles that a motion or a scan left with a pose that is not finite; they keep the pose
    before, and have weight zero"""
    active: Int[Array, "*T"] | None = None
    """particles in use, of a filter that chooses their number"""
    injected: Int[Array, "*T"] | None = None
    """particles drawn from wherever the robot may be before this step's motion, to find a lost
    one"""
    capped: Bool[Array, "*T"] | None = None
    """the wanted number of particles was above the capacity"""
    blocked: Int[Array, "*T"] | None = None
    """particles in use that are off the map or in an occupied cell, of a filter in a grid; they
    have weight zero"""

    def counts(self) -> dict[str, Array]:
        """What a campaign counts: of the fields that the filter has."""
        names = ("resampled", "underflow", "invalid", "injected", "capped")
        events = {name: getattr(self, name) for name in names}
        return {name: happened for name, happened in events.items() if happened is not None}
