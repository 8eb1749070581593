import pytest
from stored import SETTINGS

from jaxslam import store


@pytest.fixture
def made(tmp_path):
    made = store.open(tmp_path / "a" / "campaign", SETTINGS)
    made.claim({})
    return made
