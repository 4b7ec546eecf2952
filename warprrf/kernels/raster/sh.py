"""Real spherical harmonics to degree 3 and the colours they give Gaussians.

Signs and order are those of the INRIA splat layout (degree 1: -y, z, -x), so that other viewers show our files alike.
Constants: the orthonormal real harmonics, e.g. Sloan, "Stupid Spherical Harmonics Tricks" (2008), appendix A2.
"""

from types import SimpleNamespace

import warp as wp

from warprrf.cache import once

COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}  # degree -> number of basis functions


@once
def build(real: type) -> SimpleNamespace:
    """Functions and kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec16 = wp.types.vector(16, real)

    @wp.func
    def basis(d: vec3):
        """The 16 harmonics at the unit direction ``d``."""
        x = d[0]
        y = d[1]
        z = d[2]
        xx = x * x
        yy = y * y
        zz = z * z
        return vec16(
            real(0.28209479177387814),
            real(-0.48860251190291992) * y,
            real(0.48860251190291992) * z,
            real(-0.48860251190291992) * x,
            real(1.0925484305920792) * x * y,
            real(-1.0925484305920792) * y * z,
            real(0.31539156525252005) * (real(2.0) * zz - xx - yy),
            real(-1.0925484305920792) * x * z,
            real(0.54627421529603959) * (xx - yy),
            real(-0.59004358992664352) * y * (real(3.0) * xx - yy),
            real(2.8906114426405538) * x * y * z,
            real(-0.45704579946446577) * y * (real(4.0) * zz - xx - yy),
            real(0.37317633259011540) * z * (real(2.0) * zz - real(3.0) * xx - real(3.0) * yy),
            real(-0.45704579946446577) * x * (real(4.0) * zz - xx - yy),
            real(1.4453057213202769) * z * (xx - yy),
            real(-0.59004358992664352) * x * (xx - real(3.0) * yy),
        )

    @wp.kernel(module="unique", enable_backward=True)
    def colors(
        offset: int,
        means: wp.array(dtype=vec3),
        sh: wp.array(dtype=real, ndim=3),
        origin: wp.array(dtype=vec3),
        out: wp.array(dtype=real, ndim=2),
    ):
        """``max(0, SH(direction from the camera) + 0.5)`` per Gaussian and channel."""
        i = offset + wp.tid()
        b = basis(wp.normalize(means[i] - origin[0]))
        for c in range(sh.shape[2]):
            value = real(0.5)
            for k in range(sh.shape[1]):
                value += sh[i, k, c] * b[k]
            # Its adjoint, which does not repeat the loop above, takes every colour for one above zero.
            out[i, c] = wp.max(value, real(0.0))

    @wp.kernel(module="unique", enable_backward=False)
    def uncut(
        offset: int,
        colors: wp.array(dtype=real, ndim=2),
        gradient: wp.array(dtype=real, ndim=2),
        left: wp.array(dtype=real, ndim=2),
    ):
        """What is left of colours' gradients: none where a colour is cut off at zero."""
        i = offset + wp.tid()
        for c in range(colors.shape[1]):
            if colors[i, c] > real(0.0):
                left[i, c] = gradient[i, c]

    return SimpleNamespace(basis=basis, colors=colors, uncut=uncut)
