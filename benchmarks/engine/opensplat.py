"""OpenSplat's CPU rasteriser as a peer, compiled from a checkout that the user has.

https://github.com/pierotofy/OpenSplat is under the AGPL: nothing of it is part of this package, and what is compiled
here stays on the user's machine. Its rasteriser is compiled alone, as a torch extension, by the flags of its own
release build and for this machine's processor; that takes a minute, once.

What it computes differs: Gaussians are projected to ellipses (affine, EWA) and blurred by 0.3 square pixels, ordered by
camera depth and not clipped in front of the camera. Hence its image is compared by PSNR. Projection is differentiated
by torch, blending by its own adjoint, which works on one thread.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.device import require
from warprrf.geometry.splats.camera import Camera

if TYPE_CHECKING:
    import torch

SOURCES = ("project_gaussians.cpp", "rasterize_gaussians.cpp", "rasterizer/gsplat-cpu/gsplat_cpu.cpp")
_NEAR, _FAR = 1e-3, 1e3  # m: only the order of depths follows from them

# Its rasteriser reads depths as if side by side, its projection returns a column of a table: without the copies it
# blends in a wrong order.
_CALL = """
torch::Tensor render(torch::Tensor means, torch::Tensor quaternions, torch::Tensor scales, torch::Tensor opacities,
                     torch::Tensor colors, torch::Tensor view, torch::Tensor projection, double fx, double fy,
                     double cx, double cy, int64_t width, int64_t height, torch::Tensor background) {
    auto seen = ProjectGaussiansCPU::apply(
        means, scales, 1.0f, quaternions, view, projection, fx, fy, cx, cy, height, width);
    for (auto& tensor : seen) tensor = tensor.contiguous();
    return RasterizeGaussiansCPU::apply(
        seen[0], seen[1], seen[2], colors, opacities, seen[3], seen[4], height, width, background);
}
"""


@cache
def build(folder: str) -> Any:
    """The compiled rasteriser of the checkout in ``folder``.

    Raises:
        ValueError: if ``folder`` is no checkout of OpenSplat.
        RuntimeError: if it does not compile, with the compiler's words, or no compiler is there.
        ImportError: without torch.
    """
    root = Path(folder).resolve()
    missing = [name for name in SOURCES if not (root / name).is_file()]
    if missing:
        raise ValueError(f"opensplat: {root} lacks {missing[0]}, expected a checkout of OpenSplat")
    extension = _extension()
    if not extension.is_ninja_available() or shutil.which(extension.get_cxx_compiler()) is None:
        raise RuntimeError("opensplat: a C++ compiler and ninja are needed to compile it, and one is missing")
    return extension.load_inline(
        "warprrf_bench_opensplat",
        ["".join(f'#include "{root / name}"\n' for name in SOURCES) + _CALL],
        functions=["render"],
        extra_include_paths=[str(root), str(root / "rasterizer")],
        extra_cflags=["-O3", "-DNDEBUG", "-march=native"],
    )


def _extension() -> Any:
    require("torch", "baselines")
    from torch.utils import cpp_extension

    return cpp_extension


def renderer(folder: str, cam: Camera, parameters: list[torch.Tensor]) -> Callable[[], torch.Tensor]:
    """A function that renders ``parameters`` (as of :func:`warprrf.geometry.splats.torch_functions.rasterize`) over black.

    Raises:
        ValueError: for a camera other than a pinhole whose axis meets the middle of the image.
    """
    if cam.kind != "pinhole" or not np.allclose((cam.cx, cam.cy), (cam.width / 2, cam.height / 2)):
        raise ValueError(f"cam: got a {cam.kind} camera, expected a pinhole that looks at the image's middle")
    torch = require("torch", "baselines")
    module = build(folder)
    view = torch.tensor(cam.world_to_camera, dtype=torch.float32)
    depth = _FAR - _NEAR
    projection = torch.tensor(
        [
            [2 * cam.fx / cam.width, 0, 0, 0],
            [0, 2 * cam.fy / cam.height, 0, 0],
            [0, 0, (_FAR + _NEAR) / depth, -_FAR * _NEAR / depth],
            [0, 0, 1, 0],
        ]
    )
    background = torch.zeros(3)
    means, quaternions, scales, opacities, colors = parameters

    def render() -> Any:
        unit = quaternions / quaternions.norm(dim=1, keepdim=True)
        return module.render(
            means, unit, scales, opacities[:, None], colors, view, projection @ view, cam.fx, cam.fy, cam.cx, cam.cy,
            cam.width, cam.height, background,
        )  # fmt: skip

    return render
