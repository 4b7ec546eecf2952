"""Paths as a DeepMIMO scenario: the folder that version 4 of the ``DeepMIMO`` package loads.

One transmitter (set 0), one set of receivers (set 1): an ``.npz`` file for each matrix, ``params.json``, and the scene
as a triangular mesh. Powers are path gains in decibels (transmit power 0 dB, isotropic antennas, averaged over transmit
and summed over receive polarisations), phases those of the gains, -2 pi f_c tau included, so that DeepMIMO's channels
are baseband channels about the carrier. Angles in degrees, elevations counted from the zenith, delays in seconds,
float32 throughout (but codes of eight interactions and more: float64), NaN where there is no path. Paths are sorted by
power; DeepMIMO loads 25 of them unless told otherwise (``max_paths``).
"""

from __future__ import annotations

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.checks import Count, checked
from warprrf.files import write_arrays, write_text
from warprrf.kernels.radio.records import EDGE, MIRROR, SCATTER, SLAB
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.scene import Scene

# of a path's code: a digit for each interaction, from the transmitter on; 0 for line of sight
_DIGIT = {MIRROR: 1, EDGE: 2, SCATTER: 3, SLAB: 4}


@checked
def write_deepmimo(
    paths: Paths,
    folder: str | os.PathLike[str],
    *,
    scene: Scene | None = None,
    diffuse: str | None = None,
    seed: int = 0,
    max_paths: Count | None = None,
) -> Path:
    """Write a scenario folder; ``deepmimo.load(name)`` finds it as ``deepmimo_scenarios/<name>`` in its working folder.

    Args:
        paths: Of one receiver or several, with transmitter, receivers and carrier.
        folder: Folder of the scenario; DeepMIMO wants its name in lower case. Files in it are replaced one by one.
        scene: Geometry and materials to store beside the paths; none by default.
        diffuse: "random_phase" (with ``seed``) or "given", the phases in the gains; must be stated if there are diffuse
            paths: a DeepMIMO path has a phase.
        seed: Of the random phases.
        max_paths: Most paths of a receiver, the strongest; all by default.

    Returns:
        The folder.

    Raises:
        ValueError: for a name that DeepMIMO cannot load, unknown positions or carrier, several transmitters, paths without
            delay or angle, ``diffuse`` not stated.
    """
    folder = Path(folder)
    name = folder.name
    if not name or name != name.lower() or set("/\\:*?\"'<>|\n") & set(name):
        raise ValueError(f"folder: got the name {name!r}, which DeepMIMO cannot load; expected lower case")
    if paths.transmitter is None or paths.receiver is None:
        raise ValueError("paths: got ones without transmitter and receiver, which a scenario needs")
    if np.ndim(paths.transmitter) != 1:
        raise ValueError("paths: got ones of several transmitters, expected those of one")
    scattered = bool((paths.valid & (paths.kind == "diffuse")).any())
    if scattered and diffuse not in ("random_phase", "given"):
        raise ValueError(
            f"diffuse: got {diffuse!r} with diffuse paths, expected 'random_phase' or 'given': a path here has a phase"
        )
    if not np.isfinite((paths.arrival + paths.departure)[paths.valid]).all():
        raise ValueError("paths: got some without an angle, which DeepMIMO would leave out in silence")
    carrier = paths.carrier_hz
    coefficient, _ = paths.cir(diffuse=diffuse if scattered else None, seed=seed)
    several = paths.as_several()
    coefficient = coefficient.reshape(several.gain.shape)
    matrices = _matrices(several, coefficient, max_paths)
    for key, values in matrices.items():
        write_arrays(folder / f"{key}_t000_tx000_r001.npz", {key: values})
    described = _write_scene(folder, scene, carrier)
    met, codes = several.interactions, (MIRROR, EDGE, SLAB)
    most = {code: int((met == code).sum(axis=-1).max(initial=0)) for code in codes}
    parameters = {
        "version": "4.0.5",  # of the format
        "rt_params": {
            "raytracer_name": "warprrf",
            "raytracer_version": version("warprrf"),
            "frequency": carrier,
            "max_path_depth": int((several.interactions > 0).sum(axis=-1).max(initial=0)),
            "max_reflections": most[MIRROR],
            "max_scattering": int(scattered),
            "max_diffractions": most[EDGE],
            "max_transmissions": most[SLAB],
            **{f"diffuse_{kind}": 0 for kind in ("reflections", "diffractions", "transmissions")},
            "diffuse_final_interaction_only": True,
            "diffuse_random_phases": diffuse == "random_phase",
            **{f"terrain_{kind}": False for kind in ("reflection", "diffraction", "scattering")},
            "num_rays": 0,
            "ray_casting_method": "image method",
            "synthetic_array": True,
            "ray_casting_range_az": 360.0,
            "ray_casting_range_el": 180.0,
            "gps_bbox": [0, 0, 0, 0],
            "raw_params": {},
        },
        "txrx_sets": {
            "txrx_set_0": _end("tx", 0, 1, 1),
            "txrx_set_1": _end("rx", 1, len(several.gain), int(several.valid.any(axis=1).sum())),
        },
        "materials": described.pop("materials"),
        "scene": described,
    }
    # last: a folder without it does not load
    write_text(folder / "params.json", json.dumps(parameters, indent=2))
    return folder


def _matrices(paths: Paths, coefficient: np.ndarray, max_paths: int | None) -> dict[str, np.ndarray]:
    if paths.gain.shape[1] == 0:  # an empty matrix does not load
        raise ValueError("paths: got none for any receiver, expected at least one path")
    most = int(paths.valid.sum(axis=1).max())
    count = max(min(most, max_paths or most), 1)
    strength = np.where(paths.valid, np.abs(coefficient), -1.0)
    order = np.argsort(-strength, axis=1, kind="stable")[:, :count]

    def pick(values: np.ndarray) -> np.ndarray:
        return values[np.arange(len(order))[:, None], order]

    there = pick(paths.valid)
    gain = pick(coefficient)
    bounces = np.isfinite(paths.vertices[..., 0]).sum(axis=-1)
    power = 20.0 * np.log10(np.where(there & (gain != 0), np.abs(gain), np.nan))

    def real(values: np.ndarray) -> np.ndarray:
        return np.where(there, values, np.nan).astype(np.float32)

    deep = max(1, int(bounces.max(initial=0)))
    codes = np.zeros(bounces.shape)
    for met in np.moveaxis(paths.interactions, -1, 0):
        codes = np.where(met > 0, 10.0 * codes + np.vectorize(_DIGIT.get, otypes=[float])(met, 0), codes)
    exact = np.float32 if codes.max() < 2**24 else np.float64
    return {
        "rx_pos": np.asarray(paths.receiver, dtype=np.float32).reshape(-1, 3),
        "tx_pos": np.asarray(paths.transmitter, dtype=np.float32).reshape(1, 3),
        "aoa_az": real(np.rad2deg(pick(paths.phi_r))),
        "aoa_el": real(np.rad2deg(pick(paths.theta_r))),
        "aod_az": real(np.rad2deg(pick(paths.phi_t))),
        "aod_el": real(np.rad2deg(pick(paths.theta_t))),
        "delay": real(pick(paths.tau)),
        "power": real(power),
        "phase": real(np.rad2deg(np.angle(gain))),
        "inter": np.where(there, pick(codes), np.nan).astype(exact),
        "inter_pos": pick(paths.vertices)[:, :, :deep].astype(np.float32),
    }


def _end(name: str, identity: int, points: int, active: int) -> dict[str, Any]:
    return {
        "name": name,
        "id_orig": identity,
        "id": identity,
        "is_tx": name == "tx",
        "is_rx": name == "rx",
        "num_points": points,
        "num_active_points": active,
        "num_ant": 1,
        "dual_pol": False,
        "ant_rel_positions": [[0, 0, 0]],
        "array_orientation": [0, 0, 0],
        "grid_spacing": None,
    }


def _write_scene(folder: Path, scene: Scene | None, carrier: float) -> dict[str, Any]:
    """Write the mesh object by object; returns the scene's entry of the parameters and, in it, the materials."""
    vertices = np.zeros((0, 3), np.float32)
    objects: list[dict[str, Any]] = []
    faces: dict[str, np.ndarray] = {}
    kinds: dict[str, np.ndarray] = {}
    materials: dict[str, Any] = {}
    if scene is not None:
        vertices = scene.mesh.vertices.astype(np.float32)
        for k, name in enumerate(scene.object_names):
            chosen = np.flatnonzero(scene.face_object == k)
            faces[str(k)] = scene.mesh.faces[chosen].astype(np.int64)
            kinds[str(k)] = scene.face_material[chosen].astype(np.int64)
            objects.append({"name": name, "label": "objects", "id": k, "mesh_key": str(k)})
        materials = {f"material_{k}": _material(k, m, carrier) for k, m in enumerate(scene.materials)}
    write_arrays(folder / "vertices.npz", {"vertices": vertices})
    write_arrays(folder / "faces.npz", faces)
    write_arrays(folder / "materials.npz", kinds)
    write_text(folder / "objects.json", json.dumps(objects, indent=2))
    count = sum(len(f) for f in faces.values())
    return {
        "num_scenes": 1,
        "n_objects": len(objects),
        "n_vertices": len(vertices),
        "n_faces": count,
        "n_triangular_faces": count,
        "representation": "mesh",
        "materials": materials,
    }


def _material(k: int, material: Any, carrier: float) -> dict[str, Any]:
    scattering = material.scattering_coefficient(carrier)
    return {
        "id": k,
        "name": material.name,
        "permittivity": material.relative_permittivity(carrier),
        "conductivity": material.conductivity(carrier),
        "scattering_model": material.pattern if scattering > 0 else "none",
        "scattering_coefficient": scattering,
        "cross_polarization_coefficient": float(material.xpd),
        "alpha_r": float(material.alpha_r),
        "roughness": float(material.roughness_m),
        "thickness": float(material.thickness_m),
    }
