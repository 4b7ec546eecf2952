"""Scenes of more than one test file."""

import pytest
from furnished import furnished
from sionna_room import sionna_or_skip


@pytest.fixture(scope="session")
def scene():
    """A furnished room of walls that scatter in a lobe and a block that scatters evenly."""
    return furnished()


@pytest.fixture(scope="session")
def rt():
    """Sionna RT, where it is installed."""
    sionna_or_skip()
    from warprrf.rf.scene_sionna import sionna_rt

    return sionna_rt()
