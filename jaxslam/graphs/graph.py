"""The data of a graph: variables, and measurements between them in tables by kind.

The cost of a graph is χ² = Σ eᵀ Ω e over all valid rows of all tables, without a factor ½: e is the
residual of the row (`factor.Factor`) and Ω its information.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from jaxslam.types import JaxOrNumPy


class Table(NamedTuple):
    """Measurements of one kind, E rows: K variables, Z numbers measured and R residuals each."""

    who: Int[JaxOrNumPy, "E K"]
    """the variables of a row: indices of poses or points, as the factor's `variables` says"""
    z: Float[JaxOrNumPy, "E Z"]
    """what was measured"""
    information: Float[JaxOrNumPy, "E R R"]
    """Ω, the inverse of the residual's covariance; symmetric, positive semidefinite"""
    valid: Bool[JaxOrNumPy, "E"]
    """false for padding, and for rows that are left out"""


class Graph(NamedTuple):
    """A graph of N poses and P points (or landmarks of L numbers); leading axes by `vmap`.

    The factor of a table stands in a dictionary of the same keys beside the graph, since data hold
    no functions: `graphs.REGISTRY` has those of files.
    """

    poses: Float[JaxOrNumPy, "N 3"]
    """(x, y, θ); θ is wrapped where it was computed, and as it stands in a file"""
    points: Float[JaxOrNumPy, "P L"]
    tables: dict[str, Table]
    fixed_pose: Bool[JaxOrNumPy, "N"]
    """poses that optimization does not move"""
    fixed_point: Bool[JaxOrNumPy, "P"]
    pose_id: Int[JaxOrNumPy, "N"]
    """identity in a file, or in a log the number of controls before it"""
    point_id: Int[JaxOrNumPy, "P"]
    """identity in a file, or tag in a log"""
