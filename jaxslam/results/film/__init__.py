"""Films as files: frames as MP4, GIF, or a player in HTML. What is on a frame is `plot.scene`'s.

Pillow, which Matplotlib requires, writes GIF; the program ffmpeg, where it is installed, MP4.
"""

from jaxslam.results.film.encoding import NoEncoder, ffmpeg, gif, mp4
from jaxslam.results.film.film import Film
from jaxslam.results.film.player import SCRIPT, player, player_page
from jaxslam.results.film.timing import MOST, frame_steps

__all__ = [
    "MOST",
    "SCRIPT",
    "Film",
    "NoEncoder",
    "ffmpeg",
    "frame_steps",
    "gif",
    "mp4",
    "player",
    "player_page",
]
