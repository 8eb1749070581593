"""How well, and at what cost, measurements are told apart."""

from jaxslam import association


def rules(*gates: float, **search: int):
    """The methods by name. gates: of a match, and of a new landmark; search: of `joint`."""
    return {
        "nearest": association.Nearest(*gates),
        "maximum_likelihood": association.MaximumLikelihood(*gates),
        "global_nearest": association.GlobalNearest(*gates),
        "joint": association.JointCompatibility(0.99, *gates[1:], **search),
    }
