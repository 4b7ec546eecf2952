"""A working example of every public function, class and method: what is mutated is one or two of its arguments.

Names are found in the stubs that make up the public surface, and arguments in signatures: an example takes them from the
place by their names, where :data:`EXAMPLES` says nothing else. Arguments with a default are mutated too.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import warprrf as wr
from fuzz.place import POINTS, READINGS, TOWARDS, Place
from warprrf.rf.fields import BistaticField, HarmonicField
from warprrf.rf.fields.bistatic.options import FitOptions
from warprrf.rf.fields.harmonic.fitting import FieldOptions

IGNORED = ("progress", "ax", "client")
"""Arguments that are not mutated unless an example names them: a caller's own functions, matplotlib's axes."""
UNCHECKED = ("trace_links", "path_gains", "check_positions")
"""Methods that are given what others checked or made, or that every verb asks."""
PARTS = {"transformed": ("means", "vertices", "world_to_camera")}
"""What else a refusal may name: parts of what a method makes."""
FIELDS = (BistaticField, FitOptions, HarmonicField, FieldOptions)
"""What a fit makes and takes, which is documented and not of the package's table of contents."""
OPTIONS_OF = ("FitOptions", "FieldOptions")
"""Classes whose options are what is public of them."""
SERVERS = ("view",)
"""What starts a server for each call: tests/viewer has its refusals."""
SPREADS = ("channel.angular_spread", "channel.coherence_bandwidth", "channel.delay_spread")
"""What is NaN where there is no power, as their documentation says."""
ABSTRACT = ("RadioField", "BistaticField", "HarmonicField", "paths.SpecularPaths", "paths.PathValues")
"""Classes that nobody makes by calling them."""
REFUSED = (
    "Paths.from_sionna",
    "interop.array_from_sionna",
    "Scene.from_sionna",
    "interop.load_sionna_scene",
    "reconstruct",
    "HarmonicField.suggest",
    "HarmonicField.locate",
)
"""What is refused without any change: it asks for objects or files of other programs, for photos of a place, or a
bistatic field."""


def public() -> dict[str, Callable[..., Any]]:
    """Every public function, class and method, by its name: ``Mesh``, ``Mesh.cast``, ``channel.thz_channel``."""
    found: dict[str, Callable[..., Any]] = {}
    homes: set[Any] = set()
    for name, value in [*_names(wr, ""), *((kind.__name__, kind) for kind in FIELDS)]:
        if not callable(value) or value in homes or name in SERVERS:
            continue
        homes.add(value)
        if name not in ABSTRACT:
            found[name] = value
        for method in _methods(value) if inspect.isclass(value) and name not in OPTIONS_OF else ():
            if method not in UNCHECKED and not (name == "BistaticField" and hasattr(wr.RadioField, method)):
                found[f"{name}.{method}"] = getattr(value, method)
    return found


def _methods(kind: type) -> Iterator[str]:
    """Public methods of a class, inherited ones from this package too."""
    for name in (n for n in dir(kind) if not n.startswith("_") and callable(getattr(kind, n))):
        home = next(base for base in kind.__mro__ if name in vars(base))
        if home.__module__.startswith("warprrf"):
            yield name


def _names(module: ModuleType, prefix: str) -> Iterator[tuple[str, Any]]:
    """Public names of a module: those of its stub, or those it defines itself."""
    stub = Path(str(module.__file__)).with_suffix(".pyi")
    if stub.is_file():
        names = re.findall(r"^from \S+ import \w+ as (\w+)$", stub.read_text(encoding="utf-8"), re.MULTILINE)
    else:
        names = [n for n, v in vars(module).items() if getattr(v, "__module__", None) == module.__name__]
    for name in (n for n in names if not n.startswith("_")):
        value = getattr(module, name)
        if inspect.ismodule(value):
            yield from _names(value, f"{name}.")
        elif getattr(value, "__module__", "").startswith("warprrf"):
            yield prefix + name, value


def signature(name: str) -> Iterator[inspect.Parameter]:
    """Arguments of a public call; a field's methods are those of the bistatic one that is asked."""
    method = name.removeprefix("RadioField.")
    call = public()[name]
    if method != name and inspect.isfunction(call):
        call = getattr(wr.RadioField.models["bistatic"], method)
    yield from inspect.signature(call).parameters.values()


def example(name: str, place: Place) -> dict[str, Any]:
    """Arguments of a public call: its own, those of its options, those that the place has by their names.

    A method is called on the object of its class; a class is given what that object holds.
    """
    owner, _, method = name.rpartition(".")
    known = f"RadioField.{method}" if name not in EXAMPLES and owner == "HarmonicField" else name
    given = dict(EXAMPLES.get(known, lambda p: {})(place))
    for one in signature(name):
        if one.name in given:
            continue
        if one.kind == one.VAR_KEYWORD:
            given |= OPTIONS.get(one.name, {}) if name not in EXAMPLES else {}
        elif one.name == "self":
            given["self"] = CLASSES[owner](place)
        elif name in CLASSES and (known := getattr(CLASSES[name](place), one.name, None)) is not None:
            given[one.name] = known
        elif one.default is one.empty and one.kind != one.VAR_POSITIONAL:
            own = place.uploaded if owner == "splats.Rasterizer" else {}
            given[one.name] = own.get(one.name) or getattr(place, ALIASES.get(one.name, one.name))
    return given


def parameters(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a public call that are mutated, with their value in the example or by default."""
    kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    by_default = {p.name: p.default for p in signature(name) if p.kind not in kinds and p.name not in IGNORED}
    return {k: v for k, v in (by_default | dict(given)).items() if k != "self"}


def call(name: str, arguments: Mapping[str, Any]) -> Any:
    """What a public call answers."""
    given = dict(arguments)
    target = public()[name]
    if "self" in given:
        target = getattr(given.pop("self"), name.rsplit(".", 1)[1])
    return target(**given)


ALIASES = {
    "mesh_or_scene": "scene", "rt_scene": "scene", "geometry": "scene", "g": "gaussians", "cam": "camera", "ds": "train",
    "source": "paths", "tx_array": "codebook", "rx_array": "array", "transmitters": "transmitter", "folder": "home",
}  # fmt: skip
"""Arguments with other names than the place has for what they are given."""

LINK = {"wave": "plane", "squint": True, "diffuse": "power", "seed": 0, "normalize_delays": False}
OPTIONS: dict[str, dict[str, Any]] = {
    "link": LINK,
    "response": {"diffuse": "power"},
    "settings": {"frequency_hz": 300e9, "floor": 1e-14},
}
"""Options that calls take by name, by what their signature calls these."""

BAND = wr.em.Band(1e9, 1e12, 5.0, 0.0, 0.01, 0.9)
CLASSES: dict[str, Callable[[Place], Any]] = {
    "Material": lambda p: p.scene.materials[0],
    "Air": lambda p: wr.Air(),
    "Effects": lambda p: wr.Effects(),
    "Spectrum": lambda p: p.spectra[0],
    "SpectrumDataset": lambda p: p.spectra.subset([0, 1, 2]),
    **{f"{kind}Field": lambda p: p.field for kind in ("Radio", "Bistatic")},
    "HarmonicField": lambda p: p.harmonic,
    "paths.SpecularPaths": lambda p: wr.paths.trace_specular(
        p.scene, transmitter=p.transmitter, receivers=POINTS, frequency_hz=300e9
    ),
    "FitOptions": lambda p: FitOptions(),
    "FieldOptions": lambda p: FieldOptions(),
    "Antenna": lambda p: replace(wr.horn(0.3), polarisation="VH"),
    "PlanarArray": lambda p: wr.PlanarArray(2, 3, polarisation="VH"),
    "RadioMap": lambda p: p.map,
    "channel.ArraySpectra": lambda p: wr.channel.ArraySpectra(
        p.transmitter, POINTS, np.full((3, 2), 0.5), 300e9, p.array, TOWARDS
    ),
    "channel.BeamChoice": lambda p: wr.channel.select_beams(p.paths, p.codebook, p.array),
    "channel.Dispersion": lambda p: p.paths.dispersion(),
    "channel.MultiUserChoice": lambda p: wr.channel.select_beams_multiuser(
        p.sources, p.codebook, p.array, noise=1e-12
    ),
    "channel.PlaneWaveError": lambda p: wr.channel.plane_wave_error(p.array, 3.0, 1e-3),
    "channel.ThzChannel": lambda p: wr.channel.thz_channel(1),
    "em.Band": lambda p: BAND,
    "interop.SionnaPaths": lambda p: p.paths.to_sionna(),
    "interop.Twin": lambda p: wr.interop.Twin(Path("scene.xml"), 300e9, (), ()),
    "splats.Blending": lambda p: wr.splats.Blending(),
    "splats.BlendWeights": lambda p: wr.splats.blend_weights(p.gaussians, p.camera, top_k=4),
    "splats.GaussianRays": lambda p: wr.splats.GaussianRays(p.gaussians, device=p.device),
    "splats.Rasterizer": lambda p: p.raster,
    "lookups.Lookup": lambda p: wr.lookups.nearest(p.train),
}
CLASSES |= {
    name: attrgetter(name.rpartition(".")[2].lower())
    for name in "Camera Gaussians Mesh Reconstruction Scene Readings Relevance Paths channel.Codebook".split()
}
"""An object of every public class."""

EXAMPLES: dict[str, Callable[[Place], dict[str, Any]]] = {
    # verbs
    "reconstruct": lambda p: {
        "photos": p.folder / "photos", "workspace": "room", "known_positions": {"0.png": [0.0, 0.0, 0.0]}, "iterations": 1,
    },
    "render": lambda p: {"features": np.ones((len(p.gaussians), 2))},
    "simulate": lambda p: {
        "receivers": p.receivers[:2], "shape": (12, 24), "beam_sigma_rad": 0.2, "roles": ["train", "test"], "floor": 1e-14,
        "client": None,
    },
    "relevance": lambda p: {
        "geometry": p.field, "receivers": p.receivers[:2], "transmitter": p.transmitter, "frequency_hz": 300e9,
    },
    "evaluate": lambda p: {"predict": wr.lookups.nearest(p.train)},
    # geometry
    "Camera.pinhole": lambda p: {
        "width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0, "world_to_camera": np.eye(4),
    },
    "Camera.resized": lambda p: {"width": 8, "height": 6},
    "Camera.spherical": lambda p: {"width": 8, "height": 4},
    "Gaussians.load_ply": lambda p: {"path": p.folder / "splats.ply"},
    "Mesh.load": lambda p: {"path": p.folder / "walls.ply", "unit": "m", "up": "z", "simplify": 20},
    "Reconstruction.from_files": lambda p: {"ply": p.folder / "splats.ply", "mesh": p.mesh},
    "Reconstruction.load": lambda p: {"folder": p.folder / "reconstruction"},
    "Reconstruction.aligned": lambda p: {
        "self": p.filmed, "known_positions": {name: c.position for name, c in p.filmed.cameras.items()},
    },
    "Reconstruction.report": lambda p: {"path": "report.html"},
    "Scene.to_sionna": lambda p: {"frequency_hz": 300e9},
    "Scene.load": lambda p: {"path": p.folder / "scene.xml"},
    # materials and air
    "Material.custom": lambda p: {"name": "stone", "relative_permittivity": 5.0},
    "Air.from_attributes": lambda p: {"attributes": wr.Air().attributes},
    "em.Band.widened": lambda p: {"low_hz": 1e8, "high_hz": 1e9},
    "em.load_materials": lambda p: {"path": p.folder / "materials.json"},
    "em.lobe": lambda p: {"alpha_r": 4, "cos_incidence": 0.5, "cos_scatter": 0.5, "cos_to_mirror": 0.9},
    # measurements
    "Readings.from_table": lambda p: {
        "table": {
            **{f"{end}_{axis}": np.full(3, float(v)) for end, at in (("tx", p.transmitter), ("rx", POINTS[0]))
               for axis, v in zip("xyz", at, strict=True)},
            "power_db": np.array([-80.0, -90.0, -100.0]),
        },
        "frequency_hz": 300e9, "floor": 1e-14,
    },
    "Readings": lambda p: READINGS,
    "Readings.load": lambda p: {"path": p.folder / "readings.csv", "frequency_hz": 300e9, "floor": 1e-14},
    "channel.ArraySpectra.load": lambda p: {"path": p.folder / "pictures", "part": "train"},
    "SpectrumDataset.deembed": lambda p: {
        "self": p.train.subset([0]), "pattern": np.cos(np.linspace(0, np.pi / 2, 19)) ** 8, "iterations": 20,
        "snapshots": 1, "tolerance": 1e-2,
    },
    "SpectrumDataset.empty": lambda p: {"shape": (12, 24), "beam_sigma_rad": 0.1, "floor": 1e-15},
    "SpectrumDataset.export_exr": lambda p: {"path": "one.exr"},
    "SpectrumDataset.from_paths": lambda p: {"paths": p.paths, "shape": (12, 24), "beam_sigma_rad": 0.1},
    "SpectrumDataset.from_spectra": lambda p: {
        name: getattr(p.train, name)
        for name in ("receivers", "path_gain", "delay_s", "aod", "beam_sigma_rad", "line_of_sight", "engine", "floor")
    },
    "SpectrumDataset.load": lambda p: {"path": p.folder / "spectra.nc"},
    "Spectrum.stack": lambda p: {"spectra": [p.spectra[0], p.spectra[1]]},
    "SpectrumDataset.split": lambda p: {"self": p.spectra},
    # fields
    "BistaticField.array_spectrum": lambda p: {"receivers": POINTS[0], "transmitter": p.transmitter + 0.1},
    "BistaticField.at_frequency": lambda p: {"frequency_hz": 140e9},
    "BistaticField.with_objects": lambda p: {
        "objects": {"box": wr.Mesh(p.mesh.vertices * 0.05 + POINTS[0], p.mesh.faces)}, "materials": {"box": "skin"},
    },
    "RadioField.fit": lambda p: {
        "effects": wr.Effects(mirrors=1, residual=False), "lobes": (0, 4), "sub_pixels": 1, "device": p.device,
        "relevance": p.relevance,
    },
    "BistaticField.view": lambda p: {"receivers": POINTS[0]},
    "HarmonicField.load": lambda p: {"path": p.folder / "harmonic.safetensors"},
    "HarmonicField.fit": lambda p: {"model": "rf3dgs+", "iterations": 2},
    "RadioField.cfr": lambda p: {
        "frequencies_hz": [300e9], "diffuse": "power", "max_paths": 20, "client": None,
    },
    "RadioField.spectra": lambda p: {"client": None},
    "RadioField.links": lambda p: {"shape": (8, 16), "client": None},
    "RadioField.load": lambda p: {"path": p.folder / "bistatic.safetensors", "device": p.device},
    "RadioField.on_grid": lambda p: {"shape": (8, 16)},
    "RadioField.paths": lambda p: {"client": None},
    "RadioField.radio_map": lambda p: {"cell": 1.0},
    "RadioField.spectrum": lambda p: {"transmitter": p.transmitter + 0.1, "shape": (8, 16)},
    "RadioField.suggest": lambda p: {
        "n": 1, "arrival": np.full((len(POINTS), 2), 1.5), "receive_pattern": np.linspace(1.0, 0.1, 19),
    },
    "RadioMap.load": lambda p: {"path": p.folder / "map.nc"},
    "RadioMap.picture": lambda p: {"path": "map.png"},
    "Relevance.load": lambda p: {"path": p.folder / "relevance.json"},
    # channels
    "Antenna": lambda p: {"pattern": "dipole", "polarisation": "V", "orientation": (0.1, 0.2, 0.3)},
    "Antenna.from_grid": lambda p: {
        "zenith": np.linspace(0.0, np.pi, 7), "azimuth": np.linspace(-np.pi, np.pi, 12, endpoint=False), "gain": np.ones((7, 12)),
    },
    "Antenna.load": lambda p: {"path": p.folder / "sector.msi"},
    "Antenna.gain": lambda p: {"directions": TOWARDS},
    "Antenna.field": lambda p: {"directions": TOWARDS},
    "Antenna.gain_off_boresight": lambda p: {"angle": np.array([0.0, 0.3])},
    "Antenna.turned": lambda p: {"orientation": (0.1, 0.2, 0.3)},
    "paths.SpecularPaths.evaluate": lambda p: {
        "transmitter": p.transmitter + 1e-3, "receivers": POINTS + 1e-3, "transmitter_orientation": (0.1, 0.2, 0.3),
        "receiver_orientation": (0.1, 0.2, 0.3), "thickness_m": np.full(len(p.scene.materials), 0.1),
        "relative_permittivity": np.full(len(p.scene.materials), 5.0), "scattering": np.zeros(len(p.scene.materials)),
    },
    "paths.trace_specular": lambda p: {"receivers": POINTS},
    "paths.retraced_slope": lambda p: {"answer": lambda at: at.sum(axis=1)},
    "RadioField.slope": lambda p: {"receivers": POINTS[0], "quantity": "total", "step_m": 0.01},
    "Paths.after": lambda p: {"time_s": 1e-3, "doppler_hz": p.paths.doppler_hz(receiver_velocity=[1.0, 0.0, 0.0])},
    "Paths.doppler_hz": lambda p: {
        "transmitter_velocity": [1.0, 0.0, 0.0], "moving": {p.scene.object_names[0]: (0.0, 1.0, 0.0)}, "scene": p.scene,
    },
    "interop.array_from_sionna": lambda p: {"rt_array": "not of Sionna"},
    "Paths.as_several": lambda p: {"self": p.paths.row(0)},
    "Paths.cfr": lambda p: {"frequencies_hz": 300e9 + np.linspace(-1e9, 1e9, 8), **LINK},
    "Paths.concatenate": lambda p: {"parts": [p.paths.row(0), p.paths.row(0)]},
    "Paths.diffuse_power": lambda p: {"tx_array": p.array},
    "Paths.from_points": lambda p: {
        "receiver": POINTS[1], "vertices": np.array([[[2.0, 2.0, 3.0]]]), "amplitude": np.array([0.5 + 0.1j]),
        "kind": np.array(["mirror"]),
    },
    "Paths.from_sionna": lambda p: {"paths": "not of Sionna"},
    "Paths.load": lambda p: {"path": p.folder / "paths.nc"},
    "Paths.row": lambda p: {"receiver": 1},
    "Paths.select": lambda p: {"self": p.paths.row(0), "chosen": np.array([0, 1])},
    "Paths.stack": lambda p: {"parts": [p.paths.row(0), p.paths.row(1)]},
    "Paths.taps": lambda p: {"bandwidth_hz": 1e9, "l_min": -2, "l_max": 40, **LINK},
    "Paths.to_sionna": lambda p: {"tx_array": p.array},
    "channel.Codebook.received": lambda p: {"channel": np.ones((4, 4), complex)},
    "channel.Codebook.superposed": lambda p: {"gains": np.array([1e-5, 1e-5j])},
    "channel.beam_gains": lambda p: {"tx_array": p.codebook, "rx_array": p.array},
    "channel.precoded_sinr": lambda p: {"weights": np.ones((2, 4), complex) / 2},
    "channel.select_beams": lambda p: {"tx_array": p.codebook, "rx_array": p.array},
    "channel.select_beams_multiuser": lambda p: {"tx_array": p.codebook, "rx_array": p.array, "noise": 1e-12},
    "channel.signal_over_interference": lambda p: {
        "gains": [np.ones((2, 4)), np.ones((2, 4))], "rx": np.array([0, 1]),
    },
    "channel.steering_codebook": lambda p: {"directions": TOWARDS},
    "channel.transmit_covariance": lambda p: {"rx_array": p.array, "rx": np.zeros(3, int)},
    # interop
    "interop.SionnaPaths.cfr": lambda p: {"frequencies": np.linspace(-1e9, 1e9, 8)},
    "interop.SionnaPaths.taps": lambda p: {"bandwidth": 1e9, "l_min": -2, "l_max": 20},
    "interop.load_sionna_scene": lambda p: {"scene": "missing.xml"},
    "interop.write_twin": lambda p: {"folder": "twin"},
    "interop.write_deepmimo": lambda p: {"scene": p.scene},
    # metrics
    "metrics.angle_deg": lambda p: {"a": TOWARDS, "b": TOWARDS[::-1].copy()},
    "metrics.rmse_db": lambda p: {"prediction_db": p.path_gain - 100, "truth_db": p.path_gain - 90},
    "metrics.unit_image": lambda p: {"floor": 1e-14, "range_db": (-140.0, -70.0)},
}  # fmt: skip
"""What calls are given in place of what the place has by the names of their arguments."""
