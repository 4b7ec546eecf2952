"""warprrf: radio radiance fields from photos and a few radio measurements.

Stage 1 reconstructs a room's geometry from photos (:func:`reconstruct`); stage 2 fits a radio field to sparse spatial
spectra (:meth:`RadioField.fit`), which then answers for any receiver (:meth:`RadioField.spectrum`,
:meth:`RadioField.paths`).

Conventions: metres, seconds, hertz, radians; world right-handed with z up; zenith in [0, pi], azimuth in (-pi, pi];
``world_to_camera`` 4x4 with OpenCV axes; quaternions wxyz. A spectrum is an equirectangular grid of *path gain*, row i
at zenith ``(i + 0.5) pi / H``, column j at azimuth ``-pi + (j + 0.5) 2 pi / W``.

Names are imported when first used: ``import warprrf`` alone loads no heavy package.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Air": "rf.absorption",
    "BeamChoice": "rf.channel.beams",
    "Blending": "geometry.rasterizer",
    "BlendWeights": "geometry.render",
    "Camera": "geometry.camera",
    "Codebook": "rf.channel.beams",
    "GaussianRays": "geometry.gaussian_rays",
    "Gaussians": "geometry.gaussians",
    "Material": "rf.materials",
    "Mesh": "geometry.mesh",
    "Paths": "rf.channel.path_set",
    "PlanarArray": "rf.channel.arrays",
    "RadioField": "rf.field",
    "RadioMap": "rf.coverage.radio_map",
    "Rasterizer": "geometry.rasterizer",
    "Relevance": "rf.relevance",
    "Reconstruction": "geometry.reconstruction",
    "Scene": "rf.scene",
    "Spectrum": "rf.spectrum",
    "SpectrumDataset": "rf.dataset",
    "THZ_CHANNELS": "rf.channel.band_plan",
    "beam_gains": "rf.channel.beams",
    "blend_weights": "geometry.render",
    "dft_codebook": "rf.channel.beams",
    "evaluate": "rf.metrics",
    "fit_reflections": "rf.reflections",
    "gas_attenuation_db_per_m": "rf.absorption",
    "load_newrf": "rf.newrf",
    "load_sionna_scene": "rf.sionna_engine",
    "orientation_towards": "rf.channel.arrays",
    "plane_wave_error": "rf.channel.arrays",
    "precoded_sinr": "rf.channel.precoders",
    "precoders": "rf.channel.precoders",
    "reconstruct": "geometry.from_photos",
    "relevance": "rf.relevance",
    "render": "geometry.render",
    "select_beams": "rf.channel.beams",
    "select_beams_multiuser": "rf.channel.beams",
    "simulate": "rf.simulate",
    "steering_codebook": "rf.channel.beams",
    "thz_channel": "rf.channel.band_plan",
    "transmit_covariance": "rf.channel.precoders",
    "trace_paths": "rf.paths",
    "write_deepmimo": "rf.channel.deepmimo",
    "write_twin": "rf.twin",
}

__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from warprrf.geometry.camera import Camera as Camera
    from warprrf.geometry.from_photos import reconstruct as reconstruct
    from warprrf.geometry.gaussian_rays import GaussianRays as GaussianRays
    from warprrf.geometry.gaussians import Gaussians as Gaussians
    from warprrf.geometry.mesh import Mesh as Mesh
    from warprrf.geometry.rasterizer import Blending as Blending
    from warprrf.geometry.rasterizer import Rasterizer as Rasterizer
    from warprrf.geometry.reconstruction import Reconstruction as Reconstruction
    from warprrf.geometry.render import BlendWeights as BlendWeights
    from warprrf.geometry.render import blend_weights as blend_weights
    from warprrf.geometry.render import render as render
    from warprrf.rf.absorption import Air as Air
    from warprrf.rf.absorption import gas_attenuation_db_per_m as gas_attenuation_db_per_m
    from warprrf.rf.channel.arrays import PlanarArray as PlanarArray
    from warprrf.rf.channel.arrays import orientation_towards as orientation_towards
    from warprrf.rf.channel.arrays import plane_wave_error as plane_wave_error
    from warprrf.rf.channel.band_plan import THZ_CHANNELS as THZ_CHANNELS
    from warprrf.rf.channel.band_plan import thz_channel as thz_channel
    from warprrf.rf.channel.beams import BeamChoice as BeamChoice
    from warprrf.rf.channel.beams import Codebook as Codebook
    from warprrf.rf.channel.beams import beam_gains as beam_gains
    from warprrf.rf.channel.beams import dft_codebook as dft_codebook
    from warprrf.rf.channel.beams import select_beams as select_beams
    from warprrf.rf.channel.beams import select_beams_multiuser as select_beams_multiuser
    from warprrf.rf.channel.beams import steering_codebook as steering_codebook
    from warprrf.rf.channel.deepmimo import write_deepmimo as write_deepmimo
    from warprrf.rf.channel.path_set import Paths as Paths
    from warprrf.rf.channel.precoders import precoded_sinr as precoded_sinr
    from warprrf.rf.channel.precoders import precoders as precoders
    from warprrf.rf.channel.precoders import transmit_covariance as transmit_covariance
    from warprrf.rf.coverage.radio_map import RadioMap as RadioMap
    from warprrf.rf.dataset import SpectrumDataset as SpectrumDataset
    from warprrf.rf.field import RadioField as RadioField
    from warprrf.rf.materials import Material as Material
    from warprrf.rf.metrics import evaluate as evaluate
    from warprrf.rf.newrf import load_newrf as load_newrf
    from warprrf.rf.paths import trace_paths as trace_paths
    from warprrf.rf.reflections import fit_reflections as fit_reflections
    from warprrf.rf.relevance import Relevance as Relevance
    from warprrf.rf.relevance import relevance as relevance
    from warprrf.rf.scene import Scene as Scene
    from warprrf.rf.simulate import simulate as simulate
    from warprrf.rf.sionna_engine import load_sionna_scene as load_sionna_scene
    from warprrf.rf.spectrum import Spectrum as Spectrum
    from warprrf.rf.twin import write_twin as write_twin


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warprrf' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warprrf.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
