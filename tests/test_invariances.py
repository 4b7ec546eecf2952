"""What a surface is called, where it stands, how it is wound, cut up, copied or rounded does not change what it reflects.

The same room, written in ways in which exporters write it, must give the same mirrors, the same spectra and the same
fields. The fuzz suite applies the laws of :mod:`rooms` one after the other, to other rooms too.
"""

import warnings
from functools import cache

import numpy as np
import pytest
import rooms
from golden import make
from rooms import EXACT, FIGURES, LAWS, ROUNDED, most_db, rms_change_db, total_change_db

import warprrf as wr

NOT_EVERY_TIME = {"shifted by 1e3 m", "in float32", *(f"noise of 1e{k} m" for k in (-8, -7, -4))}
EVERY = [law for law in LAWS if law not in NOT_EVERY_TIME]
FEW = [
    "shifted by 1e3 m", "turned by five columns", "turned askew", "scaled by 2", "in another order", "reversed winding",
    "doubled",
]  # fmt: skip
FITTED = ("bistatic, fitted", "rf3dgs+")
ANOTHER_MATERIAL = "doubled, of another material"


@cache
def room(law=None, name="plain"):
    return rooms.ROOMS[name]().with_gaussians() if law is None else LAWS[law](room(name=name))


@cache
def found(figure, law=None, name="plain"):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore" if law == ANOTHER_MATERIAL else "error", "mesh: ")
        return FIGURES[figure](room(law, name))


SAID_BY_ANOTHER = [
    "shifted by 1e6 m", "turned by a quarter", "scaled by 0.1", "mixed winding", "unwelded", "subdivided", "cut in part",
    *(f"in two sheets 1e{k} m apart" for k in (-6, -5)), "noise of 1e-6 m",
]  # fmt: skip
"""Laws whose like, at another size, is asked of spectra too; mirrors are asked about all."""
CASES = [
    pytest.param(figure, law, marks=[pytest.mark.long] * (law in SAID_BY_ANOTHER and figure != "mirrors"))
    for figure in FIGURES
    for law in (FEW if figure in FITTED else EVERY)
]


@pytest.mark.parametrize(("figure", "law"), CASES)
def test_nothing_changes(figure, law):
    before, now = found(figure), found(figure, law)
    assert total_change_db(now, before) < most_db(figure, law)
    if room(law).turned is not None and figure != "mirrors":
        assert rms_change_db(now, before) < max(0.3, most_db(figure, law))


NO_SOLIDS = {ANOTHER_MATERIAL, *(f"in two sheets 1e{k} m apart" for k in (-5, -4)), "noise of 1e-3 m"}
"""Laws by which a solid's faces are hidden behind sheets, or edges are lost."""


@pytest.mark.parametrize("law", [law for law in EVERY if law not in NO_SOLIDS])
@pytest.mark.parametrize("figure", ["mirrors", "exact", "bistatic"])
def test_nothing_changes_behind_glass(figure, law):
    """Slabs are as thick as they were, edges where they were: a table, a cabinet, walls and a pane."""
    before, now = (found(figure, which, "behind glass") for which in (None, law))
    assert total_change_db(now, before) < max(0.01, 2.0 * most_db(figure, law))


@pytest.mark.filterwarnings("ignore:mesh")
@pytest.mark.parametrize("law", [law for law in EVERY if law in EXACT])
def test_as_many_paths_are_found(law):
    now, before = (rooms.traced(r).valid.sum(axis=1) for r in (room(law), room()))
    assert now.tolist() == before.tolist()


@pytest.mark.parametrize("factor", [0.1, 1e3])
def test_gains_keep_and_delays_scale_with_the_unit(factor):
    before, now = rooms.traced(room()), rooms.traced(rooms.scaled(factor)(room()))
    assert np.array_equal(now.valid, before.valid)
    np.testing.assert_allclose(now.tau[now.valid], factor * before.tau[now.valid], rtol=1e-12)
    np.testing.assert_allclose(np.abs(now.gain[now.valid]), np.abs(before.gain[now.valid]), rtol=1e-10)


@pytest.mark.parametrize("law", [law for law in ROUNDED if law.startswith("noise")])
def test_no_decade_of_noise_is_a_cliff(law):
    """On a room of slanted walls too: total mirror power moves at most 0.1 dB up to 1e-5 m, 1 dB at 1e-3 m."""
    other = rooms.l_shaped()
    assert total_change_db(rooms.mirrors(LAWS[law](other)), rooms.mirrors(other)) < most_db("mirrors", law)


def test_of_coincident_faces_the_first_counts_and_a_warning_says_so():
    with pytest.warns(UserWarning, match="36 faces lie on another of a different material"):
        rooms.mirrors(room(ANOTHER_MATERIAL))
    with pytest.warns(UserWarning, match="different material"):
        wr.RadioField.fit(room(ANOTHER_MATERIAL).scene, make.spectra().subset([0, 3, 6]), quick=True)
