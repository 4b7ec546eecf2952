"""Baselines that know no geometry, in PyTorch (extra ``baselines``): NeRF2 and a conditional GAN; and Sionna RT with its own
gradients.

Networks learn pictures of spectra in [0, 1]: the dB image of the data set, mapped by its stated range, which is what
their mean square and L1 losses suit. What they predict goes back the same way to path gain, so that every metric treats
them as any other method.
"""
