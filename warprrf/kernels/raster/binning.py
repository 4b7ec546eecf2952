"""Lists of what every tile sees, near to far.

Gaussians are sorted by range once, their entries then by tile with a sort that keeps the order.
"""

import warp as wp


@wp.kernel(enable_backward=False)
def counts_in_order(
    offset: int, order: wp.array(dtype=int), span: wp.array(dtype=wp.vec4i), ordered: wp.array(dtype=wp.int64)
):
    """How many tiles each Gaussian covers, near to far; their sum may be too large for 32 bits."""
    i = offset + wp.tid()
    s = span[order[i]]
    ordered[i] = wp.int64(s[1] * s[3])


@wp.kernel(enable_backward=False)
def emit_entries(
    offset: int,
    order: wp.array(dtype=int),
    span: wp.array(dtype=wp.vec4i),
    ends: wp.array(dtype=wp.int64),
    tiles_x: int,
    keys: wp.array(dtype=int),
    values: wp.array(dtype=int),
):
    """Write (tile, Gaussian) for every covered tile, Gaussians near to far."""
    i = offset + wp.tid()
    k = order[i]
    s = span[k]
    at = int(0)
    if i > 0:
        at = int(ends[i - 1])
    for row in range(s[3]):
        for column in range(s[1]):
            keys[at] = (s[2] + row) * tiles_x + (s[0] + column) % tiles_x
            values[at] = k
            at += 1


@wp.kernel(enable_backward=False)
def tile_starts(offset: int, keys: wp.array(dtype=int), count: int, starts: wp.array(dtype=int)):
    """``starts[t]``: first entry of tile t in the sorted list; ``starts[tiles]`` is the count."""
    tile = offset + wp.tid()
    starts[tile] = wp.lower_bound(keys, 0, count + 1, tile)  # the answer is before the end given
