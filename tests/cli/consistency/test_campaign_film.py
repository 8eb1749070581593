"""Films of run 0 of a campaign, as the command line writes them."""

import io

import jax
import numpy as np
import worlds
from PIL import Image

from jaxslam import catalog, plot
from jaxslam.cli.consistency.film import write_films
from jaxslam.results.film import encoding


def test_every_filter_is_filmed_in_run_0(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(encoding, "ffmpeg", lambda: None)
    world = worlds.ring(3)
    filters = {"dead_reckoning": catalog.BASELINES["dead_reckoning"](world)}
    write_films(tmp_path / "out", world, filters, 5, "float64")
    printed = capsys.readouterr().out
    assert "\nfilm: ffmpeg is not installed: GIF instead of MP4\n" in printed
    moving, page = (tmp_path / "out" / f"film-dead_reckoning.{kind}" for kind in ("gif", "html"))
    assert f"wrote {moving}, {page}" in printed
    assert "Film: ring: dead_reckoning, run 0 of seed 5" in page.read_text()
    # Another seed, another run; the title is its own, so frames are compared below it.
    other = plot.animate_world(world, filters["dead_reckoning"], jax.random.key(6))
    shown = [Image.open(io.BytesIO(each)) for each in (moving.read_bytes(), other.encoded("gif"))]
    for each in shown:
        each.seek(2)
    own, others = (np.asarray(each.convert("RGB"))[60:] for each in shown)
    assert own.shape == others.shape and not np.array_equal(own, others)
