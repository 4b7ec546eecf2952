"""A minute of fuzzing: part of what `python -m benchmarks fuzz` tries, the same in every run."""

import os
import time
from collections import Counter
from functools import partial
from itertools import islice

import numpy as np
import pytest

from benchmarks.fuzz import calls, cases, damage, judge
from benchmarks.fuzz.command import stated, stream
from benchmarks.fuzz.place import Place
from benchmarks.fuzz.workers import Workers

CASES = 600
"""About a minute of two processes, the same ones wherever they run."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return Place(tmp_path_factory.mktemp("fuzz")).make()


def test_every_public_name_has_an_example_with_all_it_needs(place):
    names = calls.public()
    assert names.keys() == calls.EXAMPLES.keys()
    for name, example in calls.EXAMPLES.items():
        given = calls.parameters(name, example(place))
        assert not [argument for argument, value in given.items() if value is calls.MISSING], name


def test_a_minute_of_fuzzing_finds_nothing(place):
    findings = []
    tried = Counter()
    with Workers(partial(cases.trial, str(place.folder)), cases.ended) as workers:
        for case, outcome in workers.run(islice(stream(place, 0, ""), CASES)):
            tried[outcome.kind] += 1
            if outcome.kind == "finding":
                findings.append(f"{stated(case)}: {outcome.text}")
    assert tried["answered"] > 50 and tried["refused"] > 50
    assert not findings, "\n".join(findings)


FOUND = [
    ("Mesh.look_around", ("directions", "as bool"), ("points", "no rows")),
    ("Paths.taps", ("center_hz", "huge")),
    ("Paths.select", ("chosen", "2^63")),
    ("RadioField.at_frequency", ("frequency_hz", "tiny")),
    ("RadioField.cfr", ("client", "true")),
    ("RadioField.fit", ("relevance", "text")),
    ("RadioField.links", ("shape", "with inf")),
    ("RadioField.load", ("path", "no text")),
    ("RadioField.suggest", ("candidates", "with 1e9")),
    ("Readings", ("chain", "ragged")),
    ("Readings.from_table", ("table", "list")),
    ("SpectrumDataset.empty", ("frequency_hz", "tiny")),
    ("Spectrum", ("range_db", "as objects")),
    ("Reconstruction", ("photos", "dictionary")),
    ("SpectrumDataset.deembed", ("pattern", "class")),
    ("SpectrumDataset.deembed", ("pattern", "ragged")),
    ("SpectrumDataset.from_spectra", ("path_gain", "negated"), ("aod", "with 1e20")),
    ("SpectrumDataset.from_spectra", ("role", "ragged")),
    ("channel.Codebook", ("factors", "as objects")),
    ("channel.angular_spread", ("power", "torch")),
    ("channel.coherence_bandwidth", ("power", "zeros")),
    ("channel.delay_spread", ("power", "as int8")),
    ("em.Band.conductivity", ("frequency_hz", "minus one")),
    ("em.lobe", ("cos_incidence", "complex")),
    ("em.lobe", ("cos_to_mirror", "with huge"), ("alpha_r", "2^31")),
    ("em.slab_reflection", ("thickness_m", "nested"), ("cos_incidence", "zero")),
    ("em.slab_reflection", ("wavelength_m", "tiny")),
    ("em.slab_transmission", ("thickness_m", "zero"), ("cos_incidence", "zero")),
    ("evaluate", ("beam_width_rad", "tiny")),
    ("evaluate", ("predict", "class")),
    ("metrics.beam_gain_loss_db", ("width_rad", "tiny")),
    ("metrics.beam_response", ("width_rad", "tiny")),
    ("metrics.psnr", ("truth", "empty"), ("prediction", "no list")),
    ("metrics.unit_image", ("floor", "minus one")),
    ("reconstruct", ("photos", "list")),
]
"""Findings of earlier hours, one of each cause."""


@pytest.fixture(scope="module")
def trial(place, tmp_path_factory):
    return cases.Trial(place, tmp_path_factory.mktemp("trial"))


@pytest.mark.parametrize("target_and_edits", FOUND, ids=lambda case: f"{case[0]}-{case[1][0]}-{case[1][1]}")
def test_what_was_found_once_is_right_now(trial, target_and_edits, monkeypatch):
    monkeypatch.chdir(trial.scratch)
    target, *edits = target_and_edits
    outcome = trial(cases.Case(target, tuple(edits)))
    assert outcome.kind in ("refused", "answered"), outcome.text


def test_cases_of_a_target_do_not_depend_on_other_targets(place):
    alone = cases.drawn(place, 3, 0, "channel.thz_channel")
    among = [case for case in cases.drawn(place, 3, 0, "channel.") if case.target == "channel.thz_channel"]
    assert alone == among


def misbehaving(scratch):
    return {
        "answers": str,
        "dies": lambda case: os.abort(),
        "hangs": lambda case: time.sleep(60.0),
    }.__getitem__


def attempts(scratch):
    known = misbehaving(scratch)
    return lambda case: known(case)(case)


def test_a_crash_and_a_hang_are_seen_and_others_go_on():
    asked = ["answers", "dies", "answers", "hangs", "answers", "answers"]
    with Workers(attempts, lambda words: f"ended: {words}", 1, 2.0) as workers:
        found = dict(islice(workers.run(asked), len(asked)))
    assert found["answers"] == "answers"
    assert "exit code -6" in found["dies"]
    assert "took more than 2 s" in found["hangs"]


def test_errors_of_other_kinds_or_without_a_name_are_findings():
    assert not judge.complaint(ValueError("rx: got NaN"), ["rx"])
    assert "KeyError" in judge.complaint(KeyError("rx"), ["rx"])
    assert "names nothing" in judge.complaint(ValueError("bad prx"), ["rx"])


def test_nan_is_a_finding_where_it_is_not_usual():
    usual = judge.leaves({"a": np.array([1.0, np.nan]), "b": 1.0})
    assert not judge.wrong(judge.leaves({"a": np.array([np.nan]), "b": 2.0}), usual)
    assert "b" in judge.wrong(judge.leaves({"a": np.array([1.0]), "b": np.nan}), usual)


def test_only_an_empty_pixel_has_no_delay():
    delay = np.array([[1e-9, np.nan]])
    assert not judge.wrong(judge.leaves({"path_gain": np.array([[1.0, 0.0]]), "delay_s": delay}), {})
    assert "delay_s" in judge.wrong(judge.leaves({"path_gain": np.array([[1.0, 1.0]]), "delay_s": delay}), {})


@pytest.mark.parametrize("name", cases.FORMATS)
def test_every_format_reads_the_same_when_its_contents_are_put_back(place, name, tmp_path):
    form = cases.FORMATS[name]
    path = form.make(place, tmp_path)
    usual = judge.leaves(form.read(path))
    assert usual
    if form.codec:
        unpack, pack = damage.CODECS[form.codec]
        pack(path, unpack(path))
        assert not judge.differs(judge.leaves(form.read(path)), usual)
    before = path.read_bytes()
    damage.damage(path, form.codec, (("flip", 3, 1),))
    assert path.read_bytes() != before
