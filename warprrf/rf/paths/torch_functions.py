"""Paths inside torch: tensors that autograd differentiates, computed by our Warp kernel. The only module of paths that knows torch."""

from __future__ import annotations

from typing import Any

import warp as wp

from warprrf.geometry.splats.torch_functions import in_stream, once_differentiable, shared, torch
from warprrf.rf.paths.specular import OUTPUTS, POSITIONS, PathValues, SpecularPaths


def evaluate(paths: SpecularPaths, parameters: dict[str, Any]) -> PathValues:
    """See :meth:`SpecularPaths.evaluate`: tensors of ``parameters``, some of which may be NumPy's arrays."""
    tensors = []
    for name, value in parameters.items():
        tensor = torch.as_tensor(value, dtype=torch.float64)
        if wp.device_from_torch(tensor.device) != paths.device:
            raise ValueError(f"{name}: got a tensor on {tensor.device}, expected {paths.device}")
        tensor = tensor[None] if name in POSITIONS and tensor.ndim == 1 else tensor
        paths.check_shape(name, tuple(tensor.shape))
        tensors.append(tensor)
    found = dict(zip(OUTPUTS, _Follow.apply(paths, tuple(parameters), *tensors), strict=True))
    for name in ("gain", "jones"):
        found[name] = torch.view_as_complex(found[name])
    return PathValues(**found)


class _Follow(torch.autograd.Function):
    @staticmethod
    @in_stream
    def forward(ctx: Any, paths: SpecularPaths, names: tuple[str, ...], *tensors: Any) -> Any:
        given = {
            name: shared(tensor, wp.vec3d if name in POSITIONS else wp.float64)
            for name, tensor in zip(names, tensors, strict=True)
        }
        for array in given.values():
            array.requires_grad = True
        with wp.Tape() as ctx.tape:
            ctx.outputs = paths.launch(given, taped=True)
        ctx.inputs = list(given.values())
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return tuple(wp.to_torch(array, requires_grad=False).clone() for array in ctx.outputs)

    @staticmethod
    @once_differentiable
    @in_stream
    def backward(ctx: Any, *incoming: Any) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since forward
        ctx.tape.zero()
        given = zip(ctx.outputs, incoming, strict=True)
        ctx.tape.backward(grads={array: shared(g, array.dtype) for array, g in given if g is not None})
        return None, None, *(wp.to_torch(array.grad, requires_grad=False).clone() for array in ctx.inputs)
