"""Radio materials: the recommendation's rows, their bands, and scattering from roughness."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

from warprrf.rf.em.fresnel import slab_reflection, slab_transmission
from warprrf.rf.em.materials import Band, Material, load_materials, roughness_scattering, table_entry

TABLE = ROOT / "data" / "lobby" / "materials.json"


@pytest.fixture(scope="module")
def table():
    return load_materials(TABLE)


def test_concrete_at_300_ghz_has_the_recommended_permittivity(table):
    # ITU-R P.2040-4: 5.17 and 0.0145 f^1.09 S/m; sigma / (2 pi f eps0) = 17.98 sigma / f[GHz]
    eta = table["concrete"].permittivity(300e9)
    assert eta.real == pytest.approx(5.17)
    assert eta.imag == pytest.approx(-17.975 * 0.0145 * 300**1.09 / 300, rel=1e-3)


def test_roughness_keeps_the_energy_of_the_mirror_direction():
    # S^2 + rho^2 = 1 with rho the Rayleigh factor
    wavelength = 299792458.0 / 140e9
    rho = math.exp(-8 * (math.pi * 0.08e-3 / wavelength) ** 2)
    assert roughness_scattering(0.08e-3, 140e9) ** 2 + rho**2 == pytest.approx(1)
    assert roughness_scattering(0.0, 140e9) == 0


def test_the_first_row_that_holds_counts():
    rows = (Band(200e9, 400e9, 2, 0, 0, 0), Band(100e9, 400e9, 3, 0, 0, 0))
    material = Material("two rows", rows)
    assert material.relative_permittivity(300e9) == 2
    assert material.relative_permittivity(150e9) == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("relative_permittivity", 0.5),
        ("relative_permittivity", 3 - 1j),
        ("conductivity", -0.1),
        ("thickness_m", -1.0),
        ("scattering", 1.2),
        ("pattern", "backscattering"),
        ("alpha_r", 1001),
        ("alpha_r", 2.5),
    ],
)
def test_a_custom_material_gives_no_power(name, value):
    with pytest.raises((ValueError, TypeError), match=name):
        Material.custom("m", **({"relative_permittivity": 3.0} | {name: value}))


def test_no_material_gives_back_more_than_comes():
    """|r|^2 + |t|^2 <= 1 for both polarisations, of any material that is accepted, thin, thick or endless."""
    rng = np.random.default_rng(5)
    frequencies, cosines = 10 ** rng.uniform(6, 13, 400), rng.uniform(0, 1, (200, 1))
    given = [
        Material.custom(
            "m",
            relative_permittivity=1 + 10 ** rng.uniform(-4, 8),
            conductivity=rng.choice([0.0, 10 ** rng.uniform(-9, 12)]),
            thickness_m=rng.choice([10 ** rng.uniform(-6, 3), np.inf]),
        )
        for _ in frequencies
    ]
    eta = np.array([m.permittivity(f) for m, f in zip(given, frequencies, strict=True)])
    thickness, wavelength = np.array([m.thickness_m for m in given]), 299792458.0 / frequencies
    assert (eta.imag <= 0).all()
    reflected = slab_reflection(cosines, eta, thickness, wavelength)
    through = slab_transmission(cosines, eta, thickness, wavelength)
    for r, t in zip(reflected, through, strict=True):
        power = np.abs(r) ** 2 + np.abs(t) ** 2
        assert np.isfinite(power).all()
        assert power.max() <= 1 + 1e-9
        assert power.min() < 0.9  # some absorb


def test_beyond_total_reflection_a_thick_slab_without_loss_gives_back_all():
    """sin^2 of the incidence above eta: the wave within decays, |r| = 1 of an endless one, and nothing comes through."""
    grazing = np.array([0.05, 0.3, 0.6])
    for thickness in (10.0, np.inf):
        for r in slab_reflection(grazing, 0.5, thickness, 1e-3):
            np.testing.assert_allclose(np.abs(r), 1.0, rtol=0, atol=1e-12)
        for t in slab_transmission(grazing, 0.5, thickness, 1e-3):
            np.testing.assert_allclose(np.abs(t), 0.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((2e9, 1e9, 3, 0, 0, 0), "low_hz, high_hz"),
        ((1e9, 2e9, -3, 0, 0, 0), "relative_permittivity.* at 1 GHz"),
        ((1e9, 100e9, 1.5, -0.4, 0, 0), "relative_permittivity.* at 100 GHz"),  # 1.5 / 100^0.4 = 0.24
        ((1e9, 100e9, 3, 0, -0.01, 1), "conductivity.* at 1 GHz"),
        ((1e9, 100e9, 3, 0, 0.01, 400), "conductivity.* at 100 GHz"),
    ],
)
def test_a_row_that_gives_power_somewhere_in_its_band_is_refused(row, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Band(*row)


def test_a_table_may_give_the_scattering_coefficient_itself_and_names_a_material_once(tmp_path):
    content, file = json.loads(TABLE.read_text()), tmp_path / "materials.json"
    brick = next(entry for entry in content["materials"] if entry["name"] == "brick")
    del brick["roughness_m"]
    brick["scattering"] = {"value": 0.43, "source": "fitted"}
    file.write_text(json.dumps(content))
    read = load_materials(file)["brick"]
    assert read.scattering_coefficient(300e9) == read.scattering_coefficient(140e9) == 0.43
    assert read.sources is not None
    assert read.sources["scattering"] == "fitted"
    for change, told in (
        (lambda: content["materials"].append(content["materials"][0]), r"materials\.json has two .*'marble'"),
        (
            lambda: content["materials"].pop() and brick["scattering"].update(value=1.43),
            r"brick.*scattering.*1\.43",
        ),
        (lambda: brick["pattern"].update(reciprocal="yes"), "reciprocal"),
        (
            lambda: brick["pattern"].pop("reciprocal") and brick.pop("scattering"),
            "brick.*neither 'roughness_m' nor 'scattering'",
        ),
    ):
        change()
        file.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=told):
            load_materials(file)


def test_a_written_entry_reads_as_the_same_material(table, tmp_path):
    given = [
        *table.values(),
        Material.custom("own", relative_permittivity=2.5, scattering=0.3, pattern="directive", alpha_r=7),
        replace(table["glass"], name="turning", xpd=0.25),
        replace(table["glass"], name="both ways", reciprocal=True),
    ]
    file = tmp_path / "materials.json"
    file.write_text(json.dumps({"materials": [table_entry(material) for material in given]}))
    read = load_materials(file)
    for material in given:
        again = read[material.name]
        assert again.bands == material.bands
        for name in ("thickness_m", "pattern", "roughness_m", "scattering", "itu", "xpd", "reciprocal"):
            assert getattr(again, name) == getattr(material, name)
        if material.pattern == "directive":
            assert again.alpha_r == material.alpha_r


def test_every_value_of_the_table_has_a_source():
    for entry in json.loads(TABLE.read_text())["materials"]:
        parts = [*entry["permittivity"], *(entry[k] for k in ("thickness_m", "roughness_m", "pattern"))]
        assert all(p["source"].startswith(("ITU-R P.2040-4", "assumed")) for p in parts)


def transfer_matrix(cosine, eta, phase, polarisation):
    """Reflection and transmission of a layer by its characteristic matrix (Born and Wolf, Principles of Optics, 1.6.2); ``phase``
    is 2 pi thickness / wavelength."""
    inner = np.sqrt(eta - (1.0 - cosine**2))  # index times cosine inside
    outer, layer = (cosine, inner) if polarisation == "TE" else (1.0 / cosine, eta / inner)  # admittances
    c, s = np.cos(phase * inner), 1j * np.sin(phase * inner)
    b, h = c + s * outer / layer, layer * s + outer * c
    reflected, through = (outer * b - h) / (outer * b + h), 2.0 * outer / (outer * b + h)
    return (reflected, through) if polarisation == "TE" else (-reflected, through)


@pytest.mark.parametrize("eta", [4.0, 6.31 - 0.02j, 2.73 - 0.3j, 1.5 - 1e-3j])
def test_a_slab_is_what_its_transfer_matrix_says(eta):
    """Both polarisations, 0 to 89 degrees, 1 to 400 GHz, 12 mm thick; power is kept without loss."""
    angle, carrier = np.meshgrid(np.radians(np.linspace(0.0, 89.0, 90)), 1e9 * np.geomspace(1, 400, 60))
    cosine, wavelength = np.cos(angle), 299792458.0 / carrier
    given = cosine, eta, 0.012, wavelength
    for k, polarisation in enumerate(("TE", "TM")):
        found = slab_reflection(*given)[k], slab_transmission(*given)[k]
        expected = transfer_matrix(cosine, complex(eta), 2.0 * np.pi * 0.012 / wavelength, polarisation)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        power = sum(np.abs(one) ** 2 for one in found)
        assert power.max() < 1.0 + 1e-12
        assert np.imag(eta) < 0 or np.abs(power - 1.0).max() < 1e-12
