"""A calibrated digital twin: the reconstructed mesh with what the bistatic field learned, as a scene for ray tracers.

A group of the field scatters as a mix of lobes times the Fresnel curve of a half-space, and mirrors a share of that
curve. A Sionna radio material has one curve |Gamma|^2, one scattering coefficient S and one lobe: it scatters
S^2 |Gamma|^2 f_s and mirrors (1 - S^2) |Gamma|^2 (Degli-Esposti et al. 2007). Each group is projected on that:

- permittivity and S are those of the slab that comes nearest to both powers, in dB over the cosine of incidence,
  weighted by it (what a surface takes in under even light). It is as thick as the scene says or the caller, which
  decides what it lets through; where nobody says, it stands for a half-space, and lets nothing through. Both faces of a
  slab reflect; their fringes, which hang on fractions of a wavelength of its thickness, are averaged. Where lobe weights
  W and mirror strength m sum to one and the slab is a half-space, that is the fitted curve and S^2 = W; else the mirror
  gives way: it shows in few pixels, scattering in all;
- the lobe is the one exponent nearest to the mix, in dB over both hemispheres, weighted by the solid angle that a
  receiver sees and with a floor where scattered power is lost in noise.

Sionna RT has no reciprocal lobes: those of a field become its own, the nearest, and lose that property. What cannot be
said is stated: both errors of each group, and what has no place in a material at all.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from warprrf.checks import check_positive, checked
from warprrf.files import folder_in_place, read_json, write_json
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.em.fresnel import COSINES, LAMBERTIAN, fresnel_curves, lobe, slab_reflection
from warprrf.rf.em.materials import VACUUM_PERMITTIVITY, Band, Material, radio_values, table_entry
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField

ABOUT = "Digital twin written by warprrf."
"""First line of a twin's ``materials.json``: a folder that says so may be replaced."""
LOSS_TANGENT = 0.02  # least that single precision, which Sionna computes in, surely turns into a decay
# What the far side sends back has then lost 25 nepers: the slab is a half-space.
THICKNESS_WAVELENGTHS = 200.0
LOST_IN_NOISE = 1e-2 / np.pi  # [1/sr], 20 dB below a white Lambertian lobe: darker directions hardly count
_EXCESS = np.geomspace(1e-2, 1e6, 1601)  # of epsilon_r - 1; the last reflects like metal
_MATERIAL = "fitted_"  # Sionna keeps names of materials and objects apart, and reserves those of the ITU


@dataclass(frozen=True)
class Reflection:
    """What a material can say of a group's reflection; see :func:`project_reflection`.

    Attributes:
        relative_permittivity: of a slab with losses of :data:`LOSS_TANGENT`.
        scattering: scattering coefficient S.
        scattering_error_db: error of S^2 |Gamma|^2, rms over incidence [dB].
        mirror_error_db: error of (1 - S^2) |Gamma|^2, rms over incidence [dB].
    """

    relative_permittivity: float
    scattering: float
    scattering_error_db: float
    mirror_error_db: float


@dataclass(frozen=True)
class TwinGroup(Reflection):
    """One material of a twin; its relative permittivity and errors are those of :class:`Reflection`.

    Attributes:
        name: its largest group's name in the field.
        area_m2: area of its faces [m^2].
        material: what it became.
        permittivity: complex relative permittivity at the carrier.
        thickness_m: of the slab [m]; inf where it stands for a half-space.
        alpha_r: exponent of its lobe, 0 for Lambertian.
        lobe_error_db: what one lobe misses of the fitted mix, rms over both directions [dB].
    """

    name: str
    area_m2: float
    material: Material = dataclasses.field(repr=False)
    permittivity: complex
    thickness_m: float
    alpha_r: int
    lobe_error_db: float


@checked
@dataclass(frozen=True)
class Twin:
    """A digital twin on disk; see :func:`write_twin`.

    Attributes:
        xml: its scene file, for :meth:`Scene.load`, :func:`load_sionna_scene` and ``sionna.rt.load_scene``.
        frequency_hz: carrier that its materials were fitted at [Hz].
        groups: its materials, largest area first.
        left_out: what of the field no material can hold, in words with numbers.
    """

    xml: Path
    frequency_hz: float
    groups: tuple[TwinGroup, ...] = dataclasses.field(repr=False)
    left_out: tuple[str, ...]

    @property
    def scattering_error_db(self) -> float:
        """Error of the scattered power over all groups, rms weighted by area [dB]."""
        return self._rms("scattering_error_db")

    @property
    def mirror_error_db(self) -> float:
        """Error of the mirrored power over all groups, rms weighted by area [dB]."""
        return self._rms("mirror_error_db")

    @property
    def lobe_error_db(self) -> float:
        """Error of the lobes over all groups, rms weighted by area [dB]."""
        return self._rms("lobe_error_db")

    def _rms(self, name: str) -> float:
        squares = [getattr(group, name) ** 2 for group in self.groups]
        return float(np.sqrt(np.average(squares, weights=[group.area_m2 for group in self.groups])))


@checked
def write_twin(
    field: RadioField,
    folder: str | os.PathLike[str],
    *,
    thickness_m: float | Mapping[str, float] | None = None,
) -> Twin:
    """Write the reconstructed mesh with a field's materials as ``scene.xml``, ``materials.json`` and ``meshes/``.

    ``sionna.rt.load_scene`` opens the XML as it is, all lobes Lambertian; :func:`load_sionna_scene` sets the scattering
    patterns too; :meth:`Scene.load` and :func:`simulate` take it as any scene. Each material of the field is an object
    ``surface_<group>`` of a material ``fitted_<group>``, named by its largest group; it holds within 10 % of the
    field's carrier.

    No material can hold a common gain (an uncalibrated receiver) or residuals of elements, and softened blocking belongs to
    the field's tracer: :attr:`Twin.left_out` says what this field has of the former, and which materials let nothing
    through because nobody said how thick they are.
    Sionna may find one mirror in several small triangles and count it as often; :func:`simulate` counts it once.

    Args:
        field: a fitted bistatic field.
        folder: a new or empty folder, or an earlier twin's, which is replaced. It is written beside and renamed.
        thickness_m: of all surfaces [m], or of some by the names of their groups; the others have that of the
            :class:`Scene` that the field was fitted on. ``inf``: a half-space.

    Raises:
        TypeError: if the field is of another model.
        ValueError: if the folder holds anything else, the field models line of sight alone, a thickness is not positive,
            or no group has its name.

    Example::

        twin = wr.interop.write_twin(field, "twin", thickness_m={"glass": 0.01})
    """
    if not isinstance(field, BistaticField):
        raise TypeError(f"field: got {type(field).__name__}, expected a field of model 'bistatic'")
    if field.effects.scatterings == 0 and field.effects.mirrors == 0:
        raise ValueError("field: it models line of sight alone, expected one with diffuse or mirror paths")
    folder = Path(folder)
    _check_replaceable(folder)
    surface = field.surface
    thickness = _thicknesses(field, thickness_m)
    # A slab: a material of one thickness, which may be unknown.
    slabs = np.column_stack([field.material, np.nan_to_num(thickness, nan=-1.0, posinf=np.inf)])
    slab = np.unique(slabs, axis=0, return_inverse=True)[1].reshape(-1)
    face_material = slab[surface.group]
    area = np.bincount(face_material, surface.mesh.areas)
    own = np.bincount(surface.group, surface.mesh.areas, minlength=surface.groups)
    used = [m for m in np.argsort(-area, kind="stable").tolist() if area[m] > 0]
    largest = {m: int(np.where(slab == m, own, -1.0).argmax()) for m in used}  # a material's name
    names = _identifiers(surface.group_names)
    groups = [
        _project(field, largest[m], names[largest[m]], float(area[m]), float(thickness[largest[m]]))
        for m in used
    ]
    half_spaces = [surface.group_names[largest[m]] for m in used if np.isnan(thickness[largest[m]])]
    left_out = _left_out(field, half_spaces)
    table = {
        "about": [ABOUT, f"Fitted to spectra at {field.frequency_hz / 1e9:g} GHz. Left out:", *left_out],
        "materials": [table_entry(group.material) for group in groups],
    }
    with folder_in_place(folder) as part:
        for m in used:
            kept, faces = np.unique(surface.mesh.faces[face_material == m], return_inverse=True)
            file = part / "meshes" / f"{names[largest[m]]}.ply"
            write_mesh(file, surface.mesh.vertices[kept], faces.reshape(-1, 3))
        write_json(part / "materials.json", table, seal=True)
        xml = _scene_xml([group.material for group in groups], field.frequency_hz)
        (part / "scene.xml").write_text(xml, encoding="utf-8")
    return Twin(folder / "scene.xml", field.frequency_hz, tuple(groups), left_out)


def project_reflection(
    log_excess: float, scattered: float, mirrored: float, thickness_wavelengths: float = np.inf
) -> Reflection:
    """The slab and the S that come nearest to what a group scatters and mirrors.

    Args:
        log_excess: ln(epsilon_r - 1) of the group's curve, clipped to the family that fields know.
        scattered: W, what it scatters of that curve; 0 for nothing.
        mirrored: m, what it mirrors of that curve; 0 for nothing.
        thickness_wavelengths: of the slab, over the wavelength; inf for a half-space.
    """
    cosine, weight, family = _slabs(thickness_wavelengths)
    curves = fresnel_curves()
    wanted_curve = curves.at(curves.curves, [log_excess])[0][0]
    gap = family - NEPER * np.log(np.interp(cosine, np.linspace(0.0, 1.0, COSINES), wanted_curve))[:, None]
    level = weight @ gap
    shape = weight @ (gap - level) ** 2
    excess = np.log(_EXCESS)
    wanted = NEPER * np.log(np.maximum([scattered, mirrored], 1e-30))
    mirror_share = 0.01  # weight of mirrored power: of a spectrum's pixels a mirror's beam fills so many
    share = np.where([scattered > 0, mirrored > 0], [1.0 - mirror_share, mirror_share], 0.0)

    def errors(x: np.ndarray, odds: np.ndarray) -> np.ndarray:
        """Mean square errors [dB^2] of scattered and mirrored power, ``(2, ...)``; ``odds`` is the logit of S^2."""
        split = [-NEPER * np.logaddexp(0.0, sign * odds) for sign in (-1.0, 1.0)]  # S^2 and 1 - S^2 in dB
        gaps = [a - b + np.interp(x, excess, level) for a, b in zip(split, wanted, strict=True)]
        return np.stack([gap**2 + np.interp(x, excess, shape) for gap in gaps])

    # Where one of the powers is none, S^2 is one or zero for certain: its logit is 40.
    certain = 40.0 if mirrored <= 0 else -40.0 if scattered <= 0 else None
    trials = np.linspace(-14.0, 14.0, 113) if certain is None else np.array([certain])
    coarse = np.tensordot(share, errors(excess[:, None], trials), axes=1)
    row, column = np.unravel_index(coarse.argmin(), coarse.shape)
    start = np.array([excess[row], trials[column]])[: 2 if certain is None else 1]

    def within(trial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The trial's ln(epsilon_r - 1), within the family, and its logit of S^2."""
        odds = trial[1] if certain is None else certain
        return np.clip(trial[0], *excess[[0, -1]]), np.asarray(odds)

    fine = {"xatol": 1e-9, "fatol": 1e-14}
    best = minimize(lambda trial: share @ errors(*within(trial)), start, method="Nelder-Mead", options=fine)
    x, odds = within(best.x)
    rms = np.sqrt(errors(x, odds))
    return Reflection(
        relative_permittivity=1.0 + float(np.exp(x)),
        scattering=float(np.exp(-0.5 * np.logaddexp(0.0, -odds))),
        scattering_error_db=float(rms[0]) if scattered > 0 else 0.0,
        mirror_error_db=float(rms[1]) if mirrored > 0 else 0.0,
    )


def project_lobes(
    exponents: Sequence[int], weight: np.ndarray, *, reciprocal: bool = False
) -> tuple[int, float]:
    """The one exponent (0: Lambertian) whose lobe, Degli-Esposti's, is nearest to a mix, and its error.

    Args:
        exponents: of the mixed lobes, 0 for Lambertian.
        weight: of each, shape ``(L,)``; their scale plays no part.
        reciprocal: whether the mixed lobes are the reciprocal ones.

    Returns:
        The exponent, and the rms difference of the lobes [dB] over cosines of incidence (evenly) and the projected
        hemisphere of scattering, both raised by :data:`LOST_IN_NOISE`.
    """
    narrowest_lobe = 60  # largest exponent that is tried
    most = max(narrowest_lobe, *exponents)
    lobes, solid_angle = _lobe_table(most, False)
    mixed = _lobe_table(most, True)[0] if reciprocal else lobes
    mix = np.asarray(weight, float) @ mixed[list(exponents)] / np.sum(weight)
    gap = NEPER * np.log((lobes + LOST_IN_NOISE) / (mix + LOST_IN_NOISE))
    error = np.sqrt(gap**2 @ solid_angle)
    best = int(error.argmin())
    return best, float(error[best])


def _thicknesses(field: BistaticField, given: float | Mapping[str, float] | None) -> np.ndarray:
    """Thickness of each group of the field [m], shape ``(G,)``: what is given, else what its scene says, else NaN."""
    names, found = field.surface.group_names, field.surface.thickness_m.copy()
    if given is None:
        return found
    for name, value in given.items() if isinstance(given, Mapping) else [(name, given) for name in names]:
        if name not in names:
            raise ValueError(f"thickness_m: got the name {name!r}, expected one of {', '.join(names)}")
        argument = f"thickness_m[{name!r}]" if isinstance(given, Mapping) else "thickness_m"
        found[names.index(name)] = value if value == np.inf else check_positive(argument, value)
    return found


def _project(field: BistaticField, g: int, name: str, area: float, thickness_m: float) -> TwinGroup:
    """What group ``g`` becomes as a slab; NaN stands for a half-space."""
    p, effects, frequency = field.parameters, field.effects, field.frequency_hz
    scattered = float(p.weight[g].sum()) if effects.scatterings else 0.0
    mirrored = float(np.exp(p.log_mirror[g])) if effects.mirrors else 0.0
    known = np.isfinite(thickness_m)
    wavelengths = thickness_m / field.wavelength_m if known else np.inf
    reflection = project_reflection(float(p.log_excess[g]), scattered, mirrored, wavelengths)
    permittivity = reflection.relative_permittivity
    alpha_r, lobe_error = LAMBERTIAN, 0.0
    if scattered > 0:
        alpha_r, lobe_error = project_lobes(p.lobes, p.weight[g], reciprocal=p.reciprocal)
    conductivity = LOSS_TANGENT * permittivity * 2.0 * np.pi * frequency * VACUUM_PERMITTIVITY
    band_share = 0.1  # a material holds this far from the carrier: it was fitted at one frequency
    low, high = (1.0 - band_share) * frequency, (1.0 + band_share) * frequency
    fitted = f"fitted at {frequency / 1e9:g} GHz"
    row = Band(low, high, permittivity, 0.0, conductivity, 0.0, fitted)
    material = Material(
        _MATERIAL + name,
        (row,),
        thickness_m=thickness_m if known else THICKNESS_WAVELENGTHS * field.wavelength_m,
        scattering=reflection.scattering,
        pattern="lambertian" if alpha_r == LAMBERTIAN else "directive",
        alpha_r=max(alpha_r, 1),
        sources={
            "thickness_m": "of the scene, or given" if known else "stands for a half-space",
            "scattering": f"{fitted}; errors {reflection.scattering_error_db:.2f} dB rms scattered, "
            f"{reflection.mirror_error_db:.2f} dB rms mirrored",
            "pattern": f"{fitted}; one lobe for the mix: {lobe_error:.2f} dB rms",
        },
    )
    return TwinGroup(
        **vars(reflection),
        name=field.surface.group_names[g],
        area_m2=area,
        material=material,
        permittivity=material.permittivity(frequency),
        thickness_m=thickness_m if known else np.inf,
        alpha_r=alpha_r,
        lobe_error_db=lobe_error,
    )


def _left_out(field: BistaticField, half_spaces: Sequence[str]) -> tuple[str, ...]:
    found, p, s = [], field.parameters, field.surface
    if half_spaces:
        found.append(
            f"what passes through {', '.join(half_spaces)}: of unknown thickness, so they let nothing through; give thickness_m"
        )
    if p.log_gain != 0.0:
        found.append(f"common gain of {NEPER * p.log_gain:.2f} dB: multiply the twin's path gain by it")
    if field.air is not None:
        loss = field.air.attenuation_db_per_m(field.frequency_hz)
        found.append(f"absorption by the air, {loss:.3g} dB/m: give it to simulate as gas")
    if field.effects.transmissions and p.log_through.any():
        share = NEPER * np.sqrt(np.mean(p.log_through**2))
        found.append(
            f"what slabs absorb as it was fitted, {share:.2f} dB rms over groups: losses are assumed"
        )
    if field.effects.diffractions:
        found.append("paths over edges: simulate has Sionna RT find none")
    if field.effects.residual:
        squares = np.average(field.residual[0] ** 2, weights=np.bincount(s.tiles.cell, s.tiles.area))
        found.append(f"residuals within groups, {NEPER * np.sqrt(squares):.2f} dB rms over area")
    if field.effects.scatterings and p.reciprocal:
        found.append("reciprocity: scattered power changes when transmitter and receiver are swapped")
    return tuple(found)


@lru_cache(maxsize=16)
def _slabs(thickness_wavelengths: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines of incidence ``(C,)``, their weights 2 cos dcos, and the family's |Gamma|^2 there [dB], ``(C, E)``.

    What both faces reflect is added in power: r + |1 - Gamma^2|^2 a^2 r / (1 - r^2 a^2), r of a face, a of one passage.
    """
    node, step = np.polynomial.legendre.leggauss(48)
    cosine = 0.5 * (1.0 + node)
    eta = (1.0 + _EXCESS) * (1.0 - 1j * LOSS_TANGENT)
    root = np.sqrt(eta - 1.0 + cosine[:, None] ** 2)
    passed = np.exp(4.0 * np.pi * min(thickness_wavelengths, THICKNESS_WAVELENGTHS) * root.imag)
    powers = []
    for face in slab_reflection(cosine[:, None], eta, np.inf, 1.0):
        power = np.abs(face) ** 2
        powers.append(power + np.abs(1.0 - face**2) ** 2 * passed**2 * power / (1.0 - (power * passed) ** 2))
    return cosine, step * cosine, NEPER * np.log(np.mean(powers, axis=0))


@lru_cache(maxsize=4)
def _lobe_table(most: int, reciprocal: bool) -> tuple[np.ndarray, np.ndarray]:
    """Lobes of exponents 0 to ``most`` at pairs of directions [1/sr], ``(most + 1, N)``, and weights that sum to 1."""
    incidence, di = np.polynomial.legendre.leggauss(10)
    scatter, ds = np.polynomial.legendre.leggauss(28)
    turn = (np.arange(28) + 0.5) * np.pi / 28  # of azimuth; the other half is the same
    ci, cs, az = np.meshgrid(0.5 * (1.0 + incidence), 0.5 * (1.0 + scatter), turn, indexing="ij", sparse=True)
    psi = ci * cs + np.sqrt((1.0 - ci**2) * (1.0 - cs**2)) * np.cos(az)
    weight = np.broadcast_to(di[:, None, None] * ds[:, None] * cs, psi.shape)
    every = [lobe(n, ci, cs, psi, reciprocal=reciprocal) for n in range(most + 1)]
    lobes = np.stack([np.broadcast_to(one, psi.shape).ravel() for one in every])
    return lobes, weight.ravel() / weight.sum()


def _identifiers(names: Sequence[str]) -> list[str]:
    """Names for files and XML: characters other than letters, digits, ``_`` and ``-`` become ``_``; all differ."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_-]", "_", name)
        while plain in found:
            plain += "_"
        found.append(plain)
    return found


def _scene_xml(materials: Sequence[Material], frequency_hz: float) -> str:
    """The scene as Sionna RT reads it: a radio material and a mesh for each group."""
    lines = [
        '<scene version="3.0.0">',
        f"  <!-- {ABOUT} Scattering patterns stand in materials.json. -->",
        "",
    ]
    for material in materials:
        values = radio_values(material, frequency_hz)
        lines += [
            f'  <bsdf type="radio-material" id="mat-{material.name}">',
            *(f'    <float name="{key}" value="{value:.9g}"/>' for key, value in values.items()),
            "  </bsdf>",
        ]
    for material in materials:
        name = material.name.removeprefix(_MATERIAL)
        lines += [
            f'  <shape type="ply" id="surface_{name}">',
            f'    <string name="filename" value="meshes/{name}.ply"/>',
            '    <boolean name="face_normals" value="true"/>',
            f'    <ref id="mat-{material.name}" name="bsdf"/>',
            "  </shape>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def _check_replaceable(folder: Path) -> None:
    """Refuse what is neither new, empty nor an earlier twin."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ValueError(f"folder: got the file {folder}, expected a folder")
    found = {item.name for item in folder.iterdir()}
    if not found:
        return
    try:
        table = read_json(folder / "materials.json")
        twin = found <= {"scene.xml", "materials.json", "meshes"} and str(table["about"][0]).startswith(ABOUT)
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        twin = False
    if not twin:
        raise ValueError(
            f"folder: {folder} holds {', '.join(sorted(found)[:5])} and is no earlier twin, expected a new or an "
            "empty folder"
        )
