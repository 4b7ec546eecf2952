"""The rasteriser's definition in plain tensor operations: the peer that our kernels are measured against.

Same images as :class:`warprrf.geometry.splats.rasterizer.Rasterizer` (exact response on every ray, both cameras, both
transmittance rules, order by range, same cutoffs and early exit),
differentiated by torch's autograd. Nothing loops over
Gaussians or pixels: tiles of 8 x 8 pixels are padded to lists of similar length and processed in bulk.

The response is written independently of the kernels. With whitening ``M = diag(1/s) R^T`` and mean ``m`` seen from the
ray origin, the squared Mahalanobis distance of the ray ``d`` from the mean is

    q = |M d x M m|^2 / |M d|^2,   M d x M m = cof(M) (d x m),

and its peak lies at range ``t = (M m . M d) / |M d|^2``. Both are products of ``d`` with matrices of the Gaussian,
made once per view in float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.rasterizer import Blending

if TYPE_CHECKING:
    import torch

TILE = 8  # pixels: of 4, 8 and 16 the fastest
# Pairs of pixel and Gaussian processed at once: operands then stay in a core's second-level cache.
CHUNK = 1 << 16


@dataclass(frozen=True)
class TorchImage:
    """What :func:`render_with_torch` returns.

    Attributes:
        features: blended features, shape ``(H, W, C)``.
        alpha: sum of blending weights, shape ``(H, W)``.
        depth: blended mean range of the peaks [m]; 0 where alpha is 0, so that a loss on it stays finite.
        passing: pairs of pixel and Gaussian that contributed.
        tested: pairs of pixel and Gaussian whose response was computed, padding included.
    """

    features: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    passing: int
    tested: int


def render_with_torch(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    cam: Camera,
    background: torch.Tensor | None = None,
    *,
    blending: Blending | None = None,
) -> TorchImage:
    """Blend Gaussians front to back along every pixel's ray; differentiable in every tensor.

    Args:
        means, quaternions, scales, opacities, features: shapes ``(N, 3)``, ``(N, 4)`` wxyz of any length, ``(N, 3)``
            [m], ``(N,)``, ``(N, C)``, one floating type; it is the precision of the image.
        background: shape ``(C,)``; default: zero.
    """
    import torch

    blending = blending or Blending()
    real, device = features.dtype, features.device
    rotation, m = (
        _rotations(quaternions.double()),
        means.double() - torch.as_tensor(cam.position, device=device),
    )
    size, distance = scales.double(), torch.linalg.vector_norm(m, dim=1)
    with torch.no_grad():
        cut = 2 * torch.log(opacities.double() / blending.alpha_min)
        span = _spans(cam, rotation, m, size, distance, cut)
        ids, starts = _tile_lists(span, distance.float(), cam)
    ray_matrices, leading = _ray_matrices(rotation, m, size)
    # One row more, of opacity zero, pads the lists.
    pad = torch.nn.functional.pad
    unseen = torch.eye(7, 3, dtype=real, device=device)[
        None
    ]  # a finite response, which its cut of zero refuses
    matrices = torch.cat([ray_matrices.to(real), unseen])
    leading = pad(leading.to(real), (0, 1))
    opacity, color = pad(opacities.to(real), (0, 1)), pad(features, (0, 0, 0, 1))
    cut = pad(cut.to(real), (0, 1))
    directions = _tiled(torch.as_tensor(cam.directions(), dtype=real, device=device))
    back = torch.zeros(features.shape[1], dtype=real, device=device) if background is None else background

    lengths = starts[1:] - starts[:-1]
    order = torch.argsort(lengths, stable=True)
    pieces, counts, tested = [], [], 0
    for tiles in _batches(lengths[order].tolist()):
        batch = order[tiles]
        longest = int(lengths[batch[-1]])
        slot = torch.arange(longest, device=device)
        listed = slot < lengths[batch][:, None]
        k = torch.where(listed, ids[torch.where(listed, starts[batch][:, None] + slot, 0)], len(means)) \
            if longest else torch.zeros((len(batch), 0), dtype=torch.long, device=device)  # fmt: skip
        piece, count = _blend(
            matrices[k], leading[k], opacity[k], cut[k], color[k], directions[batch], back, blending
        )
        pieces.append(piece)
        counts.append(count)
        tested += k.numel() * TILE * TILE
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order), device=device)
    out = _untiled(torch.cat(pieces)[place], cam)
    passing = int(_untiled(torch.cat(counts)[place], cam).sum())
    alpha, depth_sum = out[..., -2], out[..., -1]
    seen = alpha > 0
    depth = torch.where(seen, depth_sum / torch.where(seen, alpha, 1), 0)
    return TorchImage(out[..., :-2], alpha, depth, passing, tested)


def _blend(
    matrices: torch.Tensor,
    leading: torch.Tensor,
    opacity: torch.Tensor,
    cut: torch.Tensor,
    color: torch.Tensor,
    directions: torch.Tensor,
    background: torch.Tensor,
    blending: Blending,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tiles in bulk: ``(tiles, K, ...)`` Gaussians near to far on ``(tiles, P, 3)`` rays; columns features, alpha, sum
    of weight times range, shape ``(tiles, P, C + 2)``; and how many contributed, ``(tiles, P, 1)``."""
    import torch

    tiles, longest = opacity.shape
    products = torch.bmm(matrices.reshape(tiles, longest * 7, 3), directions.transpose(1, 2))
    products = products.reshape(tiles, longest, 7, -1)
    whitened, offset, along = products[:, :, 0:3], products[:, :, 3:6], products[:, :, 6]
    square = (whitened * whitened).sum(2)
    q = (offset * offset).sum(2) / square
    # Past every cut; an exponential that underflows to denormal numbers would slow all that follows.
    raw = opacity[..., None] * torch.exp(-0.5 * q.clamp(max=80.0))
    keep = (q < cut[..., None]) & (along > 0)
    alpha = torch.where(keep, raw.clamp(max=blending.alpha_max), 0)
    # Light left before each Gaussian, and behind all.
    left = torch.cumprod(1 - alpha, 1) if blending.rule == "product" else torch.exp(-torch.cumsum(alpha, 1))
    before = torch.cat([torch.ones_like(alpha[:, :1]), left], 1)
    with torch.no_grad():
        reached = before > blending.transmittance_min  # once below, always below
        final = reached[:, :-1].sum(1, keepdim=True) if longest else reached[:, :1].long() * 0
    weight = alpha * before[:, :-1] * reached[:, :-1]
    value = torch.cat([color, torch.ones_like(color[..., :1])], 2)
    blended = torch.bmm(weight.transpose(1, 2), value)
    depth = (weight * (leading[..., None] * along / square)).sum(1)
    remaining = torch.gather(before, 1, final)[:, 0]
    seen = torch.cat([blended[..., :-1] + remaining[..., None] * background, blended[..., -1:]], 2)
    return torch.cat([seen, depth[..., None]], 2), (keep & reached[:, :-1]).sum(1)[..., None]


def _ray_matrices(
    rotation: torch.Tensor, m: torch.Tensor, size: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """``(N, 7, 3)``: what a ray ``d`` is multiplied with for ``M d``, ``cof(M) (d x m)`` and ``M m . M d``; and the
    factor that makes the last a range. M is scaled by the smallest scale, which keeps float32 in range."""
    import torch

    smallest = size.amin(1, keepdim=True)
    s = smallest / size
    turned = rotation.transpose(1, 2)
    whiten = s[:, :, None] * turned
    cofactor = torch.stack([s[:, 1] * s[:, 2], s[:, 0] * s[:, 2], s[:, 0] * s[:, 1]], 1)[:, :, None] * turned
    x, y, z = m.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)  # d x m
    offset = cofactor @ cross / smallest[:, :, None]
    distance = torch.linalg.vector_norm(m, dim=1, keepdim=True)
    unit = m / distance.clamp(min=1e-12)  # nobody reads the row of a centre on the ray origin
    along = (whiten.transpose(1, 2) @ (whiten @ unit[:, :, None]))[:, None, :, 0]
    return torch.cat([whiten, offset, along], 1), distance[:, 0]


def _rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotation matrices ``(N, 3, 3)`` of quaternions wxyz, normalised here."""
    import torch

    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def _spans(
    cam: Camera,
    rotation: torch.Tensor,
    m: torch.Tensor,
    size: torch.Tensor,
    distance: torch.Tensor,
    cut: torch.Tensor,
) -> torch.Tensor:
    """Pixels that a Gaussian can touch, ``(N, 4)``: first column, columns, first row, rows. Columns run on over the
    seam of a panorama; zero columns where nothing is seen."""
    import torch

    radius = cut.clamp(min=0).sqrt()
    # A centre on the ray origin has no direction: it contributes nothing.
    visible = (cut > 0) & (distance >= 1e-12)
    inside = (((rotation.transpose(1, 2) @ m[:, :, None])[..., 0] / size) ** 2).sum(1) <= cut
    lo, hi = torch.zeros_like(m[:, :2]), torch.empty_like(m[:, :2])
    hi[:, 0], hi[:, 1] = cam.width, cam.height
    if cam.kind == "pinhole":
        to_camera = torch.as_tensor(cam.rotation, device=m.device)
        p = m @ to_camera.T
        axes = to_camera @ rotation * (radius[:, None] * size)[:, None, :]
        # An image line touches the ellipsoid where its plane's normal is on this dual cone.
        cone = axes @ axes.transpose(1, 2) - p[:, :, None] * p[:, None, :]
        one_side = ~inside & (cone[:, 2, 2] < 0)
        # Those that cross the camera plane: seen only if their cap reaches into the cone round the image.
        corner = torch.tensor(
            [max(cam.cx, cam.width - cam.cx) / cam.fx, max(cam.cy, cam.height - cam.cy) / cam.fy]
        )
        half_view = torch.atan(torch.linalg.vector_norm(corner))
        reach = radius * size.amax(1) / distance.clamp(min=1e-300)
        cap = torch.where(reach < 1, torch.asin(reach.clamp(max=1)), torch.pi)
        off_axis = torch.acos((p[:, 2] / distance.clamp(min=1e-300)).clamp(-1, 1))
        visible &= torch.where(one_side, p[:, 2] > 0, inside | (off_axis < cap + half_view))
        for axis, focal, centre in ((0, cam.fx, cam.cx), (1, cam.fy, cam.cy)):
            c13, c33 = cone[:, axis, 2], torch.where(one_side, cone[:, 2, 2], -1)
            root = (c13**2 - cone[:, axis, axis] * c33).clamp(min=0).sqrt()
            for bound, sign in ((lo, 1), (hi, -1)):
                bound[:, axis] = torch.where(
                    one_side, focal * (c13 + sign * root) / c33 + centre, bound[:, axis]
                )
    else:
        ratio = radius * size.amax(1) / distance.clamp(min=1e-300)
        small = ~inside & (ratio < 1)
        cap = torch.asin(ratio.clamp(max=1))
        zenith = torch.acos((m[:, 2] / distance.clamp(min=1e-300)).clamp(-1, 1))
        lo[:, 1] = torch.where(small, (zenith - cap) * cam.height / torch.pi, lo[:, 1])
        hi[:, 1] = torch.where(small, (zenith + cap) * cam.height / torch.pi, hi[:, 1])
        off_pole = small & (cap < zenith) & (cap < torch.pi - zenith)
        half = torch.asin((torch.sin(cap) / torch.sin(zenith).clamp(min=1e-300)).clamp(max=1))
        azimuth = torch.atan2(m[:, 1], m[:, 0]) + torch.pi
        per_radian = cam.width / (2 * torch.pi)
        lo[:, 0] = torch.where(off_pole, (azimuth - half) * per_radian, lo[:, 0])
        hi[:, 0] = torch.where(off_pole, (azimuth + half) * per_radian, hi[:, 0])
    slack = 1e-3  # pixels: covers the rounding of the bounds
    limit = torch.tensor([2.0 * cam.width, cam.height], device=m.device, dtype=m.dtype)
    first = torch.ceil(torch.minimum(torch.maximum(lo - slack, -limit), limit) - 0.5).long()
    last = torch.floor(torch.minimum(torch.maximum(hi + slack, -limit), limit) - 0.5).long()
    for axis, pixels in ((0, cam.width), (1, cam.height)):
        if axis == 0 and cam.kind == "spherical":
            last[:, 0] = torch.minimum(last[:, 0], first[:, 0] + pixels - 1)
            continue
        first[:, axis], last[:, axis] = first[:, axis].clamp(min=0), last[:, axis].clamp(max=pixels - 1)
    count = torch.where(visible[:, None] & (last >= first).all(1, keepdim=True), last - first + 1, 0)
    return torch.stack([first[:, 0], count[:, 0], first[:, 1], count[:, 1]], 1)


def _tile_lists(span: torch.Tensor, distance: torch.Tensor, cam: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Gaussians of every tile, near to far (ties by index), one list after the other, and where each list starts."""
    import torch

    tiles_x, tiles_y = -(-cam.width // TILE), -(-cam.height // TILE)
    parts, who = [], []
    order = torch.argsort(distance, stable=True)
    order = order[span[order, 1] > 0]
    first = span[order, 0] % cam.width if cam.kind == "spherical" else span[order, 0]
    end = first + span[order, 1]
    # A span over the seam is two: up to the last column, and from column zero.
    for lo, hi in ((first, end.clamp(max=cam.width)), (torch.zeros_like(first), end - cam.width)):
        some = hi > lo
        parts.append(torch.stack([lo, hi, span[order, 2], span[order, 2] + span[order, 3]], 1)[some])
        who.append(torch.nonzero(some)[:, 0])
    bounds, rank = torch.cat(parts), torch.cat(who)
    left, right = bounds[:, 0] // TILE, (bounds[:, 1] - 1) // TILE
    top, bottom = bounds[:, 2] // TILE, (bounds[:, 3] - 1) // TILE
    wide = right - left + 1
    counts = wide * (bottom - top + 1)
    entry = torch.repeat_interleave(torch.arange(len(bounds), device=span.device), counts)
    within = torch.arange(len(entry), device=span.device) - (counts.cumsum(0) - counts)[entry]
    tile = (top[entry] + within // wide[entry]) * tiles_x + left[entry] + within % wide[entry]
    # Tile first, range second; a Gaussian that meets both ends of a tile's row is listed once.
    key = torch.unique(tile * max(len(order), 1) + rank[entry])
    tile, position = key // max(len(order), 1), key % max(len(order), 1)
    starts = torch.searchsorted(tile, torch.arange(tiles_x * tiles_y + 1, device=span.device))
    return order[position], starts


def _batches(lengths: list[int]) -> list[slice]:
    """Runs of tiles (by growing length) whose padded lists hold about :data:`CHUNK` pairs."""
    batches, first = [], 0
    for k in range(1, len(lengths) + 1):
        if k == len(lengths) or (k + 1 - first) * max(lengths[k], 1) * TILE * TILE > CHUNK:
            batches.append(slice(first, k))
            first = k
    return batches


def _tiled(image: torch.Tensor) -> torch.Tensor:
    """``(H, W, C)`` as ``(tiles, TILE * TILE, C)``; what a tile has beyond the image repeats its border."""
    import torch

    height, width, channels = image.shape
    rows = torch.arange(-(-height // TILE) * TILE, device=image.device).clamp(max=height - 1)
    columns = torch.arange(-(-width // TILE) * TILE, device=image.device).clamp(max=width - 1)
    whole = image[rows][:, columns].reshape(-1, TILE, len(columns) // TILE, TILE, channels)
    return whole.transpose(1, 2).reshape(-1, TILE * TILE, channels)


def _untiled(tiles: torch.Tensor, cam: Camera) -> Any:
    """The inverse of :func:`_tiled`, cropped to the image."""
    across = -(-cam.width // TILE)
    whole = tiles.reshape(-1, across, TILE, TILE, tiles.shape[-1]).transpose(1, 2)
    return whole.reshape(-1, across * TILE, tiles.shape[-1])[: cam.height, : cam.width]
