"""Libraries and programs that are installed and of no use: stand-ins first on the path."""

import importlib
import sys

import pytest


def library(monkeypatch, folder, name, sources, version=None):
    """Install a library with these sources by module, as {"": "", "MPI": "raise …"}.

    version: of its metadata; None for that of the real one, if it is installed.
    """
    package = folder / name
    for module, source in {"": "", **sources}.items():
        path = (
            package.joinpath(*module.split("."), "__init__.py")
            if module
            else package / "__init__.py"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    if version is not None:
        about = folder / f"{name}-{version}.dist-info" / "METADATA"
        about.parent.mkdir()
        about.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    for module in [each for each in sys.modules if f"{each}.".startswith(f"{name}.")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.syspath_prepend(folder)


def program(monkeypatch, folder, name, script):
    """Install a program that runs a script of the shell."""
    path = folder / name
    path.write_text(script)
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")


def optional(name, reason=None):
    """A module of a library that some tests need; they are skipped where it cannot be used."""
    try:
        return importlib.import_module(name)
    except Exception as error:
        text = " ".join(str(error).split())
        why = reason or f"{name} cannot be used ({type(error).__name__}: {text})"
        pytest.skip(why, allow_module_level=True)
