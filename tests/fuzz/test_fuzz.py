"""Some fuzzing: part of what `python -m tests.fuzz` tries, the same in every run; and what was found before."""

import re
from collections import Counter
from functools import partial
from itertools import islice

import numpy as np
import pytest

from fuzz import calls, trial
from fuzz.answers import complaint, differs, leaves, wrong
from fuzz.files import CODECS, FORMATS
from fuzz.laws import LAWS
from fuzz.trial import FILE, LAW, Case, Trial
from fuzz.workers import Workers


@pytest.fixture
def attempt(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Trial(place, tmp_path)


def found(place, cases, **how):
    """Findings of cases, and how many ended how."""
    findings, tried = [], Counter()
    with Workers(partial(Trial, str(place.folder)), 1, **how) as workers:
        for case, outcome in workers.run(cases):
            tried[outcome.kind] += 1
            if outcome.kind == "finding":
                findings.append(f"{case}: {outcome.text}")
    return findings, tried


@pytest.mark.parametrize("cases", [60, pytest.param(600, marks=pytest.mark.long)])
def test_some_fuzzing_finds_nothing(place, cases):
    """The first ones of seed 0, the same cases wherever they run."""
    findings, tried = found(place, islice(trial.stream(place, 0), cases))
    assert tried["answered"] > cases // 12 and tried["refused"] > cases // 12
    assert not findings, "\n".join(findings)


@pytest.mark.parametrize("times", [1, pytest.param(20, marks=pytest.mark.long)])
def test_damage_of_files_with_a_checksum_is_refused_or_changes_nothing(place, times):
    """Flipped bits, a third of them early, and cuts; where there is no place for a checksum, a flipped bit changes one value
    at most, and a cut nothing."""
    kinds = [*["flip early"] * 3, *["flip"] * 7, *["cut"] * 3] * times
    draw = np.random.default_rng(0).integers(0, 2**31, (len(kinds), 2)).tolist()
    names = [FILE + name for name, form in FORMATS.items() if form.law]
    cases = (Case(name, ((kind, a, b),)) for name in names for kind, (a, b) in zip(kinds, draw, strict=True))
    findings, tried = found(place, cases, limit_s=10.0)
    assert not findings, "\n".join(findings)
    assert tried["refused"] > 10 * times * len(names) and tried.total() == len(kinds) * len(names)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_reads_the_same_when_its_contents_are_put_back(place, name, tmp_path):
    form = FORMATS[name]
    path = form.make(place, tmp_path)
    usual = leaves(form.read(path))
    assert usual
    if form.codec:
        unpack, pack = CODECS[form.codec]
        pack(path, unpack(path))
        assert not differs(leaves(form.read(path)), usual)


def test_every_public_name_has_an_example_that_is_answered(place, attempt):
    for name in calls.public():
        example = calls.example(name, place)
        if name in calls.REFUSED:
            with pytest.raises((ValueError, TypeError, OSError)):
                calls.call(name, example)
        else:
            calls.call(name, example)
    assert {*calls.EXAMPLES, *calls.REFUSED} <= calls.public().keys()


CHECKED = {
    "simulate": "scene seed transmitter receivers frequency_hz", "sample_receivers": "scene n z clearance seed",
    "trace_paths": "mesh_or_scene mirror_order transmitter receivers frequency_hz", "RadioField.fit": "ds",
    "render": "g cam", "splats.blend_weights": "g cam top_k", "Mesh": "vertices faces", "Mesh.cast": "origins directions",
    "Mesh.visible": "a b clearance", "Mesh.closest": "points", "Mesh.crossings": "points directions",
    "Mesh.cross_section": "height", "Paths.taps": "bandwidth_hz l_min l_max", "Paths.cfr": "frequencies_hz",
    "em.gas_attenuation_db_per_m": "frequency_hz", "Air": "temperature_k pressure_hpa water_vapour_g_m3",
    "lookups.nearest": "train", "lookups.mean": "train", "evaluate": "test", "em.lobe": "alpha_r",
}  # fmt: skip


@pytest.mark.parametrize("name", CHECKED)
def test_what_is_no_argument_is_refused_by_its_name(attempt, name):
    for argument in CHECKED[name].split():
        for value in ("none", "text", "object", "ragged", "nan"):
            outcome = attempt(Case(name, ((argument, value),)))
            assert outcome.kind == "refused" and argument in outcome.text, (argument, value, outcome)


FOUND = """
Mesh.crossings: directions=as bool, points=no rows; Paths.select: chosen=2^63
BistaticField.at_frequency: frequency_hz=tiny; RadioField.cfr: client=true; RadioField.fit: relevance=text
RadioField.links: shape=with -inf; RadioField.load: path=no text; RadioField.suggest: candidates=with 1e+09
Readings: chain=ragged; Readings.from_table: table=list; SpectrumDataset.empty: frequency_hz=tiny
Spectrum: range_db=as objects; Reconstruction: photos=dictionary; SpectrumDataset.deembed: pattern=class
SpectrumDataset.deembed: pattern=ragged; SpectrumDataset.from_spectra: path_gain=negated, aod=with 1e+20
SpectrumDataset.from_spectra: role=ragged; channel.Codebook: factors=as objects; channel.angular_spread: power=torch
channel.coherence_bandwidth: power=zeros; channel.delay_spread: power=as int8; em.Band.conductivity: frequency_hz=minus one
em.lobe: cos_incidence=complex; em.lobe: cos_to_mirror=huge, alpha_r=2^31
em.slab_reflection: thickness_m=nested, cos_incidence=zero; em.slab_reflection: wavelength_m=tiny
em.slab_transmission: thickness_m=zero, cos_incidence=zero; evaluate: beam_width_rad=tiny; evaluate: predict=class
metrics.beam_gain_loss_db: width_rad=tiny; metrics.beam_response: width_rad=tiny
metrics.psnr: truth=empty, prediction=no list; metrics.unit_image: floor=minus one; reconstruct: photos=list
Spectrum.stack: spectra=nested; Paths.stack: length=2^31; em.Band.widened: low_hz=numpy integer
lookups.Lookup.spectrum: receivers=no rows; lookups.mean: train=readings
em.slab_transmission: cos_incidence=zeros, thickness_m=tiny; em.slab_transmission: cos_incidence=zero, permittivity=list
channel.coherence_bandwidth: tau=no list, power=no rows; Paths.from_points: kind=texts
"""
"""Findings of earlier hours, one of each cause."""


@pytest.mark.parametrize("case", re.split("; |\n", FOUND.strip()))
def test_what_was_found_once_is_right_now(attempt, case):
    target, _, edits = case.partition(": ")
    outcome = attempt(Case(target, tuple(tuple(edit.split("=")) for edit in edits.split(", "))))
    assert outcome.kind in ("refused", "answered"), outcome.text


@pytest.mark.parametrize(
    ("target", "edits", "kind"),
    [
        ("file: arrays, plain", [("double", 269, 44445), ("double", 1974, 16233)], "unfit"),
        ("file: compact spectra", [("rename", 78, 0), ("blank", 23, 0)], "answered"),
        ("law: rooms", [("turned by a quarter", 12321, 380152463)], "answered"),
        ("file: STL mesh", [("cut", 34, 0)], "refused"),
        # there is no answer
        ("simulate", [("beam_sigma_rad", "zero")], "refused"),
        ("PlanarArray", [("orientation", "mirror")], "refused"),
        ("Mesh", [("vertices", "all alike")], "refused"),
        ("RadioField.fit", [("ds", "readings"), ("model", "rf3dgs+")], "refused"),
    ],
)
def test_what_was_found_once_ends_as_it_should(attempt, target, edits, kind):
    """Bytes alone have no contents; a fill value of zero makes pixels of zero not measured; a lattice of rays is none of
    the room's; 34 bytes are no STL file of -1 triangles."""
    outcome = attempt(Case(target, tuple(edits)))
    assert outcome.kind == kind, outcome


@pytest.mark.parametrize("more", [2, pytest.param(20, marks=pytest.mark.long)])
@pytest.mark.parametrize("law", LAWS)
def test_a_law_holds(attempt, law, more):
    plain = [Case(LAW + law, ((name, 0, 0),)) for name in dict.fromkeys(LAWS[law].edits)]
    for case in plain + trial.drawn(LAW + law, [], more, 0):
        outcome = attempt(case)
        assert outcome.kind in ("answered", "unfit"), f"{case}: {outcome.text}"


def test_errors_of_other_kinds_or_without_a_name_are_findings():
    assert not complaint(ValueError("rx: got NaN"), ["rx"])
    assert "KeyError" in complaint(KeyError("rx"), ["rx"])
    assert "names nothing" in complaint(ValueError("bad prx"), ["rx"])


def test_nan_is_a_finding_where_it_is_not_usual():
    usual = leaves({"a": np.array([1.0, np.nan]), "b": 1.0})
    assert not wrong(leaves({"a": np.array([np.nan]), "b": 2.0}), usual)
    assert "b" in wrong(leaves({"a": np.array([1.0]), "b": np.nan}), usual)
    assert not wrong(leaves({"a": np.array([1.0]), "b": np.nan}), usual, (".b",))
    delay = np.array([[1e-9, np.nan]])  # of an empty pixel alone
    assert not wrong(leaves({"path_gain": np.array([[1.0, 0.0]]), "delay_s": delay}), {})
    assert "delay_s" in wrong(leaves({"path_gain": np.array([[1.0, 1.0]]), "delay_s": delay}), {})
