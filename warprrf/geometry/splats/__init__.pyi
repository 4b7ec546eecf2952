# == classes ==
# pinhole and spherical cameras
from warprrf.geometry.splats.camera import Camera as Camera

# anisotropic Gaussians with opacity and colour
from warprrf.geometry.splats.gaussians import Gaussians as Gaussians

# transmittance rule, thresholds and cutoff of blending
from warprrf.geometry.splats.rasterizer import Blending as Blending

# renders one camera again and again, with gradients
from warprrf.geometry.splats.rasterizer import Rasterizer as Rasterizer

# the most weighty Gaussians of every pixel
from warprrf.geometry.splats.render import BlendWeights as BlendWeights

# rays from any points through Gaussians
from warprrf.geometry.splats.gaussian_rays import GaussianRays as GaussianRays

# == functions ==
# weights of a view, for fits that keep the geometry
from warprrf.geometry.splats.render import blend_weights as blend_weights
