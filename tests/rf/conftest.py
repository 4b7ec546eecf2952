"""Scenes of more than one test file."""

import pytest
from furnished import furnished


@pytest.fixture(scope="session")
def scene():
    """A furnished room of walls that scatter in a lobe and a block that scatters evenly."""
    return furnished()
