# == verbs ==
# photos to cameras, Gaussians, a mesh and its planar pieces
from warprrf.geometry.pipeline import reconstruct as reconstruct

# a picture of Gaussians from a camera
from warprrf.geometry.splats.render import render as render

# spectra of a scene at given receivers, by our own engine or Sionna RT
from warprrf.rf.simulate import simulate as simulate

# places for receivers in the air of a scene
from warprrf.rf.simulate import sample_receivers as sample_receivers

# line of sight and mirror reflections by the image method
from warprrf.rf.paths.trace import trace_paths as trace_paths

# what each effect is worth in a scene, and the smallest model within a tolerance
from warprrf.rf.relevance.search import relevance as relevance

# errors of predicted spectra at held-out receivers
from warprrf.rf.spectra.metrics import evaluate as evaluate

# what any of them holds, in the browser: drag a receiver
from warprrf.viewer import view as view

# == nouns ==
# pinhole and spherical cameras
from warprrf.geometry.splats.camera import Camera as Camera

# anisotropic Gaussians with opacity and colour
from warprrf.geometry.splats.gaussians import Gaussians as Gaussians

# triangles, with rays and visibility
from warprrf.geometry.mesh import Mesh as Mesh

# what photos give, or files bring: Gaussians, mesh, cameras
from warprrf.geometry.reconstruction import Reconstruction as Reconstruction

# a mesh, its materials, and the file that they came from
from warprrf.rf.scene import Scene as Scene

# permittivity, thickness, roughness and scattering of a surface
from warprrf.rf.em.materials import Material as Material

# temperature, pressure and humidity: absorption by ITU-R P.676
from warprrf.rf.em.absorption import Air as Air

# path gain, delay and departure over the sphere of one receiver
from warprrf.rf.spectra.spectrum import Spectrum as Spectrum

# spectra of many receivers, with roles for training and test
from warprrf.rf.spectra.dataset import SpectrumDataset as SpectrumDataset

# received powers of horns, sounders and receivers, as they were measured
from warprrf.rf.spectra.readings import Readings as Readings

# the pattern of a horn antenna
from warprrf.rf.spectra.readings import horn as horn

# a model fitted to spectra, which answers for any receiver
from warprrf.rf.fields.base import RadioField as RadioField

# propagation paths, and the channels, taps and spreads that follow
from warprrf.rf.paths.path_set import Paths as Paths

# an antenna array
from warprrf.rf.channel.arrays import PlanarArray as PlanarArray

# path gain, delay spread and SNR over a floor plan
from warprrf.rf.maps.radio_map import RadioMap as RadioMap

# what `relevance` found, as a table and as options of a fit
from warprrf.rf.relevance.search import Relevance as Relevance

# == modules ==
# beams, codebooks, precoders, dispersion, channels of IEEE 802.15.3d
from warprrf.rf import channel as channel

# Fresnel coefficients, materials, absorption by the air
from warprrf.rf import em as em

# Sionna RT, DeepMIMO, digital twins
from warprrf.rf import interop as interop

# the rasteriser, blending weights, rays through Gaussians
from warprrf.geometry import splats as splats

# PSNR, SSIM, directions and beam loss, one by one
from warprrf.rf.spectra import metrics as metrics

# predictions that know no geometry: nearest measurement, inverse distance
from warprrf.rf.spectra import lookups as lookups

# == kept ==
from warprrf.geometry.splats.gaussian_rays import GaussianRays as GaussianRays
from warprrf.geometry.splats.rasterizer import Blending as Blending
from warprrf.geometry.splats.rasterizer import Rasterizer as Rasterizer
from warprrf.geometry.splats.render import BlendWeights as BlendWeights
from warprrf.geometry.splats.render import blend_weights as blend_weights
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
from warprrf.rf.channel.precoding import precoded_sinr as precoded_sinr
from warprrf.rf.channel.precoding import precoders as precoders
from warprrf.rf.channel.precoding import transmit_covariance as transmit_covariance
from warprrf.rf.em.absorption import gas_attenuation_db_per_m as gas_attenuation_db_per_m
from warprrf.rf.fields.bistatic.field import BistaticField as BistaticField
from warprrf.rf.fields.bistatic.training import FitOptions as FitOptions
from warprrf.rf.fields.harmonic.field import HarmonicField as HarmonicField
from warprrf.rf.fields.harmonic.options import FieldOptions as FieldOptions
from warprrf.rf.interop.deepmimo import write_deepmimo as write_deepmimo
from warprrf.rf.interop.sionna_engine import load_sionna_scene as load_sionna_scene
from warprrf.rf.interop.twin import write_twin as write_twin
from warprrf.viewer.viewer import Viewer as Viewer

__version__: str
