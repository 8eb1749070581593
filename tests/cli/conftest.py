import jax
import pytest
from command import run_command

from jaxslam.results.plot import Film, _film, _style


@pytest.fixture(scope="session", autouse=True)
def devices():
    """Those of tests/conftest.py are made before a command can ask for another number."""
    jax.devices()


@pytest.fixture
def undrawn():
    """Figures are made and their files are written, but they are not drawn.

    `test_the_module_runs_as_a_program` draws them.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_style, "encode", lambda figure, kind, *_: kind.encode())
        yield


@pytest.fixture
def films(monkeypatch):
    """The films that are saved, in their order, without ffmpeg."""
    found, save = [], Film.save

    def kept(film, *arguments, **options):
        if film not in found:
            found.append(film)
        return save(film, *arguments, **options)

    monkeypatch.setattr(Film, "save", kept)
    monkeypatch.setattr(_film.shutil, "which", lambda name: None)
    return found


@pytest.fixture
def refused(capsys):
    """Check that the command exits with 2 and says every part of a message; returns the message."""

    def check(arguments, *parts):
        capsys.readouterr()
        assert run_command(arguments) == 2
        message = capsys.readouterr().err
        for part in parts:
            assert part in message
        return message

    return check
