"""Spreading of paths onto a grid of delays, one grid for each pair of a receiving and a transmitting element.

First step of a non-uniform fast Fourier transform (Dutt and Rokhlin 1993): a path of delay t adds to :data:`TAPS` cells
about t by a Kaiser-Bessel window. A pair owns its row of the grid, so that no sum is shared between threads. float64.
"""

from __future__ import annotations

import warp as wp

TAPS = 8
"""Cells that a path adds to."""

DEGREE = 10
"""Degree of the polynomials that stand for the window where every pair has delays of its own: they err by 1e-8."""

taps_vector = wp.types.vector(TAPS, wp.float64)


@wp.kernel
def spread_common_delays(
    offset: int,
    columns: int,
    left: wp.array2d(dtype=wp.vec2d),
    right: wp.array2d(dtype=wp.vec2d),
    window: wp.array(dtype=taps_vector),
    first: wp.array(dtype=int),
    real: wp.array2d(dtype=wp.float64),
    imag: wp.array2d(dtype=wp.float64),
):
    """Pairs whose paths have the same delays: pair (m, n) adds left[m, p] right[n, p] window[p].

    Paths are sorted by cell; ``first`` says where the paths of each cell begin. Sums stay in registers over a cell.
    """
    pair = offset + wp.tid()
    m = pair / columns
    n = pair - m * columns
    for cell in range(first.shape[0] - 1):
        start = first[cell]
        end = first[cell + 1]
        if end > start:
            sum_re = taps_vector()
            sum_im = taps_vector()
            for p in range(start, end):
                a = left[m, p]
                b = right[n, p]
                weights = window[p]
                sum_re += (a[0] * b[0] - a[1] * b[1]) * weights
                sum_im += (a[0] * b[1] + a[1] * b[0]) * weights
            for j in range(TAPS):
                real[pair, cell + j] = real[pair, cell + j] + sum_re[j]
                imag[pair, cell + j] = imag[pair, cell + j] + sum_im[j]


@wp.func
def add_to_cell(
    x: wp.float64,
    re: wp.float64,
    im: wp.float64,
    pair: int,
    window: wp.array(dtype=taps_vector),
    grid: wp.array2d(dtype=taps_vector),
):
    """Add a path at ``x`` cells: its eight taps stay together, as one vector of the cell that it lies in."""
    cell = int(x)
    inside = wp.float64(cell + 1) - x
    weights = window[0]
    for k in range(1, DEGREE + 1):
        weights = inside * weights + window[k]
    grid[pair, 2 * cell] = grid[pair, 2 * cell] + re * weights
    grid[pair, 2 * cell + 1] = grid[pair, 2 * cell + 1] + im * weights


@wp.kernel
def spread_separable_delays(
    offset: int,
    columns: int,
    left: wp.array2d(dtype=wp.vec2d),
    cell_left: wp.array2d(dtype=wp.float64),
    right: wp.array2d(dtype=wp.vec2d),
    cell_right: wp.array2d(dtype=wp.float64),
    window: wp.array(dtype=taps_vector),
    grid: wp.array2d(dtype=taps_vector),
):
    """Separable delays: factors left[m, p] right[n, p], places cell_left[m, p] + cell_right[n, p]."""
    pair = offset + wp.tid()
    m = pair / columns
    n = pair - m * columns
    for p in range(left.shape[1]):
        a = left[m, p]
        b = right[n, p]
        re = a[0] * b[0] - a[1] * b[1]
        im = a[0] * b[1] + a[1] * b[0]
        add_to_cell(cell_left[m, p] + cell_right[n, p], re, im, pair, window, grid)


@wp.kernel
def spread_pair_delays(
    offset: int,
    columns: int,
    place: wp.array(dtype=wp.vec3d),
    target: wp.array2d(dtype=wp.vec3d),
    extra: wp.array2d(dtype=wp.float64),
    scale: wp.array2d(dtype=wp.float64),
    amplitude: wp.array(dtype=wp.vec2d),
    cell: wp.array(dtype=wp.float64),
    turns_per_m: wp.float64,
    cells_per_m: wp.float64,
    window: wp.array(dtype=taps_vector),
    grid: wp.array2d(dtype=taps_vector),
):
    """Spherical waves of mirrored arrays: path p is longer by extra[n, p] + |target[n, p] - place[m]|.

    Its amplitude is scaled by scale[n, p] / |target - place|; its phase turns by ``turns_per_m`` of the length, its
    delay moves by ``cells_per_m``.
    """
    pair = offset + wp.tid()
    m = pair / columns
    n = pair - m * columns
    here = place[m]
    for p in range(cell.shape[0]):
        reach = wp.length(target[n, p] - here)
        ratio = scale[n, p] / reach
        longer = extra[n, p] + reach
        turns = longer * turns_per_m
        angle = wp.float64(-6.283185307179586) * (turns - wp.round(turns))
        c = wp.cos(angle) * ratio
        s = wp.sin(angle) * ratio
        a = amplitude[p]
        x = cell[p] + longer * cells_per_m
        add_to_cell(x, a[0] * c - a[1] * s, a[0] * s + a[1] * c, pair, window, grid)


@wp.kernel
def join_cells(
    offset: int,
    cells: int,
    shift: int,
    grid: wp.array2d(dtype=taps_vector),
    real: wp.array2d(dtype=wp.float64),
    imag: wp.array2d(dtype=wp.float64),
):
    """Sum the taps of neighbouring cells: tap j of cell q belongs to place q + j - ``shift``, modulo ``cells``."""
    pair = offset + wp.tid()
    width = grid.shape[1] / 2
    for q in range(width):
        re = grid[pair, 2 * q]
        im = grid[pair, 2 * q + 1]
        for j in range(TAPS):
            to = (q + j + cells - shift) % cells
            real[pair, to] = real[pair, to] + re[j]
            imag[pair, to] = imag[pair, to] + im[j]
