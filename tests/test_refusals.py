"""What would give a wrong answer without a word is refused by name. The fuzz suite tries what would fail loudly."""

from decimal import Decimal

import numpy as np
import pytest
from furnished import RECEIVERS, TX, F, furnished
from path_makers import random_paths

import warprrf as wr
from warprrf.rf.channel.dispersion import coherence_bandwidth, delay_spread
from warprrf.rf.spectra.deembedding import Scan

ENDS = {"transmitter": TX, "receivers": RECEIVERS[:1], "frequency_hz": F}


def readings(**changes):
    given = {"transmitters": TX, "receivers": RECEIVERS[0], "frequency_hz": F, "floor": 1e-15}
    turned = {"arrival": [[1.0, 0.0], [1.0, 1.0]], "receive_pattern": wr.horn(0.2)}
    return wr.Readings(**(given | turned | {"power": [1e-9, 1e-9]} | changes))


@pytest.mark.parametrize(
    ("named", "call"),
    [
        ("faces.*0 to 2", lambda: wr.Mesh(np.eye(3), [[0, 1, 3]])),
        ("faces.*0 to 2", lambda: wr.Mesh(np.eye(3), [[0, 1, -1]])),
        ("faces.*int32", lambda: wr.Mesh(np.eye(3), [[0, 1.5, 2.0]])),  # neither rounded nor wrapped
        ("pieces", lambda: wr.Reconstruction(None, furnished().mesh, pieces=["a.png"])),
        ("faces", lambda: wr.Mesh(np.eye(3), [[0, 2**40, 1]])),
        ("length", lambda: wr.Paths.stack([random_paths(3)], length=3.5)),
        ("mirrors", lambda: wr.Effects(mirrors=2.5)),
        ("tolerance", lambda: Scan(tolerance=Decimal("0.1"))),  # floats do not go together with it
        ("spacing", lambda: wr.PlanarArray(1, 1, spacing=-1.0)),
        ("power", lambda: delay_spread([1.0, -1.0], [0.0, 1e-9])),
        ("level", lambda: coherence_bandwidth([1.0, 1.0], [0.0, 1e-9], level=1.5)),
        ("frequency_hz", lambda: wr.em.gas_attenuation_db_per_m(300.0)),
        ("temperature_k", lambda: wr.em.gas_attenuation_db_per_m(F, temperature_k=15.0)),
        ("pressure_hpa", lambda: wr.em.gas_attenuation_db_per_m(F, pressure_hpa=-1.0)),
        ("frequencies_hz", lambda: random_paths(3).cfr([3e11, 3.1e11], method="grid")),
        ("seed", lambda: random_paths(3, kind="diffuse").cir(diffuse="random_phase", seed=-1)),
        ("mirror_order", lambda: wr.trace_paths(furnished(), **ENDS, mirror_order=-1)),
        ("tolerance_db", lambda: wr.relevance(furnished(), **ENDS, tolerance_db=0.0)),
        ("power", lambda: readings(power=[1e-9, -1e-9])),
        ("power.*floor", lambda: readings(power=[1e-16, 1e-16])),
        ("receive_pattern", lambda: readings(receive_pattern=None)),
        ("chain", lambda: readings(chain=["a"])),
        ("std_db", lambda: readings(std_db=-1.0)),
        ("bandwidth_hz", lambda: readings(bandwidth_hz=2e9)),
    ],
)
def test_what_would_be_wrong_in_silence_is_refused(named, call):
    with pytest.raises((ValueError, TypeError), match=named):
        call()
