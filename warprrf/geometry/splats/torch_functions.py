"""Rasteriser and rays inside torch: functions of tensors that autograd differentiates, computed by our Warp kernels.

The only module of the geometry that knows torch, without which it cannot be imported (``pip install
"warprrf[baselines]"``). Work runs on the tensors' own device in their own precision, float32 or float64. Derivatives
are of first order; asking for a second one raises torch's error instead of returning zeros.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Any, TypeVar, cast

import warp as wp

from warprrf.device import resolve
from warprrf.geometry.splats.camera import Camera, check_camera
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer

try:
    import torch
    from torch.autograd.function import once_differentiable
except ModuleNotFoundError as error:
    raise ImportError('torch is not installed: pip install "warprrf[baselines]"') from error

Function = TypeVar("Function", bound=Callable[..., Any])


def rasterize(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    cam: Camera,
    background: torch.Tensor | None = None,
    *,
    blending: Blending | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Blend Gaussians front to back, as :func:`warprrf.render` does; differentiable in every tensor.

    Args:
        means: centres [m], shape ``(N, 3)``.
        quaternions: wxyz of any length but zero, shape ``(N, 4)``.
        scales: standard deviations [m], shape ``(N, 3)``.
        opacities: in [0, 1], shape ``(N,)``.
        features: shape ``(N, C)``.
        background: shape ``(C,)``; default: zero.

    Returns:
        Features ``(H, W, C)``, alpha ``(H, W)`` and depth ``(H, W)``: the blended mean range [m], 0 where alpha is 0.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    check_camera(cam)
    _check_gaussians(means, quaternions, scales, opacities)
    _check("features", features, (len(means), None), means)
    if background is None:
        background = torch.zeros(features.shape[1], dtype=means.dtype, device=means.device)
    _check("background", background, (features.shape[1],), means)
    return _Rasterize.apply(cam, blending, means, quaternions, scales, opacities, features, background)


def colors(means: torch.Tensor, sh: torch.Tensor, cam: Camera) -> torch.Tensor:
    """Colours ``max(0, SH + 0.5)`` that harmonics ``(N, K, C)`` show towards the camera, shape ``(N, C)``;
    differentiable in both tensors.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    check_camera(cam)
    _check("means", means, (None, 3), None)
    _check("sh", sh, (len(means), None, None), means)
    return _Colors.apply(cam, means, sh)


def ray_transmittance(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    a: torch.Tensor,
    b: torch.Tensor,
    *,
    blending: Blending | None = None,
) -> torch.Tensor:
    """Share of light that passes from ``a`` to ``b`` (N, 3) or (3,) [m], shape ``(N,)``: see
    :meth:`warprrf.splats.GaussianRays.transmittance`; differentiable in the four tensors, not in the points.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    _check_gaussians(means, quaternions, scales, opacities)
    query: Any = ("transmit_with_adjoint", (a, b), {}, blending)
    return _Rays.apply(query, means, quaternions, scales, opacities)[0]


def ray_hits(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    k: int = 16,
    *,
    order: str = "peak",
    blending: Blending | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The first ``k`` Gaussians along each ray: index, t, alpha, weight (N, K) and left (N,), see
    :meth:`warprrf.splats.GaussianRays.hits`; all but the index differentiable in the four tensors, not in the rays.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    _check_gaussians(means, quaternions, scales, opacities)
    query: Any = ("trace_with_adjoint", (origins, directions, k), {"order": order}, blending)
    t, alpha, weight, left, index = _Rays.apply(query, means, quaternions, scales, opacities)
    return index, t, alpha, weight, left


def _check_gaussians(
    means: torch.Tensor, quaternions: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor
) -> None:
    _check("means", means, (None, 3), None)
    n = len(means)
    _check("quaternions", quaternions, (n, 4), means)
    smallest, _ = _check("scales", scales, (n, 3), means)
    lowest, highest = _check("opacities", opacities, (n,), means)
    tiny = torch.finfo(torch.float32).tiny
    for name, fits, misfits, expected in (
        ("quaternions", bool(quaternions.detach().any(1).all()),
         lambda: ~quaternions.detach().any(1), "wxyz rotations of a length above zero"),
        ("scales", smallest >= tiny, lambda: scales.detach() < tiny, "positive metres, not denormal"),
        ("opacities", 0 <= lowest and highest <= 1,
         lambda: (opacities.detach() < 0) | (opacities.detach() > 1), "values in [0, 1]"),
    ):  # fmt: skip
        if not fits:
            raise ValueError(
                f"{name}: got {int(misfits().sum())} values that do not fit, expected {expected}"
            )


def _check(
    name: str, tensor: object, shape: tuple[int | None, ...], like: torch.Tensor | None
) -> tuple[float, float]:
    """Refuse what is not a tensor of such numbers; returns the lowest and the highest (ones if it is empty)."""
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name}: got {type(tensor).__name__}, expected a torch.Tensor")
    if tensor.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: got {tensor.dtype}, expected torch.float32 or torch.float64")
    if like is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
        raise ValueError(
            f"{name}: got {tensor.dtype} on {tensor.device}, expected {like.dtype} on {like.device}, as means"
        )
    if tensor.ndim != len(shape) or any(
        s is not None and s != n for s, n in zip(shape, tensor.shape, strict=True)
    ):
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"{name}: got shape {tuple(tensor.shape)}, expected ({wanted})")
    if tensor.numel() == 0:
        return 1.0, 1.0
    low, high = (
        float(bound) for bound in torch.aminmax(tensor.detach())
    )  # NaN if any is: one pass tells all
    if not math.isfinite(low) or not math.isfinite(high):
        raise ValueError(f"{name}: got values that are NaN or infinite, expected finite numbers")
    return low, high


def _raster(tensor: torch.Tensor, blending: Blending | None = None) -> Rasterizer:
    real = wp.float64 if tensor.dtype == torch.float64 else wp.float32
    return Rasterizer(device=resolve(str(tensor.device)), blending=blending, real=real)


def shared(tensor: torch.Tensor, dtype: type) -> wp.array:
    """The tensor's memory as a Warp array, without a gradient yet."""
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)


def _seed(arrays: tuple[wp.array, ...], incoming: tuple[torch.Tensor | None, ...]) -> None:
    """Let torch's gradients be those of the arrays; the adjoint reads them and nothing writes them."""
    for array, gradient in zip(arrays, incoming, strict=True):
        array.grad = None if gradient is None else shared(gradient, array.dtype)


def _gradients(arrays: tuple[wp.array, ...], wanted: tuple[bool, ...], adjoint: Any) -> list[Any]:
    """What ``adjoint`` adds to new gradients of ``arrays``; None for those that nobody wants."""
    for array, want in zip(arrays, wanted, strict=True):
        array.grad = wp.zeros_like(array, requires_grad=False) if want else None
    adjoint()
    return [wp.to_torch(array.grad, requires_grad=False) if array.requires_grad else None for array in arrays]


def _stream_of(tensor: torch.Tensor | None) -> Any:
    """On a GPU, what is launched inside goes to torch's current stream, behind what made the tensor."""
    if tensor is None or not tensor.is_cuda:
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))


def in_stream(static: Function) -> Function:
    """A forward or backward in the stream of the first tensor among its arguments, if there is one: gradients of
    outputs that nobody used are None."""

    @wraps(static)
    def run(*arguments: Any) -> Any:
        first = next((a for a in arguments if isinstance(a, torch.Tensor)), None)
        with _stream_of(first):
            return static(*arguments)

    return cast("Function", run)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    @in_stream
    def forward(ctx: Any, cam: Camera, blending: Blending | None, *tensors: torch.Tensor) -> Any:
        r = _raster(tensors[0], blending)
        types = (r._vector(3), r._vector(4), r._vector(3), r.real, r.real, r.real)
        inputs = tuple(shared(t, dtype) for t, dtype in zip(tensors, types, strict=True))
        image, ctx.adjoint = r.blend_with_adjoint(
            r.prepare(inputs[0], inputs[1], inputs[2], inputs[3], cam),
            inputs[4],
            inputs[5],
            gradients=False,
        )
        ctx.inputs, ctx.outputs = inputs, (image.features, image.alpha, image.depth)
        out = tuple(wp.to_torch(array, requires_grad=False) for array in ctx.outputs)
        ctx.save_for_backward(*tensors, *out)  # the adjoint reads both
        ctx.set_materialize_grads(False)
        return out

    @staticmethod
    @once_differentiable
    @in_stream
    def backward(ctx: Any, *incoming: torch.Tensor | None) -> Any:
        _ = ctx.saved_tensors  # raises if an input or an output was changed in place since forward
        _seed(ctx.outputs, incoming)
        return None, None, *_gradients(ctx.inputs, ctx.needs_input_grad[2:], ctx.adjoint)


class _Colors(torch.autograd.Function):
    @staticmethod
    @in_stream
    def forward(ctx: Any, cam: Camera, means: torch.Tensor, sh: torch.Tensor) -> Any:
        r = _raster(means)
        inputs = (shared(means, r._vector(3)), shared(sh, r.real))
        out = wp.zeros((len(means), sh.shape[2]), dtype=r.real, device=r.device)
        origin = r.colors_into(*inputs, cam, out)
        ctx.inputs, ctx.out = inputs, out
        ctx.adjoint = lambda: r.colors_adjoint(*inputs, origin, out)
        ctx.save_for_backward(means, sh)
        return wp.to_torch(out, requires_grad=False).clone()

    @staticmethod
    @once_differentiable
    @in_stream
    def backward(ctx: Any, incoming: torch.Tensor) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since forward
        open_ones = wp.to_torch(ctx.out, requires_grad=False) > 0  # the others are cut off at zero
        left = torch.where(open_ones, incoming, 0.0)  # a copy: Warp's own adjoint zeroes what it has read
        _seed((ctx.out,), (left,))
        return None, *_gradients(ctx.inputs, ctx.needs_input_grad[1:], ctx.adjoint)


class _Rays(torch.autograd.Function):
    @staticmethod
    @in_stream
    def forward(ctx: Any, query: tuple[str, tuple[Any, ...], Any, Any], *tensors: torch.Tensor) -> Any:
        method, arguments, options, blending = query
        r = _raster(tensors[0])
        types = (r._vector(3), r._vector(4), r._vector(3), r.real)
        ctx.inputs = tuple(shared(t, dtype) for t, dtype in zip(tensors, types, strict=True))
        rays = GaussianRays(ctx.inputs, blending=blending)
        found, ctx.adjoint = getattr(rays, method)(*arguments, **options)
        hits = not isinstance(found, wp.array)
        ctx.outputs = found.outputs if hits else (found,)
        ctx.save_for_backward(*tensors)
        kind = tensors[0].dtype
        out = [wp.to_torch(a, requires_grad=False).to(kind, copy=True) for a in ctx.outputs]
        if hits:
            out.append(wp.to_torch(found.index).clone())
            ctx.mark_non_differentiable(out[-1])
        return tuple(out)

    @staticmethod
    @once_differentiable
    @in_stream
    def backward(ctx: Any, *incoming: torch.Tensor) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since forward
        _seed(ctx.outputs, tuple(g.double() for g in incoming[: len(ctx.outputs)]))
        return None, *_gradients(ctx.inputs, ctx.needs_input_grad[1:], ctx.adjoint)
