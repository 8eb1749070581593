"""Figures of maps, errors and campaigns.

Only this package draws. Figures are made without pyplot, so there is no global state and no window;
`figure.savefig(path)` saves one.
"""

from jaxslam.results.plot.campaign import (
    bound_figure,
    cost_figure,
    coverage_figure,
    gained_figure,
    whiteness_figure,
)
from jaxslam.results.plot.formats import encode
from jaxslam.results.plot.nees import nees_figure
from jaxslam.results.plot.single import ellipse, errors_figure, map_figure
from jaxslam.results.plot.style import COLORS, Figure, describe, png, warm_up

__all__ = [
    "COLORS",
    "Figure",
    "bound_figure",
    "cost_figure",
    "coverage_figure",
    "describe",
    "ellipse",
    "encode",
    "errors_figure",
    "gained_figure",
    "map_figure",
    "nees_figure",
    "png",
    "warm_up",
    "whiteness_figure",
]
