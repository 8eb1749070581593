import pytest
from stored import SETTINGS

from jaxslam import store


@pytest.fixture
def made(tmp_path):
    return store.create(tmp_path / "a" / "campaign", SETTINGS)
