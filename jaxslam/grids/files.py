"""Maps in files: the public names of what `datasets.ros_map` reads and writes."""

from pathlib import Path

from jaxslam.grids.grid import Grid


def read_map(path: str | Path) -> Grid:
    """The occupancy grid in a map file of ROS, `NAME.yaml` with its image; arrays are NumPy's.

    | key | meaning |
    |---|---|
    | `image` | a PGM (P5 or P2), PNG or BMP file, relative to the folder of the YAML file |
    | `resolution` | side of a cell [m] |
    | `origin` | [x, y, yaw], pose of the lower left corner of the lower left cell [m, m, rad] |
    | `negate` | 0: dark is occupied, p = 1 - shade; 1: p = shade; shade in [0, 1] |
    | `occupied_thresh`, `free_thresh` | above, below which p a cell is occupied, free |
    | `mode` | `trinary` (default): all else is unknown; `scale`: all else is in between |

    Another key, as `map_type`, is named in a warning. Shades have 8 or 16 bits; a colour counts as
    the mean of its channels.

    An occupied cell gets the log-odds `datasets.ros_map.CERTAIN`, a free one the negative
    of it, an unknown one 0. In mode `scale` a cell between the thresholds has the probability
    (p - free_thresh)/(occupied_thresh - free_thresh), bounded in the same way.

    Source: the map format of the ROS package `map_server`, wiki.ros.org/map_server.

    Raises:
        ValueError: `path:line: reason` for what is not YAML, a key that is missing or occurs twice,
            a resolution that is not above 0, an origin that is no pose, thresholds out of order, a
            mode `raw`, and an image that is missing, transparent, of another format, or damaged.
    """
    from jaxslam.datasets import ros_map

    return ros_map.load(path)


def write_map(path: str | Path, grid: Grid, *, mode: str = "trinary") -> list[Path]:
    """Write a grid as a map of ROS, `NAME.yaml` and `NAME.pgm` beside it; returns their paths.

    Mode `trinary` has black, white and grey 205 for log-odds above, below and equal to 0: what was
    read from a trinary map is read again as the same numbers. Mode `scale` has the probability in
    255 levels, or in 254, of which one is ½, where that alone gives the same grid again or where
    cells are unknown; its thresholds are 1 and 0. Either both files are written or none.

    Raises ValueError on a grid that is none, another mode, and a path that does not end in .yaml.
    """
    from jaxslam.datasets import ros_map

    return ros_map.save(path, grid, mode)
