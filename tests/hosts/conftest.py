"""The scene that all real trainers get."""

import pytest

from tests.helpers.real_hosts import write_scene


@pytest.fixture
def scene(tmp_path):
    write_scene(tmp_path)
    return tmp_path
