"""Radio maps: what a link gets at every place of a floor plan.

A cell holds what a receiver at its centre gets, not the mean over the cell. Cells inside solids, outside the room, on a
surface or in the transmitter's reactive near field hold NaN: see :func:`warprrf.rf.positions.is_free`.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import numpy as np

from warprrf import netcdf_files
from warprrf.checks import Number, Positive, Shaped, check_array, checked, one_of
from warprrf.device import require
from warprrf.files import write_bytes
from warprrf.geometry.mesh import Mesh
from warprrf.netcdf_files import Variable
from warprrf.rf.maps.links import LinkOptions
from warprrf.rf.positions import NEAR_FIELD, Ends, check_positions, ground_height, is_free
from warprrf.rf.spectra.spectrum import to_db
from warprrf.tensor_files import named

_FORMAT = "warprrf radio map 1"
_LAYERS = {
    "total_path_gain": ("1", "total path gain"),
    "best_path_gain": ("1", "gain of the strongest path"),
    "delay_spread_s": ("s", "rms delay spread"),
    "best_beam_gain": ("1", "path gain times array gain of the best receive beam"),
}
QUANTITIES = {
    "total_path_gain": "total path gain [dB]",
    "best_path_gain": "best path's gain [dB]",
    "delay_spread_s": "delay spread [ns]",
    "best_beam_snr_db": "best beam's SNR [dB]",
}
"""What :meth:`RadioMap.plot` draws, and how the picture calls it."""


Layer: TypeAlias = Annotated[np.ndarray, Shaped("Y X", finite=False, least=0.0)]
Quantity: TypeAlias = Annotated[str, one_of(*QUANTITIES)]


@checked
@dataclass(frozen=True)
class RadioMap:
    """What receivers at the centres of cells get; rows go along y, columns along x, NaN outside the air.

    Attributes:
        x, y: centres of the cells [m], shapes ``(X,)`` and ``(Y,)``.
        height_m: of all of them; over ``ground_m`` where that is known.
        cell_m: width of a cell.
        transmitter: position [m], shape ``(3,)``.
        frequency_hz: carrier [Hz].
        total_path_gain: sum over all paths between isotropic antennas [linear], shape ``(Y, X)``.
        best_path_gain: of the strongest path [linear], shape ``(Y, X)``.
        delay_spread_s: root mean square, weighted by power [s], shape ``(Y, X)``.
        best_beam_gain: path gain times array gain of the receiver's beam in its best direction [linear], shape
            ``(Y, X)``; the transmitter is isotropic.
        beam_sigma_rad: width of that beam [rad].
        transmit_power_dbm: of the transmitter, equally strong in all directions [dBm].
        noise_power_dbm: of the receiver, k T B F [dBm].
        outline: floor plan, line segments where the mesh meets this height [m], shape ``(S, 2, 2)``.
        ground_m: height of the ground in each cell [m], shape ``(Y, X)``, NaN where there is none; None if heights are
            coordinates.
    """

    x: Annotated[np.ndarray, Shaped("X")] = field(repr=False)
    y: Annotated[np.ndarray, Shaped("Y")] = field(repr=False)
    height_m: Number
    cell_m: Positive
    transmitter: Annotated[np.ndarray, Shaped("3")]
    frequency_hz: Positive
    total_path_gain: Layer = field(repr=False)
    best_path_gain: Layer = field(repr=False)
    delay_spread_s: Layer = field(repr=False)
    best_beam_gain: Layer = field(repr=False)
    beam_sigma_rad: Positive
    transmit_power_dbm: Number
    noise_power_dbm: Number
    outline: Annotated[np.ndarray, Shaped("S 2 2")] = field(repr=False)
    ground_m: Annotated[np.ndarray, Shaped("Y X", finite=False)] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check that the cells are as wide as is said; ValueError names their axis."""
        for name, centres in (("x", self.x), ("y", self.y)):
            if not (np.abs(np.diff(centres) - self.cell_m) < 1e-3 * self.cell_m).all():
                raise ValueError(f"{name}: got {centres}, expected steps of cell_m, {self.cell_m:g} m")

    @property
    def free(self) -> np.ndarray:
        """Whether a cell's centre lies in the air, shape ``(Y, X)``."""
        return np.isfinite(self.total_path_gain)

    @property
    def positions(self) -> np.ndarray:
        """Centres of the cells [m], shape ``(Y, X, 3)``."""
        x, y = np.meshgrid(self.x, self.y)
        return _places(x, y, self.height_m, self.ground_m)

    @property
    def best_beam_snr_db(self) -> np.ndarray:
        """Signal-to-noise ratio of the best beam [dB], shape ``(Y, X)``; another budget shifts it by a constant."""
        return self.transmit_power_dbm + to_db(self.best_beam_gain) - self.noise_power_dbm

    def plot_values(self, quantity: Quantity) -> np.ndarray:
        """``quantity`` as it is drawn: gains in dB, delay spread in ns, shape ``(Y, X)``.

        Raises:
            ValueError: for a quantity that is not one of :data:`QUANTITIES`.
        """
        value: np.ndarray = getattr(self, quantity)
        if quantity == "delay_spread_s":
            return value * 1e9
        return value if quantity.endswith("_db") else to_db(value)

    def plot(self, quantity: str = "total_path_gain", ax: Any = None, **options: Any) -> Any:
        """Draw one quantity over the floor plan into ``ax`` (a new one by default); returns the axes.

        Args:
            quantity: one of :data:`QUANTITIES`.
            options: for matplotlib's ``imshow``.

        Raises:
            ImportError: if matplotlib is missing.
            ValueError: for an unknown quantity.
        """
        value = self.plot_values(quantity)
        if ax is None:
            pyplot = require("matplotlib.pyplot", extra="plots")
            _, ax = pyplot.subplots(figsize=(8.0, 6.0), layout="constrained")
        half = 0.5 * self.cell_m
        box = (self.x[0] - half, self.x[-1] + half, self.y[0] - half, self.y[-1] + half)
        drawing: dict[str, Any] = {"cmap": "viridis", "origin": "lower", "interpolation": "nearest"} | options
        image = ax.imshow(value, extent=box, **drawing)
        if len(self.outline):
            ax.plot(*self.outline.transpose(2, 1, 0), color="#222222", linewidth=1.0)
        ax.plot(*self.transmitter[:2], marker="*", markersize=14, color="#d7263d", markeredgecolor="white")
        ax.set_aspect("equal")
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
        ax.figure.colorbar(image, ax=ax, label=QUANTITIES[quantity], shrink=0.8)
        return ax

    def picture(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG of all four quantities, whole or not at all.

        Raises:
            ImportError: if matplotlib is missing.
        """
        figure = require("matplotlib.figure", extra="plots").Figure(figsize=(13.0, 9.0), layout="constrained")
        for ax, (quantity, name) in zip(figure.subplots(2, 2).flat, QUANTITIES.items(), strict=True):
            self.plot(quantity, ax=ax)
            ax.set_title(name, fontsize=11)
        budget = f"{self.transmit_power_dbm:g} dBm transmitted, noise {self.noise_power_dbm:.1f} dBm"
        figure.suptitle(
            f"{self.frequency_hz / 1e9:g} GHz at {self.height_m:g} m, cells of {self.cell_m:g} m; receive beam of "
            f"{np.rad2deg(self.beam_sigma_rad):.3g} degrees, {budget}",
            fontsize=11,
        )
        picture = io.BytesIO()
        figure.savefig(picture, dpi=110, format="png")
        write_bytes(path, picture.getbuffer())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a NetCDF-4 file, whole or not at all: the four quantities over ``y`` and ``x``, and the outline."""
        attributes = {name: getattr(self, name) for name in _PLAIN} | {"format": _FORMAT}
        netcdf_files.write(path, netcdf_files.encoded(vars(self), _VARIABLES), _VARIABLES, {}, attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> RadioMap:
        """Read what :meth:`save` wrote.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged, or holds something else.
        """
        arrays, attributes = netcdf_files.read(path, _VARIABLES, {}, _FORMAT)
        with named(path, "damaged, or no radio map"):
            for axis, name in enumerate(("y", "x")):
                order = np.argsort(arrays[name])  # as another tool may have turned it
                for held in {name, *_LAYERS, "ground_m"} & set(arrays):
                    arrays[held] = arrays[held].take(order, axis=min(axis, arrays[held].ndim - 1))
            fields: dict[str, Any] = {**arrays, **{name: attributes[name] for name in _PLAIN}}
            return cls(**fields)


_PLAIN = ("height_m", "cell_m", "frequency_hz", "beam_sigma_rad", "transmit_power_dbm", "noise_power_dbm")
_VARIABLES = {
    **{name: Variable(("y", "x"), unit, {"long_name": text}) for name, (unit, text) in _LAYERS.items()},
    **{name: Variable((name,), "m", {"long_name": "centre of the cell"}) for name in ("x", "y")},
    "outline": Variable(("segment", "end", "xy"), "m"),
    "ground_m": Variable(("y", "x"), "m", {"long_name": "height of the ground"}, optional=True),
    "transmitter": Variable(("xyz",), "m"),
}


@checked
@dataclass(frozen=True)
class MapOptions(LinkOptions):
    """How a radio map is made: how links are found, and

    Attributes:
        bounds: lowest x and y, highest x and y [m]; the mesh's by default. The grid starts at the lowest.
        above_ground: whether heights count from the ground, the lowest surface of each cell, instead of z = 0.
        transmit_power_dbm: of the isotropic transmitter.
        bandwidth_hz: of the noise, k T B at 290 K; one channel of IEEE 802.15.3d by default.
        noise_figure_db: of the receiver.
    """

    bounds: Any = None
    above_ground: bool = False
    transmit_power_dbm: Number = 20.0
    bandwidth_hz: Positive = 2.16e9
    noise_figure_db: Number = 10.0

    @property
    def noise_power_dbm(self) -> float:
        """Of the receiver, k T B F [dBm]."""
        boltzmann = 1.380649e-23  # SI [J/K]
        room_temperature_k = 290.0  # at which noise figures are stated (ITU-R P.372)
        noise_w = boltzmann * room_temperature_k * self.bandwidth_hz
        return float(10.0 * np.log10(noise_w) + 30.0 + self.noise_figure_db)


@checked
def radio_map(
    field: Any,
    height: Number,
    cell: Positive = 0.25,
    transmitter: Any = None,
    options: MapOptions | None = None,
) -> RadioMap:
    """Links at the centres of cells over a floor plan.

    Cells are left out that the field's mesh takes for solid; see :func:`warprrf.rf.positions.is_free`.

    Args:
        field: a :class:`warprrf.RadioField` with a mesh.
        height: of the receivers [m]: z, or over the ground if ``options`` say so.
        transmitter: position (3,) [m] if another than the fitted one.
        options: bounds, ground, beam, budget and rays.

    Raises:
        ValueError: for a height outside the mesh, a cell that is not positive or makes more than two million, a field
            without a mesh, bounds without a cell in the air, a beam, power or bandwidth out of range, or a transmitter
            that is outside the scene or on a surface.
    """
    mesh, o = field.mesh, options or MapOptions()
    if not isinstance(mesh, Mesh):
        raise ValueError("field: got one without a mesh, expected one that knows walls from air")
    source = field.transmitter if transmitter is None else transmitter
    source = check_array("transmitter", source, (3,)).copy()
    nobody = np.zeros((0, 3))
    check_positions(mesh, source, nobody, field.wavelength_m, known=field.transmitter, device=field.device)
    low, high = mesh.bounds[:, 2] - (mesh.bounds[0, 2] if o.above_ground else 0.0)
    if not low < height < high:
        raise ValueError(f"height: got {height!r} m, expected {low:.3g} to {high:.3g} m")
    x, y = _centres(mesh, cell, o.bounds)
    across, along = np.meshgrid(x, y)
    ground = ground_height(mesh, across, along, device=field.device) if o.above_ground else None
    places = _places(across, along, height, ground)
    free = is_free(mesh, places.reshape(-1, 3), source, device=field.device).reshape(across.shape)
    free &= np.linalg.norm(places - source, axis=-1) > NEAR_FIELD * field.wavelength_m
    if not free.any():
        raise ValueError(f"bounds: no cell of the {free.size} at {height!r} m lies in the air")
    links = field.trace_links(Ends.of(places[free], source), o)
    layers = {}
    for name in _LAYERS:
        layers[name] = np.full(free.shape, np.nan)
        layers[name][free] = getattr(links, name)
    return RadioMap(
        x=x,
        y=y,
        height_m=height,
        cell_m=cell,
        transmitter=source,
        frequency_hz=field.frequency_hz,
        beam_sigma_rad=o.beam_sigma_rad,
        transmit_power_dbm=o.transmit_power_dbm,
        noise_power_dbm=o.noise_power_dbm,
        outline=mesh.cross_section(float(np.median(places[free][:, 2]))),
        ground_m=ground,
        **layers,
    )


def _places(x: np.ndarray, y: np.ndarray, height: float, ground: np.ndarray | None) -> np.ndarray:
    """Places at ``height`` [m] over the ``ground``, where there is one, shape ``(Y, X, 3)``."""
    return np.stack([x, y, np.full_like(x, height) + (0.0 if ground is None else ground)], axis=-1)


def _centres(mesh: Mesh, cell: float, bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the cells along x and y [m]."""
    low, high = mesh.bounds[:, :2] if bounds is None else check_array("bounds", bounds, (4,)).reshape(2, 2)
    if not (low < high).all():
        raise ValueError(f"bounds: got {bounds!r}, expected lowest x and y, then higher x and y")
    counts = np.maximum(np.ceil((high - low) / cell - 1e-6), 1.0)
    most_cells = 2_000_000
    if counts.prod() > most_cells:
        raise ValueError(
            f"cell: got {cell!r} m, which makes {counts.prod():.0f} cells; expected at most {most_cells}: give wider "
            "cells, or bounds of a part"
        )
    x, y = (start + cell * (np.arange(int(n)) + 0.5) for start, n in zip(low, counts, strict=True))
    return x, y
