"""Figures of maps: landmarks, grids, graphs, walls, places, the loops of laser SLAM."""
