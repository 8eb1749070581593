"""The style sheets and the script of the page and of a notebook's fragment; the page's policy."""

import base64
import hashlib
import re
from importlib.resources import files


def _text(name: str) -> str:
    """A file of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()


SCRIPT = _text("live.js")
"""Makes the page one to explore."""

_LIGHT, _DARK, _PARTS = map(_text, ("light.css", "dark.css", "parts.css"))

CSS = f""":root {{ {_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root:not([data-theme=light]) {{ {_DARK} }} }}
:root[data-theme=dark] {{ {_DARK} }}
{_PARTS}
{_text("page.css")}
{_text("live.css")}
"""

FRAGMENT_CSS = f"""
.jaxslam {{ {_LIGHT}
  padding: .2rem 1rem 1rem; background: var(--back); color: var(--ink);
  font: 14px/1.5 system-ui, sans-serif; & * {{ box-sizing: border-box; }}
  summary {{ cursor: pointer; }}
{_PARTS}
figure {{ margin: 1rem 0; }} }}"""
"""Rules nested below one class, with light colours alone: figures are light, too."""


def policy(html: str) -> str:
    """The policy of a page with this content: nothing is loaded, and only its scripts run.

    A script runs if its hash is that of a `<script>` without attributes in `html`.
    """
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{each}'" for each in dict.fromkeys(hashes)) or "'none'"
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
