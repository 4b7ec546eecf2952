"""Power of path records and its logarithmic slopes, interaction by interaction.

The same coefficients with their phases, of single paths, are in :mod:`warprrf.rf.em.fresnel`. ``record_power`` gives values, on
Warp's tape too; ``bin_slopes`` are the derivatives that a fit takes of line of sight and mirrors, and error bars of everything. A
fit's derivatives of scattered light are those of sums by ``bin_components``, see
:class:`~warprrf.rf.fields.bistatic.observations.Columns`.

A record is a power that geometry fixes and a few interactions from the transmitter to the receiver. Mirrors and slabs
multiply Jones matrices in (TE, TM), real: half-spaces have no phase but their sign (ITU-R P.2040-4, eqs. (37a),
(37b)), and of slabs the sizes of both fields count. Between two of them the axes turn. One interaction may be rough, which
leaves light unpolarised: a surface that scatters, after Degli-Esposti et al. (2007), or an element that sends what it got
of others. All records of a table have it in the same column.

Angles of a mirror: cosine of incidence, turn of the plane of incidence [rad]; of a slab these, and its thickness in
wavelengths if it has one of its own, else 0; of a scattering surface: cosines of incidence and of scattering, and that of
the angle to the mirror direction.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.cache import once
from warprrf.kernels.radio import slabs

MIRROR, SCATTER, SLAB, EDGE, SOURCE = 1, 2, 4, 8, 16
"""Kinds of interactions, codes of ``sionna.rt.InteractionType`` as far as it has them: a mirror, a surface that scatters, a slab
that is passed, an edge, an element that sends. 0 for none. No kernel here handles an edge: what it does is in the power of its
paths, see :mod:`warprrf.rf.paths.edge_paths`."""
EXCESS_COLUMN, MIRRORED_COLUMN, THROUGH_COLUMN = 0, 1, 2
"""Columns of a material's parameters behind those of its lobe weights: logarithms of epsilon_r - 1, of the mirrored share, and of
the share let through."""
MOMENTS = 3
"""Components that a family of Fresnel curves is resolved into."""


@once
def build(real: type) -> Any:
    """Kernels in precision ``real``: power of each record, its slopes summed by bins, and sums by group and component."""
    vec2, vec3 = wp.types.vector(2, real), wp.types.vector(3, real)
    mat2 = wp.types.matrix((2, 2), real)
    slab_field = slabs.build(real).slab

    @wp.struct
    class Materials:
        """Rows are materials: lobe weights, epsilon_r - 1, mirrored share, share let through, slope of ln even reflection to
        ln(epsilon_r - 1), 1 where lobes are reciprocal; ``scale`` is a table over the cosine for each lobe; ``row`` and
        ``side_row`` are the material of each group and of each element's side, ``radiance`` what that sends. Of groups:
        complex permittivity, 0 where it is not known, and thickness in wavelengths; slabs are of these. If ``slab`` is 1 each
        group is a material of its own, and mirrors are slabs too."""

        weight: wp.array2d(dtype=real)
        excess: wp.array(dtype=real)
        mirror: wp.array(dtype=real)
        through: wp.array(dtype=real)
        even_slope: wp.array(dtype=real)
        row: wp.array(dtype=wp.int32)
        side_row: wp.array(dtype=wp.int32)
        radiance: wp.array(dtype=real)
        exponent: wp.array(dtype=wp.int32)
        scale: wp.array2d(dtype=real)
        reciprocal: wp.array(dtype=wp.int32)
        slab: int
        permittivity: wp.array(dtype=vec2)
        thickness: wp.array(dtype=real)

    @wp.struct
    class Table:
        """Records of one sequence: power without interactions; group of each interaction, side of an element where it
        sends, -1 for none; angles; kinds; column of the rough one; half the cosine's
        stretch that a ray stands for."""

        power: wp.array(dtype=real)
        index: wp.array2d(dtype=wp.int32)
        angle: wp.array2d(dtype=vec3)
        kind: wp.array2d(dtype=wp.int8)
        rough: int
        half_width: real

    @wp.func
    def kind_of(t: Table, i: int, k: int):
        """Kind of interaction k of record i; 0 past the last."""
        found = int(0)
        if k < t.kind.shape[1]:
            found = int(t.kind[i, k])
        return found

    @wp.func
    def half_space(x: real, c: real):
        """Reflection (TE, TM) of a half-space of epsilon_r = 1 + x at cosine c."""
        root = wp.sqrt(x + c * c)
        dense = (real(1.0) + x) * c
        return vec2((c - root) / (c + root), (dense - root) / (dense + root))

    @wp.func
    def half_space_slope(x: real, c: real):
        """Its derivative to ln x."""
        root = wp.sqrt(x + c * c)
        dense = (real(1.0) + x) * c
        bend = real(0.5) * x / root
        te = real(-2.0) * c * bend / ((c + root) * (c + root))
        tm = real(2.0) * (x * c * root - dense * bend) / ((dense + root) * (dense + root))
        return vec2(te, tm)

    @wp.func
    def slab(eta: vec2, thickness: real, c: real, mirrors: wp.bool):
        """Size of what a slab of ``thickness`` wavelengths reflects of (TE, TM), or lets through."""
        te, tm, _longer = slab_field(eta, thickness, c, mirrors)
        return vec2(wp.length(te), wp.length(tm))

    @wp.func
    def reflection(m: Materials, x: real, row: int, c: real):
        """Reflection (TE, TM) of a material: of a half-space with its sign; of a slab its size, as one mirror needs."""
        if m.slab == 1:
            return slab(m.permittivity[row], m.thickness[row], c, True)
        return half_space(x, c)

    @wp.func
    def fields(t: Table, m: Materials, x: real, i: int, k: int):
        """What interaction k of record i, a mirror or a slab, makes of (TE, TM) but for the share of its material. A slab of which
        nothing is known lets pass what neither face reflects."""
        g, angle = t.index[i, k], t.angle[i, k]
        through = int(1)
        row = g
        if kind_of(t, i, k) == wp.static(MIRROR):
            through = 0
            row = m.row[g]
        known = through == 0 and m.slab == 1
        if through == 1:
            known = m.permittivity[g][0] > real(0.0)
        if known:
            thickness = m.thickness[row]
            if through == 1 and angle[2] > real(0.0):
                thickness = angle[2]
            return slab(m.permittivity[row], thickness, angle[0], through == 0)
        r = half_space(x, angle[0])
        if through == 1:
            r = vec2(real(1.0) - r[0] * r[0], real(1.0) - r[1] * r[1])
        return r

    @wp.func
    def fields_slope(t: Table, m: Materials, x: real, i: int, k: int):
        """The derivative of that to ln x."""
        g, angle = t.index[i, k], t.angle[i, k]
        rise = half_space_slope(x, angle[0])
        if kind_of(t, i, k) == wp.static(SLAB):
            r = half_space(x, angle[0])
            rise = vec2(real(-2.0) * r[0] * rise[0], real(-2.0) * r[1] * rise[1])
            if m.permittivity[g][0] > real(0.0):
                rise = vec2(real(0.0), real(0.0))
        return rise

    @wp.func
    def turned(t: Table, r: vec2, i: int, k: int, begin: int):
        """Jones matrix of interaction k of record i, which makes ``r`` of (TE, TM): the axes turn into its plane first. What
        comes to the first one, ``begin``, is unpolarised: how that is turned does not count."""
        found = wp.diag(r)
        if k > begin:
            c = wp.cos(t.angle[i, k][1])
            s = wp.sin(t.angle[i, k][1])
            found = found * mat2(c, s, -s, c)
        return found

    @wp.func
    def raised(
        t: Table, m: Materials, excess: wp.array(dtype=real), i: int, begin: int, end: int, which: int
    ):
        """Jones matrix of the mirrors and slabs in columns ``begin`` to ``end``: its derivative to ln(epsilon_r - 1) of column
        ``which``, or itself where that is no column."""
        whole = mat2(real(1.0), real(0.0), real(0.0), real(1.0))
        for k in range(begin, wp.min(end, t.index.shape[1])):
            g = t.index[i, k]
            if g >= 0:
                r = vec2()
                if k == which:
                    r = fields_slope(t, m, excess[m.row[g]], i, k)
                else:
                    r = fields(t, m, excess[m.row[g]], i, k)
                whole = turned(t, r, i, k, begin) * whole
        return whole

    @wp.func
    def smooth(t: Table, m: Materials, excess: wp.array(dtype=real), i: int, begin: int, end: int):
        """Jones matrix of the mirrors and slabs in columns ``begin`` to ``end``."""
        return raised(t, m, excess, i, begin, end, -1)

    @wp.func_grad(smooth)
    def adjoint_smooth(
        t: Table, m: Materials, excess: wp.array(dtype=real), i: int, begin: int, end: int, adjoint: mat2
    ):
        """Unrolled for Warp's own adjoint, the loop would take a GPU's compiler minutes."""
        for k in range(begin, wp.min(end, t.index.shape[1])):
            g = t.index[i, k]
            if g >= 0:
                x = excess[m.row[g]]
                if x > real(0.0):
                    slope = wp.ddot(adjoint, raised(t, m, excess, i, begin, end, k))
                    wp.adjoint[excess][m.row[g]] += slope / x

    @wp.func
    def shares(t: Table, m: Materials, mirror: wp.array(dtype=real), through: wp.array(dtype=real), i: int):
        """Product of what materials mirror and let through on record i."""
        product = real(1.0)
        for k in range(t.index.shape[1]):
            if k != t.rough and t.index[i, k] >= 0:
                if kind_of(t, i, k) == wp.static(MIRROR):
                    product = product * mirror[m.row[t.index[i, k]]]
                else:
                    product = product * through[m.row[t.index[i, k]]]
        return product

    @wp.func_grad(shares)
    def adjoint_shares(
        t: Table,
        m: Materials,
        mirror: wp.array(dtype=real),
        through: wp.array(dtype=real),
        i: int,
        adjoint: real,
    ):
        """Warp's own adjoint does not go back through a loop of unknown length."""
        slope = adjoint * shares(t, m, mirror, through, i)
        for k in range(t.index.shape[1]):
            if k != t.rough and t.index[i, k] >= 0:
                row = m.row[t.index[i, k]]
                if kind_of(t, i, k) == wp.static(MIRROR):
                    if mirror[row] > real(0.0):
                        wp.adjoint[mirror][row] += slope / mirror[row]
                else:
                    if through[row] > real(0.0):
                        wp.adjoint[through][row] += slope / through[row]

    @wp.func
    def at(table: wp.array2d(dtype=real), row: int, cosine: real):
        """Row of a table over cosine in [0, 1], interpolated linearly."""
        last = table.shape[1] - 1
        x = cosine * real(last)
        i = wp.min(int(x), last - 1)
        s = x - real(i)
        return (real(1.0) - s) * table[row, i] + s * table[row, i + 1]

    @wp.func
    def narrowed(angle: vec3, half_width: real):
        """What lobes of all exponents share: ln((1 + cos psi) / 2), and the mean of 1 / cos(theta_s) over what the ray stands for,
        what lies below the horizon left out."""
        high = angle[1] + half_width
        low = wp.max(angle[1] - half_width, real(0.01) * half_width)
        base = wp.max(real(0.5) * (real(1.0) + angle[2]), real(1e-30))
        return vec2(wp.log(base), wp.log(high / low) / (high - low))

    @wp.func
    def lobe(m: Materials, row: int, which: int, angle: vec3, shared: vec2):
        """f_s / cos(theta_s) [1/sr] of a lobe; exponent 0 is Lambertian, whose cosine cancels. ``shared``: see ``narrowed``."""
        value = real(0.3183098861837907)
        n = int(m.exponent[which])
        if n > 0:
            scale = at(m.scale, which, angle[0])
            if m.reciprocal[row] == 1:
                scale *= at(m.scale, which, angle[1])
            else:
                scale *= shared[1]
            value = wp.exp(real(n) * shared[0]) * scale
        return value

    @wp.func
    def unpolarised(m: Materials, x: real, row: int, angle: vec3):
        """|Gamma|^2, mean of TE and TM, at incidence; of reciprocal lobes the mean of that at both angles."""
        r = reflection(m, x, row, angle[0])
        value = real(0.5) * wp.dot(r, r)
        if m.reciprocal[row] == 1:
            s = reflection(m, x, row, angle[1])
            value = real(0.5) * (value + real(0.5) * wp.dot(s, s))
        return value

    @wp.func
    def mixed(t: Table, m: Materials, weight: wp.array2d(dtype=real), i: int, row: int):
        """Sum of weight times lobe at the rough interaction of record i."""
        value = real(0.0)
        angle = t.angle[i, t.rough]
        shared = narrowed(angle, t.half_width)
        for j in range(m.exponent.shape[0]):
            value += weight[row, j] * lobe(m, row, j, angle, shared)
        return value

    @wp.func
    def power_of(
        t: Table,
        m: Materials,
        weight: wp.array2d(dtype=real),
        excess: wp.array(dtype=real),
        mirror: wp.array(dtype=real),
        through: wp.array(dtype=real),
        i: int,
    ):
        """Power of record i."""
        before = smooth(t, m, excess, i, 0, t.rough)
        after = smooth(t, m, excess, i, t.rough + 1, t.index.shape[1])
        p = t.power[i] * real(0.5) * wp.ddot(before, before) * real(0.5) * wp.ddot(after, after)
        p = p * shares(t, m, mirror, through, i)
        if kind_of(t, i, t.rough) == wp.static(SCATTER):
            row = m.row[t.index[i, t.rough]]
            p = p * mixed(t, m, weight, i, row) * unpolarised(m, excess[row], row, t.angle[i, t.rough])
        if kind_of(t, i, t.rough) == wp.static(SOURCE):
            p = p * m.radiance[t.index[i, t.rough]]
        return p

    @wp.kernel(module="unique")
    def record_power(
        offset: int,
        t: Table,
        m: Materials,
        weight: wp.array2d(dtype=real),
        excess: wp.array(dtype=real),
        mirror: wp.array(dtype=real),
        through: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        """Power of each record. What is differentiated stands beside the struct, where Warp's tape sees it."""
        i = offset + wp.tid()
        out[i] = power_of(t, m, weight, excess, mirror, through, i)

    @wp.kernel(module="unique", enable_backward=False)
    def record_field(
        offset: int,
        t: Table,
        m: Materials,
        sent: wp.array(dtype=vec2),
        heard: wp.array(dtype=vec2),
        out: wp.array(dtype=real),
        slope: wp.array2d(dtype=real),
    ):
        """Field that each record of mirrors and slabs makes of ``sent``, in (TE, TM) of the first, along ``heard``, in those of the
        last; and its derivative to ln(epsilon_r - 1) of each interaction."""
        i = offset + wp.tid()
        size = wp.sqrt(t.power[i] * shares(t, m, m.mirror, m.through, i))
        last = t.index.shape[1]
        out[i] = size * wp.dot(heard[i], smooth(t, m, m.excess, i, 0, last) * sent[i])
        for k in range(last):
            if t.index[i, k] >= 0:
                slope[i, k] = size * wp.dot(heard[i], raised(t, m, m.excess, i, 0, last, k) * sent[i])

    @wp.kernel(module="unique", enable_backward=False)
    def bin_slopes(
        offset: int,
        first: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        t: Table,
        m: Materials,
        place: wp.array(dtype=wp.int32),
        slope: wp.array2d(dtype=real),
    ):
        """Derivatives of the power of each bin's records, ``order[first[b]]`` on, to the logarithms of a material's
        lobe weights, epsilon_r - 1, mirrored share and share let through, which stand from column ``place`` of it on."""
        b = offset + wp.tid()
        lobes = m.exponent.shape[0]
        for s in range(first[b], first[b + 1]):
            i = order[s]
            p = power_of(t, m, m.weight, m.excess, m.mirror, m.through, i)
            if p > real(0.0):
                for k in range(t.index.shape[1]):
                    if k != t.rough:
                        if t.index[i, k] >= 0:
                            column = place[m.row[t.index[i, k]]] + lobes
                            begin = int(0)
                            end = t.rough
                            if k > t.rough:
                                begin = t.rough + 1
                                end = t.index.shape[1]
                            run = smooth(t, m, m.excess, i, begin, end)
                            bent = raised(t, m, m.excess, i, begin, end, k)
                            size = wp.ddot(run, run)
                            if size > real(0.0):
                                slope[b, column + wp.static(EXCESS_COLUMN)] += (
                                    real(2.0) * p * wp.ddot(run, bent) / size
                                )
                            if kind_of(t, i, k) == wp.static(MIRROR):
                                slope[b, column + wp.static(MIRRORED_COLUMN)] += p
                            else:
                                slope[b, column + wp.static(THROUGH_COLUMN)] += p
                if kind_of(t, i, t.rough) == wp.static(SCATTER):
                    row = m.row[t.index[i, t.rough]]
                    angle = t.angle[i, t.rough]
                    shared = narrowed(angle, t.half_width)
                    sum = mixed(t, m, m.weight, i, row)
                    for j in range(lobes):
                        slope[b, place[row] + j] += (
                            p * m.weight[row, j] * lobe(m, row, j, angle, shared) / sum
                        )
                    r = half_space(m.excess[row], angle[0])
                    rise = wp.dot(r, half_space_slope(m.excess[row], angle[0]))
                    if m.reciprocal[row] == 1:
                        r2 = half_space(m.excess[row], angle[1])
                        rise = real(0.5) * (rise + wp.dot(r2, half_space_slope(m.excess[row], angle[1])))
                    slope[b, place[row] + lobes + wp.static(EXCESS_COLUMN)] += (
                        p * rise / unpolarised(m, m.excess[row], row, angle)
                    )
                if kind_of(t, i, t.rough) == wp.static(SOURCE):
                    row = m.side_row[t.index[i, t.rough]]
                    whole = real(0.0)
                    for j in range(lobes):
                        whole += m.weight[row, j]
                    if whole > real(0.0):
                        for j in range(lobes):
                            slope[b, place[row] + j] += p * m.weight[row, j] / whole
                    slope[b, place[row] + lobes + wp.static(EXCESS_COLUMN)] += p * m.even_slope[row]

    @wp.kernel(module="unique", enable_backward=False)
    def bin_components(
        offset: int,
        first: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        t: Table,
        m: Materials,
        place: wp.array(dtype=wp.int32),
        moments: wp.array2d(dtype=real),
        out: wp.array2d(dtype=real),
    ):
        """What each group, lobe and Fresnel component scatters into each bin at unit weight: column (group's place, lobe,
        component)."""
        b = offset + wp.tid()
        lobes = m.exponent.shape[0]
        for s in range(first[b], first[b + 1]):
            i = order[s]
            angle = t.angle[i, t.rough]
            row = m.row[t.index[i, t.rough]]
            base = place[t.index[i, t.rough]] * lobes * wp.static(MOMENTS)
            shared = narrowed(angle, t.half_width)
            for j in range(lobes):
                value = t.power[i] * lobe(m, row, j, angle, shared)
                for c in range(wp.static(MOMENTS)):
                    part = at(moments, c, angle[0])
                    if m.reciprocal[row] == 1:
                        part = real(0.5) * (part + at(moments, c, angle[1]))
                    out[b, base + j * wp.static(MOMENTS) + c] += value * part

    return SimpleNamespace(
        Materials=Materials, Table=Table, record_power=record_power, record_field=record_field, bin_slopes=bin_slopes,
        bin_components=bin_components,
    )  # fmt: skip
