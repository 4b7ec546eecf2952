"""Scenes of Sionna RT 2 in memory, from and to: objects, materials, transmitters and receivers; and its antenna arrays.

Sionna RT holds one radio material an object, in single precision, for one frequency. Materials of ITU-R P.2040 and
constant ones are read for all frequencies; one with a law of its own in Python for the frequency that the scene has.
Radio devices are positions, and the scene's array turned as each stands.

Here too is how Sionna RT and Mitsuba are imported, on an LLVM and a variant that they can use. Dr.Jit takes any LLVM on a
CPU: 15 and 16 abort the process, 14 is too old, so the choice isn't left to it.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from warprrf.checks import checked, warn
from warprrf.device import require
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.materials import Band, Material, itu_material, radio_values
from warprrf.rf.scene_parts import MaterialChoice, ScenePart
from warprrf.rf.spectra.antenna import PATTERNS, SLANTS_RAD, Antenna, as_antenna
from warprrf.rf.spectra.spectrum import directions_from_angles, pixel_directions

_FOLDERS = (
    "/usr/lib/*-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/lib/llvm-*/lib", "/opt/homebrew/opt/llvm*/lib",
)  # fmt: skip


def parts_of(rt_scene: Any, choice: MaterialChoice) -> tuple[list[ScenePart], dict[str, Any]]:
    """Objects of a ``sionna.rt.Scene``; and its transmitters, receivers and antennas by the arguments of :class:`Scene`.

    Errors and warnings are those of :meth:`Scene.from_sionna`.
    """
    rt = sionna_rt()
    if not isinstance(rt_scene, rt.Scene):
        raise TypeError(f"rt_scene: got {type(rt_scene).__name__}, expected a sionna.rt.Scene")
    if not rt_scene.objects:
        raise ValueError("rt_scene: got a scene without objects, expected surfaces")
    frequency = float(np.asarray(rt_scene.frequency).reshape(-1)[0])
    found = []
    for name, thing in rt_scene.objects.items():
        radio = thing.radio_material
        label = str(radio.name)
        label = label[4:] if label.startswith(("itu_", "itu-")) else label
        material = choice.choose(label, partial(_read, rt, radio, label, frequency))
        mesh = thing.mi_mesh
        vertices = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces_buffer(), dtype=np.int32).reshape(-1, 3)
        found.append(ScenePart(str(name), vertices, faces, material))
    devices: dict[str, Any] = {"antennas": {}}
    ends = ("transmitters", "tx_array"), ("receivers", "rx_array")
    for kind, common in ends:
        group, array = getattr(rt_scene, kind), getattr(rt_scene, common)
        devices[kind] = {str(name): _shortest(np.array(device.position)) for name, device in group.items()}
        if group and array is not None:
            try:
                own = array_from_sionna(array)
            except ValueError as error:
                text = str(error).removeprefix("rt_array: ")
                warn(f"rt_scene.{common}: {text}; it is left out")
                continue
            devices["antennas"] |= {
                str(name): replace(own, orientation=_shortest(np.array(device.orientation)))
                for name, device in group.items()
            }
    return found, devices


@checked
def array_from_sionna(rt_array: Any) -> PlanarArray:
    """A ``sionna.rt.PlanarArray`` as ours, unturned: elements, spacing, pattern and polarisation.

    Sionna's own patterns become ours of those names; any other is asked of Sionna whenever it is evaluated, in its single
    precision.

    Raises:
        TypeError: for what is no antenna array of Sionna RT.
        ValueError: for elements that do not stand in rows and columns as those of a ``PlanarArray``.
    """
    if not hasattr(rt_array, "antenna_pattern") or not hasattr(rt_array, "normalized_positions"):
        raise TypeError(f"rt_array: got {type(rt_array).__name__}, expected a sionna.rt.PlanarArray")
    place = np.array(rt_array.normalized_positions, dtype=np.float64).reshape(3, -1).T
    rows, cols = (len(np.unique(np.round(place[:, axis], 4))) for axis in (2, 1))
    sides = [
        (float(_shortest(np.ptp(place[:, axis]) / (n - 1))[0]) if n > 1 else 0.5)
        for axis, n in ((2, rows), (1, cols))
    ]
    found = PlanarArray(rows, cols, sides, pattern=_antenna(rt_array.antenna_pattern))
    if len(place) != rows * cols or np.abs(found.positions(1.0) - place).max() > 1e-4:
        raise ValueError(
            f"rt_array: got {len(place)} elements that do not stand in rows and columns about the middle, column by column "
            "from the top, expected those of a sionna.rt.PlanarArray"
        )
    return found


def _antenna(pattern: Any) -> Antenna:
    """Our antenna of a ``sionna.rt.AntennaPattern``: by name where it is everywhere the same as ours of a name."""
    live = Antenna(tuple(partial(_sionna_port, port) for port in pattern.patterns))
    towards = pixel_directions((18, 36)).reshape(-1, 3)
    fields = live.field(towards)
    for name in PATTERNS:
        for polarisation in SLANTS_RAD:
            known = Antenna(name, polarisation)
            if known.ports == live.ports and np.abs(known.field(towards) - fields).max() < 1e-4:
                return known
    return live


def _sionna_port(function: Any, zenith: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One of the functions of a ``sionna.rt.AntennaPattern`` on NumPy's arrays."""
    floats = select_variant().Float
    # where padded, directions are not known: Sionna gets some number, and what it says of it is unknown too
    known = np.isfinite(zenith)
    theta, phi = (floats(np.where(known, a, 0.0).astype(np.float32).ravel()) for a in (zenith, azimuth))

    def numbers(field: Any) -> np.ndarray:
        parts = (np.array(part, np.float64) for part in (field.real, field.imag))
        re, im = (np.broadcast_to(part, theta.numpy().shape).reshape(zenith.shape) for part in parts)
        return np.where(known, re + 1j * im, np.nan)

    along, across = function(theta, phi)
    return numbers(along), numbers(across)


def _shortest(values: Any) -> np.ndarray:
    """Single-precision values as the decimal numbers that they were most likely given as."""
    plain = np.asarray(values, dtype=np.float32).reshape(-1)
    return np.array([float(str(value)) for value in plain])


def _read(rt: Any, radio: Any, name: str, frequency: float) -> Material:
    if isinstance(radio, rt.AbsorberRadioMaterial):
        return Material.custom(name, relative_permittivity=1.0)
    if not isinstance(radio, rt.RadioMaterial):
        raise ValueError(
            f"rt_scene: material {name!r} is a {type(radio).__name__}, expected a RadioMaterial; give its values by "
            f"materials={{{name!r}: ...}}"
        )

    def value(attribute: str) -> float:
        return float(_shortest(getattr(radio, attribute))[0])

    pattern, lobe = radio.scattering_pattern, {}
    if isinstance(pattern, rt.DirectivePattern) or (
        isinstance(pattern, rt.BackscatteringPattern) and float(_shortest(pattern.lambda_)[0]) == 1.0
    ):
        lobe = {"pattern": "directive", "alpha_r": int(pattern.alpha_r)}
    elif not isinstance(pattern, rt.LambertianPattern) and value("scattering_coefficient") > 0:
        raise ValueError(
            f"rt_scene: material {name!r} scatters by {type(pattern).__name__}, expected LambertianPattern or "
            f"DirectivePattern; give what it shall be by materials={{{name!r}: ...}}"
        )
    common: dict[str, Any] = {
        "thickness_m": value("thickness"),
        "scattering": value("scattering_coefficient"),
        "xpd": value("xpd_coefficient"),
        **lobe,
    }
    if isinstance(radio, rt.ITURadioMaterial):
        return itu_material(radio.itu_type, name=name, **common)
    permittivity, conductivity = value("relative_permittivity"), value("conductivity")
    if radio.frequency_update_callback is None:
        constant = Material.custom(name, relative_permittivity=permittivity, conductivity=conductivity)
        return replace(constant, **common)
    ends = frequency * (1 - 1e-6), frequency * (1 + 1e-6)
    source = f"a law in Python of Sionna RT's material, at {frequency / 1e9:g} GHz"
    return Material(name, (Band(*ends, permittivity, 0.0, conductivity, 0.0, source),), **common)


def to_sionna_scene(
    parts: Sequence[ScenePart],
    transmitters: Mapping[str, np.ndarray],
    receivers: Mapping[str, np.ndarray],
    antennas: Mapping[str, PlanarArray],
    frequency_hz: float,
) -> Any:
    """A ``sionna.rt.Scene`` of these objects, devices and antennas; see :meth:`Scene.to_sionna`."""
    rt = sionna_rt()
    mi = select_variant()
    err_m = max(np.abs(part.vertices - part.vertices.astype(np.float32)).max() for part in parts)
    if err_m > 1e-3:
        warn(
            f"scene: Sionna RT's single precision moves its vertices by {err_m:.2g} m; expected an origin near by"
        )
    taken = {*transmitters, *receivers}  # Sionna's objects, materials and devices share one set of names

    def free(name: str, end: str) -> str:
        while name in taken:
            name += end
        taken.add(name)
        return name

    names = [free(part.name.replace(".", "_"), "_") for part in parts]  # Mitsuba parts its paths by dots
    materials = {id(part.material): part.material for part in parts}
    radio = {
        key: _radio_material(rt, one, free(one.name, "-material"), frequency_hz)
        for key, one in materials.items()
    }
    shapes: dict[str, Any] = {"type": "scene"}
    for part, name in zip(parts, names, strict=True):
        properties = mi.Properties()
        properties.set_id(name)
        properties["face_normals"] = True
        mesh = mi.Mesh(name, len(part.vertices), len(part.faces), props=properties)
        values = mi.traverse(mesh)
        values["vertex_positions"] = np.ravel(part.vertices).astype(np.float32)
        values["faces"] = np.ravel(part.faces).astype(np.uint32)
        values.update()
        mesh.set_bsdf(radio[id(part.material)])
        shapes[name] = mesh
    scene = rt.Scene(mi.load_dict(shapes, optimize=False))
    scene.frequency = frequency_hz
    for key, material in materials.items():  # not before: a new scene has Sionna's default frequency
        _follow_frequency(radio[key], material)
    ends = (rt.Transmitter, transmitters, "tx_array"), (rt.Receiver, receivers, "rx_array")
    for kind, places, common in ends:
        for name, position in places.items():
            turn = antennas[name].rotation if name in antennas else np.eye(3)
            angles = Rotation.from_matrix(turn).as_euler("ZYX").tolist()
            scene.add(kind(name, position=np.asarray(position, float).tolist(), orientation=angles))
        own = [antennas[name] for name in places if name in antennas]
        if own and (array := _common_array(rt, own, common)) is not None:
            setattr(scene, common, array)
    return scene


def _common_array(rt: Any, arrays: Sequence[PlanarArray], common: str) -> Any:
    """The array of Sionna's that ``arrays`` are, each turned; None, with a warning, where there is none."""
    plain = [as_antenna(a.pattern, a.polarisation) for a in arrays]
    if not all(antenna.polarised for antenna in plain):
        why = "got an antenna without polarisation, which Sionna RT's need"
    elif len({_told_apart(*pair) for pair in zip(arrays, plain, strict=True)}) > 1:
        why = "got antennas that differ in more than their orientation, and Sionna RT has one array for all"
    else:
        return rt.AntennaArray(_sionna_pattern(rt, plain[0]), _unturned(arrays[0]).T.tolist())
    warn(f"antennas: {why}; {common} is left to be set")
    return None


def _unturned(array: PlanarArray) -> np.ndarray:
    """Elements in wavelengths, in the array's own axes, shape ``(N, 3)``."""
    return array.positions(1.0) @ array.rotation


def _told_apart(array: PlanarArray, element: Antenna) -> bytes:
    """Equal for arrays that differ in orientation alone."""
    fields = np.asarray(element.field(pixel_directions((45, 90))), complex)
    return bytes(np.round(_unturned(array), 9) + 0.0) + bytes(fields)


def _sionna_pattern(rt: Any, antenna: Antenna) -> Any:
    """A ``sionna.rt.AntennaPattern`` of an antenna: its fields at zeniths and azimuths half a degree apart, between which they
    are interpolated."""
    mi, dr = select_variant(), require("drjit", extra="sionna")
    rows, columns = 361, 721
    zenith, azimuth = np.linspace(0.0, np.pi, rows), np.linspace(-np.pi, np.pi, columns)
    fields = antenna.field(directions_from_angles(*np.meshgrid(zenith, azimuth, indexing="ij")))

    def port(field: np.ndarray) -> Any:
        parts = np.concatenate([np.real(field), np.imag(field)], axis=-1).astype(np.float32)
        table = mi.Texture2f(mi.TensorXf(parts), wrap_mode=dr.WrapMode.Clamp, use_accel=False)

        def towards(theta: Any, phi: Any) -> Any:
            row, column = theta / np.pi * (rows - 1), (phi / (2.0 * np.pi) + 0.5) * (columns - 1)
            # texels have their centres half a texel from the edges
            along, across, *imaginary = table.eval(mi.Point2f((column + 0.5) / columns, (row + 0.5) / rows))
            return mi.Complex2f(along, imaginary[0]), mi.Complex2f(across, imaginary[1])

        return towards

    class Sampled(rt.AntennaPattern):
        def __init__(self) -> None:
            self.patterns = [port(field) for field in fields]

    return Sampled()


def _radio_material(rt: Any, material: Material, name: str, frequency: float) -> Any:
    directive = material.pattern == "directive"
    # Largest exponent of a lobe that Sionna RT can normalise: it divides by 2^alpha_r in single precision
    narrowest_sionna_lobe = 127
    if directive and material.alpha_r > narrowest_sionna_lobe:
        raise ValueError(
            f"material {material.name!r}: alpha_r is {material.alpha_r}, but in Sionna's single precision a lobe of more "
            f'than {narrowest_sionna_lobe} scatters nothing; take engine="exact" or a wider lobe'
        )
    if not np.isfinite(material.thickness_m):
        raise ValueError(f"material {material.name!r}: Sionna knows no infinite slab; give a thickness")
    if material.reciprocal and material.scattering_coefficient(frequency) > 0:
        raise ValueError(
            f"material {material.name!r}: it scatters reciprocally, Sionna RT's patterns do not; set reciprocal=False to "
            'take its lobe of the same width, or use engine="exact"'
        )
    radio = rt.RadioMaterial(name, **radio_values(material, frequency))
    radio.scattering_pattern = (
        rt.DirectivePattern(alpha_r=int(material.alpha_r)) if directive else rt.LambertianPattern()
    )
    return radio


def _follow_frequency(radio: Any, material: Material) -> None:
    """Let Sionna's material take our values whenever its scene's frequency is set."""

    def law(frequency: Any) -> tuple[float, float]:
        hertz = float(np.asarray(frequency).reshape(-1)[0])
        radio.scattering_coefficient = material.scattering_coefficient(hertz)
        return material.relative_permittivity(hertz), material.conductivity(hertz)

    radio.frequency_update_callback = law


def installed_llvm() -> dict[int, Path]:
    """The LLVM shared libraries found, by major version."""
    found: dict[int, Path] = {}
    for folder in _FOLDERS:
        for name in sorted(glob.glob(f"{folder}/libLLVM*")):
            version = re.search(r"libLLVM[-.](?:so\.)?(\d+)[\d.]*(?:\.so|\.dylib)?(?:[\d.]*)$", name)
            if version:
                found.setdefault(int(version.group(1)), Path(name).resolve())
    return found


@checked
def select_llvm() -> Path | None:
    """Point Dr.Jit at the newest LLVM of at least 17 before it is first imported; returns it.

    A ``DRJIT_LIBLLVM_PATH`` that is already set stays. None where no version is installed that Dr.Jit could take by
    mistake either (it may run on a GPU).

    Raises:
        ImportError: if only versions are installed that would abort the process.
    """
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return Path(chosen)
    found = installed_llvm()
    # Oldest LLVM whose code generator has what Dr.Jit 1.5 asks for ("Cannot select ... fminimum" before)
    min_llvm = 17
    usable = [version for version in found if version >= min_llvm]
    if usable:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(found[max(usable)])
        return found[max(usable)]
    if found:
        versions = ", ".join(str(v) for v in sorted(found))
        raise ImportError(
            f"Dr.Jit needs LLVM {min_llvm} or newer, but only {versions} is installed and would abort the process: "
            "apt-get install libllvm19 (Debian, Ubuntu), or set DRJIT_LIBLLVM_PATH"
        )
    return None


def sionna_rt() -> Any:
    """Sionna RT, on a variant of Mitsuba and an LLVM that it can use."""
    select_llvm()
    select_variant()
    return require("sionna.rt", extra="sionna")


def select_variant() -> Any:
    """Mitsuba, on a variant for radio: it may be on another, for photos, and Sionna needs the one of its import."""
    mitsuba = require("mitsuba", extra="sionna")
    if mitsuba.variant() is None or not mitsuba.variant().endswith("mono_polarized"):
        mitsuba.set_variant("cuda_ad_mono_polarized", "llvm_ad_mono_polarized")
    return mitsuba
