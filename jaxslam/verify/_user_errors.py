"""Exceptions raised by a user's model, described in one line with the place in the user's file."""

import traceback
from pathlib import Path

import jax

from jaxslam.core._validation import is_user_file

_VERIFIER = str(Path(__file__).parent)
_PACKAGE = str(Path(__file__).parents[1])


def place_of_error(error: BaseException) -> str:
    """The place of an error in a user's file, or else in the package, as "file.py:12"; or ""."""
    frames = traceback.extract_tb(error.__traceback__)[::-1]
    users = [f for f in frames if is_user_file(f.filename)]
    ours = [f for f in frames if f.filename.startswith(_PACKAGE) and _VERIFIER not in f.filename]
    for frame in users + ours:
        return f"{Path(frame.filename).name}:{frame.lineno}"
    return ""


def describe_error(error: BaseException) -> str:
    """The error in one line that begins with the user's file and line."""
    where = place_of_error(error)
    if isinstance(error, jax.errors.TracerBoolConversionError):
        why = "a Python `if`, `while` or `and` looks at a traced value; use jnp.where or lax.cond"
    elif isinstance(error, jax.errors.JAXTypeError):
        why = "not traceable: " + str(error).strip().splitlines()[0]
    else:
        first = (str(error).strip().splitlines() or [""])[0]
        why = f"{type(error).__name__}: {first}" if not isinstance(error, ValueError) else first
    return f"{where}: {why}" if where else why
