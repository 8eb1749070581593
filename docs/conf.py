"""How the documentation is built: `make docs`, with every warning an error; `make api`, whose tag
is "api", runs no code of the pages; with the tag "portion" code of the pages that CI runs for the
commit (`.ci/portion.py`)."""

import importlib.metadata
import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

import jax
from jupyter_cache import get_cache

# Sphinx ends its workers when it leaves by an exception, but not when a signal kills it.
signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE / "_ext"))


project = "jaxslam"
author = copyright = "The jaxslam authors"
version = release = importlib.metadata.version("jaxslam")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "myst_nb",
    "reference",
]
if not tags.has("api"):  # noqa: F821 Sphinx's
    extensions += ["executed", "exit_status", "commands"]
exclude_patterns = ["_build", "_ext"]
suppress_warnings = ["mystnb.unknown_mime_type", "myst-nb.lexer"]

html_theme = "furo"
html_title = "jaxslam"
# MathJax from a package instead of a network. As an extension it would forbid parallel reading.
(mathjax,) = find_spec("sphinx-mathjax-offline").submodule_search_locations
html_static_path = ["_static", str(Path(mathjax) / "static")]
mathjax_path = "mathjax/tex-mml-chtml.js"
html_css_files = ["jaxslam.css"]
pygments_style = "friendly"

# Pages.
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_show_tb = True
nb_merge_streams = True

# What a page printed and drew is kept until its cells, or code that they reach, change.
nb_execution_mode = "off" if tags.has("api") else "cache"  # noqa: F821
if tags.has("portion"):  # noqa: F821
    sys.path.insert(0, str(ROOT / ".ci"))
    import portion

    nb_execution_excludepatterns = [str(page) for page in portion.left_out(HERE.rglob("*.md"))]
    del portion  # a name left here would be a setting of Sphinx
nb_execution_cache_path = str(ROOT / ".cache" / "docs")
get_cache(nb_execution_cache_path).list_cache_records()  # makes it, before several processes do

# The kernels that run the pages keep their compiled programs in the checkout.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / f"jax-{jax.__version__}"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("JAX_ENABLE_X64", "1")
os.environ["JAXSLAM_PROGRESS"] = "0"  # `!jaxslam …` in a cell runs in a terminal, by IPython

# `!jaxslam …` in a page is the command of this environment.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["COLUMNS"] = "100"

# The reference.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "undoc-members": True}
python_use_unqualified_type_names = True
maximum_signature_line_length = 80
