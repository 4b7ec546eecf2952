"""What Warp's kernels compute of paths, inside torch: tensors that autograd differentiates. The only module of paths that knows
torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

from warprrf.geometry.splats.torch_functions import in_stream, once_differentiable, shared, torch


def evaluate(
    launch: Callable[[dict[str, wp.array]], list[wp.array]],
    given: Mapping[str, Any],
    types: Mapping[str, type],
    device: wp.Device,
) -> list[torch.Tensor]:
    """What ``launch``, which Warp's tape records, makes of tensors ``given`` by name, as arrays of ``types``; ``vec2d`` are complex
    numbers. One vector may stand for a row of vectors.
    """
    tensors = []
    for name, value in given.items():
        tensor = torch.as_tensor(value, dtype=torch.float64)
        if wp.device_from_torch(tensor.device) != device:
            raise ValueError(f"{name}: got a tensor on {tensor.device}, expected {device}")
        tensors.append(tensor[None] if types[name] is wp.vec3d and tensor.ndim == 1 else tensor)
    return list(_Evaluate.apply(launch, [(name, types[name]) for name in given], *tensors))


class _Evaluate(torch.autograd.Function):
    @staticmethod
    @in_stream
    def forward(ctx: Any, launch: Any, named: Any, *tensors: torch.Tensor) -> Any:
        arrays = {name: shared(t, dtype) for (name, dtype), t in zip(named, tensors, strict=True)}
        for array in arrays.values():
            array.requires_grad = True
        with wp.Tape() as ctx.tape:
            ctx.outputs = launch(arrays)
        ctx.inputs = list(arrays.values())
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        found = [wp.to_torch(array, requires_grad=False).clone() for array in ctx.outputs]
        return tuple(
            torch.view_as_complex(t) if a.dtype is wp.vec2d else t
            for t, a in zip(found, ctx.outputs, strict=True)
        )

    @staticmethod
    @once_differentiable
    @in_stream
    def backward(ctx: Any, *incoming: torch.Tensor | None) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since forward
        ctx.tape.zero()
        seeds = {
            array: shared(torch.view_as_real(g.resolve_conj()) if g.is_complex() else g, array.dtype)
            for array, g in zip(ctx.outputs, incoming, strict=True)
            if g is not None
        }
        ctx.tape.backward(grads=seeds)
        return None, None, *(wp.to_torch(array.grad, requires_grad=False).clone() for array in ctx.inputs)
