"""docs/gallery.md and its pictures: `python -m benchmarks.gallery [NAME …]`.

A picture is made by a script of its name in `examples/gallery/`, which binds `figure`. Those of
data sets take a folder as their argument; where it is absent, their pictures are left as they are
(JAXSLAM_DATA, by default ../shared/data beside the checkout).
"""

import argparse
import ast
import io
import runpy
import sys
import time
from pathlib import Path

from PIL import Image

from benchmarks.real_data import DATA

ROOT = Path(__file__).parents[1]
SCRIPTS, PICTURES = ROOT / "examples" / "gallery", ROOT / "benchmarks" / "figures" / "gallery"
PAGE = ROOT / "docs" / "gallery.md"
FOLDERS = {
    "bonn": "bonn",
    "carmen": "carmen",
    "carmen_freiburg": "carmen",
    "mrclam": "mrclam1",
    "mrclam_team": "mrclam1",
}
"""The folder of recorded data that a script takes, by its name."""

TITLED = ("filters", "methods")
"""Folders of scripts whose names are words, not names of code."""

COLOURS, DOTS = 64, 110
"""Colours of a picture, and dots an inch."""


HEAD = """# Gallery

Every scenario, family of filters and data set, and a method of the sources, with one figure and
its code. Each script is a file of `examples/gallery/` and runs alone: it binds `figure`, which
`figure.savefig("picture.png")` writes. `python -m benchmarks.gallery` makes all figures and this
page again, `python -m benchmarks.gallery circle` one figure. The data sets need their
[files](guide/real_data.md).
"""

PARTS = {
    "scenarios": """## Scenarios

{py:mod}`jaxslam.simulation.scenarios` has them by name. The figures have fewer steps than the
published experiments.
""",
    "filters": """## Families of filters

[Choosing a filter](guide/choosing_a_filter.md) compares them. {py:mod}`jaxslam.catalog`
has the families that run in every scenario.
""",
    "methods": """## Methods

[Bearings and ranges](methods/bearings_and_ranges.md#delayed-initialization) describes the method of
the library.
""",
    "datasets": """## Data sets

{py:mod}`jaxslam.datasets` has the readers. [Real data](guide/real_data.md) lists the sources of the
files; [Your own data](guide/own_data.md) describes how to write your own.
""",
}
"""What the page says of each folder of scripts."""


def page() -> str:
    """The text of docs/gallery.md: each script with its picture."""
    parts = [HEAD]
    for kind, said in PARTS.items():
        parts.append(said)
        for path in sorted((SCRIPTS / kind).glob("*.py")):
            name = path.stem
            title = name.replace("_", " ").capitalize() if kind in TITLED else f"`{name}`"
            about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
            argument = f"<!-- run: argument=data/{FOLDERS[name]} -->\n" if name in FOLDERS else ""
            parts.append(
                f"### {title}\n\n![{about}](../benchmarks/figures/gallery/{name}.png)\n\n"
                f"{argument}```{{literalinclude}} ../examples/gallery/{kind}/{name}.py\n```\n"
            )
    return "\n".join(parts)


def scripts() -> dict[str, Path]:
    """Every script by its name: scenarios, families of filters, data sets."""
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
    PAGE.write_text(page(), encoding="utf-8")
    for name in names:
        began = time.process_time()
        path = draw(name, known[name])
        said = (
            f"{path.stat().st_size / 1e3:.0f} kB" if path else f"no folder {DATA / FOLDERS[name]}"
        )
        print(f"{name:22}{time.process_time() - began:8.1f} s  {said}", flush=True)


if __name__ == "__main__":
    main()
