"""CARMEN: building 101 in Freiburg by scans at corrected poses; the folder is the argument."""

import sys

import jax
import numpy as np

import jaxslam
from jaxslam import grids

jax.config.update("jax_enable_x64", True)
log = jaxslam.datasets.carmen(f"{sys.argv[1]}/freiburg-101-corrected.log", max_range=20.0)
low, high = log.corrected[:, :2].min(axis=0) - 8.0, log.corrected[:, :2].max(axis=0) + 8.0
width, height = np.ceil((high - low) / 0.1).astype(int)
frame = (int(height), int(width)), (*low, 0.0), 0.1
counts = grids.count(*frame, log.corrected, log.beams, max_range=20.0, no_return=0.0)
figure = jaxslam.plot.grid_figure(grids.occupancy(counts), poses=log.corrected, title=log.name)
