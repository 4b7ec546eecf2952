"""Lists of what every tile and every block of pixels sees, near to far: keys to sort by, entries, shares of blocks.

Gaussians are sorted by range once, their entries then by tile with a sort that keeps the order.
"""

import warp as wp

from warprrf.kernels.raster.lanes import LANES, lanes_of, lowest_bit

integers = lanes_of(int)
long_pair = wp.types.vector(2, wp.int64)


@wp.kernel(enable_backward=False)
def sort_keys(
    offset: int,
    count: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    keys: wp.array(dtype=int),
    values: wp.array(dtype=int),
):
    """Ranges as integers of the same order (a float that is not negative sorts as its bits do); unseen ones last."""
    i = offset + wp.tid()
    key = int(2147483647)
    if count[i] > 0:
        key = wp.cast(distance[i], wp.int32)
    keys[i] = key
    values[i] = i


@wp.kernel(enable_backward=False)
def tally(offset: int, stripes: int, count: wp.array(dtype=int), found: wp.array(dtype=long_pair)):
    """Of every stripe of Gaussians, how many are seen and how many tiles they cover."""
    stripe = offset + wp.tid()
    total = long_pair()
    for i in range(stripe, count.shape[0], stripes):
        if count[i] > 0:
            total += long_pair(wp.int64(1), wp.int64(count[i]))
    found[stripe] = total


@wp.kernel(enable_backward=False)
def counts_in_order(
    offset: int, order: wp.array(dtype=int), count: wp.array(dtype=int), ordered: wp.array(dtype=int)
):
    """The count of tiles of each Gaussian, near to far."""
    i = offset + wp.tid()
    ordered[i] = count[order[i]]


@wp.kernel(enable_backward=False)
def emit_tiles(
    offset: int,
    order: wp.array(dtype=int),
    span: wp.array(dtype=wp.vec4i),
    ends: wp.array(dtype=int),
    tiles_x: int,
    keys: wp.array(dtype=int),
    begins: wp.array(dtype=int),
    values: wp.array(dtype=int),
    whose: wp.array(dtype=int),
):
    """Write (tile, slot) for every covered tile, Gaussians near to far, and whose slot it is: a Gaussian's slots follow
    one another from ``begins``."""
    i = offset + wp.tid()
    k = order[i]
    s = span[k]
    slot = begins[k]
    at = int(0)
    if i > 0:
        at = ends[i - 1]
    for row in range(s[3]):
        for column in range(s[1]):
            keys[at] = (s[2] + row) * tiles_x + (s[0] + column) % tiles_x
            values[at] = slot
            whose[slot] = k
            at += 1
            slot += 1


@wp.kernel(enable_backward=False)
def tile_starts(offset: int, keys: wp.array(dtype=int), count: int, starts: wp.array(dtype=int)):
    """``starts[t]``: first entry of tile t in the sorted list, by bisection; ``starts[tiles]`` is the count."""
    tile = offset + wp.tid()
    lo = int(0)
    hi = count
    while lo < hi:
        middle = (lo + hi) / 2
        if keys[middle] < tile:
            lo = middle + 1
        else:
            hi = middle
    starts[tile] = lo


@wp.kernel(enable_backward=False)
def fill_blocks(
    offset: int,
    ids: wp.array(dtype=int),
    masks: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    block_starts: wp.array(dtype=int),
    block_ids: wp.array(dtype=int),
):
    """Share a tile's list out to the blocks that its masks name, in the same order."""
    tile = offset + wp.tid()
    at = integers()
    for b in range(wp.static(LANES)):
        at[b] = block_starts[tile * wp.static(LANES) + b]
    for j in range(starts[tile], starts[tile + 1]):
        mask = masks[j]
        while mask != 0:
            b = lowest_bit(mask)
            mask = mask & (mask - 1)
            block_ids[at[b]] = ids[j]
            at[b] = at[b] + 1
