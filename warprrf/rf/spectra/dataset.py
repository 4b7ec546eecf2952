"""A set of spectra of one transmitter: what it holds, how it is split for training, what is measured out of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from warprrf.checks import Seed, Shaped, check_array, check_chosen, check_count, checked, positive, whole
from warprrf.device import DeviceLike, Progress
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import Hertz
from warprrf.rf.spectra import dataset_files
from warprrf.rf.spectra.antenna import Pattern
from warprrf.rf.spectra.deembedding import deembed
from warprrf.rf.spectra.levels import free_space_gain, question_levels
from warprrf.rf.spectra.spectrum import (
    BEAM_SIGMA_RAD,
    DEFAULT_SHAPE,
    Floor,
    GridShape,
    RangeDb,
    Spectrum,
    SpreadPaths,
    check_departures,
    check_shape,
    check_whole,
    default_floor,
    pixel_directions,
    spread_paths,
    to_db,
)

POLARISATION = "mean over vertical and horizontal transmit, sum over both receive polarisations"


BeamWidth: TypeAlias = Annotated[float, positive("beam width in radians")]
Flags: TypeAlias = Annotated[np.ndarray, lambda name, value: _check_flags(name, value), Shaped("R", np.bool_)]


@runtime_checkable
class PathsLike(Protocol):
    """Paths of one receiver, arrays ``(L,)``, or of several, ``(R, L)``: what tells :class:`warprrf.Paths`."""

    transmitter: np.ndarray | None
    receiver: np.ndarray | None
    frequency_hz: float | None
    air: Air | None

    def each(self) -> Iterator[PathsLike]:
        """The paths of one receiver after another."""


@dataclass(frozen=True)
class Received:
    """What one receiver gets, as pixels.

    Attributes:
        path_gain: Path gain per pixel [linear], shape ``(H, W)``, float64.
        delay_s: Delay of the pixel's strongest path [s], shape ``(H, W)``; NaN where empty.
        aod: Its zenith and azimuth of departure [rad], shape ``(H, W, 2)``; NaN where empty.
        line_of_sight: Whether the transmitter is seen.
    """

    path_gain: np.ndarray
    delay_s: np.ndarray
    aod: np.ndarray
    line_of_sight: bool

    @classmethod
    def of(
        cls, paths: Any, shape: tuple[int, int], beam_sigma_rad: float, device: DeviceLike = None
    ) -> Received:
        """:class:`PathsLike` of one receiver, spread by its beam."""
        spread = spread_paths(paths.arrival, paths.power, shape, beam_sigma_rad, device=device)
        aod = spread.of_strongest(np.column_stack([paths.theta_t, paths.phi_t]))
        line_of_sight = bool((paths.kind == "los").any())
        return cls(spread.path_gain, spread.of_strongest(paths.tau), aod, line_of_sight)

    @staticmethod
    def columns(found: Sequence[Received]) -> dict[str, Any]:
        """Those of several receivers, stacked by name."""
        return {f.name: np.stack([getattr(one, f.name) for one in found]) for f in fields(Received)}


@checked
@dataclass(frozen=True)
class SpectrumDataset:
    """Spectra at R receivers.

    Attributes:
        receivers: Positions [m], shape ``(R, 3)``, float64.
        transmitter: Position [m], shape ``(3,)``, float64.
        frequency_hz: Carrier frequency [Hz].
        path_gain: Path gain per pixel [linear], shape ``(R, H, W)``, float32; NaN where not measured.
        delay_s: Delay of the pixel's strongest path [s], shape ``(R, H, W)``, float64; NaN where empty.
        aod: Its zenith and azimuth of departure [rad], shape ``(R, H, W, 2)``, float32; NaN where empty.
        floor: Noise floor N0 that dB images add [linear].
        range_db: 10 log10 N0 and the highest value of the dB images [dB].
        beam_sigma_rad: Width of the receiver beam, kappa = 1 / sigma^2 [rad].
        engine: what they come from: "exact" or "sionna" where simulated, "paths", or "measured".
        polarisation: What is averaged and summed.
        seed: Seed of the engine.
        role: "train" or "test" for each receiver, shape ``(R,)``.
        line_of_sight: Whether the receiver sees the transmitter, shape ``(R,)``, bool.
        attributes: Anything else worth keeping: depth, samples, versions; the air (:attr:`air`). Text, numbers and
            lists of them, under names that the file does not need itself.
    """

    receivers: Annotated[np.ndarray, Shaped("R 3")]
    transmitter: Annotated[np.ndarray, Shaped("3")]
    frequency_hz: Hertz
    path_gain: Annotated[np.ndarray, Shaped("R H W", np.float32, finite=False, least=0.0)]
    delay_s: Annotated[np.ndarray, Shaped("R H W", finite=False, least=0.0)]
    aod: Annotated[np.ndarray, Shaped("R H W 2", np.float32, finite=False)]
    floor: Floor
    range_db: RangeDb
    beam_sigma_rad: BeamWidth
    engine: str
    polarisation: str
    seed: Seed
    role: NDArray[np.str_]
    line_of_sight: Flags
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and values; ValueError or TypeError names the field."""
        check_shape(self.shape)
        check_departures(self.aod)
        for name in ("receivers", "transmitter"):  # callers may move theirs on in place
            object.__setattr__(self, name, getattr(self, name).copy())
        object.__setattr__(self, "role", _check_roles(self.role, len(self)))
        object.__setattr__(self, "attributes", _check_attributes(self.attributes))

    def __repr__(self) -> str:
        train = int((self.role == "train").sum())
        rows, columns = self.shape
        return (
            f"SpectrumDataset({len(self)} receivers: {train} train, {len(self) - train} test; {rows} x {columns} pixels "
            f"of {self.engine!r} at {self.frequency_hz / 1e9:g} GHz, beam {np.rad2deg(self.beam_sigma_rad):.3g} degrees, "
            f"range {self.range_db[0]:.1f} to {self.range_db[1]:.1f} dB, transmitter {self.transmitter.tolist()} m)"
        )

    @classmethod
    def from_spectra(
        cls,
        *,
        receivers: Annotated[np.ndarray, Shaped("R 3")],
        transmitter: Annotated[np.ndarray, Shaped("3")],
        frequency_hz: Hertz,
        path_gain: Annotated[np.ndarray, Shaped("R H W", np.float32, finite=False, least=0.0)],
        delay_s: np.ndarray | None = None,
        aod: np.ndarray | None = None,
        line_of_sight: np.ndarray | None = None,
        beam_sigma_rad: BeamWidth,
        engine: str = "measured",
        seed: Seed = 0,
        role: Sequence[str] | NDArray[np.str_] | None = None,
        floor: Floor | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> SpectrumDataset:
        """A data set with N0, its dB range and, if none are given, roles chosen for it.

        Args:
            path_gain: NaN where nothing was measured.
            delay_s, aod: None where they were not measured.
            line_of_sight: if None, receivers are taken to see the transmitter where half the power of free space or more
                comes from its direction.
            floor: if None, 60 dB below the median spectrum's strongest pixel.

        The other arguments are the attributes of those names.

        Raises:
            TypeError, ValueError: naming the argument; spectra that sum to as much as was transmitted are refused.

        Warns:
            UserWarning: naming receivers that get far more than line of sight would give; see
                :data:`~warprrf.rf.spectra.levels.MARGIN_DB`.
        """
        gain = path_gain
        if len(gain) == 0 or np.isnan(gain).all():
            raise ValueError("path_gain: got no spectra, expected one receiver's or more")
        if line_of_sight is None:
            line_of_sight = _sees(receivers, transmitter, gain, frequency_hz, beam_sigma_rad)
        noise = default_floor(gain) if floor is None else floor
        found = cls(
            receivers=receivers,
            transmitter=transmitter,
            frequency_hz=frequency_hz,
            path_gain=gain,
            delay_s=np.full(gain.shape, np.nan) if delay_s is None else delay_s,
            aod=np.full((*gain.shape, 2), np.nan) if aod is None else aod,
            floor=noise,
            range_db=(10.0 * float(np.log10(noise)), float(to_db(np.nanmax(gain), noise))),
            beam_sigma_rad=beam_sigma_rad,
            engine=engine,
            polarisation=POLARISATION,
            seed=seed,
            role=assign_roles(len(gain), seed=seed) if role is None else role,  # type: ignore[arg-type]
            line_of_sight=line_of_sight,
            attributes={} if attributes is None else attributes,
        )
        question_spectra(found)
        return found

    @classmethod
    def from_paths(
        cls,
        paths: PathsLike,
        *,
        shape: GridShape = DEFAULT_SHAPE,
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        floor: float | None = None,
        role: Sequence[str] | NDArray[np.str_] | None = None,
        seed: int = 0,
        device: DeviceLike = None,
    ) -> SpectrumDataset:
        """Spectra of paths: each path's gain spread by the receiver's beam; delay and departure of each pixel's strongest.

        Args:
            paths: :class:`warprrf.Paths` of one transmitter at one receiver or several, with their positions and carrier:
                of :func:`trace_paths`, a field, or Sionna RT (:meth:`Paths.from_sionna`).
            shape: rows and columns of a spectrum.
            beam_sigma_rad: width of the receiver's beam.
            floor, role, seed: as for :meth:`from_spectra`.
            device: where paths are spread.

        Raises:
            ValueError: for paths without positions or carrier, or of several transmitters.

        Example::

            paths = wr.trace_paths(scene, transmitter=tx, receivers=places, frequency_hz=28e9, mirror_order=2)
            ds = wr.SpectrumDataset.from_paths(paths)
        """
        if paths.receiver is None or paths.transmitter is None or paths.frequency_hz is None:
            raise ValueError(
                "paths: got ones without receiver, transmitter or frequency_hz, expected all three "
                "(dataclasses.replace(paths, receiver=...) adds one)"
            )
        if np.ndim(paths.transmitter) != 1:
            raise ValueError("paths: got ones of several transmitters, expected those of one")
        found = [Received.of(p, shape, beam_sigma_rad, device) for p in paths.each()]
        return cls.from_spectra(
            receivers=np.atleast_2d(paths.receiver),
            transmitter=paths.transmitter,
            frequency_hz=paths.frequency_hz,
            **Received.columns(found),
            beam_sigma_rad=beam_sigma_rad,
            engine="paths",
            seed=seed,
            role=role,
            floor=floor,
            attributes=None if paths.air is None else paths.air.attributes,
        )

    @classmethod
    def empty(
        cls,
        *,
        transmitter: ArrayLike,
        frequency_hz: Hertz,
        shape: GridShape = DEFAULT_SHAPE,
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        floor: Floor | None = None,
    ) -> SpectrumDataset:
        """A data set before the first measurement: a field that is fitted to it is what is known without any.

        Args:
            transmitter: position [m], shape ``(3,)``.
            frequency_hz: carrier [Hz].
            shape: rows and columns of spectra.
            beam_sigma_rad: width of the receiver's beam.
            floor: N0; if None, 60 dB below free space's path gain over 10 m, usual in a room.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        away = np.array([10.0, 0.0, 0.0])
        strongest = float(free_space_gain(away, np.zeros(3), frequency_hz))
        noise = 1e-6 * strongest if floor is None else floor
        return cls(
            receivers=np.zeros((0, 3)), transmitter=check_array("transmitter", transmitter, (3,)),
            frequency_hz=frequency_hz, path_gain=np.zeros((0, *shape)),
            delay_s=np.zeros((0, *shape)), aod=np.zeros((0, *shape, 2)), floor=noise,
            range_db=(10.0 * float(np.log10(noise)), 10.0 * float(np.log10(max(noise, strongest)))),
            beam_sigma_rad=beam_sigma_rad, engine="none", polarisation=POLARISATION, seed=0,
            role=np.zeros(0, "<U5"), line_of_sight=np.zeros(0, bool),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.receivers)

    def __getitem__(self, index: int) -> Spectrum:
        """The spectrum of one receiver.

        Raises:
            IndexError: for a receiver that there is not.
            TypeError: for anything but a whole number.
        """
        if isinstance(index, bool) or not isinstance(index, int | np.integer):
            raise TypeError(f"index: got {index!r}, expected a whole number; subset() takes several")
        of_all = ("transmitter", "frequency_hz", "beam_sigma_rad", "engine")
        attributes = {**self.attributes, "receiver": self.receivers[index]}
        attributes |= {name: getattr(self, name) for name in of_all}
        arrays = self.path_gain[index], self.delay_s[index], self.aod[index]
        return Spectrum(*arrays, self.floor, self.range_db, attributes=attributes)

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a spectrum."""
        return self.path_gain.shape[1], self.path_gain.shape[2]

    @property
    def air(self) -> Air | None:
        """The air whose absorption is in the path gains, by the attributes ``air_...``; None for none."""
        return Air.from_attributes(self.attributes)

    @property
    def path_gain_db(self) -> np.ndarray:
        """10 log10(P + N0) [dB], shape ``(R, H, W)``, float64."""
        return to_db(self.path_gain, self.floor)

    def subset(self, indices: ArrayLike) -> SpectrumDataset:
        """The receivers named by ``indices`` (whole numbers or a mask); floor and range stay those of the whole set."""
        chosen = check_chosen("indices", indices, len(self))
        per_receiver = ("receivers", "path_gain", "delay_s", "aod", "role", "line_of_sight")
        return replace(self, **{name: getattr(self, name)[chosen] for name in per_receiver})

    def split(self, n_train: int, seed: Seed = 0) -> tuple[SpectrumDataset, SpectrumDataset]:
        """``n_train`` training receivers and all test receivers.

        Subsets are nested: a larger ``n_train`` holds the smaller one. Seed 0 takes training receivers in the order of
        the file, which for the lobby is that of the full data set; other seeds take them in another order. The test
        receivers are always the same.

        Raises:
            ValueError: if the set has fewer training receivers, or no test receivers.
        """
        train, test = np.flatnonzero(self.role == "train"), np.flatnonzero(self.role == "test")
        check_count("n_train", n_train, most=len(train))
        if len(test) == 0:
            raise ValueError("role: there are no test receivers; give simulate(..., roles=) some")
        if seed != 0:
            train = np.random.default_rng(seed).permutation(train)
        return self.subset(train[:n_train]), self.subset(test)

    def deembed(
        self,
        pattern: Pattern,
        *,
        boresight_gain_dbi: float | None = None,
        noise: float = 0.0,
        progress: Progress | None = None,
        **options: Any,
    ) -> SpectrumDataset:
        """These spectra without the antenna that measured them.

        A *scanned* antenna was steered to every pixel centre, and a pixel holds what it received there over what was
        transmitted: path gain times antenna gain, summed over all directions. ``pattern`` is then an antenna whose gain
        is one over the angle off boresight [rad] (:func:`horn`), a function of it, or samples ``(N,)`` from 0 to pi, both
        included. The result is spread by ``beam_sigma_rad``, and its sum is the total path gain between isotropic
        antennas: that of ``sum over pixels of (value - noise) times solid angle / integral of the pattern over the
        sphere``; a spectrum of which noise leaves nothing comes out empty.

        A *fixed* antenna did not turn, and directions were distinguished otherwise. ``pattern`` is then its gain in each
        pixel's direction, ``(H, W)`` (:meth:`Antenna.gain`): pixels are divided by it. Where it lies more than
        ``limit_db`` below its peak nothing is known: those pixels become empty, and the sum is that of the others.

        Delay and angle of departure are those measured in the direction that gives a pixel most of its power. Floor
        and range are chosen anew, and where the spectra had said who sees the transmitter, they say it anew;
        attributes ``deembedded...`` say what was done.

        Args:
            pattern: Linear power gain over isotropic; see above.
            boresight_gain_dbi: Scales the pattern to this gain at its strongest: 0 where measurements had the
                boresight gain divided out.
            noise: Mean noise power in every value of a scan [linear, over transmitted power].
            progress: Called once a receiver with the stage ``"deembed"``.
            **options: For a scan ``snapshots`` (1, over which each value's noise was averaged), ``iterations`` (2000),
                ``tolerance`` (1e-3) and ``device``; for a fixed antenna ``limit_db`` (20).

        Raises:
            TypeError: on a pattern that does not read as numbers, or an option of the other kind of antenna.
            ValueError: on negative, NaN or infinite gains, a scanned antenna without directivity, another shape.
        """
        check_whole("path_gain", self.path_gain)
        options |= {"boresight_gain_dbi": boresight_gain_dbi, "noise": noise, "progress": progress}
        done = deembed(self.path_gain, pattern, self.beam_sigma_rad, **options)
        each = [SpreadPaths(*one) for one in zip(done.path_gain, done.source, strict=True)]
        delay = [one.of_strongest(own.ravel()) for one, own in zip(each, self.delay_s, strict=True)]
        aod = [one.of_strongest(own.reshape(-1, 2)) for one, own in zip(each, self.aod, strict=True)]
        gain, count = done.path_gain.astype(np.float32), len(each)
        floor = default_floor(gain) if gain.any() else self.floor
        ends, beam = (self.receivers, self.transmitter), (self.frequency_hz, self.beam_sigma_rad)
        guessed = np.array_equal(self.line_of_sight, _sees(*ends, self.path_gain, *beam))
        stated = "as the pattern states" if boresight_gain_dbi is None else float(boresight_gain_dbi)
        return replace(
            self,
            path_gain=gain,
            line_of_sight=_sees(*ends, gain, *beam) if guessed else self.line_of_sight,
            delay_s=np.reshape(delay, self.delay_s.shape),
            aod=np.reshape(aod, self.aod.shape),
            floor=floor,
            range_db=(10.0 * float(np.log10(floor)), float(to_db(gain.max(initial=0.0), floor))),
            attributes={
                **self.attributes,
                "deembedded": done.method,
                "deembedded_boresight_gain_dbi": stated,
                "deembedded_noise": float(noise),
                "deembedded_share_of_sphere": done.covered,
                "deembedded_steps_median": float(np.median(done.steps)) if count else 0.0,
                "deembedded_misfit_median": float(np.median(done.misfit)) if count else 0.0,
            },
        )

    def save(self, path: str | os.PathLike[str], compact: bool = False) -> None:
        """Write NetCDF-4, whole or not at all.

        Args:
            path: File to write or replace.
            compact: Round mantissas first: path gain to 0.4 % or N0 / 128, the larger, delay to 0.91 ps, AoD to
                4.9e-4 rad. The dB image moves by at most 0.04 dB, and the file says so.
        """
        dataset_files.write(path, vars(self), compact=compact)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SpectrumDataset:
        """Read what :meth:`save` wrote.

        Dimensions and coordinates may stand in another order, as other tools leave them.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged, no NetCDF file of spectra, or holds what no data set may.

        Warns:
            UserWarning: as :meth:`from_spectra`.
        """
        values = dataset_files.read(path)
        try:
            found = cls(**values)
            question_spectra(found)
            return found
        except (TypeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from error

    def export_exr(self, path: str | os.PathLike[str], index: int) -> None:
        """Write one spectrum as OpenEXR: channels path_gain, delay, aod_zenith, aod_azimuth, 32-bit.

        Numbers in the header are text, because EXR headers hold 32-bit floats only.
        """
        spectrum = self[check_count("index", index, -len(self), len(self) - 1)]
        attributes = {**spectrum.attributes, "polarisation": self.polarisation}
        dataset_files.export_exr(path, replace(spectrum, attributes=attributes))


@checked
def assign_roles(count: Annotated[int, whole(0)], *, test: int | None = None, seed: Seed = 0) -> np.ndarray:
    """ "train" or "test" for each of ``count`` receivers, ``test`` of them (an eighth by default) drawn at random."""
    wanted = count // 8 if test is None else check_count("test", test, least=0, most=count)
    role = np.full(count, "train", dtype="<U5")
    role[np.random.default_rng(seed).choice(count, wanted, replace=False)] = "test"
    return role


def question_spectra(ds: SpectrumDataset) -> None:
    """Question spectra that hold too much power; see :func:`~warprrf.rf.spectra.levels.question_levels`."""
    total = np.asarray(np.nansum(ds.path_gain, axis=(1, 2), dtype=np.float64))
    free_space = free_space_gain(ds.transmitter, ds.receivers, ds.frequency_hz)
    hint = "; or the gain of an antenna is in them (SpectrumDataset.deembed takes it out)"
    question_levels("path_gain", total, free_space, hint=hint)


def _sees(
    receivers: np.ndarray, transmitter: np.ndarray, gain: np.ndarray, frequency_hz: float, sigma_rad: float
) -> np.ndarray:
    """Whether half the power of free space or more comes from the transmitter's direction, shape ``(R,)``."""
    way = transmitter - receivers
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    cosine = np.einsum("hwc,rc->rhw", pixel_directions(gain.shape[1:]), way / length[:, None])
    near = cosine > np.cos(max(3.0 * sigma_rad, 2.0 * np.pi / min(gain.shape[1:])))
    received = np.where(near, np.nan_to_num(gain), 0.0).sum(axis=(1, 2))
    return received >= 0.5 * free_space_gain(transmitter, receivers, frequency_hz)


def measured_at(ds: SpectrumDataset, receivers: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """Which spectra of ``ds`` are of ``receivers`` (K, 3) under ``transmitter`` [m], (3,) or that of each (K, 3), shape
    ``(R,)`` bool."""
    same_m = 1e-3  # a spectrum measured this near is the same one
    under = np.broadcast_to(transmitter, receivers.shape)
    own = receivers[np.linalg.norm(under - ds.transmitter, axis=1) <= same_m]
    if len(own) == 0:
        return np.zeros(len(ds.receivers), dtype=bool)
    return cKDTree(own).query(ds.receivers)[0] <= same_m


def _check_roles(role: ArrayLike, count: int) -> np.ndarray:
    found = np.asarray(role)
    if found.shape != (count,) or not np.isin(found, ("train", "test")).all():
        held = f" of {', '.join(sorted(map(repr, found.astype(str).tolist())))[:80]}" * (found.ndim == 1)
        raise ValueError(f"role: got shape {found.shape}{held}, expected ({count},) of 'train' and 'test'")
    return found.astype("<U5")


def _check_flags(name: str, value: np.ndarray) -> np.ndarray:
    found = check_array(name, value)
    wrong = found[~np.isin(found, (0.0, 1.0))]
    if wrong.size:
        raise ValueError(f"{name}: got {wrong[0]:g}, expected True and False")
    return found


def _check_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """What a file can hold beside the fields, under names of its own."""
    most_attribute_bytes = 60_000  # HDF5 takes 64 kB
    for name, value in attributes.items():
        if not isinstance(name, str) or not name or name.startswith("_") or {"/", "\0"} & set(name):
            raise ValueError(f"attributes: got the name {name!r}, expected text without / or a leading _")
        if name in dataset_files.RESERVED:
            raise ValueError(f"attributes: got {name!r}, which the file needs itself; take another name")
        held = np.asarray(value)
        if held.dtype.kind not in "biufU" or held.ndim > 1 or held.nbytes > most_attribute_bytes:
            raise TypeError(
                f"attributes: {name!r} is a {type(value).__name__}, expected text, a number, or a short list of these"
            )
        if "\0" in "".join(held.astype(str).ravel()):
            raise ValueError(f"attributes: {name!r} holds a zero character, expected text without")
    return dict(attributes)
