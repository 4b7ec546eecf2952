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
    "Air": "rf.em.absorption",
    "BeamChoice": "rf.channel.beams",
    "Blending": "geometry.splats.rasterizer",
    "BlendWeights": "geometry.splats.render",
    "Camera": "geometry.splats.camera",
    "Codebook": "rf.channel.beams",
    "GaussianRays": "geometry.splats.gaussian_rays",
    "Gaussians": "geometry.splats.gaussians",
    "Material": "rf.em.materials",
    "Mesh": "geometry.mesh",
    "Paths": "rf.paths.path_set",
    "PlanarArray": "rf.channel.arrays",
    "RadioField": "rf.fields.base",
    "RadioMap": "rf.maps.radio_map",
    "Rasterizer": "geometry.splats.rasterizer",
    "Relevance": "rf.relevance.search",
    "Reconstruction": "geometry.reconstruction",
    "Scene": "rf.scene",
    "Spectrum": "rf.spectra.spectrum",
    "SpectrumDataset": "rf.spectra.dataset",
    "THZ_CHANNELS": "rf.channel.band_plan",
    "beam_gains": "rf.channel.beams",
    "blend_weights": "geometry.splats.render",
    "dft_codebook": "rf.channel.beams",
    "evaluate": "rf.spectra.metrics",
    "fit_reflections": "rf.paths.reflections",
    "gas_attenuation_db_per_m": "rf.em.absorption",
    "load_newrf": "rf.interop.newrf",
    "load_sionna_scene": "rf.interop.sionna_engine",
    "orientation_towards": "rf.channel.arrays",
    "plane_wave_error": "rf.channel.arrays",
    "precoded_sinr": "rf.channel.precoders",
    "precoders": "rf.channel.precoders",
    "reconstruct": "geometry.photos.pipeline",
    "relevance": "rf.relevance.search",
    "render": "geometry.splats.render",
    "select_beams": "rf.channel.beams",
    "select_beams_multiuser": "rf.channel.beams",
    "simulate": "rf.simulate",
    "steering_codebook": "rf.channel.beams",
    "thz_channel": "rf.channel.band_plan",
    "transmit_covariance": "rf.channel.precoders",
    "trace_paths": "rf.paths.trace",
    "write_deepmimo": "rf.interop.deepmimo",
    "write_twin": "rf.interop.twin",
}

__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from warprrf.geometry.mesh import Mesh as Mesh
    from warprrf.geometry.photos.pipeline import reconstruct as reconstruct
    from warprrf.geometry.reconstruction import Reconstruction as Reconstruction
    from warprrf.geometry.splats.camera import Camera as Camera
    from warprrf.geometry.splats.gaussian_rays import GaussianRays as GaussianRays
    from warprrf.geometry.splats.gaussians import Gaussians as Gaussians
    from warprrf.geometry.splats.rasterizer import Blending as Blending
    from warprrf.geometry.splats.rasterizer import Rasterizer as Rasterizer
    from warprrf.geometry.splats.render import BlendWeights as BlendWeights
    from warprrf.geometry.splats.render import blend_weights as blend_weights
    from warprrf.geometry.splats.render import render as render
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
    from warprrf.rf.channel.precoders import precoded_sinr as precoded_sinr
    from warprrf.rf.channel.precoders import precoders as precoders
    from warprrf.rf.channel.precoders import transmit_covariance as transmit_covariance
    from warprrf.rf.em.absorption import Air as Air
    from warprrf.rf.em.absorption import gas_attenuation_db_per_m as gas_attenuation_db_per_m
    from warprrf.rf.em.materials import Material as Material
    from warprrf.rf.fields.base import RadioField as RadioField
    from warprrf.rf.interop.deepmimo import write_deepmimo as write_deepmimo
    from warprrf.rf.interop.newrf import load_newrf as load_newrf
    from warprrf.rf.interop.sionna_engine import load_sionna_scene as load_sionna_scene
    from warprrf.rf.interop.twin import write_twin as write_twin
    from warprrf.rf.maps.radio_map import RadioMap as RadioMap
    from warprrf.rf.paths.path_set import Paths as Paths
    from warprrf.rf.paths.reflections import fit_reflections as fit_reflections
    from warprrf.rf.paths.trace import trace_paths as trace_paths
    from warprrf.rf.relevance.search import Relevance as Relevance
    from warprrf.rf.relevance.search import relevance as relevance
    from warprrf.rf.scene import Scene as Scene
    from warprrf.rf.simulate import simulate as simulate
    from warprrf.rf.spectra.dataset import SpectrumDataset as SpectrumDataset
    from warprrf.rf.spectra.metrics import evaluate as evaluate
    from warprrf.rf.spectra.spectrum import Spectrum as Spectrum


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warprrf' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warprrf.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
