"""The page of what is kept and what is left out names what there is."""

import re

from test_docs import PAGES

import jaxslam

PAGE = PAGES["docs/background/scope.md"]


def kept():
    """The names in the second column of what is kept."""
    rows = PAGE.split("## Kept beyond the sources")[1].split("## See also")[0].splitlines()
    cells = [row.split("|")[2] for row in rows if row.startswith("|")][2:]
    return [name for cell in cells for name in re.findall(r"`([\w.]+)`", cell)]


def test_what_is_kept_is_there():
    for name in kept():
        found = jaxslam
        for part in name.split("."):
            found = getattr(found, part)


def test_every_public_name_is_of_the_sources_or_has_its_users():
    """Of the sources are filters alone: all others stand in the table."""
    assert set(jaxslam.__all__) - {"filters"} <= {name.split(".")[0] for name in kept()}
