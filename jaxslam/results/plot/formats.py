"""A figure as the bytes of a file: PNG, PDF or SVG."""

import io

import matplotlib
from matplotlib.figure import Figure

from jaxslam.results.plot.style import png

_NO_DATE = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def encode(figure: Figure, kind: str) -> bytes:
    """The figure as a file of a kind, png, pdf or svg; the same bytes every time."""
    if kind == "png":
        return png(figure)
    out = io.BytesIO()
    # TrueType fonts in PDF, as publishers ask; the same names of parts in every SVG file.
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.hashsalt": "jaxslam"}):
        figure.savefig(out, format=kind, metadata=_NO_DATE[kind])
    return out.getvalue()
