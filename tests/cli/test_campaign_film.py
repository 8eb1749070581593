"""Films of run 0 of a campaign, as the command line writes them."""

import jax
import pytest
import worlds
from PIL import Image, ImageChops

from jaxslam import catalog, plot
from jaxslam._cli.campaigns.consistency import write_films


@pytest.mark.sweep
def test_every_filter_is_filmed_in_run_0(tmp_path, capsys, films):
    world = worlds.ring(3)
    filters = {"dead_reckoning": catalog.ALL["dead_reckoning"](world)}
    write_films(tmp_path / "out", world, filters, 5, "float64")
    printed = capsys.readouterr().out
    assert "\nfilm: ffmpeg is not installed: GIF instead of MP4\n" in printed
    moving, page = (tmp_path / "out" / f"film-dead_reckoning.{kind}" for kind in ("gif", "html"))
    assert f"wrote {moving}, {page}" in printed
    assert page.read_text().count("iVBOR") == 3
    # Run 0 of this seed, not of another.
    for seed, same in ((5, True), (6, False)):
        key, title = jax.random.key(seed), "ring: dead_reckoning, run 0 of seed 5"
        film = plot.animate_world(world, filters["dead_reckoning"], key, title=title)
        film.save(tmp_path / "other.gif")
        with Image.open(moving) as own, Image.open(tmp_path / "other.gif") as other:
            own.seek(2)
            other.seek(2)
            difference = ImageChops.difference(own.convert("RGB"), other.convert("RGB"))
        assert (difference.getbbox() is None) == same
