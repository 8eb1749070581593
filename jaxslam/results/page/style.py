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

_LIGHT = """ color-scheme: light;
  --ink: #1c2330; --soft: #5b6577; --line: #dfe3ea; --back: #fff;
  --card: #f7f8fa; --accent: #0b5a8f; --good: #0a6b47; --good-bg: #dcf3e8; --over: #9c3b00;
  --over-bg: #fde6d6; --under: #22508f; --under-bg: #dfe9f8; --bad: #a3123a; --bad-bg: #fbdfe6;
  --none: #4d5566; --none-bg: #e8eaef; --band: #d4d6da; --c0: #0072b2; --c1: #d55e00;
  --c2: #009e73; --c3: #cc79a7; --c4: #c98500; --c5: #7d5f1f;"""

_DARK = """ color-scheme: dark;
  --ink: #e4e8ef; --soft: #9aa5b8; --line: #333b49; --back: #14181f;
  --card: #1b212b; --accent: #7cc0f0; --good: #7fdcb2; --good-bg: #123a2b; --over: #ffb284;
  --over-bg: #47250f; --under: #a4c6fb; --under-bg: #1b2f50; --bad: #ff9db4; --bad-bg: #4a1524;
  --none: #c0c7d4; --none-bg: #2b323e; --band: #353c48; --c0: #4ba9e4; --c1: #ff8a4c;
  --c2: #2fc79b; --c3: #e39ac4; --c4: #f0b83c; --c5: #cdb06a;"""

_PARTS = _text("parts.css")

CSS = f""":root {{{_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root:not([data-theme=light]) {{{_DARK} }} }}
:root[data-theme=dark] {{{_DARK} }}
{_PARTS}
{_text("page.css")}
{_text("live.css")}
"""

FRAGMENT_CSS = f"""
.jaxslam {{{_LIGHT}
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
