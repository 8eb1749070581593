"""A cache of compiled programs: one program a structure, with its numbers as arguments."""

from jaxslam.programs.cache import call, clear, on_device, outside, trace

__all__ = ["call", "clear", "on_device", "outside", "trace"]
