"""What a surface is called, where it stands, how it is wound, cut up, copied or rounded does not change what it reflects.

The same room, written in ways in which exporters write it, must give the same mirrors, the same spectra and the same
fields. The laws and what they are measured by are those of ``benchmarks.invariances``, which tries them on other rooms
and through all decades of noise.
"""

import warnings
from functools import cache

import numpy as np
import pytest
from golden import make

import warprrf as wr
from benchmarks import invariances
from benchmarks.invariances import LAWS, Room, noisy, rms_change_db, scaled, total_change_db

RIGID = [
    "shifted by metres", "shifted by 1e6 m", "turned by a quarter", "turned by five columns", "turned askew",
    "scaled by 2", "in another order", "reversed winding", "mixed winding", "unwelded", "doubled",
    "doubled, of another material", "covered by finer faces", "subdivided", "with faces without area",
]  # fmt: skip
ROUNDED = [
    "in two sheets 1e-6 m apart", "in two sheets 1e-5 m apart", "in two sheets 1e-4 m apart",
    "turned four times in float32", "noise of 1e-6 m", "noise of 1e-5 m", "noise of 1e-3 m",
]  # fmt: skip
EVERY = RIGID + ROUNDED
FEW = [
    "shifted by 1e3 m", "turned by five columns", "turned askew", "scaled by 2", "in another order", "reversed winding",
    "doubled",
]  # fmt: skip


@cache
def room(law: str | None = None) -> Room:
    if law is not None:
        return LAWS[law](room())
    mesh, part = make.room_mesh()
    plain = Room(mesh.vertices, mesh.faces, part, invariances.materials(), make.TRANSMITTER, make.places(3))
    return invariances.with_gaussians(plain, 600)


@cache
def found(figure: str, law: str | None = None) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.filterwarnings("error" if law != "doubled, of another material" else "ignore", "mesh: ")
        return invariances.FIGURES[figure](room(law))


def tolerance_db(law: str, rigid: float) -> float:
    """Place, winding, order and copies change nothing; micrometres, little; a mesh's error is not roughness."""
    return 1.0 if law == "noise of 1e-3 m" else 0.1 if law in ROUNDED else rigid


def check_spectra(figure: str, law: str, rigid: float) -> None:
    before, now = found(figure), found(figure, law)
    assert total_change_db(now, before) < tolerance_db(law, rigid)
    if room(law).turned is not None:
        assert rms_change_db(now, before) < max(0.3, tolerance_db(law, rigid))


@pytest.mark.parametrize("law", EVERY)
def test_mirror_paths_do_not_change(law):
    assert total_change_db(found("mirrors", law), found("mirrors")) < tolerance_db(law, 1e-9)


@pytest.mark.parametrize("law", RIGID)
def test_as_many_paths_are_found(law):
    def count(r):
        paths = wr.trace_paths(
            r.scene,
            transmitter=r.transmitter,
            receivers=r.receivers,
            frequency_hz=r.frequency_hz,
            mirror_order=2,
        )
        return paths.valid.sum(axis=1).tolist()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert count(room(law)) == count(room())


@pytest.mark.parametrize("law", EVERY)
def test_exact_spectra_do_not_change(law):
    check_spectra("exact", law, 0.01)


@pytest.mark.parametrize("law", EVERY)
def test_a_field_of_several_bounces_does_not_change(law):
    check_spectra("bistatic", law, 0.1)


@pytest.mark.parametrize("law", FEW)
def test_a_fitted_field_does_not_change(law):
    check_spectra("bistatic, fitted", law, 0.1)


@pytest.mark.parametrize("law", FEW)
def test_a_harmonic_field_does_not_change(law):
    check_spectra("rf3dgs+", law, 0.1)


@pytest.mark.parametrize("factor", [0.1, 1e3])
def test_gains_keep_and_delays_scale_with_the_unit(factor):
    def paths(r):
        return wr.trace_paths(
            r.scene,
            transmitter=r.transmitter,
            receivers=r.receivers,
            frequency_hz=r.frequency_hz,
            mirror_order=2,
        )

    before, now = paths(room()), paths(scaled(factor)(room()))
    assert np.array_equal(now.valid, before.valid)
    valid = before.valid
    np.testing.assert_allclose(now.tau[valid], factor * before.tau[valid], rtol=1e-12)
    np.testing.assert_allclose(np.abs(now.gain[valid]), np.abs(before.gain[valid]), rtol=1e-10)


def test_no_decade_of_noise_is_a_cliff():
    """Total mirror power moves at most 0.1 dB up to 1e-5 m, 1 dB at 1e-3 m, on a room of slanted walls too."""
    other = invariances.l_shaped()
    before = invariances.mirrors(other)
    for decade in range(-8, -2):
        change = total_change_db(invariances.mirrors(noisy(10.0**decade)(other)), before)
        assert change < (0.1 if decade <= -5 else 1.0), f"noise of 1e{decade} m: {change:.3f} dB"


def test_of_coincident_faces_the_first_counts_and_a_warning_says_so():
    with pytest.warns(UserWarning, match="36 faces lie on another of a different material"):
        invariances.mirrors(room("doubled, of another material"))
    with pytest.warns(UserWarning, match="different material"):
        wr.RadioField.fit(
            room("doubled, of another material").scene, make.spectra().subset([0, 3, 6]), quick=True
        )
