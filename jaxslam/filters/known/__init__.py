"""Filters with half of SLAM known: the map, the poses, or no measurements at all."""
