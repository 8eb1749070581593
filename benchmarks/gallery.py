"""The pictures of docs/gallery.md: `python -m benchmarks.gallery [NAME …]`.

A picture is made by a script of its name in `examples/gallery/`, which binds `figure`. Those of
data sets take a folder as their argument; where it is absent, their pictures are left as they are
(JAXSLAM_DATA, by default ../shared/data beside the checkout).
"""

import argparse
import io
import runpy
import sys
import time
from pathlib import Path

from PIL import Image

from benchmarks.real_data import DATA

ROOT = Path(__file__).parents[1]
SCRIPTS, PICTURES = ROOT / "examples" / "gallery", ROOT / "benchmarks" / "figures" / "gallery"
FOLDERS = {
    "bonn": "bonn",
    "carmen": "carmen",
    "carmen_freiburg": "carmen",
    "lost_in_the_woods": "lost_in_the_woods",
    "mrclam": "mrclam1",
    "mrclam_team": "mrclam1",
}
"""The folder of recorded data that a script takes, by its name."""

PARTS = ("scenarios", "filters", "methods", "datasets")
"""Folders of scripts, in the order of the page."""

COLOURS, DOTS = 64, 110
"""Colours of a picture, and dots an inch."""


def scripts() -> dict[str, Path]:
    """Every script by its name."""
    return {path.stem: path for kind in PARTS for path in sorted((SCRIPTS / kind).glob("*.py"))}


def draw(name: str, script: Path) -> Path | None:
    """Run a script and write its picture; None where its data is absent."""
    folder = FOLDERS.get(name)
    if folder and not (DATA / folder).is_dir():
        return None
    before, sys.argv = sys.argv, [str(script), *([str(DATA / folder)] if folder else [])]
    try:
        figure = runpy.run_path(str(script))["figure"]
    finally:
        sys.argv = before
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DOTS)
    PICTURES.mkdir(parents=True, exist_ok=True)
    path = PICTURES / f"{name}.png"
    Image.open(drawn).convert("RGB").quantize(COLOURS).save(path, optimize=True)
    return path


def main() -> None:
    known = scripts()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}")
    names = parser.parse_args().names or list(known)
    for name in names:
        if name not in known:
            parser.error(f"NAME: expected one of {', '.join(known)}, got {name}")
    for name in names:
        began = time.process_time()
        path = draw(name, known[name])
        said = (
            f"{path.stat().st_size / 1e3:.0f} kB" if path else f"no folder {DATA / FOLDERS[name]}"
        )
        print(f"{name:22}{time.process_time() - began:8.1f} s  {said}", flush=True)


if __name__ == "__main__":
    main()
