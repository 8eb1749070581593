"""Helpers of all commands: look-up by name, and folders among the options."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

_T = TypeVar("_T")

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def pick(kind: str, name: str, known: Mapping[str, _T], more: str = "") -> _T:
    """The entry of `known` with a name; raises ValueError with the known names and `more`."""
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}{more}")
    return known[name]


def as_folders(options: argparse.Namespace) -> None:
    """Convert the options that name folders to paths; raises ValueError on an empty name.

    `Path("")` would be the current folder.
    """
    for name in ("out", "resume", "cache"):
        text = getattr(options, name, None)
        if text is None:
            continue
        if not text.strip():
            raise ValueError(f"--{name}: expected a folder, got {text!r}")
        setattr(options, name, Path(text))
