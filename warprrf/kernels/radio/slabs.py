"""A slab's reflection and transmission, for kernels in either precision. Complex numbers are pairs (real, imaginary).

ITU-R P.2040-4, section 2.2.2, the single layer in vacuum; in NumPy it is :mod:`warprrf.rf.em.fresnel`.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.cache import once


@once
def build(real: type) -> Any:
    """Functions in precision ``real``; Warp's adjoint of them is their derivative."""
    vec2 = wp.types.vector(2, real)

    @wp.func
    def times(a: vec2, b: vec2):
        """Product of complex numbers."""
        return vec2(a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])

    @wp.func
    def over(a: vec2, b: vec2):
        """Quotient of complex numbers; ``a`` where ``b`` is 0."""
        found = a
        if b[0] != real(0.0) or b[1] != real(0.0):
            found = times(a, vec2(b[0], -b[1])) / wp.dot(b, b)
        return found

    @wp.func
    def root_of(a: vec2):
        """Square root of a complex number, its real part positive."""
        size = wp.dot(a, a)
        found = vec2(real(0.0), real(0.0))
        if size > real(0.0):
            large = wp.sqrt(real(0.5) * (wp.sqrt(size) + wp.abs(a[0])))
            small = real(0.5) * a[1] / large
            found = vec2(large, small)
            if a[0] < real(0.0):
                found = vec2(wp.abs(small), wp.where(a[1] > real(0.0), large, -large))
        return found

    @wp.func
    def spun(angle: real):
        """exp(-j angle)."""
        return vec2(wp.cos(angle), -wp.sin(angle))

    @wp.func
    def shared(wave: vec2, face: vec2, echo: vec2, none: vec2):
        """``wave`` over 1 - face^2 echo; ``none`` where that is 0, as at grazing of a slab without thickness."""
        below = vec2(real(1.0), real(0.0)) - times(times(face, face), echo)
        found = none
        if below[0] != real(0.0) or below[1] != real(0.0):
            found = over(wave, below)
        return found

    @wp.func
    def slab(eta: vec2, thickness: real, c: real, mirrors: wp.bool):
        """What a slab of ``thickness`` wavelengths makes of a field at cosine ``c``: (TE, TM) that it reflects, or lets through
        less the phase of the way through, and by how many wavelengths that way is longer than in air; eqs. (37a), (37b), (43a),
        (43b), (44)."""
        one = vec2(real(1.0), real(0.0))
        root = root_of(eta - (real(1.0) - c * c) * one)
        once = real(0.0) * one  # nothing comes back from, or through, a half-space
        faded = real(0.0) * one
        longer = real(0.0)
        if not wp.isinf(thickness):
            turns = real(6.283185307179586) * thickness
            faded = wp.exp(turns * root[1]) * one
            once = times(faded, spun(turns * root[0]))
            longer = thickness * (root[0] - c)
        echo = times(once, once)
        before = c * one
        te = over(before - root, before + root)
        tm = over(c * eta - root, c * eta + root)
        te_out = shared(times(te, one - echo), te, echo, real(0.0) * one)
        tm_out = shared(times(tm, one - echo), tm, echo, real(0.0) * one)
        if not mirrors:
            te_out = shared(times(one - times(te, te), faded), te, echo, faded)
            tm_out = shared(times(one - times(tm, tm), faded), tm, echo, faded)
        return te_out, tm_out, longer

    return SimpleNamespace(times=times, spun=spun, slab=slab)
