"""The style sheets of the page and of a notebook's fragment."""

from importlib.resources import files


def _text(name: str) -> str:
    """A file of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()


_LIGHT, _DARK, _PARTS = map(_text, ("light.css", "dark.css", "parts.css"))

CSS = f""":root {{ {_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
{_PARTS}
{_text("page.css")}
"""

FRAGMENT_CSS = f"""
.jaxslam {{ {_LIGHT}
  padding: .2rem 1rem 1rem; background: var(--back); color: var(--ink);
  font: 14px/1.5 system-ui, sans-serif; & * {{ box-sizing: border-box; }}
  summary {{ cursor: pointer; }}
{_PARTS}
figure {{ margin: 1rem 0; }} }}"""
"""Rules nested below one class, with light colours alone: figures are light, too."""
