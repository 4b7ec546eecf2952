"""Spreading of point-like paths over an equirectangular grid by a von Mises-Fisher beam, in float64.

``exp(kappa (cos a - 1))`` is evaluated as ``exp(-kappa c^2 / 2)`` with c the chord between unit vectors, which does not
cancel near the beam's centre, as it is at the poles and across the azimuth seam. Paths come sorted by the pixel that
they fall in, so that every pixel gathers its own sum: no atomics, the same result on any number of threads.
"""

import warp as wp


@wp.struct
class BeamGrid:
    """Pixels of a grid, and how far a beam reaches on it.

    Attributes:
        pixels: unit vectors through their centres, by row and column.
        solid_angles: of a pixel of each row [sr].
        half_widths: ``[i, m]`` columns either side hold row i's share of paths in row m; -1 where there is none.
        kappa: of the beam.
        chord_limit: squared chord at which it ends.
    """

    pixels: wp.array2d(dtype=wp.vec3d)
    solid_angles: wp.array(dtype=wp.float64)
    half_widths: wp.array2d(dtype=wp.int32)
    kappa: wp.float64
    chord_limit: wp.float64


@wp.func
def column_start(column: int, half: int, columns: int):
    """First column of a window about ``column``; 0 if the window spans the whole row."""
    if 2 * half + 1 >= columns:
        return 0
    return (column - half + columns) % columns


@wp.func
def window_width(half: int, columns: int):
    """Number of columns of the window."""
    return wp.min(2 * half + 1, columns)


@wp.func
def column_at(start: int, step: int, columns: int):
    """Column of a window, counted from its first."""
    column = start + step
    if column >= columns:
        column = column - columns
    return column


@wp.func
def beam_at(c: wp.float64, shift: wp.float64, grid: BeamGrid):
    """Beam at the squared chord ``c`` over that at ``shift``; nothing beyond the limit."""
    value = wp.float64(0.0)
    if c <= grid.chord_limit:
        value = wp.exp(wp.float64(0.5) * grid.kappa * (shift - c))
    return value


@wp.kernel
def beam_normaliser(
    offset: int,
    directions: wp.array(dtype=wp.vec3d),
    cells: wp.array(dtype=wp.int32),
    grid: BeamGrid,
    nearest: wp.array(dtype=wp.float64),
    total: wp.array(dtype=wp.float64),
):
    """For each path: squared chord to its nearest pixel centre, and the beam's sum over pixels relative to there."""
    k = offset + wp.tid()
    rows = grid.pixels.shape[0]
    columns = grid.pixels.shape[1]
    d = directions[k]
    cell_row = cells[k] / columns
    cell_column = cells[k] - cell_row * columns
    c0 = wp.length_sq(d - grid.pixels[cell_row, cell_column])
    # The pixel whose cell holds the path is the nearest, or near enough to keep the exponentials from underflowing.
    shift = c0
    weight = wp.float64(0.0)
    for row in range(rows):
        half = grid.half_widths[row, cell_row]
        if half >= 0:
            start = column_start(cell_column, half, columns)
            row_weight = wp.float64(0.0)
            for step in range(window_width(half, columns)):
                c = wp.length_sq(d - grid.pixels[row, column_at(start, step, columns)])
                row_weight = row_weight + beam_at(c, shift, grid)
            weight = weight + row_weight * grid.solid_angles[row]
    nearest[k] = shift
    total[k] = weight


@wp.kernel(enable_backward=False)
def separate_beams(
    offset: int,
    directions: wp.array(dtype=wp.vec3d),
    cells: wp.array(dtype=wp.int32),
    nearest: wp.array(dtype=wp.float64),
    total: wp.array(dtype=wp.float64),
    grid: BeamGrid,
    images: wp.array3d(dtype=wp.float32),
):
    """The beam of each path by itself, whose pixels sum to one."""
    k = offset + wp.tid()
    rows = grid.pixels.shape[0]
    columns = grid.pixels.shape[1]
    d = directions[k]
    cell_row = cells[k] / columns
    cell_column = cells[k] - cell_row * columns
    for row in range(rows):
        half = grid.half_widths[row, cell_row]
        if half >= 0:
            start = column_start(cell_column, half, columns)
            for step in range(window_width(half, columns)):
                column = column_at(start, step, columns)
                c = wp.length_sq(d - grid.pixels[row, column])
                value = beam_at(c, nearest[k], grid) * grid.solid_angles[row]
                images[k, row, column] = wp.float32(value / total[k])


@wp.kernel
def gather_beams(
    offset: int,
    directions: wp.array(dtype=wp.vec3d),
    powers: wp.array(dtype=wp.float64),
    nearest: wp.array(dtype=wp.float64),
    starts: wp.array(dtype=wp.int32),
    grid: BeamGrid,
    image: wp.array2d(dtype=wp.float64),
    strongest: wp.array2d(dtype=wp.int32),
):
    """Sum of the beams at each pixel, and which path gives the most there (-1: none)."""
    k = offset + wp.tid()
    rows = grid.pixels.shape[0]
    columns = grid.pixels.shape[1]
    row = k / columns
    column = k - row * columns
    p = grid.pixels[row, column]
    value = wp.float64(0.0)
    best_value = wp.float64(0.0)
    best = int(-1)
    for cell_row in range(rows):
        half = grid.half_widths[row, cell_row]
        if half >= 0:
            first = column_start(column, half, columns)
            width = window_width(half, columns)
            # The window's cells are contiguous but for the seam: one stretch of paths, or two.
            for part in range(2):
                low = first
                high = wp.min(first + width, columns)
                if part == 1:
                    low = 0
                    high = wp.max(first + width - columns, 0)
                if high > low:
                    base = cell_row * columns
                    for m in range(starts[base + low], starts[base + high]):
                        c = wp.length_sq(directions[m] - p)
                        if c <= grid.chord_limit:
                            w = powers[m] * wp.exp(wp.float64(0.5) * grid.kappa * (nearest[m] - c))
                            value = value + w
                            if w > best_value:
                                best_value = w
                                best = m
    image[row, column] = value * grid.solid_angles[row]
    strongest[row, column] = best


@wp.kernel
def strongest_rays(
    offset: int,
    directions: wp.array(dtype=wp.vec3d),
    per_pixel: int,
    log_power: wp.array(dtype=wp.float64),
    top: wp.array(dtype=wp.float64),
    highest: wp.float64,
    grid: BeamGrid,
    first_row: wp.array(dtype=wp.int32),
    least_fall: wp.array3d(dtype=wp.float32),
    strongest: wp.array(dtype=wp.int32),
):
    """Which ray's beam gives a pixel the most (-1: none), for ``per_pixel`` rays in every pixel's cell.

    ``top`` is the largest ``log_power`` of a cell, ``highest`` of all, ``least_fall`` by how much the beam lowers any
    ray of a cell at least: of the pixel's row, of the cell's row from ``first_row`` on, of the distance in columns.
    Most cells need no closer look.
    """
    k = offset + wp.tid()
    columns = grid.pixels.shape[1]
    row = k / columns
    column = k - row * columns
    p = grid.pixels[row, column]
    half_kappa = wp.float64(0.5) * grid.kappa
    best_value = wp.float64(-1.0e300)
    best = int(-1)
    # The own cell first: it is most often the answer.
    for j in range(per_pixel):
        m = k * per_pixel + j
        value = log_power[m] - half_kappa * wp.length_sq(directions[m] - p)
        if value > best_value:
            best_value = value
            best = m
    first = first_row[row]
    for r in range(wp.min(least_fall.shape[1], grid.pixels.shape[0] - first)):
        half = wp.min(grid.half_widths[row, first + r], columns / 2)
        base = (first + r) * columns
        for apart in range(half + 1):
            # Farther cells of the row can only give less.
            fall = wp.float64(least_fall[row, r, apart])
            if highest - fall <= best_value:
                break
            for side in range(2):
                cell_column = column + apart
                if side == 1:
                    cell_column = column - apart
                if cell_column >= columns:
                    cell_column = cell_column - columns
                if cell_column < 0:
                    cell_column = cell_column + columns
                n = base + cell_column
                if top[n] - fall > best_value:
                    for j in range(per_pixel):
                        m = n * per_pixel + j
                        c = wp.length_sq(directions[m] - p)
                        value = log_power[m] - half_kappa * c
                        if c <= grid.chord_limit and value > best_value:
                            best_value = value
                            best = m
    strongest[k] = best
