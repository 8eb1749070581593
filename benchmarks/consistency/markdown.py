"""Sections of the gallery, as Markdown."""

from typing import NamedTuple


class Section(NamedTuple):
    name: str
    title: str
    text: str

    def __str__(self) -> str:
        return f"### {self.title} (`{self.name}`)\n\n{self.text}\n"


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
