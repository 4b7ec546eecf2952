# == functions ==
# photos to cameras, Gaussians, a mesh and its planar pieces
from warprrf.geometry.pipeline import reconstruct as reconstruct

# a picture of Gaussians from a camera
from warprrf.geometry.splats.render import render as render

# spectra of a scene at given receivers, by our own engine or Sionna RT
from warprrf.rf.simulate import simulate as simulate

# positions for receivers in the free space of a scene
from warprrf.rf.simulate import sample_receivers as sample_receivers

# line of sight and mirror reflections by the image method
from warprrf.rf.paths.trace import trace_paths as trace_paths

# what each effect is worth in a scene, and the smallest model within a tolerance
from warprrf.rf.relevance.search import relevance as relevance

# which of many places transmitters should stand at, by a field's radio maps
from warprrf.rf.maps.placing import place as place

# errors of predicted spectra at held-out receivers
from warprrf.rf.spectra.metrics import evaluate as evaluate

# the pattern of a horn antenna
from warprrf.rf.spectra.antenna import horn as horn

# what any of them holds, in the browser: drag a receiver
from warprrf.viewer import view as view

# == classes ==
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

# a model fitted to spectra, which answers for any receiver
from warprrf.rf.fields.base import RadioField as RadioField

# which paths a field or a simulation models
from warprrf.rf.tracing.model import Effects as Effects

# propagation paths, and the channels, taps and spreads that follow
from warprrf.rf.paths.path_set import Paths as Paths

# an antenna by name, from numbers on a grid of angles, or from a file: gain, or field in two polarisations
from warprrf.rf.spectra.antenna import Antenna as Antenna

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

# derivatives of paths, slopes of what is traced anew
from warprrf.rf import paths as paths

# Sionna RT, DeepMIMO, digital twins
from warprrf.rf import interop as interop

# the rasteriser, blending weights, rays through Gaussians
from warprrf.geometry import splats as splats

# PSNR, SSIM, directions and beam loss, one by one
from warprrf.rf.spectra import metrics as metrics

# predictions that know no geometry: nearest measurement, inverse distance
from warprrf.rf.spectra import lookups as lookups

__version__: str
