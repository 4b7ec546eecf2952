"""Gaussians: the frozen geometry's primitive, and the INRIA splat PLY layout that other viewers open.

Scales in metres, opacities in [0, 1], quaternions wxyz (normalised on entry), colour = max(0, SH + 0.5).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace
from typing import Annotated

import numpy as np
import warp as wp
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from warprrf.checks import LARGEST_M, Shaped, check_count, check_similarity, checked, one_line
from warprrf.files import file_at
from warprrf.geometry.mesh import Mesh, headings
from warprrf.geometry.ply_files import read_ply, write_ply
from warprrf.kernels.raster import sh as _sh
from warprrf.kernels.raster.sh import COEFFICIENTS

Y00 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
# The file holds the logit; beyond this an opacity is as good as 0 or 1 and its logit stays finite in float32.
OPACITY_MARGIN = 1e-7
LARGEST_SH = 1e6

# Of discs on a mesh:
OVERSAMPLING = 8  # candidates per disc before thinning: enough to fill 95 % of the cells
RADIUS = 0.75  # standard deviation of a disc in units of the mean spacing: leaves no holes, blurs little
FLATNESS = 0.01  # thickness over radius
OPACITY = 0.999


@checked
@dataclass(frozen=True)
class Gaussians:
    """N anisotropic Gaussians.

    Attributes:
        means: centres [m], shape ``(N, 3)`` float32.
        quaternions: rotations wxyz, unit, shape ``(N, 4)`` float32.
        scales: standard deviations along the rotated axes [m], shape ``(N, 3)`` float32.
        opacities: in [0, 1], shape ``(N,)`` float32.
        sh: spherical-harmonic coefficients, shape ``(N, K, C)`` float32, K of 1, 4, 9, 16.

    Raises:
        ValueError: for shapes that do not fit, values that are not finite, zero quaternions, scales that are not
            positive, opacities outside [0, 1].
    """

    __repr__ = one_line

    means: Annotated[np.ndarray, Shaped("N 3", np.float32)]
    quaternions: Annotated[np.ndarray, Shaped("N 4")]
    scales: Annotated[np.ndarray, Shaped("N 3", np.float32)]
    opacities: Annotated[np.ndarray, Shaped("N", np.float32)]
    sh: Annotated[np.ndarray, Shaped("N K C", np.float32)]

    def __post_init__(self) -> None:
        for one in fields(self):  # callers may go on with theirs
            object.__setattr__(self, one.name, getattr(self, one.name).copy())
        scales, opacities = self.scales, self.opacities
        if self.sh.shape[1] not in COEFFICIENTS.values():
            raise ValueError(
                f"sh: got {self.sh.shape[1]} coefficients, expected 1, 4, 9 or 16 (degree 0 to 3)"
            )
        for name, most in (("means", LARGEST_M), ("scales", LARGEST_M), ("sh", LARGEST_SH)):
            largest = np.abs(getattr(self, name)).max(initial=0.0)
            if largest > most:
                raise ValueError(f"{name}: got values up to {largest:g}, expected at most {most:g}")
        norm = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        if (norm < 1e-12).any():
            raise ValueError(
                f"quaternions: {int((norm < 1e-12).sum())} are zero, expected wxyz rotations; (1, 0, 0, 0) is none"
            )
        norm = np.where(
            np.abs(norm - 1) < 1e-6, 1.0, norm
        )  # unit up to float32: saving and loading changes nothing
        smallest = float(np.finfo(np.float32).tiny)
        if (scales < smallest).any():
            raise ValueError(
                f"scales: {int((scales < smallest).any(axis=1).sum())} have a scale that is zero, negative or "
                "denormal, expected positive metres; a flat Gaussian needs a small scale such as 1e-4"
            )
        if ((opacities < 0) | (opacities > 1)).any():
            raise ValueError(
                f"opacities: got values from {opacities.min()} to {opacities.max()}, expected [0, 1] (not logits)"
            )
        object.__setattr__(self, "quaternions", (self.quaternions / norm).astype(np.float32))

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, chosen: slice | np.ndarray) -> Gaussians:
        """The Gaussians that an index array, mask or slice selects."""
        return Gaussians(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @property
    def rotations(self) -> np.ndarray:
        """Rotation matrices, columns are the axes of the scales, shape ``(N, 3, 3)`` float64."""
        return rotations_of(self.quaternions)

    @property
    def normals(self) -> np.ndarray:
        """Axis of the smallest scale, up to sign, shape ``(N, 3)`` float64."""
        return self.rotations[np.arange(len(self)), :, np.argmin(self.scales, axis=1)]

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Gaussians:
        """The Gaussians at ``scale rotation x + shift``; their colours turn along.

        Arguments and errors: see :func:`warprrf.checks.check_similarity`.
        """
        scale, turn, moved = check_similarity(scale, rotation, shift)
        return replace(
            self,
            means=scale * self.means @ turn.T + moved,
            quaternions=quaternions_of(turn @ self.rotations),
            scales=scale * self.scales,
            sh=np.einsum("jk,nkc->njc", _turned_harmonics(turn, self.sh.shape[1]), self.sh),
        )

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write the INRIA splat layout (binary little endian): x y z, normals (zero), f_dc, f_rest channel by channel,
        opacity as logit, scales as logarithm, rotation wxyz.

        Raises:
            ValueError: unless there are three colour channels, as the layout demands.
        """
        n, k, channels = self.sh.shape
        if channels != 3:
            raise ValueError(f"sh: got {channels} channels, the INRIA PLY layout holds exactly 3")
        names = [
            *("x", "y", "z", "nx", "ny", "nz"), *(f"f_dc_{c}" for c in range(3)),
            *(f"f_rest_{j}" for j in range(3 * (k - 1))), "opacity", *(f"scale_{c}" for c in range(3)),
            *(f"rot_{c}" for c in range(4)),
        ]  # fmt: skip
        opacity = np.clip(self.opacities.astype(np.float64), OPACITY_MARGIN, 1 - OPACITY_MARGIN)
        values = np.concatenate(
            [
                self.means, np.zeros((n, 3)), self.sh[:, 0], self.sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (k - 1)),
                np.log(opacity / (1 - opacity))[:, None], np.log(self.scales.astype(np.float64)), self.quaternions,
            ],
            axis=1,
        )  # fmt: skip
        write_ply(path, dict(zip(names, values.T, strict=True)), None)

    @classmethod
    def load_ply(cls, path: str | os.PathLike[str]) -> Gaussians:
        """Read splats in the INRIA layout, ASCII or binary, properties in any order.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no PLY, is cut short, or lacks a property of the layout.
        """
        table = read_ply(file_at(path)).get("vertex", {})

        def columns(*names: str) -> np.ndarray:
            missing = [name for name in names if not isinstance(table.get(name), np.ndarray)]
            if missing:
                raise ValueError(
                    f"{path}: lacks the vertex properties {missing}; expected a splat in the INRIA layout "
                    "(x y z f_dc_* f_rest_* opacity scale_* rot_*), not a mesh or a plain point cloud"
                )
            return np.stack([np.asarray(table[name], dtype=np.float64) for name in names], axis=1)

        dc = columns(*(f"f_dc_{c}" for c in range(3)))
        rest = sum(name.startswith("f_rest_") for name in table)
        if 1 + rest / 3 not in COEFFICIENTS.values():
            raise ValueError(f"{path}: got {rest} f_rest properties, expected 0, 9, 24 or 45")
        higher = columns(*(f"f_rest_{j}" for j in range(rest))) if rest else np.zeros((len(dc), 0))
        sh = np.concatenate([dc[:, None], higher.reshape(len(dc), 3, rest // 3).transpose(0, 2, 1)], axis=1)
        logit = columns("opacity")[:, 0]
        try:
            return cls(
                columns("x", "y", "z"),
                columns(*(f"rot_{c}" for c in range(4))),
                np.exp(np.clip(columns(*(f"scale_{c}" for c in range(3))), -700.0, 700.0)),
                0.5 * (1 + np.tanh(0.5 * logit)),  # the sigmoid, without overflow
                sh,
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _turned_harmonics(rotation: np.ndarray, count: int) -> np.ndarray:
    """Coefficients of the first ``count`` harmonics after a turn from those before, shape ``(count, count)``.

    A turned harmonic is a sum of those of its degree, so values at more directions than harmonics fix the sum.
    """
    kernels = _sh.build(wp.float64)
    directions = headings(np.random.default_rng(0).standard_normal((4 * count, 3)))[0]
    before, after = (
        np.array([[float(v) for v in kernels.basis(wp.vec3d(*d))][:count] for d in turned])
        for turned in (directions, directions @ rotation.T)
    )
    return np.linalg.lstsq(after, before, rcond=None)[0]


def rotations_of(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices ``(N, 3, 3)`` of quaternions wxyz ``(N, 4)``, normalised here."""
    return Rotation.from_quat(np.asarray(quaternions, np.float64)[:, [1, 2, 3, 0]]).as_matrix()


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Quaternions wxyz ``(N, 4)`` of rotation matrices ``(N, 3, 3)``."""
    return Rotation.from_matrix(np.asarray(rotations, np.float64)).as_quat()[:, [3, 0, 1, 2]]


def gaussians_of(geometry: object) -> Gaussians | None:
    """What a geometry has as its ``gaussians``; None for a mesh, a scene, or a reconstruction of a mesh alone."""
    return getattr(geometry, "gaussians", None) if getattr(geometry, "has_gaussians", True) else None


def discs_on_mesh(mesh: Mesh, count: int = 30_000, *, seed: int = 0) -> Gaussians:
    """About ``count`` flat Gaussians, evenly spread over ``mesh``, normals along its faces.

    They stand in for a reconstruction where a mesh is known and there are no photos.

    Args:
        count: wanted number; a few per cent fewer come out.
    """
    check_count("count", count)
    rng = np.random.default_rng(seed)
    area = np.where(mesh.first_at_place == np.arange(len(mesh.faces)), mesh.areas, 0.0)
    spacing = float(np.sqrt(area.sum() / count))
    face = rng.choice(len(area), size=OVERSAMPLING * count, p=area / area.sum())
    root, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
    barycentric = np.stack([1 - root, root * (1 - v), root * v], axis=-1)
    points = np.einsum("nk,nkj->nj", barycentric, mesh.triangles[face])
    # One disc per cell and side of the surface: opposite faces of a thin plate keep theirs.
    side = np.round(2 * mesh.face_normals[face]).astype(np.int64)
    cells = np.concatenate([np.floor((points - mesh.bounds[0]) / spacing).astype(np.int64), side], axis=1)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    points, normal = points[kept], mesh.face_normals[face[kept]]
    radius = RADIUS * spacing
    return Gaussians(
        means=points,
        quaternions=_turning_z_to(normal),
        scales=np.tile([radius, radius, FLATNESS * radius], (len(points), 1)),
        opacities=np.full(len(points), OPACITY),
        sh=np.zeros((len(points), 1, 3)),
    )


def _turning_z_to(normal: np.ndarray) -> np.ndarray:
    """Quaternions wxyz ``(N, 4)`` that turn the z axis to unit vectors ``(N, 3)``; a half turn about x for -z."""
    quaternion = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=-1)
    quaternion[np.linalg.norm(quaternion, axis=1) < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return quaternion
