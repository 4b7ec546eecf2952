"""Learned baselines that know no geometry, in PyTorch (extra ``baselines``): NeRF2 and a conditional GAN.

Both learn pictures of spectra in [0, 1]: the dB image of the data set, mapped by its stated range, which is what their
mean square and L1 losses suit. What they predict goes back the same way to path gain, so that every metric treats them
as any other method. The only package of stage 2 that uses torch, imported when something is fitted or loaded.
"""

from benchmarks.baselines.cgan import CGAN, CGANOptions
from benchmarks.baselines.images import SpectrumImages
from benchmarks.baselines.nerf2 import NeRF2, NeRF2Options
from benchmarks.baselines.training import Training

__all__ = ["CGAN", "CGANOptions", "NeRF2", "NeRF2Options", "SpectrumImages", "Training"]
