"""Reader and writer of pose and landmark graphs: g2o and TORO; `graphs.read`, `graphs.write`."""

from jaxslam.datasets.formats.g2o.reader import Loaded, load
from jaxslam.datasets.formats.g2o.writer import save, text_of

__all__ = ["Loaded", "load", "save", "text_of"]
