"""An exception in a user's model, in one line that names theirs."""

import traceback
from pathlib import Path

import jax

_VERIFIER = str(Path(__file__).parent)
_PACKAGE = str(Path(__file__).parents[1])
_JAX = str(Path(jax.__file__).parent)


def line_of(error: BaseException) -> str:
    """As "file.py:12", the innermost frame of a user's file, or else of a model of ours; or ""."""
    frames = traceback.extract_tb(error.__traceback__)[::-1]
    users = [f for f in frames if is_users(f.filename)]
    ours = [f for f in frames if f.filename.startswith(_PACKAGE) and _VERIFIER not in f.filename]
    for frame in users + ours:
        return f"{Path(frame.filename).name}:{frame.lineno}"
    return ""


def is_users(filename: str) -> bool:
    """Whether a source file is a user's own, rather than a library's."""
    libraries = (_JAX, _PACKAGE, "<")
    return not (filename.startswith(libraries) or "site-packages" in filename)


def told(error: BaseException) -> str:
    """What went wrong, on one line, with the user's file and line in front."""
    where = line_of(error)
    if isinstance(error, jax.errors.TracerBoolConversionError):
        why = "a Python `if`, `while` or `and` looks at a traced value; use jnp.where or lax.cond"
    elif isinstance(error, jax.errors.JAXTypeError):
        why = "not traceable: " + str(error).strip().splitlines()[0]
    else:
        first = (str(error).strip().splitlines() or [""])[0]
        why = f"{type(error).__name__}: {first}" if not isinstance(error, ValueError) else first
    return f"{where}: {why}" if where else why
