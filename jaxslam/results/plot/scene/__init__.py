"""Scenes, which are rendered to films: panels of layers, each a function that draws frame k."""

from jaxslam.results.plot.scene.animate import animate, animate_world
from jaxslam.results.plot.scene.graph_scene import graph_scene
from jaxslam.results.plot.scene.history import History, history_of
from jaxslam.results.plot.scene.map_scene import map_scene
from jaxslam.results.plot.scene.probe import Cloud, Hypotheses, Links, probe
from jaxslam.results.plot.scene.render import Draw, Layer, Panel, Scene, render
from jaxslam.results.plot.scene.run_scene import run_scene

__all__ = [
    "Cloud",
    "Draw",
    "History",
    "Hypotheses",
    "Layer",
    "Links",
    "Panel",
    "Scene",
    "animate",
    "animate_world",
    "graph_scene",
    "history_of",
    "map_scene",
    "probe",
    "render",
    "run_scene",
]
