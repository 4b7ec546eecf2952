"""The exact paths among all: line of sight and mirror reflections, through slabs where asked for.

Mirror reflections follow the image method on the planar patches of a mesh, in float64: lengths are exact to rounding.
Angles: arrival points from the receiver to the last interaction, departure from the transmitter to the first.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_count, checked, whole
from warprrf.device import DeviceLike, Progress, silent
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE, GeometryLike, Mesh, as_mesh
from warprrf.geometry.planar_patches import planar_patches
from warprrf.rf.em.absorption import Gas
from warprrf.rf.em.fresnel import surface_table
from warprrf.rf.em.waves import SPEED_OF_LIGHT, Hertz, check_frequency
from warprrf.rf.paths.edge_paths import EdgeFinder, EdgePaths
from warprrf.rf.paths.images import MOST_CHAINS, MirrorImages
from warprrf.rf.paths.mirror_paths import MirrorPaths, exact_paths
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.slabs import MOST_SLABS, Walls
from warprrf.rf.paths.specular import OUTPUTS, SpecularPaths, fixed_parameters
from warprrf.rf.positions import Ends, check_positions, question_unit, warn_of_unmodelled

Order: TypeAlias = Annotated[int, whole(0)]
SlabCount: TypeAlias = Annotated[int, whole(0, MOST_SLABS)]


@checked
def trace_paths(
    mesh_or_scene: GeometryLike,
    *,
    transmitter: ArrayLike,
    receivers: ArrayLike,
    frequency_hz: Hertz,
    mirror_order: Order = 1,
    transmissions: SlabCount = 0,
    diffractions: Annotated[int, whole(0, 1)] = 0,
    gas: Gas = False,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> Paths:
    """Line of sight and mirror reflections by the image method, in float64.

    A bare mesh reflects perfectly and without a sign change. A scene's surfaces reflect as ITU-R P.2040 slabs, less
    sqrt(1 - S^2) for what scatters. |gain|^2 is then the power averaged over both transmit and summed over both receive
    polarisations (half the squared Frobenius norm of the Jones matrix); its phase is -2 pi f tau plus the phase of
    the TE coefficient of each reflection (-1 for a conductor), because one number cannot carry both polarisations;
    ``jones`` carries them. A bare mesh says nothing of polarisation: its paths have no ``jones``.

    A slab lets waves straight through (ITU-R P.2040-4, eq. (43b)), later by what it is slower than air; such paths, with
    mirrors or without, are of kind ``"slab"``. A wall may be a sheet, as thick as its material says, or a closed solid of
    two faces at most :data:`~warprrf.rf.paths.slabs.THICKEST_M` apart, as thick as it is. Sionna RT takes each face for
    a slab of its own.

    Over the edge of a wedge or a sheet, paths of kind ``"edge"`` go round: one edge, and one mirror or slab before or behind
    it if these are asked for (:mod:`~warprrf.rf.em.diffraction`, :mod:`~warprrf.rf.paths.edge_paths`). Fields add up: with
    them the sum of ``jones``, or of a bare mesh's ``gain``, is continuous where line of sight and mirror paths end. A bare
    mesh's edges are conductors' of hard polarisation, which has no sign change. The phase of ``gain`` is that of the field
    along the edge.

    Args:
        mesh_or_scene: A :class:`Mesh` or anything with a ``mesh``; a scene has ``face_material`` and ``materials`` too.
        transmitter, receivers: Positions [m], shapes ``(3,)`` or ``(R, 3)``, row by row.
        frequency_hz: Carrier frequency [Hz].
        mirror_order: Most reflections on one path: 0 and up.
        transmissions: Most slabs that one path passes, 0 to 8. Of a bare mesh nothing is known to let through.
        diffractions: Most edges on one path, 0 or 1.
        gas: Absorption of the air in every gain: see :meth:`Paths.with_gas`.
        progress: Called with the stages ``"patches"``, in which the mesh's planes are found, and ``"mirrors"``.
        device: Where chains are tried and rays cast.

    Returns:
        Arrays ``(L,)`` for one receiver and transmitter, else ``(R, L)``: free paths, then those through slabs, each by order,
        then by length; then those over edges.

    Raises:
        ValueError: on a position that is NaN, outside a closed room, inside a solid, on the same surface as the other end, or
            within the reactive near field of the transmitter; on a frequency that is not positive or outside a material's band, or
            another order; if more than :data:`~warprrf.rf.paths.images.MOST_CHAINS` chains of mirrors would be tried
            (:class:`MirrorTracer` takes another limit).

    Warns:
        UserWarning: below 100 GHz and outdoors, of diffraction and transmission if not asked for.
    """
    ends = Ends.of(receivers, transmitter)
    most = {"transmissions": transmissions, "diffractions": diffractions}
    _check_question(mesh_or_scene, ends, frequency_hz, device, **most)
    tell = progress or silent
    found: dict[int, Paths] = {}
    for source, own in ends.groups():
        tell("patches", 0, 1)
        tracer = MirrorTracer(
            mesh_or_scene, transmitter=source, frequency_hz=frequency_hz, device=device, **most
        )
        tell("patches", 1, 1)
        several = tracer.trace_each(ends.receivers[own], mirror_order, progress)
        found |= zip(own.tolist(), several, strict=True)
    several = [found[k] for k in sorted(found)]
    return (several[0] if ends.single else Paths.stack(several)).with_gas(gas)


@checked
def trace_specular(
    mesh_or_scene: GeometryLike,
    *,
    transmitter: ArrayLike,
    receivers: ArrayLike,
    frequency_hz: Hertz,
    mirror_order: Order = 1,
    transmissions: SlabCount = 0,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> SpecularPaths:
    """The paths of :func:`~warprrf.trace_paths`, edges and gas apart, as a function of both ends, of their antennas' orientations
    and of materials, which Warp's tape and torch differentiate.

    Which paths there are and what each meets is held fixed: only near where they were traced do they stay those that there are.

    Args:
        mesh_or_scene, frequency_hz, mirror_order, transmissions, progress, device: As of :func:`trace_paths`.
        transmitter: Position [m], shape ``(3,)``.
        receivers: Positions [m], shape ``(3,)`` or ``(R, 3)``.

    Returns:
        See :meth:`SpecularPaths.evaluate`.

    Raises:
        ValueError: as :func:`trace_paths`, and for several transmitters.

    Example::

        held = wr.paths.trace_specular(scene, transmitter=tx, receivers=rx, frequency_hz=60e9, mirror_order=2)
        eta = wp.array(held.parameters["relative_permittivity"], dtype=wp.float64, requires_grad=True)
        with wp.Tape() as tape:
            values = held.evaluate(relative_permittivity=eta)
        tape.backward(grads={values.tau: wp.ones(len(held), dtype=wp.float64)})
        eta.grad  # of the summed delays [s], one for each material
    """
    if np.ndim(transmitter) != 1:
        raise ValueError(f"transmitter: got shape {np.shape(transmitter)}, expected (3,)")
    ends = Ends.of(receivers, transmitter)
    _check_question(mesh_or_scene, ends, frequency_hz, device, transmissions)
    tracer = MirrorTracer(
        mesh_or_scene, transmitter=ends.transmitters[0], frequency_hz=frequency_hz, transmissions=transmissions, device=device
    )  # fmt: skip
    return tracer.trace_specular(ends.receivers, mirror_order, progress)


def _check_question(
    mesh_or_scene: GeometryLike,
    ends: Ends,
    frequency_hz: float,
    device: DeviceLike,
    transmissions: int,
    diffractions: int = 0,
) -> None:
    """Refuse places that :func:`trace_paths` cannot answer for, and warn of what it leaves out."""
    mesh, wavelength_m = as_mesh(mesh_or_scene), SPEED_OF_LIGHT / frequency_hz
    question_unit(mesh, wavelength_m)
    receivers = ends.shaped(ends.receivers)
    check_positions(mesh, ends.transmitters, receivers, wavelength_m, on_surfaces=True, device=device)
    modelled = {"transmission": transmissions > 0, "diffraction": diffractions > 0}
    for source, own in ends.groups():
        points = ends.receivers[own]
        _refuse_along_surfaces(mesh, source, points, device)
        warn_of_unmodelled(mesh, source, points, frequency_hz=frequency_hz, device=device, **modelled)


def _refuse_along_surfaces(mesh: Mesh, source: np.ndarray, points: np.ndarray, device: DeviceLike) -> None:
    """Refuse receivers (R, 3) on the same flat surface as the transmitter (3,): ways between them lie in it, and whether it stops
    them is a matter of rounding."""
    on_m = 1e-7
    normal = mesh.face_normals[mesh.faces_at(source[None], on_m)[1]]
    if len(normal) == 0:
        return
    along = (np.abs((points - source) @ normal.T) < on_m).any(axis=1)
    along[along] = mesh.distance(points[along], device=device) < on_m
    if along.any():
        raise ValueError(
            f"receivers: {points[along][0].tolist()} lies on the same surface as the transmitter, {source.tolist()} "
            f"({int(along.sum())} such in all), along which nothing is known to be free; expected one of them a millimetre off it"
        )


class MirrorTracer:
    """Image method for one transmitter: patches and images are found once, then any receiver is traced.

    Args: as of :func:`trace_paths`, and ``max_chains``: searches that would try more chains of mirrors are refused.

    Attributes:
        mesh: The mesh.
        transmitter: Position [m], shape ``(3,)``.
        frequency_hz: Carrier frequency [Hz].
        patches: What mirrors.
        images: Images of the transmitter in them.
        table: Radio properties of the scene's materials; None for a bare mesh.
        walls: What may be passed, if anything.
        edges: Paths over edges, if asked for.
    """

    def __init__(
        self,
        mesh_or_scene: GeometryLike,
        *,
        transmitter: ArrayLike,
        frequency_hz: float,
        transmissions: int = 0,
        diffractions: int = 0,
        max_chains: float = MOST_CHAINS,
        device: DeviceLike = None,
    ) -> None:
        self.mesh = as_mesh(mesh_or_scene)
        self.transmitter = check_array("transmitter", transmitter, (3,))
        self.frequency_hz = check_frequency(frequency_hz)
        materials = getattr(mesh_or_scene, "materials", None)
        groups = None if materials is None else getattr(mesh_or_scene, "face_material", None)
        self.table = None if materials is None else surface_table(materials, frequency_hz)
        self.patches = planar_patches(self.mesh, groups)
        self.walls: Walls | None = None
        self._face_material = np.zeros(0, np.int32)
        if transmissions and self.table is not None and groups is not None:
            self._face_material = np.asarray(groups, np.int32)
            slabs = self.table.permittivity, self.table.thickness_m
            eta, thickness = (a[self._face_material] for a in slabs)
            clearance = max(ENDPOINT_CLEARANCE, self.patches.tolerance_m)
            self.walls = Walls.of_slabs(
                self.mesh, eta, thickness, self.wavelength_m, transmissions, clearance, device
            )
        self.images = MirrorImages(
            self.patches, self.transmitter, to_edges=True, max_chains=max_chains, device=device
        )
        self._fixed = fixed_parameters(materials, self.table, self.frequency_hz, self.images.device)
        self.edges: EdgeFinder | None = None
        if diffractions:
            self.edges = EdgeFinder(
                self.images, self.wavelength_m, self.table, walls=self.walls, group=self._face_material
            )

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    def trace(self, receiver: ArrayLike, mirror_order: int = 1) -> Paths:
        """Paths of one receiver (3,); see :func:`trace_paths`."""
        return self.trace_each(check_array("receiver", receiver, (3,))[None], mirror_order)[0]

    def trace_each(
        self, receivers: ArrayLike, mirror_order: int = 1, progress: Progress | None = None
    ) -> list[Paths]:
        """Paths of each of ``receivers`` (R, 3), one after the other."""
        points = check_array("receivers", receivers, (None, 3))
        found = self.find(points, mirror_order, progress)
        held, kind = self._held(found, points).evaluate(), found.kind
        over = None if self.edges is None else self.edges.find(points, min(mirror_order, 1), progress)
        ends = np.searchsorted(found.receiver, np.arange(len(points) + 1))
        result = []
        for k, point in enumerate(points):
            own = slice(ends[k], ends[k + 1])
            columns: dict[str, Any] = {name: getattr(held, name)[own] for name in OUTPUTS}
            if self.table is None:
                columns["jones"] = None
            result.append(
                Paths(
                    **columns, kind=kind[own], valid=np.ones(ends[k + 1] - ends[k], bool), interactions=found.code[own],
                    frequency_hz=self.frequency_hz, transmitter=self.transmitter.copy(), receiver=point.copy(),
                )
            )  # fmt: skip
            if over is not None:
                result[-1] = Paths.concatenate([result[-1], self._over(over, k, point)])
        return result

    def trace_specular(
        self, receivers: ArrayLike, mirror_order: int = 1, progress: Progress | None = None
    ) -> SpecularPaths:
        """Paths to ``receivers`` (R, 3) as a function of ends and materials; see :func:`trace_specular`."""
        points = check_array("receivers", receivers, (None, 3))
        return self._held(self.find(points, mirror_order, progress), points)

    def _over(self, found: EdgePaths, k: int, point: np.ndarray) -> Paths:
        own = found.take(np.flatnonzero(found.receiver == k))
        jones = (self.wavelength_m / (4.0 * np.pi * own.length_m))[:, None, None] * own.matrix
        kind = np.full(len(own), "edge", "<U7")
        return Paths.from_points(
            self.transmitter, point, own.point, own.amplitude, kind, self.frequency_hz,
            jones=None if self.table is None else jones, excess_m=own.excess_m, interactions=own.code,
        )  # fmt: skip

    def find(
        self, receivers: ArrayLike, mirror_order: int = 1, progress: Progress | None = None
    ) -> MirrorPaths:
        """Geometry of all paths to ``receivers`` (R, 3), sorted by receiver."""
        order = check_count("mirror_order", mirror_order, 0)
        points = check_array("receivers", receivers, (None, 3))
        if (points == self.transmitter).all(axis=1).any():
            raise ValueError("receivers: got a receiver at the transmitter's place, expected them apart")
        found = exact_paths(self.images, points, order, progress, self.walls)
        return found.take(np.lexsort((found.length_m, found.order, found.slabs > 0, found.receiver)))

    def _held(self, found: MirrorPaths, points: np.ndarray) -> SpecularPaths:
        """Those found, to ``points`` (R, 3), as a function of ends and materials."""
        mirror, slab = found.patch >= 0, found.slab >= 0
        offset, material = np.zeros(found.patch.shape), np.full(found.patch.shape, -1)
        offset[mirror] = self.patches.offset[found.patch[mirror]]
        offset[slab] = (self.mesh.triangles[found.slab[slab], 0] * found.normal[slab]).sum(axis=1)
        if self.table is not None:
            material[mirror] = self.patches.group[found.patch[mirror]]
            material[slab] = self._face_material[found.slab[slab]]
        where, ends = self.images.device, {"transmitter": self.transmitter[None], "receivers": points}
        traced = {name: wp.array(value, dtype=wp.vec3d, device=where) for name, value in ends.items()}
        return SpecularPaths(found, offset, material, traced | self._fixed, self.frequency_hz, where)
