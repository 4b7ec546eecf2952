"""Warp functions and kernels: no files, no torch, no state of the host."""
