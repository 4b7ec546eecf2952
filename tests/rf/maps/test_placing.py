"""Where transmitters go: beside all sets tried, objectives by their definition, bad input."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from furnished import SHAPE, SIGMA, TX, F

import warprrf as wr
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.placing import best_set
from warprrf.rf.maps.radio_map import MapOptions, radio_map
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.tracing.model import Effects

CANDIDATES = np.array(
    [[0.8, 0.9, 2.8], [4.2, 3.2, 2.8], [0.9, 3.3, 2.8], [4.3, 0.8, 2.8], [2.6, 1.0, 2.8], [2.6, 3.2, 2.8]]
)
MAP = {"height": 1.2, "cell": 1.0}
LEVEL_DB = 28.0
BY_DEFINITION = {
    "share": lambda snr: np.count_nonzero(snr >= LEVEL_DB) / len(snr),
    "worst tenth": lambda snr: np.percentile(snr, 10),
    "mean rate": lambda snr: np.log1p(10 ** (snr / 10)).mean() / np.log(2),
}


@pytest.fixture(scope="module")
def field(scene):
    known = SpectrumDataset.empty(
        transmitter=TX, frequency_hz=F, shape=SHAPE, beam_sigma_rad=SIGMA, floor=1e-16
    )
    return BistaticField.prior(scene, known, effects=Effects(mirrors=1, scatterings=1, residual=False))


@pytest.fixture(scope="module")
def snr_db(field):
    """Of each candidate at the cells in the air, by the field's own maps, which are made once."""

    @cache
    def kept(height, cell, source, options):
        return radio_map(field, height, cell, np.array(source), options)

    def made(of, height, cell, source, options):
        assert of is field
        return kept(height, cell, tuple(source), options)

    maps = [made(field, *MAP.values(), one, MapOptions()).best_beam_snr_db for one in CANDIDATES]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warprrf.rf.maps.placing.radio_map", made)
        yield np.stack(maps)[:, np.isfinite(maps[0])]


@pytest.mark.parametrize("objective", BY_DEFINITION)
def test_one_and_two_transmitters_are_as_good_as_the_best_of_all_sets(field, snr_db, objective):
    value = BY_DEFINITION[objective]
    for n in (1, 2):
        chosen = wr.place(field, CANDIDATES, n, objective=objective, level_db=LEVEL_DB, **MAP)
        every = [value(snr_db[list(some)].max(axis=0)) for some in combinations(range(len(CANDIDATES)), n)]
        assert min(every) < max(every)  # there is something to choose
        found = value(snr_db[chosen].max(axis=0))
        assert len(set(chosen.tolist())) == n
        if objective == "worst tenth":
            assert found >= max(every) - 0.1
        else:  # 0.1 dB
            assert found >= max(every) * 10 ** (-0.01)


def test_pairs_are_all_tried_while_they_are_few():
    """The best single one covers four cells of six; the two that cover three cover all."""
    snr_db = np.zeros((3, 1, 7))
    for candidate, cells in enumerate(((0, 1, 2, 3), (0, 1, 4), (2, 3, 5))):
        snr_db[candidate, 0, cells] = 20.0
    snr_db[..., 6] = np.nan
    assert best_set(snr_db, 2, "share", 10.0).tolist() == [1, 2]
    assert best_set(snr_db, 2, "share", 10.0, most=2).tolist() == [0, 1]


def test_bad_input_names_the_argument(field):
    for name, words in {
        "candidates": {"candidates": [[1, 2]]}, "n": {"n": 7}, "objective": {"objective": "best"},
        "transmitter": {"candidates": [[9.0, 9.0, 9.0]]}, "level_db": {"level_db": np.nan},
    }.items():  # fmt: skip
        with pytest.raises((TypeError, ValueError), match=name):
            wr.place(field, **{"candidates": CANDIDATES} | words, **MAP)
