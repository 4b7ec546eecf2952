"""A working call of every public function, class and method: what is mutated is one or two of its arguments.

Names are found in the stubs that make up the public surface, so that a new one is missed here by a test. Arguments with
a default are mutated too, whether an example names them or not.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

import warprrf as wr
from benchmarks.fuzz.place import CARRIER, SHAPE, SIGMA, TRANSMITTER, Place

WAVELENGTH = 1e-3
IGNORED = ("self", "progress", "ax", "args", "kwargs")
"""Arguments that are not mutated: what a caller's own function does is the caller's, and axes are matplotlib's."""

MISSING = inspect.Parameter.empty
UNCHECKED = ("RadioField.trace_links",)
"""What ``RadioField.links`` and ``radio_map`` give positions that they checked; these two are fuzzed."""
BISTATIC = ("array_spectrum", "at_frequency")
"""Methods that a bistatic field has beside those of every ``RadioField``."""
SERVERS = ("view",)
"""What starts a server for each call: tests/viewer has its refusals."""
SPREADS = ("channel.angular_spread", "channel.coherence_bandwidth", "channel.delay_spread")
"""What is NaN where there is no power, as their documentation says."""
ABSTRACT = ("RadioField",)
"""Classes that nobody makes by calling them."""


def public() -> dict[str, Callable[..., Any]]:
    """Every public function, class and method, by its name: ``Mesh``, ``Mesh.cast``, ``channel.thz_channel``."""
    found: dict[str, Callable[..., Any]] = {}
    homes: dict[Any, str] = {}
    for name, value in _names(wr, ""):
        if not callable(value) or value in homes or name in SERVERS:
            continue
        homes[value] = name
        if not inspect.isclass(value):
            found[name] = value
            continue
        if name not in ABSTRACT:
            found[name] = value
        for method in vars_of(value):
            if callable(getattr(value, method)) and f"{name}.{method}" not in UNCHECKED:
                found[f"{name}.{method}"] = getattr(value, method)
    of_bistatic = wr.RadioField.models["bistatic"]
    return found | {f"RadioField.{method}": getattr(of_bistatic, method) for method in BISTATIC}


def vars_of(kind: type) -> Iterator[str]:
    """Public attributes of a class, inherited ones from this package too."""
    for name in dir(kind):
        if name.startswith("_"):
            continue
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


def parameters(name: str, example: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a public call that are mutated, with their value in the example or by default."""
    found = {}
    for one in inspect.signature(public()[name]).parameters.values():
        if one.name in IGNORED or one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL):
            continue
        found[one.name] = example.get(one.name, one.default)
    return found | {k: v for k, v in example.items() if k not in IGNORED}


def call(name: str, arguments: Mapping[str, Any]) -> Any:
    """What a public call answers."""
    given = dict(arguments)
    target = public()[name]
    if "self" in given:
        target = getattr(given.pop("self"), name.rsplit(".", 1)[1])
    return target(**given)


def _field_of(paths: wr.Paths) -> dict[str, Any]:
    return {name: getattr(paths, name) for name in paths.__dataclass_fields__}


def _readings(p: Place) -> dict[str, Any]:
    return {
        "transmitters": TRANSMITTER,
        "receivers": POINTS[0],
        "power": np.array([1e-8, 1e-9, 1e-10]),
        "frequency_hz": CARRIER,
        "floor": 1e-14,
        "arrival": np.array([[1.5, 0.0], [1.5, 1.0], [1.5, 2.0]]),
        "receive_pattern": np.linspace(1.0, 0.0, 19),
        "std_db": 1.0,
    }


def _array_spectra(p: Place) -> dict[str, Any]:
    return {
        "transmitters": TRANSMITTER,
        "receivers": POINTS,
        "power": np.full((len(POINTS), 2), 0.5),
        "frequency_hz": CARRIER,
        "array": p.array,
        "directions": np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]),
    }


def _spectra(p: Place) -> dict[str, Any]:
    ds = p.train.subset([0, 1, 2])
    return {name: getattr(ds, name) for name in ds.__dataclass_fields__}


def _with_nan(values: np.ndarray) -> np.ndarray:
    """``values``, one of which is not known."""
    found = values.copy()
    found.flat[0] = np.nan
    return found


def _warp(p: Place) -> dict[str, Any]:
    """Parameters of Gaussians on the device, and colours."""
    raster = wr.Rasterizer(device="cpu")
    means, quaternions, scales, opacities = raster.upload(p.gaussians)
    sh = wp.array(p.gaussians.sh, dtype=float, device="cpu")
    features = raster.colors(means, sh, p.camera)
    return {
        "raster": raster, "means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities,
        "sh": sh, "features": features, "out": wp.zeros_like(features, requires_grad=True),
        "origin": wp.array([p.camera.position], dtype=wp.vec3, device="cpu"),
        "prepared": raster.prepare(means, quaternions, scales, opacities, p.camera),
    }  # fmt: skip


def _raster(*names: str, **more: Any) -> Callable[[Place], dict[str, Any]]:
    def example(p: Place) -> dict[str, Any]:
        known = _warp(p)
        return {"self": known["raster"], **{name: known[name] for name in names}, **more}

    return example


def _rays(**more: Any) -> Callable[[Place], dict[str, Any]]:
    start = np.array([[1.0, 1.0, 1.5], [4.0, 3.0, 1.0]])
    given = {"origins": start, "directions": np.array([[1.0, 0.2, 0.1], [0.0, 0.0, -1.0]])} | more
    return lambda p: {"self": wr.GaussianRays(p.gaussians, device="cpu"), **given}


def _ends(**more: Any) -> Callable[[Place], dict[str, Any]]:
    ends = {"a": np.array([[1.0, 1.0, 1.5]]), "b": np.array([[4.0, 3.0, 1.0]])}
    return lambda p: {"self": wr.GaussianRays(p.gaussians, device="cpu"), **ends, **more}


def _on(make: Callable[[Place], Any], **more: Any) -> Callable[[Place], dict[str, Any]]:
    return lambda p: {"self": make(p), **more}


def _image(p: Place) -> np.ndarray:
    return np.asarray(p.spectra.path_gain[0], dtype=float)


def _unit(p: Place) -> np.ndarray:
    return wr.metrics.unit_image(_image(p), p.spectra.floor, p.spectra.range_db)


def _sources(**more: Any) -> Callable[[Place], dict[str, Any]]:
    return lambda p: {"tx_array": p.codebook, "rx_array": p.array, **more, "sources": list(p.paths.each())}


POINTS = np.array([[1.0, 1.0, 1.5], [4.0, 3.0, 1.0], [1.0, 3.0, 2.0]])
ANGLES = np.linspace(0.3, 2.5, 5)
TOWARDS = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
POWERS = np.array([1e-9, 2e-9, 5e-10, 1e-10, 0.0])
CUSTOM = {"relative_permittivity": 5.0}
BANDS = (wr.em.Band(1e9, 1e12, 5.0, 0.0, 0.01, 0.9),)
LINK = {"wave": "plane", "squint": True, "diffuse": "power", "seed": 0, "normalize_delays": False}
TRACE = {"transmitter": TRANSMITTER, "frequency_hz": CARRIER}
MATERIAL = _on(lambda p: p.scene.materials[0], frequency_hz=CARRIER)
AIR = _on(lambda p: wr.Air(), frequency_hz=CARRIER)

EXAMPLES: dict[str, Callable[[Place], dict[str, Any]]] = {
    # verbs
    "reconstruct": lambda p: {
        "photos": p.folder / "photos", "workspace": "room", "known_positions": {"0.png": [0.0, 0.0, 0.0]},
        "iterations": 1, "device": "cpu",
    },
    "render": lambda p: {"g": p.gaussians, "cam": p.camera, "features": np.ones((len(p.gaussians), 2)), "device": "cpu"},
    "simulate": lambda p: {
        **TRACE, "scene": p.scene, "receivers": p.receivers[:2], "shape": SHAPE, "beam_sigma_rad": SIGMA,
        "roles": ["train", "test"], "floor": 1e-14, "device": "cpu",
    },
    "sample_receivers": lambda p: {"scene": p.scene, "n": 3, "seed": 0},
    "trace_paths": lambda p: {**TRACE, "mesh_or_scene": p.scene, "receivers": p.receivers[:3], "device": "cpu"},
    "relevance": lambda p: {**TRACE, "geometry": p.field, "receivers": p.receivers[:2], "device": "cpu"},
    "evaluate": lambda p: {"test": p.test, "predict": wr.lookups.nearest(p.train)},
    # nouns
    "Camera": lambda p: {name: getattr(p.camera, name) for name in p.camera.__dataclass_fields__},
    "Camera.directions": _on(lambda p: p.camera),
    "Camera.pinhole": lambda p: {
        "width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0, "world_to_camera": np.eye(4),
    },
    "Camera.project": _on(lambda p: p.camera, points=POINTS),
    "Camera.resized": _on(lambda p: p.camera, width=8, height=6),
    "Camera.spherical": lambda p: {"width": 8, "height": 4, "position": POINTS[0]},
    "Gaussians": lambda p: {name: getattr(p.gaussians, name) for name in p.gaussians.__dataclass_fields__},
    "Gaussians.load_ply": lambda p: {"path": p.folder / "splats.ply"},
    "Gaussians.save_ply": _on(lambda p: p.gaussians, path="splats.ply"),
    "Mesh": lambda p: {"vertices": p.mesh.vertices, "faces": p.mesh.faces},
    "Mesh.cast": _on(lambda p: p.mesh, origins=POINTS[:2], directions=TOWARDS, device="cpu"),
    "Mesh.closest": _on(lambda p: p.mesh, points=POINTS, device="cpu"),
    "Mesh.cross_section": _on(lambda p: p.mesh, height=1.0),
    "Mesh.distance": _on(lambda p: p.mesh, points=POINTS, device="cpu"),
    "Mesh.load": lambda p: {"path": p.folder / "meshes/mesh.ply", "unit": "m", "up": "z", "simplify": 20},
    "Mesh.look_around": _on(lambda p: p.mesh, points=POINTS, directions=TOWARDS, device="cpu"),
    "Mesh.on_device": _on(lambda p: p.mesh, device="cpu"),
    "Mesh.visible": _on(lambda p: p.mesh, a=POINTS, b=POINTS[::-1].copy(), device="cpu"),
    "Reconstruction": lambda p: {"gaussians": p.gaussians, "mesh": p.mesh, "cameras": {"0.png": p.camera}},
    "Reconstruction.from_files": lambda p: {"ply": p.folder / "splats.ply", "mesh": p.mesh, "device": "cpu"},
    "Reconstruction.load": lambda p: {"folder": p.folder / "reconstruction"},
    "Reconstruction.report": _on(lambda p: p.reconstruction, path="report.html", device="cpu"),
    "Reconstruction.save": _on(lambda p: p.reconstruction, folder="saved"),
    "Scene": lambda p: {
        "mesh": p.mesh, "materials": p.scene.materials, "face_material": p.scene.face_material,
        "face_object": p.scene.face_object, "object_names": p.scene.object_names,
    },
    "Scene.is_free": _on(lambda p: p.scene, points=POINTS, device="cpu"),
    "Scene.from_sionna": lambda p: {"rt_scene": p.scene},
    "Scene.load": lambda p: {"path": p.folder / "scene.xml"},
    "Scene.object_faces": _on(lambda p: p.scene, name="walls"),
    "Scene.to_sionna": _on(lambda p: p.scene, frequency_hz=CARRIER),
    "Scene.with_materials": _on(lambda p: p.scene, materials=[wr.Material.conductor()] * 2),
    "Material": lambda p: {"name": "stone", "bands": BANDS, "scattering": 0.1},
    "Material.band": MATERIAL,
    "Material.conductivity": MATERIAL,
    "Material.permittivity": MATERIAL,
    "Material.relative_permittivity": MATERIAL,
    "Material.scattering_coefficient": MATERIAL,
    "Material.conductor": lambda p: {},
    "Material.extrapolated": _on(lambda p: p.scene.materials[0]),
    "Material.custom": lambda p: {"name": "stone", **CUSTOM},
    "Air": lambda p: {},
    "Air.attenuation_db_per_m": AIR,
    "Air.from_attributes": lambda p: {"attributes": wr.Air().attributes},
    "Air.loss_per_m": AIR,
    "Air.transmittance": lambda p: {**AIR(p), "length_m": np.array([1.0, 2.0])},
    "Spectrum": lambda p: {
        "path_gain": p.spectra.path_gain[0], "delay_s": p.spectra.delay_s[0], "aod": p.spectra.aod[0], "floor": 1e-14,
        "range_db": (-140.0, -70.0),
    },
    "Spectrum.plot": _on(lambda p: p.spectra[0]),
    "Readings": _readings,
    "Readings.from_table": lambda p: {
        "table": {
            **{f"{end}_{axis}": np.full(3, float(v)) for end, at in (("tx", TRANSMITTER), ("rx", POINTS[0]))
               for axis, v in zip("xyz", at, strict=True)},
            "power_db": np.array([-80.0, -90.0, -100.0]),
        },
        "frequency_hz": CARRIER, "floor": 1e-14,
    },
    "Readings.load": lambda p: {"path": p.folder / "readings.csv", "frequency_hz": CARRIER, "floor": 1e-14},
    "Readings.subset": lambda p: {"self": wr.Readings(**_readings(p)), "rows": np.array([0, 2])},
    "channel.ArraySpectra": _array_spectra,
    "channel.ArraySpectra.load": lambda p: {"path": p.folder / "pictures", "frequency_hz": CARRIER, "part": "train"},
    "channel.ArraySpectra.subset": lambda p: {"self": wr.channel.ArraySpectra(**_array_spectra(p)), "rows": np.array([0])},
    "horn": lambda p: {"width_rad": 0.2},
    "SpectrumDataset": _spectra,
    "SpectrumDataset.deembed": _on(
        lambda p: p.train.subset([0]), pattern=np.cos(np.linspace(0, np.pi / 2, 19)) ** 8, iterations=20, snapshots=1,
        tolerance=1e-2,
    ),
    "SpectrumDataset.empty": lambda p: {
        "transmitter": TRANSMITTER, "frequency_hz": CARRIER, "shape": (12, 24), "beam_sigma_rad": 0.1, "floor": 1e-15,
    },
    "SpectrumDataset.export_exr": _on(lambda p: p.train, path="one.exr", index=0),
    "SpectrumDataset.from_spectra": lambda p: {
        k: _with_nan(v) if k in ("delay_s", "aod") else v
        for k, v in _spectra(p).items() if k not in ("range_db", "polarisation")
    },
    "SpectrumDataset.load": lambda p: {"path": p.folder / "spectra.nc"},
    "SpectrumDataset.save": _on(lambda p: p.train, path="saved.nc"),
    "SpectrumDataset.split": _on(lambda p: p.spectra, n_train=4),
    "SpectrumDataset.subset": _on(lambda p: p.spectra, indices=np.array([0, 3])),
    "RadioField.array_spectrum": _on(
        lambda p: p.field, receivers=POINTS[0], array=wr.PlanarArray(2, 2), directions=TOWARDS, transmitter=TRANSMITTER + 0.1,
    ),
    "RadioField.at_frequency": _on(lambda p: p.field, frequency_hz=140e9),
    "RadioField.check_positions": _on(lambda p: p.field, receivers=POINTS),
    "RadioField.fit": lambda p: {
        "geometry": p.scene, "ds": p.train, "mirror_order": 1, "lobes": (0, 4), "diffuse": True, "indirect": False,
        "residual": False, "sub_pixels": 1, "device": "cpu", "relevance": p.relevance,
    },
    "RadioField.cfr": _on(lambda p: p.field, receivers=POINTS, frequencies_hz=[CARRIER], diffuse="power", max_paths=20),
    "RadioField.spectra": _on(lambda p: p.field, receivers=POINTS),
    "RadioField.links": _on(lambda p: p.field, receivers=POINTS, shape=(8, 16)),
    "RadioField.load": lambda p: {"path": p.folder / "bistatic.safetensors", "device": "cpu"},
    "RadioField.paths": _on(lambda p: p.field, receivers=POINTS[0], max_paths=20),
    "RadioField.radio_map": _on(lambda p: p.field, height=1.2, cell=1.0),
    "RadioField.save": _on(lambda p: p.field, path="field.safetensors"),
    "RadioField.spectrum": _on(lambda p: p.field, receivers=POINTS[0], transmitter=TRANSMITTER + 0.1),
    "RadioField.suggest": _on(
        lambda p: p.field, candidates=POINTS, n=1, arrival=np.full((len(POINTS), 2), 1.5),
        receive_pattern=np.linspace(1.0, 0.1, 19),
    ),
    "RadioField.was_fitted_on": lambda p: {"self": p.field, "ds": p.spectra},
    "RadioField.with_gas": _on(lambda p: p.field),
    "Paths": lambda p: _field_of(p.paths),
    "Paths.as_several": _on(lambda p: p.paths.row(0)),
    "Paths.cfr": _on(lambda p: p.paths, frequencies_hz=CARRIER + np.linspace(-1e9, 1e9, 8), **LINK),
    "Paths.check_delays": _on(lambda p: p.paths),
    "Paths.cir": _on(lambda p: p.paths, **LINK),
    "Paths.concatenate": lambda p: {"parts": [p.paths.row(0), p.paths.row(0)]},
    "Paths.diffuse_power": lambda p: {"self": p.paths, "tx_array": p.array},
    "Paths.dispersion": _on(lambda p: p.paths),
    "Paths.each": _on(lambda p: p.paths),
    "Paths.from_points": lambda p: {
        "transmitter": TRANSMITTER, "receiver": POINTS[1], "vertices": np.array([[[2.0, 2.0, 3.0]]]),
        "amplitude": np.array([0.5 + 0.1j]), "kind": np.array(["mirror"]), "frequency_hz": CARRIER,
    },
    "Paths.from_sionna": lambda p: {"paths": "not of Sionna", "frequency_hz": CARRIER},
    "Paths.load": lambda p: {"path": p.folder / "paths.nc"},
    "Paths.row": _on(lambda p: p.paths, receiver=1),
    "Paths.save": _on(lambda p: p.paths, path="paths.nc"),
    "Paths.select": _on(lambda p: p.paths.row(0), chosen=np.array([0, 1])),
    "Paths.stack": lambda p: {"parts": [p.paths.row(0), p.paths.row(1)]},
    "Paths.taps": _on(lambda p: p.paths, bandwidth_hz=1e9, l_min=-2, l_max=40, **LINK),
    "Paths.to_sionna": lambda p: {"self": p.paths, "tx_array": p.array},
    "Paths.with_gas": _on(lambda p: p.paths),
    "PlanarArray": lambda p: {"rows": 2, "cols": 3},
    "PlanarArray.aperture_m": _on(lambda p: p.array, wavelength_m=WAVELENGTH),
    "PlanarArray.field": _on(lambda p: wr.PlanarArray(2, 2, polarisation="VH"), directions=TOWARDS),
    "PlanarArray.gain": _on(lambda p: p.array, directions=TOWARDS),
    "PlanarArray.positions": _on(lambda p: p.array, wavelength_m=WAVELENGTH),
    "PlanarArray.response": _on(lambda p: p.array, directions=TOWARDS, wavelength_m=WAVELENGTH),
    "PlanarArray.spherical_response": _on(lambda p: p.array, points=POINTS, wavelength_m=WAVELENGTH),
    "RadioMap": lambda p: {name: getattr(p.map, name) for name in p.map.__dataclass_fields__},
    "RadioMap.load": lambda p: {"path": p.folder / "map.nc"},
    "RadioMap.picture": _on(lambda p: p.map, path="map.png"),
    "RadioMap.plot": _on(lambda p: p.map),
    "RadioMap.save": _on(lambda p: p.map, path="map.nc"),
    "RadioMap.shown": _on(lambda p: p.map, quantity="total_path_gain"),
    "Relevance": lambda p: {name: getattr(p.relevance, name) for name in p.relevance.__dataclass_fields__},
    "Relevance.load": lambda p: {"path": p.folder / "relevance.json"},
    "Relevance.options": _on(lambda p: p.relevance, frequency_hz=CARRIER),
    "Relevance.reduce": lambda p: {"self": p.relevance, "full": p.field},
    "Relevance.save": _on(lambda p: p.relevance, path="relevance.json"),
    "Relevance.table": _on(lambda p: p.relevance),
    "Relevance.to_dict": _on(lambda p: p.relevance),
    # channel
    "channel.Codebook": lambda p: {"array": p.array, "factors": p.codebook.factors},
    "channel.Codebook.amplitude": _on(lambda p: p.codebook, directions=TOWARDS),
    "channel.Codebook.beam": _on(lambda p: p.codebook, index=1),
    "channel.Codebook.power": _on(lambda p: p.codebook, directions=TOWARDS, powers=np.array([1e-9, 1e-10])),
    "channel.Codebook.received": _on(lambda p: p.codebook, channel=np.ones((4, 4), complex)),
    "channel.Codebook.superposed": _on(lambda p: p.codebook, directions=TOWARDS, gains=np.array([1e-5, 1e-5j])),
    "channel.BeamChoice": lambda p: {"tx": np.array([0]), "rx": np.array([0]), "gain": np.array([1.0])},
    "channel.MultiUserChoice": lambda p: {"tx": np.array([0]), "rx": np.array([0]), "sinr": np.array([1.0])},
    "channel.PlaneWaveError": lambda p: {"phase_rad": 0.1, "beam_loss_db": 0.1, "entry_error": 0.1},
    "channel.ThzChannel": lambda p: {"number": 1, "low_hz": 252.72e9, "high_hz": 254.88e9},
    "channel.ThzChannel.frequencies_hz": _on(lambda p: wr.thz_channel(1), count=8),
    "channel.Dispersion": lambda p: {name: np.ones(2) for name in wr.channel.Dispersion.__dataclass_fields__},
    "channel.angular_spread": lambda p: {"power": POWERS, "angle": ANGLES},
    "channel.beam_gains": lambda p: {"source": p.paths, "tx_array": p.codebook, "rx_array": p.array},
    "channel.coherence_bandwidth": lambda p: {"power": POWERS, "tau": 1e-8 * ANGLES},
    "channel.delay_spread": lambda p: {"power": POWERS, "tau": 1e-8 * ANGLES},
    "channel.dft_codebook": lambda p: {"array": p.array},
    "channel.orientation_towards": lambda p: {"direction": TOWARDS[1]},
    "channel.plane_wave_error": lambda p: {"array": p.array, "distance_m": 3.0, "wavelength_m": WAVELENGTH},
    "channel.precoded_sinr": lambda p: {"channels": p.channels, "weights": np.ones((2, 4), complex) / 2, "noise": 0.1},
    "channel.precoders": lambda p: {"channels": p.channels, "noise": 0.1},
    "channel.select_beams": lambda p: {"source": p.paths, "tx_array": p.codebook, "rx_array": p.array},
    "channel.select_beams_multiuser": _sources(noise=1e-12),
    "channel.signal_over_interference": lambda p: {
        "gains": [np.ones((2, 4)), np.ones((2, 4))], "tx": np.array([0, 1]), "rx": np.array([0, 1]), "noise": 0.1,
    },
    "channel.steering_codebook": lambda p: {"array": p.array, "directions": TOWARDS},
    "channel.thz_channel": lambda p: {"number": 69},
    "channel.transmit_covariance": _sources(rx=np.zeros(3, int)),
    # waves
    "em.Band": lambda p: {"low_hz": 1e9, "high_hz": 1e12, "a": 5.0, "b": 0.0, "c": 0.01, "d": 0.9},
    "em.Band.conductivity": _on(lambda p: BANDS[0], frequency_hz=CARRIER),
    "em.Band.relative_permittivity": _on(lambda p: BANDS[0], frequency_hz=CARRIER),
    "em.Band.widened": _on(lambda p: BANDS[0], low_hz=1e8, high_hz=1e9),
    "em.carrier_phase": lambda p: {"frequency_hz": CARRIER, "tau": 1e-8 * ANGLES},
    "em.gas_attenuation_db_per_m": lambda p: {"frequency_hz": CARRIER},
    "em.itu_material": lambda p: {"itu": "concrete"},
    "em.load_materials": lambda p: {"path": p.folder / "materials.json"},
    "em.lobe": lambda p: {"alpha_r": 4, "cos_incidence": 0.5, "cos_scatter": 0.5, "cos_to_mirror": 0.9},
    "em.roughness_scattering": lambda p: {"roughness_m": 1e-4, "frequency_hz": CARRIER},
    "em.slab_reflection": lambda p: {
        "cos_incidence": np.cos(ANGLES / 2), "permittivity": 5.0 - 0.1j, "thickness_m": 0.1, "wavelength_m": WAVELENGTH,
    },
    "em.slab_transmission": lambda p: {
        "cos_incidence": np.cos(ANGLES / 2), "permittivity": 5.0 - 0.1j, "thickness_m": 0.1, "wavelength_m": WAVELENGTH,
    },
    # interop
    "interop.SionnaPaths": lambda p: vars(p.paths.to_sionna()),
    "interop.SionnaPaths.cfr": _on(lambda p: p.paths.to_sionna(), frequencies=np.linspace(-1e9, 1e9, 8)),
    "interop.SionnaPaths.cir": _on(lambda p: p.paths.to_sionna()),
    "interop.SionnaPaths.taps": _on(lambda p: p.paths.to_sionna(), bandwidth=1e9, l_min=-2, l_max=20),
    "interop.Twin": lambda p: {"xml": Path("scene.xml"), "frequency_hz": CARRIER, "groups": (), "left_out": ()},
    "interop.load_sionna_scene": lambda p: {"scene": "missing.xml", "frequency_hz": CARRIER},
    "interop.select_llvm": lambda p: {},
    "interop.write_deepmimo": lambda p: {"paths": p.paths, "folder": "deepmimo", "scene": p.scene},
    "interop.write_twin": lambda p: {"field": p.field, "folder": "twin"},
    # splats
    "splats.Blending": lambda p: {},
    "splats.BlendWeights": lambda p: {
        name: np.zeros((2, 3)) for name in wr.BlendWeights.__dataclass_fields__
    },
    "splats.blend_weights": lambda p: {"g": p.gaussians, "cam": p.camera, "top_k": 4, "device": "cpu"},
    "splats.GaussianRays": lambda p: {"gaussians": p.gaussians, "device": "cpu"},
    "splats.GaussianRays.hits": _rays(k=4),
    "splats.GaussianRays.trace": _rays(k=4),
    "splats.GaussianRays.trace_with_adjoint": _rays(k=4),
    "splats.GaussianRays.transmit": _ends(),
    "splats.GaussianRays.transmit_with_adjoint": _ends(),
    "splats.GaussianRays.transmittance": _ends(),
    "splats.Rasterizer": lambda p: {"device": "cpu"},
    "splats.Rasterizer.blend": _raster("prepared", "features"),
    "splats.Rasterizer.blend_with_adjoint": _raster("prepared", "features"),
    "splats.Rasterizer.colors": lambda p: {**_raster("means", "sh")(p), "cam": p.camera},
    "splats.Rasterizer.colors_adjoint": _raster("means", "sh", "origin", "out"),
    "splats.Rasterizer.colors_into": lambda p: {**_raster("means", "sh", "out")(p), "cam": p.camera},
    "splats.Rasterizer.prepare": lambda p: {
        **_raster("means", "quaternions", "scales", "opacities")(p), "cam": p.camera,
    },
    "splats.Rasterizer.rasterize": lambda p: {
        **_raster("means", "quaternions", "scales", "opacities", "features")(p), "cam": p.camera,
    },
    "splats.Rasterizer.strongest": _raster("prepared", top_k=2),
    "splats.Rasterizer.upload": lambda p: {**_raster()(p), "g": p.gaussians},
    # metrics and lookups
    "metrics.angle_deg": lambda p: {"a": TOWARDS, "b": TOWARDS[::-1].copy()},
    "metrics.beam_gain_loss_db": lambda p: {"path_gain": _image(p), "direction": TOWARDS[0], "width_rad": 0.2},
    "metrics.beam_kappa": lambda p: {"width_rad": 0.2},
    "metrics.beam_response": lambda p: {"path_gain": _image(p), "width_rad": 0.2},
    "metrics.psnr": lambda p: {"prediction": _unit(p), "truth": _unit(p)[::-1].copy()},
    "metrics.rmse_db": lambda p: {"prediction_db": _image(p) - 100, "truth_db": _image(p) - 90},
    "metrics.ssim": lambda p: {"prediction": _unit(p), "truth": _unit(p)[::-1].copy()},
    "metrics.strongest_direction": lambda p: {"path_gain": _image(p)},
    "metrics.unit_image": lambda p: {"path_gain": _image(p), "floor": 1e-14, "range_db": (-140.0, -70.0)},
    "metrics.weighted_median": lambda p: {"values": ANGLES, "weights": np.ones(5)},
    "lookups.Lookup": lambda p: {"name": "mine", "note": "", "train": p.train, "_predict": _image},
    "lookups.Lookup.spectrum": _on(lambda p: wr.lookups.nearest(p.train), receiver=POINTS[0]),
    "lookups.Lookup.was_fitted_on": lambda p: {"self": wr.lookups.nearest(p.train), "ds": p.test},
    "lookups.constant": lambda p: {"train": p.train},
    "lookups.idw": lambda p: {"train": p.train},
    "lookups.mean": lambda p: {"train": p.train},
    "lookups.nearest": lambda p: {"train": p.train},
}  # fmt: skip
"""What each is called with, from a :class:`Place`; relative paths lie in the folder of the process that tries it."""
