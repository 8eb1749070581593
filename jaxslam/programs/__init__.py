"""Compiled programs, kept: one for each structure, its numbers as arguments."""

from jaxslam.programs.cache import call, clear, trace

__all__ = ["call", "clear", "trace"]
