"""Figures of maps, errors and campaigns, all in one style.

Only this package draws. Figures are made without pyplot, without global state and windows;
`figure.savefig(path)` saves one. They are as wide as a page; `width=plot.COLUMN` makes one for a
column of a paper, with letters of the same size. Matplotlib's backend and settings are not used.
"""

import contextlib
import locale
import os
import sys

try:
    import matplotlib
except (ValueError, OSError, locale.Error):
    # The user's backend or locale is not installed, or the user's matplotlibrc cannot be read.
    from unittest import mock

    for _half_loaded in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        del sys.modules[_half_loaded]
    _settings = {"MPLBACKEND": "agg", "LC_ALL": "C", "MATPLOTLIBRC": os.devnull}
    with contextlib.ExitStack() as _stack:
        _stack.enter_context(mock.patch.dict(os.environ, _settings))
        if os.path.exists("matplotlibrc"):  # which Matplotlib would take first
            _stack.enter_context(contextlib.chdir(sys.prefix))
        import matplotlib  # noqa: F401

from jaxslam._public import publish
from jaxslam.results.plot._check_figure import check_figure
from jaxslam.results.plot._film import Film, stage
from jaxslam.results.plot._graph_figures import graph_figure
from jaxslam.results.plot._grid_figures import (
    grid_figure,
    loops_figure,
    maps_before_after,
    topology_figure,
)
from jaxslam.results.plot._landmarks import ellipse, map_figure, walls_figure
from jaxslam.results.plot._measure_figures import (
    cost_figure,
    coverage_figure,
    gained_figure,
    nees_figure,
    rmse_figure,
    whiteness_figure,
)
from jaxslam.results.plot._pose_errors import errors_figure
from jaxslam.results.plot._recording_figure import recording_figure
from jaxslam.results.plot._run_film import animate, animate_world, probe
from jaxslam.results.plot._style import (
    COLORS,
    COLUMN,
    FAINT,
    INK,
    PAGE,
    SHADE,
    TEXT,
    Figure,
    band,
    caption,
    curve,
    every_handle,
    look,
    panels_of,
    titled,
)

__all__ = [
    "COLORS",
    "COLUMN",
    "FAINT",
    "INK",
    "PAGE",
    "SHADE",
    "TEXT",
    "Figure",
    "Film",
    "animate",
    "animate_world",
    "band",
    "caption",
    "check_figure",
    "cost_figure",
    "coverage_figure",
    "curve",
    "ellipse",
    "errors_figure",
    "every_handle",
    "gained_figure",
    "graph_figure",
    "grid_figure",
    "look",
    "loops_figure",
    "map_figure",
    "maps_before_after",
    "nees_figure",
    "panels_of",
    "probe",
    "recording_figure",
    "rmse_figure",
    "stage",
    "titled",
    "topology_figure",
    "walls_figure",
    "whiteness_figure",
]

publish(__name__)
