"""The twin's comparison with the truth: what can be said exactly scores high, a wrong pattern lower."""

import numpy as np
from twin_fields import BLOCKED, SEES, SHAPE, SIGMA, TX, F, known_field, room

from benchmarks.runner import Job
from benchmarks.twin import Options, compare
from warprrf.rf.exact import ExactEngine
from warprrf.rf.spectra.dataset import SpectrumDataset


def test_the_twin_of_a_known_room_scores_like_the_room(tmp_path):
    engine = ExactEngine(room(), transmitter=TX, frequency_hz=F, shape=SHAPE, beam_sigma_rad=SIGMA)
    found = [engine.receive(r) for r in (SEES, BLOCKED)]
    test = SpectrumDataset.from_spectra(
        receivers=np.array([SEES, BLOCKED]), transmitter=TX, frequency_hz=F,
        path_gain=np.stack([f.path_gain for f in found]), delay_s=np.stack([f.delay_s for f in found]),
        aod=np.stack([f.aod for f in found]), line_of_sight=[f.line_of_sight for f in found], beam_sigma_rad=SIGMA,
        engine="exact",
    )  # fmt: skip
    figures = compare(known_field(), test, None, Options(engine="exact"), Job(tmp_path / "twin"))
    assert "true_scene" not in figures
    assert figures["twin"]["psnr_db"] > 55
    assert figures["field"]["psnr_db"] > 35
    assert figures["twin_lambertian"]["psnr_db"] < figures["twin"]["psnr_db"] - 20
    assert figures["twin"]["tof_error_median_ns"] < 1e-3
    assert figures["projection"]["lobe_error_db"] < 1e-6
    assert figures["projection"]["groups"] == 2
