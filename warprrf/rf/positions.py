"""Where transmitters and receivers may be: in the air of the scene, off its surfaces, and not at each other's place.

Only a closed surface has an inside (:attr:`warprrf.Mesh.closed_parts`: a scan's with small holes too); a sheet, or walls
with an open side or a doorway, have none, however they are wound. A place is in the same air as another that sees it, or
that the same closed surfaces hold. Else what is entered on the way from one to the other parts them, unless as many
are left (another room), or only walls with two surfaces are left (the open air); a solid's hollow, wound the other way,
is air. Where no place is known to be in the air, a closed surface that holds most of the rest is a room's, and so is one
that is all there is.

A city's buildings often have no floors. So under the sky places are judged by rays upward besides. In a building low, slanting,
steep and vertical ones all cross an odd number of surfaces, or out of the same number of solids; in a court, under a bridge
or below a canopy some of them do not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Positive, check_array, checked, warn
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import PowerTable
from warprrf.rows import distinct_rows

WALL_CLEARANCE_M = 1e-4
"""Positions nearer to a surface than this count as on it [m]."""
NEAR_FIELD = 1.0 / (2.0 * np.pi)
"""Distance of two antennas, in wavelengths, within which their reactive fields outweigh what they radiate, however
small they are: Friis's formula does not hold, and gives gains above one within half of it. Source: H. A. Wheeler, "The
radiansphere around a small antenna", Proc. IRE 47 (1959)."""

_DIRECTIONS = 24
_UPWARD = _DIRECTIONS, 0.0, 1.0  # of a lattice over the upper half of the sphere, from low to steep
_BANDS = 3  # of rays upward: low, slanting, steep; a fourth of as many is overhead
_LEAK = 0.02  # share of rays that may leave a closed room: its walls need not meet exactly
_AT_ONCE = 20_000  # places whose rays are cast in one launch


def check_receivers(name: str, value: ArrayLike) -> np.ndarray:
    """A copy of ``value``, positions (3,) or (R, 3) [m], R at least 1: callers may move theirs on in place."""
    array = check_array(name, value).copy()
    if array.ndim not in (1, 2) or array.shape[-1] != 3 or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}, expected (3,) or (R, 3) with R at least 1")
    return array


class Ends(NamedTuple):
    """Both ends of links, row by row.

    Attributes:
        receivers, transmitters: positions [m], shape ``(R, 3)`` each.
        single: whether one link was asked for: then results have no receiver axis.
    """

    receivers: np.ndarray
    transmitters: np.ndarray
    single: bool

    @classmethod
    def of(cls, receivers: ArrayLike, transmitter: ArrayLike, name: str = "receivers") -> Ends:
        """``receivers`` and ``transmitter`` [m], each ``(3,)`` or ``(R, 3)``: one of either goes with all of the other.

        Raises:
            ValueError: naming the argument, on other shapes, numbers of rows that differ, or numbers not finite.
        """
        to, source = check_receivers(name, receivers), check_receivers("transmitter", transmitter)
        if to.ndim == source.ndim == 2 and len(to) != len(source):
            raise ValueError(f"transmitter: got shape {source.shape}, expected (3,) or {to.shape}")
        rows = np.atleast_2d(*map(np.ascontiguousarray, np.broadcast_arrays(to, source)))
        return cls(rows[0], rows[1], to.ndim == source.ndim == 1)

    def groups(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Each transmitter (3,) and the rows under it."""
        sources, under = np.unique(self.transmitters, axis=0, return_inverse=True)
        return [(source, np.flatnonzero(under.ravel() == k)) for k, source in enumerate(sources)]

    def shaped(self, results: Any) -> Any:
        """``results`` of all rows as they are handed out: a single one by itself."""
        return results[0] if self.single else results


def beside(points: np.ndarray, step_m: float) -> np.ndarray:
    """Places ``step_m`` from ``points`` (..., 3) along x, y and z, then against them, shape ``(..., 6, 3)``."""
    return np.asarray(points[..., None, :] + step_m * np.concatenate([np.eye(3), -np.eye(3)]))


def quotients(answers: Any, step_m: float) -> np.ndarray:
    """Slopes along x, y and z on a last axis [1/m], of answers at the six places of :func:`beside`, first axis."""
    found = np.moveaxis(np.asarray(answers), 0, -1)
    return np.asarray((found[..., :3] - found[..., 3:]) / (2.0 * step_m))


@checked
def retraced_slope(
    answer: Callable[[np.ndarray], Any], points: ArrayLike, *, step_m: Positive = 0.01
) -> np.ndarray:
    """Slopes of what is traced anew on either side of each place: central differences.

    Of totals and spectra much is edges of shadows, which derivatives of paths (:func:`warprrf.paths.trace_specular`) do not know.

    Args:
        answer: of positions ``(N, 3)`` [m] to numbers ``(N, ...)``; called once.
        points: where slopes are wanted [m], shape ``(3,)`` or ``(R, 3)``.
        step_m: how far away it is asked [m].

    Returns:
        Shape ``(..., 3)`` for one point, else ``(R, ..., 3)``, in the answer's unit per metre.

    Raises:
        ValueError: naming the argument; for another number of answers.

    Example::

        def total_db(at):
            return 10 * np.log10(wr.trace_paths(scene, transmitter=tx, receivers=at, frequency_hz=f).power.sum(axis=1))

        wr.paths.retraced_slope(total_db, [3.0, 2.0, 1.5])  # [dB/m], shape (3,)
    """
    at = check_receivers("points", points)
    places = beside(at, step_m).reshape(-1, 3)
    found = np.asarray(answer(places))
    if found.ndim == 0 or len(found) != len(places):
        raise ValueError(
            f"answer: got shape {found.shape} for {len(places)} positions, expected a row for each"
        )
    found = found.reshape(*at.shape[:-1], 6, *found.shape[1:])
    return quotients(np.moveaxis(found, at.ndim - 1, 0), step_m)


def check_positions(
    mesh: Mesh | None,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength_m: float,
    *,
    names: tuple[str, str] = ("transmitter", "receivers"),
    known: np.ndarray | None = None,
    on_surfaces: bool = False,
    device: DeviceLike = None,
) -> None:
    """Refuse places where no answer would be right.

    Args:
        mesh: What blocks; None checks distances between antennas alone.
        transmitter: Position [m], shape ``(3,)``, or that of each receiver, ``(R, 3)``; each link is looked at once.
        receivers: Positions [m], shape ``(3,)`` or ``(R, 3)``.
        known: A place that is in the air for certain [m], shape ``(3,)``; the transmitter by default.
        on_surfaces: Whether antennas may be mounted flush with a surface.

    Raises:
        ValueError: naming the first place outside the scene, on a surface, inside a solid, or so near to the
            transmitter that it lies within its reactive field.

    Warns:
        UserWarning: if a receiver is within a wavelength of the transmitter.
    """
    to = np.reshape(receivers, (-1, 3))
    rows = [f"{names[1]}[{k}]" for k in range(len(to))] if np.ndim(receivers) == 2 else [names[1]]
    asked = [(transmitter, np.arange(len(to)))]
    if np.ndim(transmitter) == 2:
        first = np.sort(distinct_rows(np.column_stack([transmitter, to]))[0])
        asked = [(source, first[own]) for source, own in Ends(to[first], transmitter[first], False).groups()]
    for source, own in asked:
        points, labels = np.concatenate([source[None], to[own]]), [names[0], *(rows[k] for k in own)]
        _check_apart(points, wavelength_m, labels)
        if mesh is not None:
            _check_in_air(mesh, points, labels, known, on_surfaces, device)


def _check_in_air(
    mesh: Mesh,
    points: np.ndarray,
    labels: list[str],
    known: np.ndarray | None,
    on_surfaces: bool,
    device: DeviceLike,
) -> None:
    """:func:`check_positions` of a transmitter and its receivers, ``points`` (1 + R, 3), whose names are ``labels``."""
    transmitter = points[0]
    reference = transmitter if known is None else known
    apart = parted(mesh, points, reference, device=device)
    if (
        known is None
        and (len(points) == 1 or apart[1:].mean() > 0.5)
        and parted(mesh, transmitter[None], None, device=device)[0]
    ):
        apart = np.arange(len(points)) == 0
    outside = ((points < mesh.bounds[0]) | (points > mesh.bounds[1])).any(axis=1)
    if outside.all():
        away = np.linalg.norm(points - points.clip(*mesh.bounds), axis=1).min()
        size = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
        if away > 30.0 * size:
            warn(
                f"{labels[0]}: all places are {away:.3g} m or more from the scene, which is {size:.3g} m large: are they "
                "in metres, and counted from its origin?"
            )
    if outside.any():
        air = points[~outside & ~apart]
        sealed = _is_sealed(mesh, air[0], device) if len(air) else apart[0]
        _refuse(outside & sealed, "outside the scene", points, labels, mesh)
    if not on_surfaces:
        near = mesh.distance(points, device=device) < WALL_CLEARANCE_M
        _refuse(near, "on a surface", points, labels, mesh)
    _refuse(apart, "inside a solid", points, labels, mesh)


def check_dataset(mesh: Mesh | None, ds: SpectrumDataset | PowerTable, *, device: DeviceLike = None) -> None:
    """Refuse a data set that no field of this mesh can be fitted to.

    Raises, warns: as :func:`check_positions` and :func:`question_unit`.
    """
    wavelength_m = SPEED_OF_LIGHT / ds.frequency_hz
    name = "transmitters" if isinstance(ds, PowerTable) else "transmitter"
    if mesh is not None:
        question_unit(mesh, wavelength_m)
    names = f"ds.{name}", "ds.receivers"
    check_positions(mesh, getattr(ds, name), ds.receivers, wavelength_m, names=names, device=device)


def parted(
    mesh: Mesh, points: np.ndarray, known: np.ndarray | None, *, device: DeviceLike = None
) -> np.ndarray:
    """Whether closed surfaces part each of ``points`` (N, 3) [m] from the air around ``known`` (3,), or from the scene's
    air if that is None, shape ``(N,)``, bool.

    In doubt they don't: see the module's text for what counts.
    """
    found = np.zeros(len(points), dtype=bool)
    asked = np.arange(len(points))
    if known is not None:
        # A segment through a vertex may slip through a surface; another one beside it does not.
        beside = known + [1.3e-5, 0.7e-5, 1.1e-5]
        seen = mesh.visible(points, known, device=device) & mesh.visible(points, beside, device=device)
        asked = np.flatnonzero(~seen)
    if len(asked) == 0:
        return found
    own, rooms = points[asked], _rooms(mesh) if known is None else ()
    entered, left = np.zeros(len(own), int), np.zeros(len(own), int)
    solids: list[Mesh] = []
    for k, part in _outermost_first(mesh):
        inside = holds(part, own, device=device)
        if k in rooms or (known is not None and holds(part, known[None], device=device)[0]):
            left += ~inside
        elif inside.any():
            entered += np.where(_is_cavity(part, solids), -1, 1) * inside
            solids.append(part)
    found[asked] = (entered != left) & ((entered > 0) | (left % 2 == 1))
    if is_open_air(mesh, device=device):
        roofed = under_a_roof(mesh, own, device=device)
        found[asked] |= roofed != (known is not None and under_a_roof(mesh, known[None], device=device)[0])
    return found


def is_free(
    mesh: Mesh,
    points: np.ndarray,
    known: np.ndarray | None = None,
    *,
    clearance_m: float = WALL_CLEARANCE_M,
    device: DeviceLike = None,
) -> np.ndarray:
    """Whether ``points`` (N, 3) [m] lie within the scene, in its air (that of ``known`` (3,) if given), and over its
    floor or ground, where it has one, and ``clearance_m`` [m] off its surfaces, shape ``(N,)``, bool.

    This is the mesh's word: a solid whose back no photo shows is air to it.
    """
    free = ((points >= mesh.bounds[0]) & (points <= mesh.bounds[1])).all(axis=1)
    if clearance_m > 0:
        free[free] = mesh.distance(points[free], device=device) >= clearance_m
    free[free] = ~parted(mesh, points[free], known, device=device)
    places = _spread(mesh) if known is None else known[None]
    if _is_over(mesh, places, device).mean() > 0.1:
        free[free] = _is_over(mesh, points[free], device)
    return free


def holds(part: Mesh, points: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Whether each of ``points`` (N, 3) [m] is inside a closed surface, shape ``(N,)``, bool: most rays from it cross the
    surface an odd number of times."""
    found = ((points > part.bounds[0]) & (points < part.bounds[1])).all(axis=1)
    within = np.flatnonzero(found)
    for first in range(0, len(within), _AT_ONCE):
        some = within[first : first + _AT_ONCE]
        winding, _ = part.crossings(points[some], lattice(_DIRECTIONS), device=device)
        found[some] = (winding % 2).mean(axis=1) > 0.5
    return found


def question_unit(mesh: Mesh, wavelength_m: float) -> None:
    """Warn if the mesh is too large, too high or too small to be in metres.

    Rooms and cities pass: no scene of them is larger than 20 km or 5 million wavelengths (5 km at 300 GHz, where ITU-R
    P.676 takes 5 dB a kilometre), 1 km in its smallest extent, or smaller than 5 cm.
    """
    extent = np.ptp(mesh.bounds, axis=0)
    largest = float(extent.max())
    unit, metres = "millimetres", "1e-3"
    if largest < 0.05:
        unit, metres = "kilometres", "1e3"
    elif largest <= min(20e3, 5e6 * wavelength_m) and extent.min() <= 1e3:
        return
    size = " x ".join(f"{e:.4g}" for e in extent)
    warn(
        f"mesh: it is {size} m large ({largest / wavelength_m:.2g} wavelengths); coordinates look like {unit}, expected "
        f"metres: Mesh({metres} * vertices, faces)"
    )


def under_a_roof(mesh: Mesh, points: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Whether each of ``points`` (N, 3) [m] of a scene under the sky is in a building or in the ground, shape ``(N,)``,
    bool; in doubt it is not."""
    found = np.zeros(len(points), dtype=bool)
    agreed = 0.75  # share of the rays of a band that must say the same
    overhead = lattice(_DIRECTIONS // _BANDS, 0.98, 1.0)
    upward = np.concatenate([lattice(*_UPWARD), overhead])
    for first in range(0, len(points), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        winding, _ = mesh.crossings(points[some], upward, device=device)
        middle = np.median(winding, axis=1, keepdims=True)
        for votes in (winding % 2 == 1, (winding == middle) & (middle != 0)):
            share = votes.reshape(len(votes), _BANDS + 1, -1).mean(axis=2)
            found[some] |= (share >= agreed).all(axis=1)
    return found


def ground_height(mesh: Mesh, x: np.ndarray, y: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Height z of the lowest surface at ``x``, ``y`` [m], of their shape; NaN where there is none."""
    low = mesh.bounds[0, 2] - 1.0
    start = np.column_stack([np.ravel(x), np.ravel(y), np.full(np.size(x), low)])
    up = mesh.cast(start, [0.0, 0.0, 1.0], device=device).t
    return np.where(np.isfinite(up), low + up, np.nan).reshape(np.shape(x))


def is_open_air(mesh: Mesh, *, device: DeviceLike = None) -> bool:
    """Whether most of a scene is ground under the sky: a street or a city, not a room or a corridor, torn as its mesh
    may be."""
    if mesh.is_closed:
        return False
    places = _spread(mesh)
    places = places[np.abs(places[:, 2] - mesh.center[2]) <= 0.1 * np.ptp(mesh.bounds[:, 2])]  # halfway up
    ground = np.isfinite(ground_height(mesh, *places[:, :2].T, device=device))
    return bool((ground & _sky_over(mesh, places, device)).mean() > 0.5)


def warn_of_unmodelled(
    mesh: Mesh | None,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    *,
    frequency_hz: float,
    transmission: bool = False,
    diffraction: bool = False,
    device: DeviceLike = None,
) -> None:
    """Warn, where the user's code calls, of what is left out and matters: below 100 GHz, and outdoors.

    Args:
        mesh: The scene's; None if there is none.
        transmitter, receivers: Positions [m], shapes ``(3,)``, and ``(3,)`` or ``(R, 3)``.
        transmission, diffraction: Whether transmission through walls is modelled, and diffraction.
    """
    least_hz = 100e9  # below it walls let much through, and waves bend round edges, indoors too
    reasons = [f"below {least_hz / 1e9:g} GHz"] if frequency_hz < least_hz else []
    some = np.concatenate([transmitter[None], np.reshape(receivers, (-1, 3))])[:_DIRECTIONS]
    if mesh is not None and (_sky_over(mesh, some, device).any() or is_open_air(mesh, device=device)):
        reasons.append("outdoors (under the sky)")
    lacking = ["diffraction"] * (not diffraction) + ["transmission through walls"] * (not transmission)
    if not reasons or not lacking:
        return
    what = f"{' and '.join(lacking)} {'are' if len(lacking) > 1 else 'is'}"
    warn(
        f"{frequency_hz / 1e9:g} GHz: {what} not modelled, which matters {' and '.join(reasons)}: receivers without line "
        "of sight may get more power than is found here; warprrf.relevance estimates how much"
    )


def _check_apart(points: np.ndarray, wavelength_m: float, labels: list[str]) -> None:
    apart = np.linalg.norm(points[1:] - points[0], axis=1) / wavelength_m
    # Distance in wavelengths above which Friis's formula is trusted: 2 D^2 / lambda for an antenna 0.7
    # wavelengths wide. Source: H. T. Friis, "A note on a simple transmission formula", Proc. IRE 34 (1946)
    far_field = 1.0
    if len(apart) == 0 or apart.min() >= far_field:
        return
    k = int(apart.argmin())
    where = f"{apart[k]:.3g} wavelengths ({apart[k] * wavelength_m:.3g} m) from the transmitter"
    if apart[k] == 0:
        where = "the transmitter's own position"
    what = f"{labels[1 + k]}: {points[1 + k].tolist()} is {where}"
    if apart[k] < NEAR_FIELD:
        raise ValueError(
            f"{what}, within its reactive near field, where path gain has no meaning (it would exceed one); expected "
            f"more than {NEAR_FIELD * wavelength_m:.3g} m, better {far_field * wavelength_m:.3g} m"
        )
    warn(f"{what}; within a wavelength ({wavelength_m:.3g} m) path gain by Friis's formula is a rough guide")


def _refuse(bad: np.ndarray, what: str, points: np.ndarray, labels: list[str], mesh: Mesh) -> None:
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        box = " to ".join(str(np.round(corner, 3).tolist()) for corner in mesh.bounds)
        raise ValueError(
            f"{labels[k]}: {points[k].tolist()} is {what} ({int(bad.sum())} such in all), expected a place in the air "
            f"of the scene ({box} m), more than {WALL_CLEARANCE_M} m off its surfaces; sample_receivers finds some"
        )


def _rooms(mesh: Mesh) -> list[int]:
    """Which closed parts of a scene have its air inside: those that hold most of what is left, from the outermost inward,
    or are all that is left: the scene's only surface, or the inner one of its walls."""
    rooms = list[int]()
    least = 0.1 * _box(mesh)  # that share of the box around a scene its room takes
    samples = 1000  # faces whose places tell what a surface holds
    for k, part in _outermost_first(mesh):
        if _box(part) < least:
            break
        volume = _box(part) * holds(part, _spread(part)).mean()
        if volume < least:
            continue
        rest = mesh.distinct_faces
        rest = rest[~np.isin(mesh.closed_part_of[rest], [*rooms, k])]
        rest = rest[np.argsort(-mesh.areas[rest], kind="stable")][:samples]
        places, area = mesh.triangles[rest].mean(axis=1), mesh.areas[rest]
        off = part.distance(places) > WALL_CLEARANCE_M  # what covers it is neither in it nor beside it
        places, area = places[off], area[off]
        held, left = area[holds(part, places)].sum(), area.sum()
        # a tenth of a surface's area beside it is nothing to speak of
        fragments = left <= 0.1 * part.areas.sum() and not _is_amid(part, places)
        if held > 0.5 * left or fragments:
            rooms.append(k)
            least = 0.5 * volume  # that share of what its walls hold their inner surface does
    return rooms


def _outermost_first(mesh: Mesh) -> list[tuple[int, Mesh]]:
    """Closed parts with their numbers, of copies the first."""
    first = np.unique(mesh.parts_by_box(WALL_CLEARANCE_M), return_index=True)[1]
    return sorted(((k, mesh.closed_parts[k]) for k in first), key=lambda item: -_box(item[1]))


def _box(mesh: Mesh) -> float:
    """Volume of the box around a mesh [m^3]."""
    return float(np.ptp(mesh.bounds, axis=0).prod())


def _is_amid(part: Mesh, points: np.ndarray) -> bool:
    """Whether most of ``points`` (N, 3) are in the hollow of a closed surface, as furniture amid walls of solids: all around
    they see it."""
    side = part.crossings(points, lattice(_DIRECTIONS))[1]
    return bool(len(points) and np.mean((side != 0).mean(axis=1) > 1.0 - _LEAK) > 0.5)


def _is_cavity(part: Mesh, solids: list[Mesh]) -> bool:
    """Whether a closed surface bounds a hollow in one of ``solids``: it lies within that, and is wound the other way."""

    def within(solid: Mesh) -> bool:
        boxed = (part.bounds[0] >= solid.bounds[0]).all() and (part.bounds[1] <= solid.bounds[1]).all()
        turned = boxed and _volume(part) * _volume(solid) < 0
        return bool(turned and holds(solid, part.triangles.mean(axis=1)[:_DIRECTIONS]).mean() > 0.5)

    return any(map(within, solids))


def _volume(part: Mesh) -> float:
    """What a closed surface encloses [m^3], negative where it is wound inward."""
    a, b, c = np.moveaxis(part.triangles - part.center, 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


def _is_sealed(mesh: Mesh, known: np.ndarray, device: DeviceLike) -> bool:
    """Whether a closed surface holds ``known`` (3,), or ways end on surfaces from there and from all places within the
    bounds that it sees: no sky, no open side."""
    if any(holds(part, known[None], device=device)[0] for part in mesh.closed_parts):
        return True
    places = _spread(mesh)
    places = np.concatenate([known[None], places[mesh.visible(places, known, device=device)]])
    side = mesh.crossings(places, lattice(4 * _DIRECTIONS), device=device)[1]
    return bool(((side == 0).mean(axis=1) < _LEAK).all())


def _is_over(mesh: Mesh, points: np.ndarray, device: DeviceLike) -> np.ndarray:
    """Whether there is something below each of ``points`` (N, 3) [m], shape ``(N,)``, bool: straight below, or around a hole
    in the floor, in most directions that are 45 degrees off at most."""

    def met(asked: np.ndarray, directions: np.ndarray) -> np.ndarray:
        hit = mesh.cast(asked, directions, per_origin=len(directions), device=device)
        return np.asarray(hit.valid.reshape(len(asked), len(directions)).mean(axis=1) > 0.5)

    found = met(points, np.array([[0.0, 0.0, -1.0]]))
    found[~found] = met(points[~found], lattice(_DIRECTIONS, -0.71, -1.0))
    return found


def _spread(mesh: Mesh) -> np.ndarray:
    """Places spread over the box around a scene, shape ``(N, 3)`` [m]."""
    places = 5  # along each side of a scene, at which the sky is looked for
    share = (np.arange(places) + 0.5) / places
    grid = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    return mesh.bounds[0] + grid * np.ptp(mesh.bounds, axis=0)


def _sky_over(mesh: Mesh, points: np.ndarray, device: DeviceLike) -> np.ndarray:
    """Whether a third of the rays upward from ``points`` (N, 3) meets nothing, shape ``(N,)``, bool."""
    side = mesh.crossings(points, lattice(*_UPWARD), device=device)[1]
    sky = 1.0 / 3.0  # share of rays upward that meet nothing where there is sky
    return np.asarray((side == 0).mean(axis=1) >= sky)


@lru_cache(maxsize=4)
def lattice(count: int, first: float = 1.0, last: float = -1.0) -> np.ndarray:
    """Directions ``(count, 3)`` spread over the sphere, or what of it lies between two heights, sines of the elevation: a
    Fibonacci lattice, of which none runs along a wall."""
    k = np.arange(count) + 0.5
    azimuth, height = np.pi * (1.0 + np.sqrt(5.0)) * k, first + (last - first) * k / count
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), height])
