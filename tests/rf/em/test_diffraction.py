"""Diffraction by an edge against exact solutions, and the laws that hold for any faces."""

import numpy as np
import pytest
from scipy.special import fresnel, jv

from warprrf.rf.em.diffraction import EdgeRays, diffraction_matrices
from warprrf.rf.em.fresnel import slab_reflection, slab_transmission
from warprrf.rf.em.materials import itu_material

METAL = ((-1.0, 1.0), (-1.0, 1.0))
CONCRETE = itu_material("concrete", thickness_m=0.2)


def slab(cosine, wavelength_m, coefficient=slab_reflection):
    return coefficient(cosine, CONCRETE.permittivity(299792458.0 / wavelength_m), 0.2, wavelength_m)


def matrices(rays, metal, sheet=False):
    """Of metal or concrete, on the side of face n half as strong; a sheet lets something through."""
    if metal:
        return diffraction_matrices(rays, METAL)
    c = rays.incidence_cosines()
    reflected = [slab(c[2 + k], rays.wavelength_m) for k in range(2)]
    through = [slab(c[k], rays.wavelength_m, slab_transmission) for k in range(2)] if sheet else None
    return diffraction_matrices(rays, tuple(reflected), through)


def series(n, phi, source, kr, soft):
    """Plane wave on a conducting wedge, exactly: J. J. Bowman et al., Electromagnetic and Acoustic Scattering, ch. 6."""
    m = np.arange(int(n * (kr + 40 + 6 * kr ** (1 / 3))))
    wave = np.sin if soft else np.cos
    weight = np.where(m == 0, 1, 2) * np.exp(0.5j * np.pi * m / n) * jv(m / n, kr) * wave(source * m / n)
    return 2 / n * (wave(np.outer(phi, m / n)) @ weight)


@pytest.mark.parametrize(
    "interior, limits", [(0, (1e-12,) * 3), (90, (5e-3, 5e-4, 2e-4)), (150, (1.2e-2, 1e-3, 4e-4))]
)
def test_field_of_a_conducting_wedge_is_the_exact_series(interior, limits):
    n = 2 - interior / 180
    phi = np.linspace(0, n * np.pi, 361)[1:-1] + 1e-9
    for wavelengths, limit in zip((1, 10, 30), limits, strict=True):
        kr = 2 * np.pi * wavelengths
        for source in np.radians(np.arange(4, 90 * n, 11)):
            slant = 0.6  # along the edge a plane wave shortens k alone
            rays = EdgeRays(n, source, phi, slant, np.inf, wavelengths / (1 - slant**2), 1.0)
            bent, straight, image = matrices(rays, metal=True) * np.exp(-1j * kr), phi - source, phi + source
            assert np.abs(bent[:, [0, 1], [1, 0]]).max() < 1e-12
            for k, sign in enumerate((-1, 1)):
                field = bent[:, k, k] + (straight < np.pi) * np.exp(1j * kr * np.cos(straight))
                for angle, lit in (
                    (image, image < np.pi),
                    (2 * n * np.pi - image, image > (2 * n - 1) * np.pi),
                ):
                    field += sign * lit * np.exp(1j * kr * np.cos(angle))
                assert np.abs(field - series(n, phi, source, kr, soft=k == 0)).max() < limit


def wave_along(sent, towards):
    """Field of a dipole ``sent`` in the direction ``towards``, of unit strength at unit distance."""
    return sent - np.outer(sent @ towards, towards)


def total(source, receiver, n, wavelength, metal, sheet, direct, images):
    """Field vector at ``receiver`` of dipoles at ``source``, shape ``(3, 3)``: straight, by mirrors, and by the edge z."""
    field, k, sent = np.zeros((3, 3), complex), 2 * np.pi / wavelength, np.eye(3)
    way = receiver - source
    d = np.linalg.norm(way)
    for on, normal in ((direct, None), *zip(images, faces(n), strict=True)):
        if normal is None:
            s, part = way / d, 1.0
            out, length = wave_along(sent, s), d
            if sheet and not direct:
                te, tm = slab(abs(s[1]), wavelength, slab_transmission)
                across = np.cross(s, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(s, [0.0, 1.0, 0.0]))
                part = te * np.outer(across, across) + tm * (np.eye(3) - np.outer(across, across))
                on, out = True, out @ part
        else:
            mirror = np.eye(3) - 2 * np.outer(normal, normal)
            length = np.linalg.norm(receiver - mirror @ source)
            back = (receiver - mirror @ source) / length
            s = mirror @ back
            across = np.cross(s, normal) / np.linalg.norm(np.cross(s, normal))
            te, tm = (-1.0, 1.0) if metal else slab(abs(s @ normal), wavelength)
            part = te * np.outer(across, across) + tm * np.outer(np.cross(across, s), np.cross(across, back))
            out = wave_along(sent, s) @ part
        field += on * out * np.exp(-1j * k * length) / length
    rho = np.hypot(source[0], source[1]), np.hypot(receiver[0], receiver[1])
    edge = np.array([0, 0, source[2] + (receiver[2] - source[2]) * rho[0] / sum(rho)])
    near, far = edge - source, receiver - edge
    before, behind = np.linalg.norm(near), np.linalg.norm(far)
    angle = [np.arctan2(x[1], x[0]) % (2 * np.pi) for x in (source, receiver)]
    rays = EdgeRays(n, *angle, near[2] / before, before, behind, wavelength)
    basis = []
    for s in (near / before, far / behind):
        p = np.cross([0, 0, 1], s) / np.linalg.norm(np.cross([0, 0, 1], s))
        basis.append(np.stack([np.cross(s, p), p]))
    bent = basis[1].T @ matrices(rays, metal, sheet) @ basis[0]
    phase = np.exp(-1j * k * (before + behind)) / (before + behind)
    return field + (bent @ wave_along(sent, near / before).T).T * phase


def faces(n):
    return np.array([0.0, 1.0, 0.0]), np.array([np.sin(n * np.pi), -np.cos(n * np.pi), 0.0])


@pytest.mark.parametrize("wavelengths", [1, 30, 1000])
@pytest.mark.parametrize(
    "metal, n, sheet", [(True, 1.5, False), (False, 1.5, False), (False, 1.2, False), (False, 2, True)]
)
@pytest.mark.parametrize("height", [0.0, 1.2])
def test_total_is_continuous_where_paths_end(wavelengths, metal, n, sheet, height):
    wavelength, phi, far = 0.1, np.radians(20.0 if n == 1.2 else 55.0), 0.1 * wavelengths
    source, step = far * np.array([np.cos(phi), np.sin(phi), height]), np.radians(1e-6)
    for edge, what in ((np.pi - phi, "image"), (np.pi + phi, "straight")):
        sides = []
        for at in edge + step * np.array([-2, -1, 1, 2]):
            receiver = 0.8 * far * np.array([np.cos(at), np.sin(at), 0.0])
            lit = what == "image", at < edge
            sides.append(total(source, receiver, n, wavelength, metal, sheet, any(lit), (all(lit), False)))
        power = [(np.abs(side) ** 2).sum() for side in sides]
        assert abs(10 * np.log10(power[2] / power[1])) < 0.01
        assert np.abs(sides[2] - sides[1]).max() < 1e-3 * np.abs(sides[1]).max()
        # Dipoles along and across the edge, whose patterns have no slope there: so has the sum no kink.
        if height == 0:
            across = [np.array([-np.sin(x), np.cos(x), 0.0]) for x in (phi, edge)]
            field = np.array([(side[2, 2], across[0] @ side @ across[1]) for side in sides])
            slopes = np.diff(field, axis=0)
            assert np.abs(slopes[2] - slopes[0]).max() < 1e-2 * np.abs(slopes).max()


def test_what_is_reciprocal_flat_or_a_knife_edge():
    rng = np.random.default_rng(0)
    n = rng.uniform(1.05, 2, 200)
    a, b = n * np.pi * rng.uniform(0.02, 0.98, (2, 200))
    s, t, cosine = *rng.uniform(1, 50, (2, 200)), rng.uniform(-0.9, 0.9, 200)
    there = matrices(EdgeRays(n, a, b, cosine, s, t, 0.1), False, sheet=True)
    back = matrices(EdgeRays(n, b, a, -cosine, t, s, 0.1), False, sheet=True)
    turned = np.array([[1, -1], [-1, 1]]) * np.swapaxes(back, 1, 2)  # p points the other way on the way back
    assert np.abs(there - turned).max() < 1e-9
    flat = EdgeRays(1.0, a / n, b / n, cosine, s, t, 0.1)
    assert (
        np.abs(matrices(flat, metal=True)).max() < 1e-12 and np.abs(matrices(flat, metal=False)).max() < 1e-12
    )
    over = np.radians(np.linspace(-3.0, 3.0, 41)[1::2])  # past a screen met head on
    screen = EdgeRays(2.0, np.pi / 2, 1.5 * np.pi + over, 0.0, 100.0, 100.0, 0.1)
    straight = np.where(over < 0, np.exp(2j * np.pi / 0.1 * 200.0 * (1.0 - np.cos(over / 2))), 0.0)
    field = matrices(screen, metal=True) + straight[:, None, None] * np.eye(2)
    s, c = fresnel(over * np.sqrt(2 / 0.1 * 50.0))  # of v, P.526, eqs. (28) and (30)
    loss = -10 * np.log10(((1 - c - s) ** 2 + (c - s) ** 2) / 4)
    assert np.abs(-10 * np.log10(0.5 * (np.abs(field) ** 2).sum(axis=(1, 2))) - loss).max() < 0.1
