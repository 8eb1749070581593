"""Figures of maps, errors and campaigns, all in one style (`plot.style`).

Only this package draws. Figures are made without pyplot, without global state and windows;
`figure.savefig(path)` saves one. They are as wide as a page; `width=plot.COLUMN` makes one for a
column of a paper, with letters of the same size.
"""

from jaxslam.results.plot.film import Film, Layer, Panel, Scene, has_ffmpeg
from jaxslam.results.plot.graph_figures import graph_figure, graph_scene
from jaxslam.results.plot.grid_figures import (
    grid_figure,
    loops_figure,
    map_scene,
    maps_before_after,
    topology_figure,
)
from jaxslam.results.plot.landmarks import ellipse, map_figure, run_map_figure, walls_figure
from jaxslam.results.plot.measure_figures import (
    cost_figure,
    coverage_figure,
    gained_figure,
    nees_figure,
    rmse_figure,
    whiteness_figure,
)
from jaxslam.results.plot.pose_errors import errors_figure, run_errors_figure
from jaxslam.results.plot.run_film import (
    History,
    animate,
    animate_world,
    frame_steps,
    probe,
    run_scene,
)
from jaxslam.results.plot.style import COLORS, COLUMN, PAGE, Figure, describe, encode, png

__all__ = [
    "COLORS",
    "COLUMN",
    "PAGE",
    "Figure",
    "Film",
    "History",
    "Layer",
    "Panel",
    "Scene",
    "animate",
    "animate_world",
    "cost_figure",
    "coverage_figure",
    "describe",
    "ellipse",
    "encode",
    "errors_figure",
    "frame_steps",
    "gained_figure",
    "graph_figure",
    "graph_scene",
    "grid_figure",
    "has_ffmpeg",
    "loops_figure",
    "map_figure",
    "map_scene",
    "maps_before_after",
    "nees_figure",
    "png",
    "probe",
    "rmse_figure",
    "run_errors_figure",
    "run_map_figure",
    "run_scene",
    "topology_figure",
    "walls_figure",
    "whiteness_figure",
]
