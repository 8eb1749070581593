import jax
import pytest

from jaxslam import cli


@pytest.fixture(scope="session", autouse=True)
def devices():
    """Those of tests/conftest.py are made before a command can ask for another number."""
    jax.devices()


@pytest.fixture
def refused(capsys):
    """Check that the command exits with 2 and says every part of a message; returns the message."""

    def check(arguments, *parts):
        capsys.readouterr()
        assert cli.main(list(map(str, arguments))) == 2
        message = capsys.readouterr().err
        for part in parts:
            assert part in message
        return message

    return check
