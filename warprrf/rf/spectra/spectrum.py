"""Spatial spectra: the equirectangular grid, the receiver beam that fills it, and the spectrum of one receiver.

Row i has zenith (i + 1/2) pi / H, column j has azimuth -pi + (j + 1/2) 2 pi / W. A pixel holds path gain: received over
transmitted power between isotropic antennas, averaged over vertical and horizontal transmit polarisation, summed over
both receive polarisations; linear. Every path is spread by a von Mises-Fisher beam, kappa = 1 / sigma^2, taken at the
pixel centres times the pixels' solid angles and normalised to sum to one over the pixels: the sum over pixels is the
total path gain, and an isotropic field stays one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import EllipsisType
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import (
    NotNegative,
    check_array,
    check_count,
    check_items,
    check_known_whole,
    check_positive,
    checked,
    one_line,
    positive,
    within,
)
from warprrf.device import DeviceLike, filled, launch, require, resolve
from warprrf.kernels.radio import beam as beam_kernels

BEAM_SIGMA_RAD = float(np.deg2rad(2.0))
"""Default beam width: kappa = 1 / sigma^2 [rad]."""

NARROWEST_BEAM_RAD = 1e-4

DEFAULT_SHAPE = (90, 180)
"""Default grid: 2 by 2 degrees."""


def check_shape(shape: Sequence[int]) -> tuple[int, int]:
    """``shape`` as (rows, columns), each at least 2, at most 2^24 in all (a sixteenth of a degree each)."""
    try:
        rows, columns = (check_count("shape", n, 2) for n in shape)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"shape: got {shape!r}, expected two whole numbers of at least 2, such as (90, 180)"
        ) from error
    if rows * columns > 1 << 24:
        raise ValueError(f"shape: got {rows} x {columns} pixels, expected at most {1 << 24} in all")
    return rows, columns


def check_range_db(range_db: Sequence[float]) -> tuple[float, float]:
    """``range_db`` as lowest and highest value [dB]."""
    low, high = (float(value) for value in check_array("range_db", range_db, (2,)))
    if not -1e4 <= low <= high <= 1e4:
        raise ValueError(f"range_db: got {low:g} to {high:g}, expected decibels, the lowest value first")
    return low, high


GridShape: TypeAlias = Annotated[tuple[int, int], lambda _, shape: check_shape(shape)]
Beam: TypeAlias = Annotated[float, within(NARROWEST_BEAM_RAD, np.pi)]
RangeDb: TypeAlias = Annotated[tuple[float, float], lambda _, range_db: check_range_db(range_db)]
Floor: TypeAlias = Annotated[float, positive("linear noise floor")]


def check_departures(aod: np.ndarray) -> None:
    """Refuse angles of departure ``(..., 2)`` that are none; NaN is an empty one."""
    check_known_whole("aod", aod)
    zenith, azimuth, rounding = aod[..., 0], aod[..., 1], 1e-3  # by as much compact files are out of range
    if ((zenith < -rounding) | (zenith > np.pi + rounding) | (np.abs(azimuth) > np.pi + rounding)).any():
        raise ValueError(
            "aod: got angles out of range, expected zeniths 0 to pi and azimuths -pi to pi, or NaN where empty"
        )


def check_whole(name: str, path_gain: ArrayLike) -> None:
    """Raise ValueError, naming the argument, if pixels of spectra were not measured."""
    missing = int(np.isnan(path_gain).sum())
    if missing:
        raise ValueError(f"{name}: {missing} of {np.size(path_gain)} pixels are NaN, expected whole spectra")


def pixel_angles(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Zenith of the rows, shape ``(H,)``, and azimuth of the columns, shape ``(W,)`` [rad], at pixel centres."""
    rows, columns = check_shape(shape)
    return (np.arange(rows) + 0.5) * np.pi / rows, -np.pi + (np.arange(columns) + 0.5) * 2.0 * np.pi / columns


def pixel_directions(shape: tuple[int, int]) -> np.ndarray:
    """Unit vectors from the receiver through the pixel centres, shape ``(H, W, 3)``, float64."""
    zenith, azimuth = pixel_angles(shape)
    return directions_from_angles(zenith[:, None], azimuth[None, :])


def pixel_solid_angles(shape: tuple[int, int]) -> np.ndarray:
    """Solid angle of one pixel of each row [sr], shape ``(H,)``; exact, so that all pixels sum to 4 pi."""
    rows, columns = check_shape(shape)
    zenith = np.arange(rows + 1) * np.pi / rows
    return (np.cos(zenith[:-1]) - np.cos(zenith[1:])) * 2.0 * np.pi / columns


def sub_pixel_directions(shape: tuple[int, int], sub_pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """``sub_pixels``^2 directions per pixel, pixel by pixel, of equal solid angle within one.

    Returns:
        Unit directions, shape ``(H W sub_pixels^2, 3)``, and their solid angles [sr].
    """
    rows, columns = shape
    count = sub_pixels**2
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    coprime = [a for a in range(1, count + 1) if np.gcd(a, count) == 1]
    step = min(coprime, key=lambda a: abs(a - count * golden))
    k, i, j = np.arange(count), np.arange(rows)[:, None, None], np.arange(columns)[None, :, None]
    across = (k + np.mod(i * golden, 1.0)) / count  # one value a row and direction: no two alike in a column
    down = (k * step % count + np.mod(j * golden, 1.0)) / count
    top, bottom = np.cos(i * np.pi / rows), np.cos((i + 1) * np.pi / rows)
    azimuth = -np.pi + (j + across) * 2.0 * np.pi / columns
    directions = directions_from_angles(np.arccos(top + (bottom - top) * down), azimuth).reshape(-1, 3)
    return directions, np.repeat(pixel_solid_angles(shape) / count, columns * count)


def directions_from_angles(zenith: ArrayLike, azimuth: ArrayLike) -> np.ndarray:
    """Unit vectors, shape ``(..., 3)``, of zenith in [0, pi] and azimuth in (-pi, pi] [rad]."""
    zenith, azimuth = np.broadcast_arrays(np.asarray(zenith, float), np.asarray(azimuth, float))
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def angles_from_directions(directions: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Zenith in [0, pi] and azimuth in (-pi, pi] [rad] of vectors ``(..., 3)`` of any length."""
    d = np.asarray(directions, dtype=np.float64)
    azimuth = np.arctan2(d[..., 1], d[..., 0])
    return np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]), np.where(azimuth == -np.pi, np.pi, azimuth)


def transverse_basis(directions: ArrayLike) -> np.ndarray:
    """Zenith and azimuth unit vectors at unit directions ``(..., 3)``, shape ``(..., 2, 3)``."""
    zenith, azimuth = angles_from_directions(directions)
    cosine = np.cos(zenith)
    up = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), -np.sin(zenith)], axis=-1)
    around = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    return np.stack([up, around], axis=-2)


def unit_vectors(
    name: str, value: ArrayLike, shape: tuple[int | EllipsisType | None, ...] = (None, 3)
) -> np.ndarray:
    """Vectors of ``shape``, made of length one.

    Raises:
        TypeError, ValueError: naming the argument, for another shape, numbers not finite, or a vector of no length.
    """
    vectors = check_array(name, value, shape)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not (length > 0).all():
        raise ValueError(f"{name}: got a vector of length zero, expected ones with a length")
    return vectors / length


def pixel_of(directions: ArrayLike, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that each direction ``(..., 3)`` falls in."""
    rows, columns = check_shape(shape)
    zenith, azimuth = angles_from_directions(directions)
    row = np.minimum((zenith * rows / np.pi).astype(np.int64), rows - 1)
    return row, np.floor((azimuth + np.pi) * columns / (2.0 * np.pi)).astype(np.int64) % columns


def to_db(path_gain: ArrayLike, floor: float = 0.0) -> np.ndarray:
    """10 log10(P + N0) [dB], of linear path gain and the noise floor N0; minus infinity of nothing."""
    with np.errstate(divide="ignore"):
        return 10.0 * np.log10(np.asarray(path_gain, dtype=np.float64) + floor)


def default_floor(path_gain: np.ndarray) -> float:
    """N0 of a data set ``(R, H, W)``: median over views of the view's maximum, less 60 dB. Empty views (blocked, where
    surfaces scatter nothing) do not count.
    """
    peak = np.nan_to_num(path_gain).reshape(len(path_gain), -1).max(axis=1)
    if not (peak > 0.0).any():
        raise ValueError("path_gain: all spectra are empty, expected power to set a floor from")
    # The default N0 lies this far below the median over views of the view's maximum
    floor_below_median_db = 60.0
    return float(np.median(peak[peak > 0.0])) * 10.0 ** (-floor_below_median_db / 10.0)


class SpreadPaths(NamedTuple):
    """Paths on the grid.

    Attributes:
        path_gain: Spread path gain, shape ``(H, W)``, float64.
        strongest: Index of the path that gives the pixel most of its power, shape ``(H, W)``, int32; -1 where empty.
    """

    path_gain: np.ndarray
    strongest: np.ndarray

    def of_strongest(self, values: np.ndarray) -> np.ndarray:
        """Values ``(L, ...)`` of paths as those of each pixel's strongest, shape ``(H, W, ...)``; NaN where empty."""
        found = np.full((*self.strongest.shape, *values.shape[1:]), np.nan)
        filled = self.strongest >= 0
        found[filled] = values[self.strongest[filled]]
        return found


def spread(
    directions: ArrayLike,
    powers: ArrayLike,
    shape: tuple[int, int],
    sigma: float = BEAM_SIGMA_RAD,
    *,
    device: DeviceLike = None,
) -> np.ndarray:
    """Path gains spread by the receiver beam, shape ``(H, W)``, float64; sums to ``powers.sum()``. See spread_paths."""
    return spread_paths(directions, powers, shape, sigma, device=device).path_gain


def spread_paths(
    directions: ArrayLike,
    powers: ArrayLike,
    shape: tuple[int, int],
    sigma: float = BEAM_SIGMA_RAD,
    *,
    beams: np.ndarray | None = None,
    device: DeviceLike = None,
) -> SpreadPaths:
    """Path gains spread by the receiver beam, and each pixel's strongest path.

    Args:
        directions: Directions of arrival, shape ``(L, 3)``, normalised here.
        powers: Path gains, linear, not negative, shape ``(L,)``.
        sigma: Beam width, kappa = 1 / sigma^2 [rad].
        beams: :func:`beam_sums` of the directions, where they are known: half of the work.

    Raises:
        ValueError: on a wrong shape, NaN, a negative gain, a direction of length zero, or a sigma that is not positive.
    """
    shape = rows, columns = check_shape(shape)
    d = check_array("directions", directions, (None, 3))
    power = check_array("powers", powers, (len(d),), least=0.0)
    check_positive("sigma", sigma, "beam width in radians")
    positive = np.flatnonzero(power > 0)
    if len(positive) == 0:
        return SpreadPaths(np.zeros((rows, columns)), np.full((rows, columns), -1, dtype=np.int32))
    d, power = unit_vectors("directions", d[positive]), power[positive]
    cell = np.ravel_multi_index(pixel_of(d, shape), shape).astype(np.int32)
    order = np.argsort(cell, kind="stable")
    starts = np.zeros(rows * columns + 1, dtype=np.int32)
    starts[1:] = np.cumsum(np.bincount(cell, minlength=rows * columns))

    where = resolve(device)
    grid = _beam_grid((rows, columns), float(sigma), str(where))
    known = beam_sums(d, shape, sigma, device=where) if beams is None else beams[positive]
    near, total = np.ascontiguousarray(known[order].T)
    image = wp.zeros((rows, columns), dtype=wp.float64, device=where)
    best = wp.zeros((rows, columns), dtype=wp.int32, device=where)
    inputs = [d[order], power[order] / total, near, starts, grid, image, best]
    launch(beam_kernels.gather_beams, rows * columns, inputs, device=where)
    index = best.numpy()
    return SpreadPaths(image.numpy(), np.where(index >= 0, positive[order][index], -1).astype(np.int32))


def beam_sums(
    directions: np.ndarray, shape: tuple[int, int], sigma: float, *, device: DeviceLike = None
) -> np.ndarray:
    """Squared chord from each unit vector ``directions`` (L, 3) to its pixel's centre, and the sum of its beam over all
    pixels, one there, shape ``(L, 2)``."""
    where = resolve(device)
    grid = _beam_grid(shape, float(sigma), str(where))
    sums = [wp.zeros(len(directions), dtype=wp.float64, device=where) for _ in range(2)]
    inputs = [directions, np.ravel_multi_index(pixel_of(directions, shape), shape), grid, *sums]
    launch(beam_kernels.beam_normaliser, len(directions), inputs, device=where)
    return np.stack([one.numpy() for one in sums], axis=1)


def strongest_rays(
    directions: wp.array,
    power: np.ndarray,
    shape: tuple[int, int],
    sigma: float,
    *,
    device: DeviceLike = None,
) -> np.ndarray:
    """The ray that gives each pixel the most through the receiver beam, shape ``(H, W)`` int32; -1 where none does.

    What :func:`spread_paths` finds for the same rays (but for how a beam's sum varies over the grid), in a fraction of
    its time.

    Args:
        directions: unit vectors on the device, pixel by pixel, equally many in each pixel's cell.
        power: of each, not negative.
        sigma: beam width [rad].
    """
    rows, columns = check_shape(shape)
    where = resolve(device)
    grid = _beam_grid((rows, columns), float(sigma), str(where))
    with np.errstate(divide="ignore"):
        log_power = np.log(np.asarray(power, np.float64))
    log_power = np.maximum(log_power, -1e301)  # what is dark stays below where the kernel starts
    top = log_power.reshape(rows * columns, -1).max(axis=1)
    best = wp.zeros(rows * columns, dtype=wp.int32, device=where)
    first_row, least_fall = _least_falls((rows, columns), float(sigma), str(where))
    inputs = [directions, len(power) // (rows * columns), log_power, top, wp.float64(top.max())]
    inputs += [grid, first_row, least_fall, best]
    launch(beam_kernels.strongest_rays, rows * columns, inputs, device=where)
    return best.numpy().reshape(rows, columns)


def unit_beams(
    directions: np.ndarray, shape: tuple[int, int], sigma: float, *, device: DeviceLike = None
) -> np.ndarray:
    """The beam of each unit vector ``directions`` (L, 3) by itself, shape ``(L, H, W)`` float32; each sums to one.

    The same beams as :func:`spread`, all images at once: for tens of paths, not for thousands.
    """
    shape, where = check_shape(shape), resolve(device)
    near, total = beam_sums(directions, shape, sigma, device=where).T
    images = wp.zeros((len(directions), *shape), dtype=wp.float32, device=where)
    grid = _beam_grid(shape, float(sigma), str(where))
    inputs = [directions, np.ravel_multi_index(pixel_of(directions, shape), shape), near, total, grid, images]
    launch(beam_kernels.separate_beams, len(directions), inputs, device=where)
    return images.numpy()


def _cutoff(shape: tuple[int, int], sigma: float) -> float:
    """Where a beam ends [rad]; one narrower than the grid still reaches the centre of the pixel it falls in."""
    # Beyond this many sigma a path is cut off: 106 dB below its peak; 2.3e-11 of its power, given back by
    # normalising
    beam_cutoff = 7.0
    return float(min(max(beam_cutoff * sigma, np.hypot(np.pi / shape[0], 2.0 * np.pi / shape[1])), np.pi))


@lru_cache(maxsize=8)
def _beam_grid(shape: tuple[int, int], sigma: float, device: str) -> Any:
    """The grid, for beams of width ``sigma``, as :class:`~warprrf.kernels.radio.beam.BeamGrid` on the device."""
    rows, columns = shape
    cutoff = _cutoff(shape, sigma)
    zenith = pixel_angles(shape)[0]
    edges = np.arange(rows + 1) * np.pi / rows
    gap = np.maximum(0.0, np.maximum(edges[None, :-1] - zenith[:, None], zenith[:, None] - edges[None, 1:]))
    lowest_sine = np.minimum(np.sin(edges[:-1]), np.sin(edges[1:]))
    room = np.sin(0.5 * cutoff) ** 2 - np.sin(0.5 * gap) ** 2
    # sin^2(dphi / 2) = (sin^2(cutoff / 2) - sin^2(dtheta / 2)) / (sin theta sin theta'), widest over the cell's row
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = room / (np.sin(zenith)[:, None] * lowest_sine[None, :])
    azimuth = 2.0 * np.arcsin(np.sqrt(np.clip(np.nan_to_num(ratio, nan=1.0, posinf=1.0), 0.0, 1.0)))
    half = np.ceil(azimuth * columns / (2.0 * np.pi) + 0.5).astype(np.int32)
    half = np.where(room < 0, -1, np.minimum(half, columns)).astype(np.int32)
    return filled(
        beam_kernels.BeamGrid, device, pixels=pixel_directions(shape), solid_angles=pixel_solid_angles(shape), half_widths=half,
        kappa=1.0 / sigma**2, chord_limit=4.0 * np.sin(0.5 * cutoff) ** 2 * (1.0 + 1e-12),
    )  # fmt: skip


@lru_cache(maxsize=8)
def _least_falls(shape: tuple[int, int], sigma: float, device: str) -> tuple[wp.array, wp.array]:
    """First row of cells that reach each row's pixels, and by how many nepers the beam of any ray in a cell falls there
    at least: of the row, the cell's row after the first, and the columns between; infinite beyond the beam."""
    rows, columns = shape
    reaching = _beam_grid(shape, sigma, device).half_widths.numpy() >= 0
    first, count = reaching.argmax(axis=1), int(reaching.sum(axis=1).max())
    zenith = pixel_angles(shape)[0]
    cell = np.minimum(first[:, None] + np.arange(count), rows - 1)
    apart = np.cos(np.arange(columns // 2 + 1) * 2.0 * np.pi / columns)
    cosine = np.cos(zenith)[:, None] * np.cos(zenith[cell])
    sine = np.sin(zenith)[:, None] * np.sin(zenith[cell])
    chord = np.sqrt(np.maximum(2.0 - 2.0 * (cosine[..., None] + sine[..., None] * apart), 0.0))
    # of a ray in the cell
    nearest = np.maximum(chord - 0.5 * np.hypot(np.pi / rows, 2.0 * np.pi / columns), 0.0)
    fall = 0.5 * (nearest / sigma) ** 2 * (1.0 - 1e-6)
    fall[nearest > 2.0 * np.sin(0.5 * _cutoff(shape, sigma)) * (1.0 + 1e-6)] = np.inf
    falls = wp.array(fall, dtype=wp.float32, device=device)
    return wp.array(first, dtype=wp.int32, device=device), falls


@dataclass(frozen=True)
class Spectra:
    """Path gain by direction at many receivers; :meth:`RadioField.spectra` gives them.

    Attributes:
        receivers, transmitters: positions [m], shape ``(R, 3)``; ``(3,)`` for a single link.
        frequency_hz: carrier [Hz].
        path_gain: [linear], shape ``(R, H, W)`` or ``(H, W)``, float32; an array that stays on the disk where they were
            stored.
    """

    receivers: np.ndarray
    transmitters: np.ndarray
    frequency_hz: float
    path_gain: np.ndarray

    __repr__ = one_line

    def __len__(self) -> int:
        return len(np.atleast_2d(self.receivers))


@checked
@dataclass(frozen=True)
class Spectrum:
    """The spatial spectrum of one receiver, arrays ``(H, W)``, or of several, arrays ``(R, H, W)``.

    Attributes:
        path_gain: Path gain per pixel [linear], shape ``(H, W)``; NaN where not measured.
        delay_s: Delay of the pixel's strongest path [s], shape ``(H, W)``; NaN where empty.
        aod: Its zenith and azimuth of departure at the transmitter [rad], shape ``(H, W, 2)``; NaN where empty.
        floor: Noise floor N0 added before taking decibels [linear].
        range_db: Lowest and highest value of the data set's dB images [dB].
        std_db: Standard deviation of the dB image per pixel [dB], shape ``(H, W)``; None where it is not known.
        attributes: What else is known: ``transmitter``, ``frequency_hz``, ``beam_sigma_rad``, those of the air. Of several
            receivers that were stacked a list each.
    """

    __repr__ = one_line

    path_gain: np.ndarray
    delay_s: np.ndarray | None = None
    aod: np.ndarray | None = None
    floor: NotNegative = 0.0
    range_db: RangeDb | None = None
    std_db: np.ndarray | None = None
    attributes: dict[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        """Check shapes and values; ValueError or TypeError names the field."""
        shape = check_array("path_gain", self.path_gain, (..., None, None), finite=False).shape
        for name, value in self._arrays().items():
            if value is not None:
                least = 0.0 if name != "aod" else None
                check_array(name, value, (*shape, 2) if name == "aod" else shape, finite=False, least=least)
                object.__setattr__(self, name, np.asarray(value))
        if self.aod is not None:
            check_departures(self.aod)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.path_gain.shape[-2], self.path_gain.shape[-1]

    @property
    def batched(self) -> bool:
        """Whether the arrays are those of several receivers."""
        return self.path_gain.ndim > 2

    @classmethod
    def stack(cls, spectra: Sequence[Spectrum]) -> Spectrum:
        """Spectra of several receivers as one; floor and range are those of the first.

        Raises:
            TypeError, ValueError: for none, for what are no spectra, or not of one shape, and where only some have delays, say.
        """
        each, several = check_items("spectra", spectra, Spectrum, 1), dict[str, Any]()
        for name, first in each[0]._arrays().items():
            if len(shapes := {np.shape(getattr(one, name)) for one in each}) > 1:
                raise ValueError(
                    f"spectra: got {name} of shapes {shapes}, expected one; () where there is none"
                )
            several[name] = None if first is None else np.stack([getattr(one, name) for one in each])
        several["attributes"] = {n: [one.attributes.get(n) for one in each] for n in each[0].attributes}
        return replace(each[0], **several)

    def __getitem__(self, receiver: int) -> Spectrum:
        """The spectrum of one of several receivers."""
        if not self.batched:
            raise TypeError("spectrum: it is of one receiver, which has no index")
        own: dict[str, Any] = {n: None if a is None else a[receiver] for n, a in self._arrays().items()}
        own["attributes"] = {n: a[receiver] if isinstance(a, list) else a for n, a in self.attributes.items()}
        return replace(self, **own)

    def _arrays(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path_gain", "delay_s", "aod", "std_db")}

    @property
    def path_gain_db(self) -> np.ndarray:
        """10 log10(P + N0) [dB], shape of ``path_gain``."""
        return to_db(self.path_gain, self.floor)

    @property
    def total_path_gain(self) -> Any:
        """Sum over the pixels [linear]; shape ``(R,)`` for several receivers."""
        total = np.sum(self.path_gain, axis=(-2, -1), dtype=np.float64)
        return total if total.ndim else float(total)

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """Draw the dB image over azimuth and zenith [degrees] into ``ax`` (a new one by default); returns the axes.

        Raises:
            ImportError: if matplotlib is missing.
            ValueError: for spectra of several receivers.
        """
        if self.batched:
            raise ValueError(f"spectrum: got {len(self.path_gain)} receivers, expected one: spectrum[0]")
        pyplot = require("matplotlib.pyplot", extra="plots")
        if ax is None:
            _, ax = pyplot.subplots(figsize=(8.0, 4.0))
        low, high = self.range_db if self.range_db is not None else (None, None)
        drawing: dict[str, Any] = {"vmin": low, "vmax": high, "cmap": "viridis", "aspect": "auto", **options}
        image = ax.imshow(self.path_gain_db, extent=(-180.0, 180.0, 180.0, 0.0), **drawing)
        ax.set_xlabel("azimuth [degrees]")
        ax.set_ylabel("zenith [degrees]")
        ax.figure.colorbar(image, ax=ax, label="path gain [dB]")
        return ax
